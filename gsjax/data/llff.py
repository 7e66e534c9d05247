"""LLFF's `poses_bounds.npy`: one row a photograph, in the order of their names.

A row has 17 numbers: a 3 × 5 matrix (camera → world rotation with axes down, right,
back; the camera's position; image height, width and focal length in px), then the
nearest and farthest depth, which are not used.
"""

from os import PathLike
from pathlib import Path

import numpy as np

from gsjax.data.colmap_model import MAX_COORDINATE, MAX_SIDE
from gsjax.data.image_files import check_name, image_folder, is_photograph
from gsjax.data.transforms_fields import rigid
from gsjax.data.types import Dataset, View, intrinsic_matrix
from gsjax.errors import InputError
from gsjax.io.npy import read_npy
from gsjax.runtime.files import read_bytes

_COLUMNS = 17


def load_llff(
    path: Path,
    *,
    images: str | PathLike[str] | None = None,
    factor: int | None = None,
    poses_only: bool = False,
) -> Dataset:
    """The scene of a `poses_bounds.npy` and the folder beside it; see `load_dataset`.

    Raises:
      InputError: if the file is no such array, is truncated, has poses that are none,
        or the number of photographs is not that of its rows.
    """
    table = read_poses(path)
    root = image_folder(path.parent, images, factor, poses_only=poses_only)
    there = root.iterdir() if root.is_dir() else ()
    files = sorted(p for p in there if is_photograph(p))
    if poses_only and len(files) != len(table):
        files = [root / f"row_{index:04d}.png" for index in range(len(table))]
    if len(files) != len(table):
        raise InputError(
            f"{path}: {len(table)} rows, but {root} has {len(files)} photographs; as "
            "rows have no names, the photographs must be exactly those of the rows"
        )
    for file in files:
        check_name(file)
    views = [
        _view(f"{path}: row {index}", row, file)
        for index, (row, file) in enumerate(zip(table, files))
    ]
    return Dataset(path, "llff", tuple(views))


def _view(where: str, row: np.ndarray, file: Path) -> View:
    if not (np.abs(row) < MAX_COORDINATE).all():
        raise InputError(
            f"{where}: values that are no finite numbers: {row.tolist()}; remove the "
            "row and its photograph"
        )
    matrix = row[:15].reshape(3, 5)
    height, width, focal = matrix[:, 4].tolist()
    sides = (width, height)
    if not all(1 <= v <= MAX_SIDE and v % 1 == 0 for v in sides):
        raise InputError(
            f"{where}: height {height:g}, width {width:g}; whole sizes ≥ 1 are wanted"
        )
    # Down, right, back → right, down, forward.
    block = matrix[:, [1, 0, 2]] * (1, 1, -1)
    rotation, _ = rigid(where, block)
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation.T, -rotation.T @ matrix[:, 3]
    K = intrinsic_matrix(where, (focal, focal), (width / 2, height / 2))
    return View(file.name, file, viewmat, K, int(width), int(height))


def read_poses(path: Path) -> np.ndarray:
    """[N, 17] float64 of a .npy file, which is held against its size first."""
    table = read_npy(str(path), read_bytes(path, "a poses_bounds.npy"))
    if table.shape[1:] != (_COLUMNS,) or table.dtype.kind != "f":
        raise InputError(
            f"{path}: the header is that of {table.dtype} {list(table.shape)}; floats "
            f"[N, {_COLUMNS}] are wanted: is it a poses_bounds.npy?"
        )
    return table.astype(np.float64)
