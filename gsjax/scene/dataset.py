"""Datasets: photographs with known cameras, whatever program wrote them."""

from dataclasses import replace
from functools import partial
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from gsjax.errors import InputError
from gsjax.scene.colmap import find_colmap, load_colmap
from gsjax.scene.initialise import near_plane
from gsjax.scene.llff import load_llff
from gsjax.scene.nerf import find_transforms, load_nerf
from gsjax.scene.rebase import rebase
from gsjax.scene.types import Scene


def load_dataset(
    path: str | PathLike[str],
    *,
    images: str | PathLike[str] | None = None,
    skip_missing: bool = False,
    factor: int | None = None,
    poses_only: bool = False,
) -> Scene:
    """Read cameras, points and the names of the photographs of a dataset.

    What it is follows from what is there, in this order:

    - a COLMAP model, .bin or .txt, in ``sparse/0``, ``sparse`` or the folder itself;
      photographs in ``images``, masks (0 is left out) in ``masks``;
    - ``transforms.json`` of nerfstudio or instant-ngp;
    - ``transforms_train.json`` and ``transforms_test.json``, in its absence
      ``transforms_val.json``, of NeRF's synthetic scenes; another list is read where
      ``path`` is the file;
    - ``poses_bounds.npy`` of LLFF.

    Photographs themselves are read by `gsjax.scene.photos`. A scene that lies far out
    is moved near the origin of coordinates, see `gsjax.scene.rebase`.

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
            return _finished(nerf([path]))
        if path.suffix.lower() == ".npy":
            return _finished(llff(path))
        raise InputError(f"{path}: pass the folder of a dataset, a .json or a .npy")
    if find_colmap(path) is not None:
        return _finished(load_colmap(path, skip_missing=skip_missing, **where))
    lists = find_transforms(path)
    if lists:
        return _finished(nerf(lists))
    if (path / "poses_bounds.npy").exists():
        return _finished(llff(path / "poses_bounds.npy"))
    names = sorted(entry.name for entry in path.iterdir())
    raise InputError(
        f"{path}: no dataset is known by its content ({', '.join(names[:12]) or 'none'}"
        "); sparse/0 of COLMAP, transforms.json, transforms_train.json or "
        "poses_bounds.npy is wanted; for photographs alone run `gsjax sfm` first"
    )


def _finished(scene: Scene) -> Scene:
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
    near = near_plane(np.stack([view.centre for view in views]))
    views = tuple(replace(view, near=near) for view in views)
    return rebase(replace(scene, views=views))


def is_dataset(path: Path) -> bool:
    """Whether a folder has what `load_dataset` knows a dataset by."""
    known = find_colmap(path) is not None or bool(find_transforms(path))
    return known or (path / "poses_bounds.npy").exists()
