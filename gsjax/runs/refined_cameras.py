"""Cameras as a run refined them: worked out, written and read back.

Axis legend: V views that were trained on.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import make_camera
from gsjax.data.colmap_model import MAX_COORDINATE
from gsjax.data.types import Dataset, Photo, View
from gsjax.errors import InputError
from gsjax.runtime.files import read_json, write_json
from gsjax.train.camera_refinement import CameraRefinement, refine_camera

_RIGID_TOLERANCE = 1e-3


def refined_scene(
    scene: Dataset, trained: Sequence[int], refinement: CameraRefinement, extent: float
) -> Dataset:
    """The scene with its cameras corrected.

    Args:
      scene: all views of the dataset.
      trained: V indices of those that the corrections are of; of the others, only the
        intrinsics are corrected, which all have in common.
      refinement: what was learnt.
      extent: of the training views.
    """
    place = {index: row for row, index in enumerate(trained)}
    for_all = CameraRefinement(intrinsics=refinement.intrinsics)
    with jax.enable_x64(True):
        wide, wide_for_all = jax.tree.map(
            lambda a: jnp.asarray(np.asarray(a, np.float64)), (refinement, for_all)
        )
        views = [
            _refined(view, wide, place[index], extent)
            if index in place
            else _refined(view, wide_for_all, 0, extent)
            for index, view in enumerate(scene.views)
        ]
    return replace(scene, views=tuple(views))


def _refined(view: View, refinement: CameraRefinement, row: int, extent: float) -> View:
    camera = make_camera(
        viewmat=view.viewmat[None], K=view.K[None], width=view.width, height=view.height
    )
    moved = refine_camera(camera, refinement, jnp.asarray([row]), extent)
    return replace(view, viewmat=np.asarray(moved.viewmat[0]), K=np.asarray(moved.K[0]))


def refined_photos(
    photos: Sequence[Photo], given: Sequence[View], refined: Sequence[View]
) -> list[Photo]:
    """Photographs that were loaded for ``given`` views, for those views refined.

    They are not loaded anew: what undistorts them is the lens as it was given.
    """
    return [
        photo._replace(K=photo.K @ np.linalg.solve(before.K, after.K))
        for photo, before, after in zip(photos, given, refined, strict=True)
    ]


def save_cameras(path: Path, scene: Dataset) -> None:
    """Write the cameras of all views, in the coordinates of the dataset's files.

    Raises:
      InputError: if it cannot be written.
    """
    views = [
        {
            "name": view.name,
            "viewmat": _moved(view.viewmat, -scene.origin).tolist(),
            "K": view.K.tolist(),
        }
        for view in scene.views
    ]
    write_json(path, {"views": views})


def with_cameras(scene: Dataset, path: Path) -> Dataset:
    """The scene with the cameras of a file that `save_cameras` wrote.

    Raises:
      InputError: if the file is damaged, or a view is not in it.
    """
    data = read_json(path, "the cameras.json of a run")
    try:
        found = {view["name"]: view for view in data["views"]}
        views = []
        for view in scene.views:
            viewmat, K = (
                np.asarray(found[view.name][name], np.float64).reshape(size, size)
                for name, size in (("viewmat", 4), ("K", 3))
            )
            if not (_is_rigid(viewmat) and np.isfinite(K).all()):
                raise ValueError(f"{view.name}: no rigid pose, or not finite")
            viewmat = _moved(viewmat, scene.origin)
            views.append(replace(view, viewmat=viewmat, K=K))
        return replace(scene, views=tuple(views))
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(
            f"{path}: damaged, or of another dataset: {error!r}; remove it to use the "
            "cameras of the dataset"
        ) from error


def _is_rigid(viewmat: np.ndarray) -> bool:
    rotation = viewmat[:3, :3]
    good = (np.abs(viewmat) < MAX_COORDINATE).all()
    return bool(
        good
        and np.abs(rotation @ rotation.T - np.eye(3)).max() < _RIGID_TOLERANCE
        and np.linalg.det(rotation) > 0
        and (viewmat[3] == (0, 0, 0, 1)).all()
    )


def _moved(viewmat: np.ndarray, by: np.ndarray) -> np.ndarray:
    """The same camera where the world's origin is at ``by``."""
    moved = viewmat.copy()
    moved[:3, 3] += viewmat[:3, :3] @ by
    return moved
