"""What programs say: results on stdout; progress, warnings and errors on stderr."""

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
# What a terminal obeys instead of showing it: control characters, and those that turn
# the direction of text. Line breaks and tabs are neither.
_OBEYED = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def say(line: str) -> None:
    """Print a result line, above the progress bar if there is one."""
    from tqdm import tqdm

    tqdm.write(harmless(line), file=sys.stdout)


def note(line: str) -> None:
    """Print a line on stderr, above the progress bar if there is one."""
    from tqdm import tqdm

    tqdm.write(f"gsjax: {harmless(line)}", file=sys.stderr)


def progress(items: Sequence[T], label: str) -> Iterator[T]:
    """The items; a bar on a terminal, elsewhere a line at most every two seconds."""
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


def harmless(text: str) -> str:
    """Text in which what a terminal would obey, as of a file's name, is spelled out."""
    return _OBEYED.sub(lambda found: repr(found[0])[1:-1], text)


def one_line(text: object, most: int | None = None) -> str:
    """Text without line breaks, `harmless`.

    Args:
      text: anything.
      most: characters; of more, some in the middle are left out. None for any number.
    """
    line = harmless(" ".join(str(text).split()))
    if most is None or len(line) <= most:
        return line
    return f"{line[: most // 2]} […] {line[-most // 2 :]}"


def decibels(value: float | None) -> str:
    """PSNR to read; None is that of an image without any error."""
    return "∞ dB" if value is None or value == float("inf") else f"{value:.2f} dB"


@contextmanager
def stopping_on_ctrl_c() -> Iterator[Callable[[], bool]]:
    """Within, Ctrl-C only sets a flag, so that what goes on is never cut in two.

    A second one raises `KeyboardInterrupt` as usual. Nothing changes off the main
    thread, where signals cannot be caught; where Ctrl-C is ignored, as by what a script
    starts in the background; and where something other than Python handles it.
    """
    asked = False
    previous = signal.getsignal(signal.SIGINT)
    mine = threading.current_thread() is threading.main_thread()
    if not mine or previous in (signal.SIG_IGN, None):
        yield lambda: False
        return

    def handle(*_):
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        note("stopping after this step; once more to stop at once")

    signal.signal(signal.SIGINT, handle)
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, previous)


@contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Within, a warning is a line ``gsjax: warning: …`` on stderr."""

    def show(message, *_):
        note(f"warning: {one_line(message)}")

    with warnings.catch_warnings():
        # Those for the user are always shown; of others, what the filters let through.
        warnings.filterwarnings("always", category=UserWarning)
        warnings.showwarning = show
        yield
