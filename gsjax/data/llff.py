"""Reader of LLFF's `poses_bounds.npy`: one row per photograph, in the order of names.

A row has 17 numbers: a 3 × 5 matrix (camera → world rotation with axes down, right,
back; the camera's position; image height, width and focal length in px), then the
nearest and farthest depth, which are not used.

A row may also be that of a fixed camera, whose frames are in a folder of its own, as in
the Neural 3D Video dataset. The first of several cameras is then held out.
"""

from dataclasses import replace
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
    inverted,
    unexpected,
)
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
    cameras = _camera_folders(path.parent, len(table), options)
    if cameras:
        return _of_fixed_cameras(path, table, cameras)
    root = image_folder(path.parent, options)
    there = root.iterdir() if root.is_dir() else ()
    files = sorted(p for p in there if is_photograph(p))
    if options.poses_only and len(files) != len(table):
        files = [root / f"row_{index:04d}.png" for index in range(len(table))]
    if len(files) != len(table):
        expected = f"{len(table)} photographs in {root}, one per row"
        remedy = "rows have no names: put exactly their photographs there"
        raise unexpected(path, expected, len(files), remedy)
    for file in files:
        check_name(file)
    views = [
        _view(f"{path}: row {index}", row, file)
        for index, (row, file) in enumerate(zip(table, files))
    ]
    return Dataset(path, "llff", tuple(views))


def _camera_folders(path: Path, rows: int, options: ReadOptions) -> list[list[Path]]:
    """Return the frames of each camera, if there is a folder of frames for each row.

    The folders are in the dataset, or in its folder of photographs.
    """
    suffix = f"_{options.factor}" if (options.factor or 1) > 1 else ""
    for root in (path, path / f"{options.images or 'images'}{suffix}"):
        folders = (
            sorted(p for p in root.iterdir() if p.is_dir()) if root.is_dir() else []
        )
        inner = [p / f"images{suffix}" for p in folders]
        places = [b if b.is_dir() else a for a, b in zip(folders, inner)]
        frames = [sorted(filter(is_photograph, p.iterdir())) for p in places]
        frames = [found for found in frames if found]
        if (
            rows > 1
            and len(frames) == rows
            and not any(map(is_photograph, root.iterdir()))
        ):
            return frames
    return []


def _of_fixed_cameras(
    path: Path, table: np.ndarray, cameras: list[list[Path]]
) -> Dataset:
    """Return the dataset of the frames of fixed cameras, in the order of the rows."""
    views = []
    for index, (row, frames) in enumerate(zip(table, cameras)):
        first = _view(f"{path}: row {index}", row, frames[0])
        split = "test" if index == 0 and len(cameras) > 2 else "train"
        for file in frames:
            name = file.relative_to(path.parent).as_posix()
            views.append(replace(first, name=name, image=file, split=split))
    return Dataset(path, "llff", tuple(views))


def _view(where: str, row: np.ndarray, file: Path) -> View:
    if not (np.abs(row) < MAX_COORDINATE).all():
        remedy = "remove the row and its photograph"
        raise unexpected(where, "finite numbers", row.tolist(), remedy)
    matrix = row[:15].reshape(3, 5)
    height, width, focal = matrix[:, 4].tolist()
    if not all(1 <= side <= MAX_SIDE and side % 1 == 0 for side in (width, height)):
        expected = f"a whole height and width from 1 to {MAX_SIDE}"
        raise unexpected(where, expected, f"{height:g}, {width:g}")
    # Down, right, back → right, down, forward.
    block = matrix[:, [1, 0, 2]] * (1, 1, -1)
    rotation, _ = rigid(where, block)
    viewmat = inverted(rotation, matrix[:, 3])
    K = intrinsic_matrix(where, (focal, focal), (width / 2, height / 2))
    return View(file.name, file, viewmat, K, int(width), int(height))


def read_poses(path: Path) -> np.ndarray:
    """Return the [N, 17] float64 table of a .npy file, whose size is checked first."""
    table = read_npy(str(path), read_bytes(path, "a poses_bounds.npy"))
    if table.shape[1:] != (_COLUMNS,) or table.dtype.kind != "f":
        expected = f"floats of shape [N, {_COLUMNS}] in the header"
        got, remedy = f"{table.dtype} {list(table.shape)}", f"pass a {_FILE}"
        raise unexpected(path, expected, got, remedy)
    return table.astype(np.float64)


LLFF = Reader(
    "LLFF",
    lambda p: (p / _FILE).exists() if p.is_dir() else p.suffix.lower() == ".npy",
    load_llff,
)
