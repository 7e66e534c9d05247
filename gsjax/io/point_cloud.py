"""Coloured points of a PLY file: the clouds that datasets come with."""

from os import PathLike
from pathlib import Path

import numpy as np

from gsjax.errors import InputError
from gsjax.io.ply_header import check_size, read_header
from gsjax.io.ply_rows import read_rows
from gsjax.runtime.files import opened
from gsjax.runtime.memory import Estimate, require

_GREY = 128
_COLORS = (  # names of red, green and blue
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)


def read_point_cloud(path: str | PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    """Points [M, 3] float64 and colours [M, 3] uint8, in the order of the file.

    Properties are found by name: x y z, and red green blue, which are 0 to 255, of 16
    bits 0 to 65535 where any is beyond 255, or 0 to 1 where they are floating-point;
    grey where there are none.

    Args:
      path: the file, binary or ascii.

    Raises:
      InputError: if the file cannot be read, is no PLY, is truncated, has no x y z,
        or values that are not finite, or colours beyond what there can be.
      CapacityError: if the memory would not hold it, before it is read.
    """
    path = Path(path)
    with opened(path, "a .ply file") as file:
        header = read_header(file, path)
        types = header.vertex.types
        if not all(types.get(name) for name in "xyz") or None in types.values():
            raise InputError(
                f"{path}: element vertex has {', '.join([*types][:20])}; scalar x, "
                "y, z are wanted: export the points as a PLY"
            )
        check_size(header)
        known = (names for names in _COLORS if types.keys() >= {*names})
        names = next(known, ())
        kinds = {types[name] or "" for name in names}
        unit = bool(names) and all(kind.startswith("f") for kind in kinds)
        narrow = unit or kinds <= {"u1"}
        require(
            Estimate(
                {"coordinates and colours": header.vertex.rows * (28 if narrow else 34)}
            ),
            f"{path}: {header.vertex.rows:,} points",
            "leave out some of them where the file was made",
        )
        points = np.empty((header.vertex.rows, 3))
        kind = np.uint8 if narrow else np.uint16
        colors = np.full((header.vertex.rows, 3), _GREY, kind)
        wild = np.zeros(header.vertex.rows, bool)
        start, darkest, brightest = 0, 0.0, 0.0
        for size, columns in read_rows(file, header):
            rows = slice(start, start + size)
            for axis, name in enumerate("xyz"):
                points[rows, axis] = columns[name]
                wild[rows] |= ~(np.abs(points[rows, axis]) < 1e30)
            for axis, name in enumerate(names):
                values = columns[name].astype(np.float64)
                wild[rows] |= ~np.isfinite(values)
                values = np.nan_to_num(values)
                brightest = max(brightest, values.max(initial=0.0))
                darkest = min(darkest, values.min(initial=0.0))
                values = np.clip(values, 0, 1) * 255 if unit else values
                colors[rows, axis] = np.rint(
                    np.clip(values, 0, 255 if narrow else 65535)
                )
            start += size
    if wild.any():
        raise InputError(
            f"{path}: {wild.sum()} of {len(points)} points have values that are no "
            f"finite numbers, the first: {np.flatnonzero(wild)[:5].tolist()}; remove "
            "them"
        )
    if unit and brightest > 1.01:
        raise InputError(
            f"{path}: colours are floating-point, and up to {brightest:g}; 0 to 1 is "
            "wanted of such, or whole numbers of type uchar"
        )
    if not unit and not 0 <= darkest <= brightest <= 65535:
        raise InputError(
            f"{path}: colours are from {darkest:g} to {brightest:g}; 0 to 255 is "
            "wanted, of type uchar, or 0 to 65535, of type ushort"
        )
    if brightest > 255:
        colors = (colors.astype(np.uint32) + 128) // 257
    return points, colors.astype(np.uint8, copy=False)
