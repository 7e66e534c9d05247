"""Coloured points of a PLY file, as datasets bring them."""

from os import PathLike
from pathlib import Path
from typing import BinaryIO

import numpy as np

from gsjax.errors import InputError
from gsjax.io.ply_header import Header, check_size, read_header
from gsjax.io.ply_rows import read_rows
from gsjax.runtime.files import opened
from gsjax.runtime.memory import Estimate, require

_GREY = 128
_RGB = ("red", "green", "blue")
_COLORS = (_RGB, tuple(f"diffuse_{color}" for color in _RGB), ("r", "g", "b"))


def read_point_cloud(path: str | PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    """Read points [M, 3] float64 and colours [M, 3] uint8, in the order of the file.

    Properties are found by name: x y z, and red green blue. Integer colours are 0 to
    255, or 0 to 65535 if any is above 255; floating-point ones are 0 to 1. Points
    without colours are grey.

    Args:
      path: the file, binary or ascii.

    Raises:
      InputError: if the file cannot be read, is not a PLY, is truncated, has no x y z,
        values that are not finite, or colours out of range.
      CapacityError: if memory is too small; raised before the body is read.
    """
    path = Path(path)
    with opened(path, "a .ply file") as file:
        header = read_header(file, path)
        types = header.vertex.types
        if not all(types.get(name) for name in "xyz") or None in types.values():
            what = "expected scalar properties x, y, z of element vertex, got "
            what += ", ".join([*types][:20])
            raise InputError(f"{path}: {what}; export the points as a PLY")
        check_size(header)
        names = next((names for names in _COLORS if types.keys() >= {*names}), ())
        kinds = {types[name] or "" for name in names}
        unit = bool(names) and all(kind.startswith("f") for kind in kinds)
        narrow = unit or kinds <= {"u1"}
        rows = header.vertex.rows
        estimate = Estimate({"coordinates and colours": rows * (28 if narrow else 34)})
        remedy = "leave out some of them where the file was made"
        require(estimate, f"{path}: {rows:,} points", remedy)
        points, colors, (darkest, brightest) = _read(file, header, names, unit, narrow)
    bad = np.isnan(points[:, 0])
    if bad.any():
        which = f"{bad.sum()} of {len(bad)} points, the first: "
        which += f"{np.flatnonzero(bad)[:5].tolist()}; remove them"
        raise InputError(f"{path}: coordinates or colours are not finite in {which}")
    most = 1.01 if unit else 65535
    if brightest > most or (darkest < 0 and not unit):
        raise InputError(
            f"{path}: expected colours of 0 to 255 (uchar), 0 to 65535 (ushort) or 0 "
            f"to 1 (float), got {darkest:g} to {brightest:g}; export the points again"
        )
    if brightest > 255:
        colors = (colors.astype(np.uint32) + 128) // 257
    return points, colors.astype(np.uint8, copy=False)


def _read(
    file: BinaryIO, header: Header, names: tuple[str, ...], unit: bool, narrow: bool
) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Return points, colours, and the range of the colours as stored."""
    points = np.empty((header.vertex.rows, 3))
    kind = np.uint8 if narrow else np.uint16
    colors = np.full((header.vertex.rows, 3), _GREY, kind)
    start, darkest, brightest = 0, 0.0, 0.0
    for size, columns in read_rows(file, header):
        rows = slice(start, start + size)
        for axis, name in enumerate("xyz"):
            points[rows, axis] = columns[name]
        for axis, name in enumerate(names):
            values = columns[name].astype(np.float64)
            points[rows][~np.isfinite(values)] = np.nan  # reported with the points
            values = np.nan_to_num(values)
            brightest = max(brightest, values.max(initial=0.0))
            darkest = min(darkest, values.min(initial=0.0))
            values = np.clip(values, 0, 1) * 255 if unit else values
            colors[rows, axis] = np.rint(np.clip(values, 0, np.iinfo(kind).max))
        # Block by block: a temporary copy of all points would double the memory.
        points[rows][~(np.abs(points[rows]) < 1e30).all(axis=1)] = np.nan
        start += size
    return points, colors, (darkest, brightest)
