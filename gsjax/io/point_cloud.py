"""Coloured points of a PLY file: the clouds that datasets come with."""

import stat
from os import PathLike
from pathlib import Path

import numpy as np

from gsjax.errors import InputError
from gsjax.io.ply_header import check_size, read_header
from gsjax.io.ply_rows import read_rows

_GREY = 128


def read_point_cloud(path: str | PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    """Points [M, 3] float64 and colours [M, 3] uint8, in the order of the file.

    Properties are found by name: x y z, and red green blue, which are 0 to 255, or 0
    to 1 where they are floating-point; grey where there are none.

    Args:
      path: the file, binary or ascii.

    Raises:
      InputError: if the file cannot be read, is no PLY, is truncated, has no x y z,
        or values that are not finite.
    """
    path = Path(path)
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise InputError(f"{path}: not a regular file; pass a .ply file")
        with path.open("rb") as file:
            header = read_header(file, path)
            types = header.vertex.types
            if not all(types.get(name) for name in "xyz") or None in types.values():
                raise InputError(
                    f"{path}: element vertex has {', '.join([*types][:20])}; scalar x, "
                    "y, z are wanted: export the points as a PLY"
                )
            check_size(header)
            names = [name for name in ("red", "green", "blue") if name in types]
            names = names if len(names) == 3 else []
            points = np.empty((header.vertex.rows, 3))
            colors = np.full((header.vertex.rows, 3), float(_GREY))
            start = 0
            for size, columns in read_rows(file, header):
                rows = slice(start, start + size)
                for target, source in ((points, "xyz"), (colors, names)):
                    for axis, name in enumerate(source):
                        target[rows, axis] = columns[name]
                start += size
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read: {error.strerror or error}; check the path and "
            "its permissions"
        ) from error
    unit = bool(names) and all((types[name] or "").startswith("f") for name in names)
    _check(path, points, colors)
    colors = np.clip(np.rint(colors * (255 if unit else 1)), 0, 255)
    return points, colors.astype(np.uint8)


def _check(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    wild = ~((np.abs(points) < 1e30).all(axis=1) & np.isfinite(colors).all(axis=1))
    if wild.any():
        raise InputError(
            f"{path}: {wild.sum()} of {len(points)} points have values that are no "
            f"finite numbers, the first: {np.flatnonzero(wild)[:5].tolist()}; remove "
            "them"
        )
