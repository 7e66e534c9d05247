"""What programs say: results on stdout; progress, warnings and errors on stderr."""

import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")


def say(line: str) -> None:
    """Print a result line, above the progress bar if there is one."""
    from tqdm import tqdm

    tqdm.write(line, file=sys.stdout)


def note(line: str) -> None:
    """Print a line on stderr, above the progress bar if there is one."""
    from tqdm import tqdm

    tqdm.write(f"gsjax: {line}", file=sys.stderr)


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


def one_line(text: object) -> str:
    """Text without line breaks."""
    return " ".join(str(text).split())


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
