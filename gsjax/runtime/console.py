"""Output of programs: results on stdout; progress, warnings and errors on stderr."""

import re
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")
# Control characters, and those that change the direction of text; not line breaks and
# tabs.
_CONTROLS = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def say(line: str) -> None:
    """Print a result line, above the progress bar if there is one."""
    from tqdm import tqdm

    tqdm.write(escape_controls(line), file=sys.stdout)


def note(line: str) -> None:
    """Print a line on stderr, above the progress bar if there is one."""
    from tqdm import tqdm

    tqdm.write(f"gsjax: {escape_controls(line)}", file=sys.stderr)


def progress(items: Sequence[T], label: str) -> Iterator[T]:
    """Iterate with a progress bar; if stderr is no terminal, a line every 2 s."""
    if sys.stderr.isatty():
        from tqdm import tqdm

        yield from tqdm(items, desc=label, leave=False)
        return
    last = time.monotonic()
    for done, item in enumerate(items, 1):
        yield item
        if done == len(items) or time.monotonic() > last + 2:
            last = time.monotonic()
            note(f"{label} {done}/{len(items)}")


def escape_controls(text: str) -> str:
    """Escape the characters that a terminal would interpret."""
    return _CONTROLS.sub(lambda found: repr(found[0])[1:-1], text)


def one_line(text: object, most: int | None = None) -> str:
    """Return text without line breaks and control characters.

    Args:
      text: any object.
      most: number of characters beyond which the middle is left out; None for no limit.
    """
    line = escape_controls(" ".join(str(text).split()))
    if most is None or len(line) <= most:
        return line
    return f"{line[: most // 2]} […] {line[-most // 2 :]}"


def decibels(value: float | None) -> str:
    """Format a PSNR; None stands for infinity, that of equal images."""
    return "∞ dB" if value is None or value == float("inf") else f"{value:.2f} dB"


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Within, the first Ctrl-C only sets a flag; a second one interrupts as usual.

    Nothing changes outside the main thread, if Ctrl-C is ignored (as in background
    processes of a script), or if another library handles it.

    Yields:
      A function that returns the flag.
    """
    requested = False
    previous = signal.getsignal(signal.SIGINT)
    main = threading.current_thread() is threading.main_thread()
    if not main or previous in (signal.SIG_IGN, None):
        yield lambda: False
        return

    def handle(*_):
        nonlocal requested
        if requested:
            raise KeyboardInterrupt
        requested = True
        note("stopping after this step; press Ctrl-C again to stop at once")

    signal.signal(signal.SIGINT, handle)
    try:
        yield lambda: requested
    finally:
        signal.signal(signal.SIGINT, previous)


@contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Within, print warnings as lines ``gsjax: warning: …`` on stderr."""

    def show(message, *_):
        note(f"warning: {one_line(message)}")

    with warnings.catch_warnings():
        # User warnings are always shown; others as the filters say.
        warnings.filterwarnings("always", category=UserWarning)
        warnings.showwarning = show
        yield
