"""The container of SPZ files: header, compressed blocks and extension records.

Versions 2 and 3 are one gzip stream of a header of 16 bytes, the blocks, and extension
records. Version 4 has a plain header of 32 bytes, extension records, a table of
contents and a Zstandard frame for each block that is not empty (Niantic,
https://github.com/nianticlabs/spz). Sizes are checked before anything is inflated.
"""

import gzip
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from io import BufferedIOBase
from pathlib import Path
from struct import Struct
from typing import BinaryIO, NamedTuple, cast

import numpy as np
import zstandard

from gsjax.errors import InputError
from gsjax.io import common
from gsjax.math.sh import num_bases
from gsjax.runtime.files import opened
from gsjax.runtime.memory import Estimate, require

# Flags of the header: trained with antialiasing; extension records follow.
ANTIALIASED, EXTENSIONS = 1, 2
PLAIN_VERSION = 4  # of files that are not one gzip stream
VERSIONS = (2, 3, PLAIN_VERSION)
_MAGIC = b"NGSP"
_REMEDY = "export or download it again"
_HEADER = Struct("<4sIIBBBB")
_PLAIN_HEADER = Struct("<4sIIBBBBI12x")
_ENTRY, _RECORD = Struct("<QQ"), Struct("<II")
_MAX_RATIO = 1032  # of any deflated data
# Zstandard has no such limit; this one is that of Niantic's reader.
_MAX_ROWS_PER_BYTE = 1024 / 9
_MAX_TAIL = 1 << 18  # bytes after the Gaussians of a gzip stream
_MIN_WINDOW, _MAX_WINDOW = 1 << 25, 1 << 30  # bytes of a frame kept for references
_GZIP_LEVEL, _ZSTD_LEVEL = 6, 12


class SpzHeader(NamedTuple):
    """Contents of a header.

    Attributes:
      version: 2, 3 or 4.
      rows: number of Gaussians N.
      degree: SH degree, 0 to 4.
      fraction: binary digits of a mean after the point.
      flags: `ANTIALIASED` and `EXTENSIONS`, added.
      blocks: number of blocks that are not empty, as version 4 declares it.
      table: byte at which the table of contents of version 4 starts.
    """

    version: int
    rows: int
    degree: int
    fraction: int
    flags: int
    blocks: int = 0
    table: int = _PLAIN_HEADER.size


class SpzContent(NamedTuple):
    """A file whose blocks are inflated, not decoded.

    Attributes:
      header: the header.
      blocks: [N, bytes] uint8 by name, see `block_widths`.
      extensions: payloads of the extension records by type.
    """

    header: SpzHeader
    blocks: dict[str, np.ndarray]
    extensions: dict[int, bytes]


def block_widths(version: int, degree: int) -> dict[str, int]:
    """Return the bytes of a Gaussian in each block, in the order of the file."""
    return {
        "means": 9,
        "opacities": 1,
        "colors": 3,
        "scales": 3,
        "quats": 3 if version == 2 else 4,
        "sh": 3 * (num_bases(degree) - 1),
    }


@contextmanager
def _opened(path: Path) -> Iterator[tuple[BinaryIO, SpzHeader, int]]:
    """Yield the stream after the header, the header, and the size of the file."""
    with opened(path, "an .spz file") as file:
        size = file.seek(0, 2)
        file.seek(0)
        plain = file.read(len(_MAGIC)) == _MAGIC
        file.seek(0)
        if plain:
            yield file, _plain_header(file, path, size), size
            return
        try:
            with gzip.GzipFile(fileobj=file) as inflated:
                stream = cast(BinaryIO, inflated)
                yield stream, _gzip_header(stream, path, size), size
        except (gzip.BadGzipFile, zlib.error, EOFError) as error:
            what = f"not an SPZ file, or damaged or truncated: {error}"
            raise InputError(f"{path}: {what}; {_REMEDY}") from error


def read_spz_header(path: Path) -> SpzHeader:
    """Read the header of an SPZ file.

    Raises:
      InputError: as `read_spz_content`, from the header alone.
    """
    with _opened(path) as (_, header, _):
        return header


def read_spz_content(path: Path) -> SpzContent:
    """Read an SPZ file of version 2, 3 or 4 and inflate its blocks.

    Raises:
      InputError: if the file cannot be read, is not an SPZ, has another version, or is
        damaged, truncated or longer than its header declares.
      CapacityError: if memory is too small; raised before the blocks are read.
    """
    with _opened(path) as (stream, header, size):
        rows, bases = header.rows, num_bases(header.degree)
        estimate = Estimate({"values as read": rows * (220 + 16 * 3 * bases)})
        remedy = "reduce the file with the tool that made it"
        require(estimate, f"{path}: {rows:,} Gaussians", remedy)
        if header.version == PLAIN_VERSION:
            return _read_frames(stream, header, path, size)
        return _read_stream(stream, header, path)


def _gzip_header(stream: BinaryIO, path: Path, size: int) -> SpzHeader:
    raw = stream.read(_HEADER.size)
    if len(raw) < _HEADER.size or raw[:4] != _MAGIC:
        raise _no_header(path, _HEADER, raw)
    header = SpzHeader(*_HEADER.unpack(raw)[1:-1])
    _check_header(header, path, VERSIONS[:-1])
    widths = block_widths(header.version, header.degree)
    if header.rows * sum(widths.values()) > _MAX_RATIO * size:
        raise _too_many(header, path, size)
    return header


def _plain_header(file: BinaryIO, path: Path, size: int) -> SpzHeader:
    raw = file.read(_PLAIN_HEADER.size)
    if len(raw) < _PLAIN_HEADER.size:
        raise _no_header(path, _PLAIN_HEADER, raw)
    header = SpzHeader(*_PLAIN_HEADER.unpack(raw)[1:])
    _check_header(header, path, VERSIONS[-1:])
    if header.rows > _MAX_ROWS_PER_BYTE * size:
        raise _too_many(header, path, size)
    return header


def _no_header(path: Path, form: Struct, raw: bytes) -> InputError:
    return InputError(
        f"{path}: expected an SPZ header of {form.size} bytes that starts with "
        f"{_MAGIC!r}, got {raw[:8]!r}; {_REMEDY}"
    )


def _too_many(header: SpzHeader, path: Path, size: int) -> InputError:
    return InputError(
        f"{path}: the header declares {header.rows:,} Gaussians, which {size:,} bytes "
        f"cannot hold; the file is truncated or damaged: {_REMEDY}"
    )


def _check_header(header: SpzHeader, path: Path, versions: tuple[int, ...]) -> None:
    for name, least, most in (
        ("version", versions[0], versions[-1]),
        ("degree", 0, 4),
        ("fraction", 0, 24),
    ):
        value = getattr(header, name)
        if not least <= value <= most:
            span = f"{least} to {most}" if most > least else f"{most}"
            raise InputError(
                f"{path}: expected a header with {name} {span}, got {value}; export it "
                "in another version"
            )


def _read_stream(stream: BinaryIO, header: SpzHeader, path: Path) -> SpzContent:
    """Read the blocks and extension records of versions 2 and 3."""
    blocks: dict[str, np.ndarray] = {}
    for name, width in block_widths(header.version, header.degree).items():
        raw = common.read_exactly(stream, header.rows * width, path, name)
        blocks[name] = np.frombuffer(raw, np.uint8).reshape(header.rows, width)
    tail = stream.read(_MAX_TAIL + 1)  # to the end, where the checksum is verified
    if len(tail) > _MAX_TAIL:
        raise InputError(
            f"{path}: expected at most {_MAX_TAIL:,} bytes after the last Gaussian, "
            f"got more; the file is damaged: {_REMEDY}"
        )
    if header.flags & EXTENSIONS:
        return SpzContent(header, blocks, _extensions(tail, path))
    if tail:
        common.warn(f"{path}: bytes after the last Gaussian are ignored")
    return SpzContent(header, blocks, {})


def _read_frames(
    file: BinaryIO, header: SpzHeader, path: Path, size: int
) -> SpzContent:
    """Read the extension records, table of contents and frames of version 4."""
    widths = block_widths(header.version, header.degree)
    names = [name for name, width in widths.items() if header.rows * width]
    start = header.table + len(names) * _ENTRY.size
    if header.blocks != len(names) or not _PLAIN_HEADER.size <= header.table <= size:
        raise InputError(
            f"{path}: expected a table of {len(names)} blocks within {size:,} bytes, "
            f"got {header.blocks} at byte {header.table:,}; the file is damaged: "
            f"{_REMEDY}"
        )
    area = header.table - _PLAIN_HEADER.size
    records = common.read_exactly(file, area, path, "extension records")
    given = header.flags & EXTENSIONS
    extensions = _extensions(records, path) if given else {}
    raw = common.read_exactly(file, start - header.table, path, "the table of contents")
    table = dict(zip(names, _ENTRY.iter_unpack(raw)))
    end = start + sum(compressed for compressed, _ in table.values())
    if end != size:
        raise InputError(
            f"{path}: expected a file of {end:,} bytes after its table of contents, "
            f"got {size:,}; the file is truncated or damaged: {_REMEDY}"
        )
    for name, (_, declared) in table.items():
        expected = header.rows * widths[name]
        if declared != expected:
            raise InputError(
                f"{path}: expected {expected:,} bytes of {name}, got {declared:,} in "
                f"the table of contents; the file is damaged: {_REMEDY}"
            )
    blocks: dict[str, np.ndarray] = {}
    for name, width in widths.items():
        compressed, declared = table.get(name, (0, 0))
        raw = common.read_exactly(file, compressed, path, name)
        raw = _inflated(raw, declared, path, name) if name in table else raw
        blocks[name] = np.frombuffer(raw, np.uint8).reshape(header.rows, width)
    return SpzContent(header, blocks, extensions)


def _inflated(raw: bytes, size: int, path: Path, name: str) -> bytes:
    """Return the content of a frame that must hold exactly ``size`` bytes."""
    window = min(max(_MIN_WINDOW, 2 * size), _MAX_WINDOW)
    try:
        declared = zstandard.frame_content_size(raw)
        if declared in (-1, size):  # unknown, or right
            inflater = zstandard.ZstdDecompressor(max_window_size=window)
            found = inflater.decompress(
                raw, max_output_size=size, allow_extra_data=False
            )
            if len(found) == size:
                return found
            declared = len(found)
        fault = f"expected {size:,} bytes of {name}, got {declared:,}"
    except zstandard.ZstdError as error:
        fault = f"the block of {name} is damaged or truncated: {error}"
    raise InputError(f"{path}: {fault}; {_REMEDY}")


def _extensions(raw: bytes, path: Path) -> dict[int, bytes]:
    """Return the payloads of extension records by type."""
    found, at = {}, 0
    while at < len(raw):
        kind, size = 0, len(raw)
        if at + _RECORD.size <= len(raw):
            kind, size = _RECORD.unpack_from(raw, at)
        begin = at + _RECORD.size
        if begin + size > len(raw):
            raise InputError(
                f"{path}: expected whole extension records, got one that is truncated "
                f"after {len(raw) - at:,} bytes; the file is damaged: {_REMEDY}"
            )
        found[kind] = raw[begin : begin + size]
        at = begin + size
    return found


def write_spz_content(
    file: BinaryIO, header: SpzHeader, blocks: Mapping[str, Iterator[bytes]]
) -> None:
    """Write an SPZ file of version 3 or 4 without extension records.

    Args:
      file: an empty file.
      header: ``blocks`` and ``table`` are ignored.
      blocks: the bytes of each block in pieces, by the names of `block_widths`.
    """
    fields = _MAGIC, *header[:5]
    widths = block_widths(header.version, header.degree)
    if header.version != PLAIN_VERSION:
        with gzip.GzipFile("", "wb", _GZIP_LEVEL, file, mtime=0) as stream:
            stream.write(_HEADER.pack(*fields, 0))
            for name in widths:
                _write_all(stream, blocks[name])
        return
    frames, table = [], []
    for name, width in widths.items():
        size = header.rows * width
        if size:
            deflater = zstandard.ZstdCompressor(_ZSTD_LEVEL, write_checksum=True)
            deflate = deflater.compressobj(size)
            pieces = [deflate.compress(piece) for piece in blocks[name]]
            frame = b"".join([*pieces, deflate.flush()])
            frames.append(frame)
            table.append(_ENTRY.pack(len(frame), size))
    file.write(_PLAIN_HEADER.pack(*fields, len(frames), _PLAIN_HEADER.size))
    file.write(b"".join([*table, *frames]))


def _write_all(stream: BufferedIOBase, pieces: Iterator[bytes]) -> None:
    for piece in pieces:
        stream.write(piece)
