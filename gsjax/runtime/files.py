"""Files, read or refused by name, and written complete or not at all."""

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
# Of JSON: a camera is an object and five lists in 90 bytes or more, with some 50 keys
# and 100 values at most; 3 bytes, "[],", take 70 in memory, a key of its own 100. So
# what is full of them is refused before it is parsed.
_MANY, _LEAST_BYTES, _MOST_ITEMS = 10_000, 10, 100
# Python's parser takes up to that many times the text: of a short word, 6 bytes, 60.
_PARSED = 14


_short = reprlib.Repr()
_short.maxlist = _short.maxdict = 20
_short.maxstring = _short.maxlong = _short.maxother = 80


def shown(value: Any) -> str:
    """A value as found, for a message: 80 characters at most, whatever it is."""
    if isinstance(value, dict):  # of which all keys would be sorted
        value = dict(islice(value.items(), _short.maxdict))
    return _short.repr(value)[:80]


@contextmanager
def reading(path: Path, wanted: str = "a file") -> Iterator[None]:
    """Within, what keeps ``path`` from being read is told with its name.

    Args:
      path: checked to be a regular file first: a pipe or device may never end.
      wanted: what to pass instead, for the message.

    Raises:
      InputError: if it is missing, no regular file, may not be read, or is larger
        than the memory.
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
            f"{path}: cannot be read: larger than the memory; is it {wanted}?"
        ) from error


@contextmanager
def opened(path: Path, wanted: str = "a file") -> Iterator[BinaryIO]:
    """A file open to read bytes from; raises as `reading`."""
    with reading(path, wanted), path.open("rb") as file:
        yield file


def read_bytes(path: Path, wanted: str = "a file") -> bytes:
    """All of a file; raises as `reading`."""
    with reading(path, wanted):
        return path.read_bytes()


def read_json(path: Path, wanted: str = "a JSON file") -> dict[str, Any]:
    """The object that a JSON file holds.

    It is parsed as a whole, and takes up to 14 times its size in memory meanwhile.

    Raises:
      InputError: as `reading`, and if it is no JSON, no object, or so full of empty
        objects and lists, keys or values that it can be no list of cameras.
      CapacityError: if the memory may not hold what is in it.
    """
    raw = read_bytes(path, wanted)
    _check_json(path, raw, wanted)
    require(
        Estimate({"objects and numbers": _PARSED * len(raw)}),
        f"{path}: {len(raw):,} bytes of JSON",
        "leave out some of it",
    )
    try:
        data = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: not JSON: {str(error)[:120]}; pass {wanted}"
        ) from error
    if not isinstance(data, dict):
        raise InputError(
            f"{path}: the top is {shown(data)}, an object is wanted; pass {wanted}"
        )
    return data


def _check_json(path: Path, raw: bytes, wanted: str) -> None:
    """Refuse what is of another kind than what is kept as JSON, before it is parsed."""
    size, objects = len(raw), raw.count(b"{")
    keys, values = raw.count(b":"), raw.count(b",")
    nested = objects + raw.count(b"[")
    fault = None
    if nested > _MANY and nested * _LEAST_BYTES > size:
        told = f"{nested} objects and lists in {size} bytes"
        fault = f"{told}, fewer than {_LEAST_BYTES} bytes each"
    elif keys > _MANY + _MOST_ITEMS * objects:
        fault = f"{keys} keys in {objects} objects"
    # A list of names is as long, but of longer values.
    elif values > _MANY + _MOST_ITEMS * objects and values * _LEAST_BYTES > size:
        fault = f"{values} values in {objects} objects and {size} bytes"
    if fault is not None:
        raise InputError(
            f"{path}: {fault}, which no list of cameras has; pass {wanted}"
        )


@contextmanager
def writing(path: Path, what: str = "written") -> Iterator[None]:
    """Within, what keeps ``path`` from being written is told with its name.

    Raises:
      InputError: on any error of the system.
    """
    try:
        yield
    except OSError as error:
        remedy = "check permissions and space"
        if error.errno in _FULL:
            remedy = "free some space, then do this again"
        raise InputError(
            f"{path}: cannot be {what}: {error.strerror or error}; {remedy}"
        ) from error


@contextmanager
def replacing(path: Path, *, durable: bool = False) -> Iterator[BinaryIO]:
    """A file to write to that becomes ``path``, in place of what is there, at the end.

    It stands beside ``path`` until then, and is gone if anything fails. Where ``path``
    is a link, all that goes for what it leads to.

    Args:
      path: of the file.
      durable: wait until it is on the disk before it gets its name, so that a power
        cut leaves the one file or the other.

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
        with suppress(OSError):  # it is told already
            temporary.unlink()


def temporary_in(folder: Path) -> Path:
    """A hidden name that nothing has yet, for what is to be moved when it is done."""
    return folder / _TEMPORARY.format(secrets.token_hex(6))


def remove_leftovers(folder: Path, than: Path) -> None:
    """Remove what `replacing` was filling in ``folder`` when its process was killed.

    Only what is older ``than`` a file that was just written: what is newer may be that
    of another process. What cannot be removed stays.
    """
    with suppress(OSError):
        written = than.stat().st_mtime_ns
        for path in folder.glob(_TEMPORARY.format("*")):
            with suppress(OSError):
                if path.lstat().st_mtime_ns < written:
                    path.unlink()


def write_file(path: Path, data: bytes | memoryview, *, durable: bool = False) -> None:
    """Write all of a file; as `replacing`."""
    with replacing(path, durable=durable) as file:
        file.write(data)


def append_to_file(path: Path, data: bytes) -> None:
    """Add to the end of a file, all or nothing; it is made if it is missing.

    Raises:
      InputError: as `writing`.
    """
    with writing(path), path.open("ab", buffering=0) as file:
        size = file.tell()
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[file.write(rest) or 0 :]
        except BaseException:
            with suppress(OSError):  # what is there stays readable to its end
                file.truncate(size)
            raise


def write_json(path: Path, data: Any, *, indent: int = 1) -> None:
    """Write ``data`` as JSON, without numbers that it lacks; as `write_file`."""
    form = {"indent": indent, "allow_nan": False}
    try:
        told = f"{json.dumps(data, ensure_ascii=False, **form)}\n".encode()
    except UnicodeEncodeError:  # the name of a file that is not UTF-8
        told = f"{json.dumps(data, **form)}\n".encode()
    write_file(path, told)


def finite_or_none(value: float) -> float | None:
    """For JSON, which has no number for infinity or NaN."""
    return value if math.isfinite(value) else None


def make_folder(path: Path) -> None:
    """Create a folder and those above it.

    Raises:
      InputError: if that cannot be.
    """
    with writing(path, "made a folder"):
        path.mkdir(parents=True, exist_ok=True)


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Within, no other process that asks has the folder; that ends with this process,
    whatever ends it. Where the system has no such locks, nothing is held.

    Raises:
      InputError: if another has it.
    """
    try:
        handle = _locked(folder)
    except BlockingIOError:
        raise InputError(
            f"{folder}: another training is at work in it; wait until it has ended, "
            "or use another folder"
        ) from None
    try:
        yield
    finally:
        if handle is not None:
            os.close(handle)


def _locked(folder: Path) -> int | None:
    """What holds a folder until it is closed; None where that cannot be."""
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
    except OSError:  # a disk without locks
        pass
    return handle


def refuse_existing(
    paths: Iterable[Path], overwrite: bool, instead: str = "another name"
) -> None:
    """Check names before the work that would fill them.

    Args:
      instead: what to pass in place of ``--overwrite``, for the message.

    Raises:
      InputError: if one exists and ``overwrite`` is not set, or is a folder.
    """
    found = [path for path in paths if path.exists()]
    folders = [path for path in found if path.is_dir()]
    if folders:
        raise InputError(f"{folders[0]}: is a folder; a file is to be written there")
    if found and not overwrite:
        more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
        raise InputError(f"{found[0]}{more}: exists; pass --overwrite, or {instead}")
