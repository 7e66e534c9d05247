"""The body of a PLY file, read in pieces by property."""

import os
from collections.abc import Iterator, Mapping
from io import BytesIO
from itertools import islice
from typing import BinaryIO

import numpy as np

from gsjax.errors import InputError
from gsjax.io.common import warn
from gsjax.io.numerals import BLOCK, find_words, parse_numbers
from gsjax.io.ply_header import Header

CHUNK_ROWS = 1 << 14
# Longest line of text: per value, and besides.
_MAX_VALUE, _MAX_LINE = 100, 1000


def read_rows(
    file: BinaryIO, header: Header
) -> Iterator[tuple[int, Mapping[str, np.ndarray] | np.ndarray]]:
    """Yield (rows, columns by property) of the vertices, some `CHUNK_ROWS` at a time.

    Raises:
      InputError: if a line of text is invalid, or the file shrinks while it is read.
    """
    file.seek(header.body)
    return (_binary_rows if header.order else _ascii_rows)(file, header)


def _binary_rows(file: BinaryIO, header: Header) -> Iterator[tuple[int, np.ndarray]]:
    vertex, order = header.vertex, header.order
    dtype = np.dtype([(name, f"{order}{kind}") for name, kind in vertex.types.items()])
    file.seek(sum(e.rows * e.min_bytes(order) for e in header.before), os.SEEK_CUR)
    for start in range(0, vertex.rows, CHUNK_ROWS):
        size = min(CHUNK_ROWS, vertex.rows - start)
        data = file.read(size * dtype.itemsize)
        if len(data) < size * dtype.itemsize:
            what = f"{header.path}: vertex {start}: the file became shorter"
            raise InputError(f"{what} while it was read; wait until it is complete")
        yield size, np.frombuffer(data, dtype)


def _ascii_rows(
    file: BinaryIO, header: Header
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    path, vertex = header.path, header.vertex
    width = len(vertex.types)
    longest = _MAX_LINE + _MAX_VALUE * width
    offset, block = header.body, b"\n"
    for block in islice(file, sum(element.rows for element in header.before)):
        offset += len(block)
    start = 0
    while start < vertex.rows:
        file.seek(offset)
        block = file.read(BLOCK)
        block = _whole_lines(block + file.readline(longest), vertex.rows - start)
        table = _table(block, width)
        if table is None:
            raise _bad_row(header, block, start, offset, longest)
        yield len(table), dict(zip(vertex.types, table.T))
        start += len(table)
        offset += len(block)
    file.seek(offset)
    if not block.endswith((b"\n", b"\r")):
        warn(f"{path}: the last line has no newline; its last value may be truncated")
    extra = iter(lambda: file.read(BLOCK), b"")
    if not header.after and any(text.strip() for text in extra):
        warn(f"{path}: text after the last element (byte {offset}) is ignored")


def _whole_lines(block: bytes, most: int) -> bytes:
    """Return the first ``most`` lines, or all if there are fewer."""
    ends = np.flatnonzero(np.frombuffer(block, np.uint8) == ord("\n"))
    return block if len(ends) < most else block[: ends[most - 1] + 1]


def _table(block: bytes, width: int) -> np.ndarray | None:
    """Parse lines to [rows, width]; None unless each has exactly ``width`` numbers."""
    if not block:
        return None
    raw = np.frombuffer(block, np.uint8)
    counts = find_words(raw).counts
    if (counts != width).any():
        return None
    values = parse_numbers(raw, width * len(counts))
    return None if values is None else values.reshape(-1, width)


def _bad_row(
    header: Header, block: bytes, start: int, offset: int, longest: int
) -> InputError:
    """Return the error that names the first bad line of a block and its fault."""
    width, found = len(header.vertex.types), "the end of the file"
    for line in BytesIO(block):
        if _table(line, width) is None:
            words = line.split()
            if len(line) > longest:
                found = f"a line of {len(line)} bytes or more"
            elif len(words) != width:
                found = f"{len(words)}"
            else:
                bad = next((word for word in words if _table(word, 1) is None), b"")
                found = repr(bad[:60].decode("ascii", "replace"))
            break
        start, offset = start + 1, offset + len(line)
    return InputError(
        f"{header.path}: vertex {start} (byte {offset}): expected {width} numbers, got "
        f"{found}; the file is truncated or damaged: export it again"
    )
