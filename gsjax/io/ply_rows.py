"""The body of a PLY file in pieces, by property, and its end."""

import os
from collections.abc import Iterator, Mapping
from itertools import islice
from typing import BinaryIO

import numpy as np

from gsjax.errors import InputError
from gsjax.io.common import warn
from gsjax.io.numerals import BLOCK, find_words, parse_number, parse_numbers
from gsjax.io.ply_header import Header

CHUNK_ROWS = 1 << 14
# Of a row as text: per value, and besides.
_LONGEST_VALUE, _LONGEST = 100, 1000


def read_rows(
    file: BinaryIO, header: Header
) -> Iterator[tuple[int, Mapping[str, np.ndarray] | np.ndarray]]:
    """(rows, columns by property) of the vertices, in pieces of `CHUNK_ROWS` or so."""
    file.seek(header.body)
    return (_binary_rows if header.order else _ascii_rows)(file, header)


def _binary_rows(file: BinaryIO, header: Header) -> Iterator[tuple[int, np.ndarray]]:
    """(rows, columns by name) in pieces; ``file`` stands at the body."""
    vertex, order = header.vertex, header.order
    dtype = np.dtype([(name, f"{order}{kind}") for name, kind in vertex.types.items()])
    file.seek(sum(e.rows * e.least_bytes(order) for e in header.before), os.SEEK_CUR)
    for start in range(0, vertex.rows, CHUNK_ROWS):
        size = min(CHUNK_ROWS, vertex.rows - start)
        data = file.read(size * dtype.itemsize)
        if len(data) < size * dtype.itemsize:
            raise InputError(
                f"{header.path}: the file became shorter while it was read, at vertex "
                f"{start}; wait until it is complete"
            )
        yield size, np.frombuffer(data, dtype)


def _ascii_rows(
    file: BinaryIO, header: Header
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """(rows, columns by name) in pieces; ``file`` stands at the body."""
    path, vertex = header.path, header.vertex
    width = len(vertex.types)
    longest = _LONGEST + _LONGEST_VALUE * width
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
        warn(f"{path}: the last line has no end; its last value may be truncated")
    extra = iter(lambda: file.read(BLOCK), b"")
    if not header.after and any(text.strip() for text in extra):
        warn(f"{path}: text after the last element (byte {offset}) is ignored")


def _whole_lines(block: bytes, most: int) -> bytes:
    """The first ``most`` lines, or as many as there are."""
    ends = np.flatnonzero(np.frombuffer(block, np.uint8) == ord("\n"))
    return block if len(ends) < most else block[: ends[most - 1] + 1]


def _table(block: bytes, width: int) -> np.ndarray | None:
    """[rows, width] of lines; None unless each has so many numbers and no more."""
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
    """What is wrong with the first bad one of the lines of a block."""
    width, where = len(header.vertex.types), ""
    at = 0
    for row in range(start, header.vertex.rows):
        end = block.find(b"\n", at) + 1 or len(block)
        line = block[at:end]
        where = f"{header.path}: vertex {row} (byte {offset + at})"
        if len(line) > longest:
            return InputError(
                f"{where}: a line of {len(line)} bytes or more, {width} values are "
                "wanted; the file is damaged: export it again"
            )
        words = line.split()
        if len(words) != width:
            return InputError(
                f"{where}: found {len(words)} values, {width} are wanted; the file is "
                "truncated or damaged: export it again"
            )
        try:
            if b"_" in line:  # which Python takes
                raise ValueError(f"an underscore in {line[:60]!r}")
            for word in words:
                parse_number(word.decode("ascii", "replace"))
        except ValueError as error:
            return InputError(f"{where}: {str(error)[:80]}; pass numbers")
        at = end
        if at >= len(block):
            break
    return InputError(f"{where}: text that holds no numbers; export the file again")
