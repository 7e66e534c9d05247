"""Files: read with typed errors, and written completely or not at all."""

import errno
import json
import math
import os
import reprlib
import secrets
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

from gsjax.errors import InputError
from gsjax.runtime.memory import Estimate, require

_FULL = (errno.ENOSPC, errno.EDQUOT)
_TEMPORARY = ".gsjax-{}.tmp"
# In JSON a camera is an object and five lists in 90 bytes or more, with at most some 50
# keys and 100 values. An empty list takes 3 bytes and 70 in memory, so files that are
# full of them are rejected before parsing.
_MANY, _LEAST_BYTES, _MOST_ITEMS = 10_000, 10, 100
# Memory of Python's parser relative to the text.
_PARSED = 14

_short = reprlib.Repr()
_short.maxlist = _short.maxdict = 20
_short.maxstring = _short.maxlong = _short.maxother = 80


def shown(value: Any) -> str:
    """Return a value for a message, in at most 80 characters."""
    if isinstance(value, dict):  # whose keys would all be sorted
        value = dict(islice(value.items(), _short.maxdict))
    return _short.repr(value)[:80]


@contextmanager
def reading(path: Path, wanted: str = "a file") -> Iterator[None]:
    """Turn errors of reading ``path`` within the context into typed ones.

    Args:
      path: a regular file; a pipe or device may never end.
      wanted: what to pass instead, for the message.

    Raises:
      InputError: if it is missing, not a regular file, not readable, or larger than
        the memory.
    """
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise InputError(
                f"{path}: not a regular file and cannot be read; pass {wanted}"
            )
        yield
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read: {error.strerror or error}; check the path and "
            "its permissions"
        ) from error
    except MemoryError as error:
        raise InputError(
            f"{path}: cannot be read: larger than memory; is it {wanted}?"
        ) from error


@contextmanager
def opened(path: Path, wanted: str = "a file") -> Iterator[BinaryIO]:
    """Open a file for reading bytes; raises as `reading`."""
    with reading(path, wanted), path.open("rb") as file:
        yield file


def read_bytes(path: Path, wanted: str = "a file") -> bytes:
    """Return the bytes of a file; raises as `reading`."""
    with reading(path, wanted):
        return path.read_bytes()


def read_json(path: Path, wanted: str = "a JSON file") -> dict[str, Any]:
    """Return the object in a JSON file.

    Raises:
      InputError: as `reading`, and if it is not JSON, not an object, or has too many
        objects, keys or values to be a list of cameras.
      CapacityError: if parsing may exceed the memory.
    """
    raw = read_bytes(path, wanted)
    _check_json(path, raw, wanted)
    require(
        Estimate({"objects and numbers": _PARSED * len(raw)}),
        f"{path}: {len(raw):,} bytes of JSON",
        "leave out a part of it",
    )
    try:
        data = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: not JSON: {str(error)[:120]}; pass {wanted}"
        ) from error
    if not isinstance(data, dict):
        raise InputError(
            f"{path}: expected an object at the top, got {shown(data)}; pass {wanted}"
        )
    return data


def _check_json(path: Path, raw: bytes, wanted: str) -> None:
    """Reject JSON that cannot be a list of cameras, before parsing."""
    size, objects = len(raw), raw.count(b"{")
    keys, values = raw.count(b":"), raw.count(b",")
    nested = objects + raw.count(b"[")
    fault = None
    if nested > _MANY and nested * _LEAST_BYTES > size:
        fault = f"{nested} objects and lists in {size} bytes"
    elif keys > _MANY + _MOST_ITEMS * objects:
        fault = f"{keys} keys in {objects} objects"
    # A list of names may be as long, but has longer values.
    elif values > _MANY + _MOST_ITEMS * objects and values * _LEAST_BYTES > size:
        fault = f"{values} values in {objects} objects and {size} bytes"
    if fault is not None:
        raise InputError(
            f"{path}: {fault}: too many for a list of cameras; pass {wanted}"
        )


@contextmanager
def writing(path: Path, what: str = "written") -> Iterator[None]:
    """Turn errors of writing ``path`` within the context into an `InputError`."""
    try:
        yield
    except OSError as error:
        remedy = "check permissions and space"
        if error.errno in _FULL:
            remedy = "free some space and try again"
        raise InputError(
            f"{path}: cannot be {what}: {error.strerror or error}; {remedy}"
        ) from error


@contextmanager
def replacing(path: Path, *, durable: bool = False) -> Iterator[BinaryIO]:
    """Open a temporary file that replaces ``path`` at the end of the context.

    It lies beside ``path``, or beside the target of a link, and is removed on failure.

    Args:
      path: the file.
      durable: flush to the disk before renaming, so that a power cut leaves the old or
        the new file.

    Raises:
      InputError: as `writing`.
    """
    place = Path(os.path.realpath(path))
    temporary = temporary_in(place.parent)
    try:
        with writing(path):
            with temporary.open("xb") as file:
                yield file
                if durable:
                    file.flush()
                    os.fsync(file.fileno())
            os.replace(temporary, place)
    finally:
        with suppress(OSError):  # already reported
            temporary.unlink()


def temporary_in(folder: Path) -> Path:
    """Return an unused hidden name in a folder."""
    return folder / _TEMPORARY.format(secrets.token_hex(6))


def remove_leftovers(folder: Path, than: Path) -> None:
    """Remove temporary files that killed processes left in ``folder``.

    Only those older ``than`` a file just written; newer ones may be in use.
    """
    with suppress(OSError):
        written = than.stat().st_mtime_ns
        for path in folder.glob(_TEMPORARY.format("*")):
            with suppress(OSError):
                if path.lstat().st_mtime_ns < written:
                    path.unlink()


def write_file(path: Path, data: bytes | memoryview, *, durable: bool = False) -> None:
    """Write a file as `replacing` does."""
    with replacing(path, durable=durable) as file:
        file.write(data)


def append_to_file(path: Path, data: bytes) -> None:
    """Append to a file, all or nothing; create it if missing. Raises as `writing`."""
    with writing(path), path.open("ab", buffering=0) as file:
        size = file.tell()
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[file.write(rest) or 0 :]
        except BaseException:
            with suppress(OSError):  # keep the old content readable
                file.truncate(size)
            raise


def write_json(path: Path, data: Any, *, indent: int = 1) -> None:
    """Write ``data`` as JSON, without NaN and infinity; as `write_file`."""
    form = {"indent": indent, "allow_nan": False}
    try:
        text = f"{json.dumps(data, ensure_ascii=False, **form)}\n".encode()
    except UnicodeEncodeError:  # a file name that is not UTF-8
        text = f"{json.dumps(data, **form)}\n".encode()
    write_file(path, text)


def finite_or_none(value: float) -> float | None:
    """Return the value, or None if it is not finite, for JSON."""
    return value if math.isfinite(value) else None


def make_folder(path: Path) -> None:
    """Create a folder and its parents. Raises as `writing`."""
    with writing(path, "created"):
        path.mkdir(parents=True, exist_ok=True)


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Lock a folder within the context, where the system supports locks.

    Raises:
      InputError: if another process has locked it.
    """
    try:
        handle = _locked(folder)
    except BlockingIOError:
        raise InputError(
            f"{folder}: in use by another training; wait until it has ended, or use "
            "another folder"
        ) from None
    try:
        yield
    finally:
        if handle is not None:
            os.close(handle)


def _locked(folder: Path) -> int | None:
    """Return the handle that holds the lock; None without locks."""
    try:
        import fcntl  # not on Windows

        handle = os.open(folder, os.O_RDONLY)
    except (ImportError, OSError):
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise
    except OSError:  # a file system without locks
        pass
    return handle


def reject_existing(
    paths: Iterable[Path], overwrite: bool, instead: str = "another name"
) -> None:
    """Check output names before the work.

    Args:
      paths: files to write.
      overwrite: existing files are accepted.
      instead: alternative to ``--overwrite``, for the message.

    Raises:
      InputError: if a file exists and ``overwrite`` is not set, or is a folder.
    """
    found = [path for path in paths if path.exists()]
    folders = [path for path in found if path.is_dir()]
    if folders:
        raise InputError(
            f"{folders[0]}: expected a file to write, got a folder; pass another name"
        )
    if found and not overwrite:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        raise InputError(f"{found[0]}{more}: exists; pass --overwrite, or {instead}")
