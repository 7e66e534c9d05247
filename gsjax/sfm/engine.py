"""COLMAP as a program: loaded, quiet, seeded, run in a thread so that progress can be
told and Ctrl-C is heard.
"""

import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gsjax.errors import MissingExtraError
from gsjax.io import images

_FATAL = 3  # of glog's levels
_WAIT = 5.0  # seconds between lines of progress
_COUNT_ROWS = """
import sqlite3, sys
uri, table = sys.argv[1:]
read = sqlite3.connect(uri + "?mode=ro", uri=True)
print(read.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
"""

Tell = Callable[[str], None]


def colmap() -> Any:
    """The module pycolmap.

    Raises:
      MissingExtraError: if it is absent or does not load.
    """
    # OpenCV first: loaded after pycolmap 4.2, OpenCV 5.0 aborts as it writes a PNG.
    images.opencv()
    try:
        import pycolmap
    except ImportError as error:
        raise MissingExtraError(
            f"pycolmap, which finds the cameras, does not load ({error}); install "
            "it: pip install pycolmap"
        ) from error
    return pycolmap


@contextmanager
def quiet_and_seeded(seed: int) -> Iterator[None]:
    """Within, COLMAP logs nothing, and its random numbers start from ``seed``."""
    log = colmap().logging
    before, log.minloglevel = log.minloglevel, _FATAL
    try:
        colmap().set_random_seed(seed)
        yield
    finally:
        log.minloglevel = before


def watched(work: Callable[[Any], Any], look: Callable[[], str], tell: Tell) -> Any:
    """What ``work(token)`` returns, run in a thread and cancelled by Ctrl-C, or where
    progress cannot be told."""
    token = colmap().CancellationToken()
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(work, token)
        try:
            while True:
                try:
                    return running.result(timeout=_WAIT)
                except TimeoutError:
                    tell(look())
        except BaseException as error:
            token.cancel()
            if isinstance(error, KeyboardInterrupt):
                tell("stopping when the images that are begun are done")
            raise


def rows_of(database: Path, table: str) -> int:
    """How far a step is that fills a table.

    Looked at from another process. COLMAP brings an SQLite of its own, and two of them
    in one process undo each other's locks as soon as either closes the file (so does
    whoever opens and closes it): COLMAP then reads what is half written, or dies of
    SIGBUS.
    """
    call = [sys.executable, "-I", "-S", "-c", _COUNT_ROWS, database.as_uri(), table]
    try:
        counted = subprocess.run(call, capture_output=True, timeout=10, check=True)
        return int(counted.stdout)
    except (OSError, ValueError, subprocess.SubprocessError):
        return 0
