"""Files of a SOG scene: the entries of a `.sog` archive, or those beside a meta.json.

Only names in one archive or folder are read, and their sizes are bounded before
anything is inflated.
"""

import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO, NamedTuple

from gsjax.errors import InputError
from gsjax.runtime.files import opened, read_bytes, reading, replacing, shown, writing

META = "meta.json"
REMEDY = "export or download it again"
_STREAMED = "lod-meta.json"
_MAX_META = 1 << 20
# Textures are compressed: an entry is not much larger than its archive.
_MAX_ENTRY = 1 << 16
_MAX_NAME = 255
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# Errors that zipfile raises on damaged archives.
_ZIP_ERRORS = (
    *(zipfile.BadZipFile, NotImplementedError, RuntimeError, ValueError),
    *(EOFError, KeyError, OverflowError, struct.error, zlib.error),
)


class SogFiles(NamedTuple):
    """An opened scene.

    Attributes:
      path: the .sog file, or the meta.json of a folder.
      read: ``read(name) -> bytes``; raises `InputError` for a missing or damaged file.
      size: ``size(names) -> int``, the bytes that these files take on the disk.
      where: ``where(name) -> str``, a file as messages name it.
    """

    path: Path
    read: Callable[[str], bytes]
    size: Callable[[Sequence[str]], int]
    where: Callable[[str], str]


def scene_path(path: Path) -> Path:
    """Return the file that a path denotes: for the folder of a SOG, its meta.json.

    A folder with a config.json is that of a run.
    """
    inside = path / META
    if os.path.isfile(inside) and not os.path.exists(path / "config.json"):
        return inside
    return path


@contextmanager
def opened_scene(path: Path) -> Iterator[SogFiles]:
    """Open a scene for reading.

    Args:
      path: a .sog file, the folder of an unbundled scene, or its meta.json.

    Raises:
      InputError: if it cannot be read, or is not a ZIP archive.
    """
    path = scene_path(path)
    if path.suffix.lower() != ".json":
        with opened(path, "a .sog file") as file:
            yield _bundle(path, file)
    elif path.name.lower() == _STREAMED:
        got = f"got the {_STREAMED} of a streamed one"
        remedy = f"pass the {META} of one of its parts"
        raise InputError(f"{path}: expected the {META} of a SOG, {got}; {remedy}")
    else:
        yield _folder(path)


def _folder(path: Path) -> SogFiles:
    def place(name: str) -> Path:
        return path if name == META else path.parent / checked_name(str(path), name)

    def read(name: str) -> bytes:
        file = place(name)
        if name == META:
            _check_entry(str(file), _bytes_of(file), _MAX_META)
        return read_bytes(file, "the file of a SOG")

    def size(names: Sequence[str]) -> int:
        return sum(_bytes_of(place(name)) for name in names)

    return SogFiles(path, read, size, lambda name: str(place(name)))


def _bytes_of(path: Path) -> int:
    with reading(path, "the file of a SOG"):
        return path.stat().st_size


def _bundle(path: Path, file: BinaryIO) -> SogFiles:
    total = file.seek(0, os.SEEK_END)
    try:
        archive = zipfile.ZipFile(file)
        entries = {entry.filename: entry for entry in archive.infolist()}
    except _ZIP_ERRORS as error:
        what = f"not a SOG, or truncated: {str(error)[:80]}"
        raise InputError(f"{path}: {what}; {REMEDY}") from error

    def where(name: str) -> str:
        return f"{path}: {name}"

    def read(name: str) -> bytes:
        entry = entries.get(name)  # whatever the name, nothing else is read
        if entry is None:
            found = shown([*entries])
            raise InputError(f"{where(name)} is missing, got {found}; {REMEDY}")
        if entry.compress_type not in _METHODS:
            got = f"got the compression method {entry.compress_type}"
            raise InputError(
                f"{where(name)}: expected a stored or deflated entry, {got}; {REMEDY}"
            )
        most = _MAX_META if name == META else max(total, _MAX_ENTRY)
        _check_entry(where(name), entry.file_size, most)
        try:
            data = archive.read(entry)
        except _ZIP_ERRORS as error:
            what = f"damaged or truncated: {str(error)[:80]}"
            raise InputError(f"{where(name)}: {what}; {REMEDY}") from error
        return data

    return SogFiles(path, read, lambda _: total, where)


def checked_name(where: str, name: str) -> str:
    """Return a name from meta.json, after a check that it leads nowhere else.

    Raises:
      InputError: if it is not the name of a file in one folder; it begins with
        ``where``.
    """
    plain = name.isprintable() and not {"/", "\\", ":"}.intersection(name)
    if not plain or name in ("", ".", "..") or len(name.encode()) > _MAX_NAME:
        expected = f"the name of a file beside {META}"
        raise InputError(f"{where}: expected {expected}, got {shown(name)}; {REMEDY}")
    return name


def _check_entry(where: str, size: int, most: int) -> None:
    if size > most:
        expected = f"expected at most {most:,} bytes, got {size:,}"
        raise InputError(f"{where}: {expected}; {REMEDY}")


def write_files(path: Path, files: dict[str, bytes], *, overwrite: bool) -> None:
    """Write the files of a scene as a .sog archive, or beside a meta.json.

    They appear complete or not at all. In a folder the meta.json is removed before the
    first texture is replaced, and appears last.

    Raises:
      InputError: if they cannot be written, or if textures exist without ``overwrite``.
    """
    if path.suffix.lower() != ".json":
        with replacing(path, durable=True) as file:
            _write_archive(file, files)
        return
    if path.name != META:
        expected = f"expected the name {META} for a folder of files"
        raise InputError(f"{path}: {expected}, got {path.name}; pass it, or a .sog")
    places = {name: path.with_name(name) for name in files}
    found = [place for place in places.values() if place.exists()]
    if found and not overwrite:
        remedy = "pass overwrite=True or another folder"
        raise InputError(f"{found[0]}: exists; {remedy}")
    with ExitStack() as stack:
        # Entered first, it is renamed last.
        last = stack.enter_context(replacing(path, durable=True))
        last.write(files[META])
        for name, data in files.items():
            if name != META:
                file = stack.enter_context(replacing(places[name], durable=True))
                file.write(data)
        with writing(path, "replaced"):
            path.unlink(missing_ok=True)


def _write_archive(file: BinaryIO, files: dict[str, bytes]) -> None:
    """Write a ZIP archive of stored entries; equal files give equal bytes."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name), data)
