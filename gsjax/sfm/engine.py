"""Access to pycolmap: loading, logging, random seed, progress and cancellation."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gsjax.errors import MissingExtraError
from gsjax.io import images

_FATAL = 3  # glog level
_COUNT_ROWS = """
import sqlite3, sys
uri, table = sys.argv[1:]
read = sqlite3.connect(uri + "?mode=ro", uri=True)
print(read.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
"""

Progress = Callable[[str], None]


def colmap() -> Any:
    """Return the module pycolmap.

    Raises:
      MissingExtraError: if it is absent or does not load.
    """
    # OpenCV first: loaded after pycolmap 4.2, OpenCV 5.0 aborts when it writes a PNG.
    images.opencv()
    try:
        import pycolmap
    except ImportError as error:
        raise MissingExtraError(
            f"pycolmap is needed to find cameras and does not load ({error}); install "
            "it: pip install pycolmap"
        ) from error
    return pycolmap


@contextmanager
def quiet_and_seeded(seed: int) -> Iterator[None]:
    """Silence COLMAP's log and seed its random numbers within the context."""
    log = colmap().logging
    before, log.minloglevel = log.minloglevel, _FATAL
    try:
        colmap().set_random_seed(seed)
        yield
    finally:
        log.minloglevel = before


def run_cancellable(
    work: Callable[[Any], Any],
    status: Callable[[], str],
    progress: Progress,
    interval: float = 5.0,
) -> Any:
    """Run ``work(token)`` in a thread and return its result.

    ``progress(status())`` is called every ``interval`` seconds. The token is cancelled
    on Ctrl-C, or if ``progress`` raises.
    """
    token = colmap().CancellationToken()
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(work, token)
        try:
            while True:
                try:
                    return running.result(timeout=interval)
                except TimeoutError:
                    progress(status())
        except BaseException as error:
            token.cancel()
            if isinstance(error, KeyboardInterrupt):
                progress("stopping once the images in progress are done")
            raise


def count_rows(database: Path, table: str) -> int:
    """Return the number of rows in a table; 0 if it cannot be read.

    The count runs in another process: COLMAP links its own SQLite, and two copies of
    SQLite in one process release each other's file locks, which corrupts reads.
    """
    call = [sys.executable, "-I", "-S", "-c", _COUNT_ROWS, database.as_uri(), table]
    try:
        counted = subprocess.run(call, capture_output=True, timeout=10, check=True)
        return int(counted.stdout)
    except (OSError, ValueError, subprocess.SubprocessError):
        return 0
