"""The body of a PLY file in pieces, by property, and its end."""

import os
from collections.abc import Iterator, Mapping
from itertools import islice
from typing import BinaryIO

import numpy as np

from gsjax.errors import InputError
from gsjax.io.ply_header import Header, warn

CHUNK_ROWS = 1 << 14


def read_rows(
    file: BinaryIO, header: Header
) -> Iterator[tuple[int, Mapping[str, np.ndarray] | np.ndarray]]:
    """(rows, columns by property) of the vertices, in pieces of `CHUNK_ROWS`."""
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
    offset, line = header.body, b"\n"
    for line in islice(file, sum(element.rows for element in header.before)):
        offset += len(line)
    for start in range(0, vertex.rows, CHUNK_ROWS):
        size = min(CHUNK_ROWS, vertex.rows - start)
        table = np.empty((size, len(vertex.types)))
        for row in range(size):
            line = file.readline()
            words = line.split()
            where = f"{path}: vertex {start + row} (byte {offset})"
            if len(words) != len(vertex.types):
                raise InputError(
                    f"{where}: found {len(words)} values, {len(vertex.types)} are "
                    "wanted; the file is truncated or damaged: export it again"
                )
            try:
                if b"_" in line:  # which Python takes
                    raise ValueError(f"an underscore in {line[:60]!r}")
                table[row] = [float(word) for word in words]
            except ValueError as error:
                raise InputError(f"{where}: {str(error)[:80]}; pass numbers") from error
            offset += len(line)
        yield size, dict(zip(vertex.types, table.T))
    if not line.endswith((b"\n", b"\r")):
        warn(f"{path}: the last line has no end; its last value may be truncated")
    if not header.after and any(extra.strip() for extra in file):
        warn(f"{path}: text after the last element (byte {offset}) is ignored")
