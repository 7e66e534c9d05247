"""Reader of LLFF's `poses_bounds.npy`: one row per photograph, in the order of names.

A row has 17 numbers: a 3 × 5 matrix (camera → world rotation with axes down, right,
back; the camera's position; image height, width and focal length in px), then the
nearest and farthest depth, which are not used.
"""

from pathlib import Path

import numpy as np

from gsjax.data.colmap_model import MAX_COORDINATE, MAX_SIDE
from gsjax.data.image_files import check_name, image_folder, is_photograph
from gsjax.data.transforms_fields import rigid
from gsjax.data.types import (
    Dataset,
    Reader,
    ReadOptions,
    View,
    intrinsic_matrix,
    unexpected,
)
from gsjax.errors import InputError
from gsjax.io.npy import read_npy
from gsjax.runtime.files import read_bytes

_FILE, _COLUMNS = "poses_bounds.npy", 17


def load_llff(path: Path, options: ReadOptions | None = None) -> Dataset:
    """Read the dataset of a `poses_bounds.npy`, or of the folder that contains it.

    Raises:
      InputError: if the file is truncated or holds something else, a row is not a pose,
        or the number of photographs differs from that of rows.
    """
    options = options or ReadOptions()
    path = path / _FILE if path.is_dir() else path
    table = read_poses(path)
    root = image_folder(path.parent, options)
    there = root.iterdir() if root.is_dir() else ()
    files = sorted(p for p in there if is_photograph(p))
    if options.poses_only and len(files) != len(table):
        files = [root / f"row_{index:04d}.png" for index in range(len(table))]
    if len(files) != len(table):
        raise InputError(
            f"{path}: expected {len(table)} photographs in {root}, one per row, got "
            f"{len(files)}; rows have no names: put exactly their photographs there"
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
        raise unexpected(
            where, "finite numbers", row.tolist(), "remove the row and its photograph"
        )
    matrix = row[:15].reshape(3, 5)
    height, width, focal = matrix[:, 4].tolist()
    sides = (width, height)
    if not all(1 <= v <= MAX_SIDE and v % 1 == 0 for v in sides):
        raise InputError(
            f"{where}: expected a whole height and width from 1 to {MAX_SIDE}, got "
            f"{height:g}, {width:g}; export the poses again"
        )
    # Down, right, back → right, down, forward.
    block = matrix[:, [1, 0, 2]] * (1, 1, -1)
    rotation, _ = rigid(where, block)
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation.T, -rotation.T @ matrix[:, 3]
    K = intrinsic_matrix(where, (focal, focal), (width / 2, height / 2))
    return View(file.name, file, viewmat, K, int(width), int(height))


def read_poses(path: Path) -> np.ndarray:
    """Return the [N, 17] float64 table of a .npy file, whose size is checked first."""
    table = read_npy(str(path), read_bytes(path, "a poses_bounds.npy"))
    if table.shape[1:] != (_COLUMNS,) or table.dtype.kind != "f":
        raise InputError(
            f"{path}: expected floats of shape [N, {_COLUMNS}] in the header, got "
            f"{table.dtype} {list(table.shape)}; pass a poses_bounds.npy"
        )
    return table.astype(np.float64)


def _detect(path: Path) -> bool:
    if path.is_dir():
        return (path / _FILE).exists()
    return path.suffix.lower() == ".npy"


LLFF = Reader("LLFF", _detect, load_llff)
