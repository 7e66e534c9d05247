"""Datasets: photographs with known cameras, whatever program wrote them."""

from dataclasses import replace
from functools import partial
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from gsjax.data.colmap import find_colmap, load_colmap
from gsjax.data.extent import in_one_place, least_extent, near_plane
from gsjax.data.llff import load_llff
from gsjax.data.nerf import find_transforms, load_nerf
from gsjax.data.rebase import rebase
from gsjax.data.types import Dataset
from gsjax.errors import InputError

# How far one camera may stand from the middle of all, times the next; a heuristic. From
# the other on, the next stand in one place, as those of one tripod, but for rounding.
_MOST_APART, _ROUNDING = 1e6, 1e12
# Coordinates of cameras: in float64 a tenth of the unit is left there, and products of
# two are finite in float32.
_FARTHEST = 1e15


def load_dataset(
    path: str | PathLike[str],
    *,
    images: str | PathLike[str] | None = None,
    skip_missing: bool = False,
    factor: int | None = None,
    poses_only: bool = False,
) -> Dataset:
    """Read cameras, points and the names of the photographs of a dataset.

    What it is follows from what is there, in this order:

    - a COLMAP model, .bin or .txt, in ``sparse/0``, ``sparse`` or the folder itself;
      photographs in ``images``, masks (0 is left out) in ``masks``;
    - ``transforms.json`` of nerfstudio or instant-ngp;
    - ``transforms_train.json`` and ``transforms_test.json``, in its absence
      ``transforms_val.json``, of NeRF's synthetic scenes; another list is read where
      ``path`` is the file;
    - ``poses_bounds.npy`` of LLFF.

    Photographs themselves are read by `gsjax.data.photos`. A scene that lies far out
    is moved near the origin of coordinates, see `gsjax.data.rebase`.

    Args:
      path: folder of the dataset, or its .json or .npy file.
      images: name of the folder of the photographs in the dataset, or a path; None for
        ``images``, for a .json the folders in it. In another folder, or one of smaller
        copies, the first folders of a .json's names may be left out; names that lead
        out of the dataset are looked for in ``images`` alone, by their ends.
      skip_missing: leave out photographs that are listed but not there, with a
        warning, instead of raising.
      factor: read the smaller copies in ``images_2``, ``images_4``, …
      poses_only: cameras and points are all that is wanted: photographs need not be
        there, masks are left out, and a `View.image` may be no file.

    Returns:
      Views sorted by name.

    Raises:
      InputError: if nothing of this is there, or a file is missing, truncated,
        damaged or not supported; the message names the file, what was found in it
        and what to do.
    """
    path = Path(path)
    try:
        return _finished(
            _read(path, images, skip_missing, factor, poses_only=poses_only)
        )
    except OSError as error:  # of names that the system does not take, say
        raise InputError(
            f"{str(error.filename or path)[:200]}: {error.strerror or error}; check "
            "the path and its permissions"
        ) from error


def _read(
    path: Path,
    images: str | PathLike[str] | None,
    skip_missing: bool,
    factor: int | None,
    *,
    poses_only: bool,
) -> Dataset:
    """What is there, as its reader gives it."""
    where: dict[str, Any] = {
        "images": images,
        "factor": factor,
        "poses_only": poses_only,
    }
    nerf = partial(load_nerf, skip_missing=skip_missing, **where)
    llff = partial(load_llff, **where)
    if not path.exists():
        raise InputError(f"{path}: does not exist; pass the folder of a dataset")
    if not path.is_dir():
        if path.suffix.lower() == ".json":
            return nerf([path])
        if path.suffix.lower() == ".npy":
            return llff(path)
        raise InputError(f"{path}: pass the folder of a dataset, a .json or a .npy")
    model, lists = find_colmap(path), find_transforms(path)
    # Of nerfstudio's two, its list has what was done to the poses afterwards.
    if model is not None and not (lists and model.parent.parent.name == "colmap"):
        return load_colmap(path, skip_missing=skip_missing, **where)
    if lists:
        return nerf(lists)
    if (path / "poses_bounds.npy").exists():
        return llff(path / "poses_bounds.npy")
    names = sorted(entry.name for entry in path.iterdir())
    raise InputError(
        f"{path}: no dataset is known by its content ({', '.join(names[:12]) or 'none'}"
        "); sparse/0 of COLMAP, transforms.json, transforms_train.json or "
        "poses_bounds.npy is wanted; for photographs alone run `gsjax sfm` first"
    )


def _finished(scene: Dataset) -> Dataset:
    """Views sorted, names unique, a near plane that suits, coordinates near 0."""
    views = sorted(scene.views, key=lambda view: view.name)
    if not views:
        raise InputError(f"{scene.source}: no view is left; at least 1 is wanted")
    for before, after in pairwise(views):
        if before.name == after.name:
            raise InputError(
                f"{scene.source}: the photograph {after.name!r} is listed more than "
                "once; remove all but one"
            )
    centres = np.stack([view.centre for view in views])
    _check_places(scene, [view.name for view in views], centres)
    near = near_plane(centres, least_extent(scene))
    views = tuple(replace(view, near=near) for view in views)
    scene = rebase(replace(scene, views=views))
    return _together(scene) if in_one_place(centres) else scene


def _together(scene: Dataset) -> Dataset:
    """With all cameras where the first is; what they were apart was rounding, which may
    be all that is left of their coordinates by now."""
    centre, moved = scene.views[0].centre, []
    for view in scene.views:
        viewmat = view.viewmat.copy()
        viewmat[:3, 3] = -viewmat[:3, :3] @ centre
        moved.append(replace(view, viewmat=viewmat))
    return replace(scene, views=tuple(moved))


def _check_places(scene: Dataset, names: list[str], centres: np.ndarray) -> None:
    """Refuse cameras that stand where nothing could be learnt with them.

    One alone at the end of the world makes the extent of the scene, by which all is
    measured, that of the world.
    """
    apart = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    worst = int(np.argmax(apart))
    others = float(np.max(np.delete(apart, worst), initial=0))
    if _MOST_APART * others < apart[worst] < _ROUNDING * others:
        raise InputError(
            f"{scene.source}: the camera of {names[worst]!r} stands {apart[worst]:.3g} "
            f"from the middle of all, the others within {others:.3g}; its pose is "
            "damaged: remove the photograph, or estimate the cameras again"
        )
    worst = int(np.argmax(np.abs(centres).max(axis=1)))
    if np.abs(centres[worst]).max() > _FARTHEST:
        where = ", ".join(f"{value:.3g}" for value in centres[worst])
        raise InputError(
            f"{scene.source}: the camera of {names[worst]!r} stands at {where}; at "
            f"most {_FARTHEST:g} from the origin is wanted: estimate the cameras again"
        )


def is_dataset(path: Path) -> bool:
    """Whether a folder has what `load_dataset` knows a dataset by."""
    known = find_colmap(path) is not None or bool(find_transforms(path))
    return known or (path / "poses_bounds.npy").exists()
