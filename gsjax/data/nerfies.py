"""Reader of the captures of Nerfies and HyperNeRF.

``dataset.json`` lists the photographs, ``metadata.json`` holds their times, and
``camera/ID.json`` their cameras: the rotation world → camera in OpenCV axes, the
position, and intrinsics in px of the photograph in ``rgb/1x``. The time of a photograph
is its ``time_id``, or its ``warp_id`` where there is none. Photographs of ``train_ids``
are for training and those of ``val_ids`` are held out; others are left out.
"""

from pathlib import Path
from typing import Any

import numpy as np

from gsjax.cameras.distortion import Distortion
from gsjax.data.colmap_model import MAX_COORDINATE, MAX_SIDE
from gsjax.data.image_files import check_factor, find_file, inside
from gsjax.data.transforms_fields import rigid, shown
from gsjax.data.types import (
    Dataset,
    Reader,
    ReadOptions,
    View,
    intrinsic_matrix,
    inverted,
    unexpected,
)
from gsjax.errors import InputError
from gsjax.io.common import warn
from gsjax.io.npy import read_npy
from gsjax.runtime.files import read_bytes, read_json

_LIST, _METADATA, _POINTS = "dataset.json", "metadata.json", "points.npy"
_TIMES = ("time_id", "warp_id")
_REMEDY = "copy the capture again"


def load_nerfies(path: Path, options: ReadOptions | None = None) -> Dataset:
    """Read the dataset of a folder of Nerfies or HyperNeRF; see `load_dataset`."""
    options = options or ReadOptions()
    splits = _splits(path / _LIST)
    metadata = read_json(path / _METADATA, "a metadata.json of Nerfies")
    root = _photographs(path, options)
    views, missing = [], []
    for name, split in splits.items():
        where = f"{path / _METADATA}: {shown(name)}"
        listed = inside(where, name).as_posix()
        file = find_file(root, listed)
        if file is None and not options.poses_only:
            missing.append(name)
            continue
        time = _time(where, metadata.get(name))
        camera = path / "camera" / f"{listed}.json"
        views.append(_view(camera, file or root / f"{listed}.png", time, split))
    if missing:
        fault = f"{path}: {len(missing)} of {len(splits)} photographs are missing"
        if not options.skip_missing or not views:
            raise InputError(
                f"{fault} in {root}, the first: {missing[0]}; put them there, or leave "
                "them out with skip_missing=True (--skip-missing)"
            )
        warn(f"{fault} in {root} and left out: {', '.join(missing[:5])}")
    return Dataset(path, "nerfies", tuple(views), *_points(path / _POINTS))


def _splits(path: Path) -> dict[str, str | None]:
    """Return the names of the photographs that are used, and their splits."""
    data = read_json(path, "a dataset.json of Nerfies")
    lists = {key: data.get(key) or [] for key in ("ids", "train_ids", "val_ids")}
    for key, names in lists.items():
        if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
            raise unexpected(f"{path}: {key}", "a list of names", shown(names), _REMEDY)
    if not lists["train_ids"]:
        return dict.fromkeys(lists["ids"])
    splits: dict[str, str | None] = dict.fromkeys(lists["train_ids"], "train")
    return splits | dict.fromkeys(lists["val_ids"], "test")


def _photographs(path: Path, options: ReadOptions) -> Path:
    """Return the folder of the photographs, rgb/2x for a factor of 2.

    Raises:
      InputError: if there is no such folder.
    """
    check_factor(options.factor)
    if options.images is not None:
        return path / options.images
    there = [p.name for p in (path / "rgb").glob("*x") if p.name[:-1].isdecimal()]
    sizes = sorted(int(name[:-1]) for name in there)
    factor = options.factor or (sizes[0] if sizes else 1)
    root = path / "rgb" / f"{factor}x"
    if not root.is_dir() and not options.poses_only:
        found = ", ".join(f"{size}x" for size in sizes) or "nothing"
        remedy = "pass a factor that is there (--factor)"
        raise unexpected(root, "a folder of photographs", f"{found} in rgb", remedy)
    return root


def _time(where: str, entry: Any) -> float:
    entry = entry if isinstance(entry, dict) else {}
    time = next((entry[key] for key in _TIMES if key in entry), None)
    if isinstance(time, bool) or not isinstance(time, int | float):
        raise unexpected(where, f"a number {_TIMES[0]}", shown(time), _REMEDY)
    if not abs(time) < MAX_COORDINATE:
        raise unexpected(where, f"a finite {_TIMES[0]}", shown(time), _REMEDY)
    return float(time)


def _view(path: Path, file: Path, time: float, split: str | None) -> View:
    """Return the view of a camera file."""
    data = read_json(path, "a camera of Nerfies")
    where = str(path)
    rotation, _ = rigid(where, _numbers(where, data, "orientation", (3, 3)))
    position = _numbers(where, data, "position", (3,))
    size = _numbers(where, data, "image_size", (2,))
    if not all(1 <= side <= MAX_SIDE and side % 1 == 0 for side in size):
        raise unexpected(f"{where}: image_size", "whole sides", size.tolist(), _REMEDY)
    focal = float(_numbers(where, data, "focal_length", ()))
    aspect = float(_numbers(where, data, "pixel_aspect_ratio", (), 1.0))
    if _numbers(where, data, "skew", (), 0.0):
        raise unexpected(f"{where}: skew", "0", shown(data["skew"]), "undistort first")
    cx, cy = _numbers(where, data, "principal_point", (2,)).tolist()
    K = intrinsic_matrix(where, (focal, focal * aspect), (cx, cy))
    k1, k2, k3 = _numbers(where, data, "radial_distortion", (3,), (0.0,) * 3).tolist()
    p1, p2 = _numbers(where, data, "tangential_distortion", (2,), (0.0,) * 2).tolist()
    bent = any((k1, k2, k3, p1, p2))
    lens = Distortion("opencv", (k1, k2, p1, p2, k3)) if bent else None
    width, height = (int(side) for side in size)
    viewmat = inverted(rotation.T, position)
    place = (width, height, lens)
    return View(file.name, file, viewmat, K, *place, split=split, time=time)


def _numbers(
    where: str, data: dict[str, Any], key: str, shape: tuple[int, ...], default=None
) -> np.ndarray:
    """Return finite numbers of a key."""
    value = data.get(key, default)
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.asarray(np.nan)
    if array.shape != shape or not (np.abs(array) < MAX_COORDINATE).all():
        expected = f"finite numbers of shape {list(shape)}"
        raise unexpected(f"{where}: {key}", expected, shown(value), _REMEDY)
    return array


def _points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the points [M, 3], if there are any, in grey."""
    points = np.zeros((0, 3))
    if path.exists():
        points = read_npy(str(path), read_bytes(path, "a points.npy"))
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind != "f":
        got = f"{points.dtype} {list(points.shape)}"
        raise unexpected(path, "floats of shape [M, 3]", got, _REMEDY)
    points = points.astype(np.float64)
    points = points[(np.abs(points) < MAX_COORDINATE).all(1)]
    return points, np.full(points.shape, 128, np.uint8)


NERFIES = Reader(
    "Nerfies",
    lambda p: all((p / name).is_file() for name in (_LIST, _METADATA)),
    load_nerfies,
)
