"""Cameras refined by a run: computed, written and read.

Axis legend: V training views.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import make_camera
from gsjax.cameras.distortion import Distortion, lens_fields
from gsjax.data.colmap_model import MAX_COORDINATE
from gsjax.data.types import Dataset, Photo, View
from gsjax.errors import InputError
from gsjax.runtime.files import read_json, write_json
from gsjax.train.camera_refinement import CameraRefinement, refine_camera
from gsjax.train.config import TrainConfig
from gsjax.train.frames import with_shutter_of

_RIGID_TOLERANCE = 1e-3


def refine_dataset(
    dataset: Dataset,
    trained: Sequence[int],
    refinement: CameraRefinement,
    extent: float,
    config: TrainConfig,
) -> Dataset:
    """Return the dataset with corrected cameras.

    Args:
      dataset: all views.
      trained: indices of the V training views. Poses of other views are not corrected;
        intrinsics are common to all views.
      refinement, extent: learnt corrections, and the extent of the training views.
      config: of the run.
    """
    rows = {index: row for row, index in enumerate(trained)}
    with jax.enable_x64(True):
        wide = jax.tree.map(
            lambda a: jnp.asarray(np.asarray(a, np.float64)), refinement
        )
        shared = CameraRefinement(
            intrinsics=wide.intrinsics, distortion=wide.distortion
        )
        views = []
        for i, view in enumerate(dataset.views):
            corrections = wide if i in rows else shared
            views.append(_refine(view, corrections, rows.get(i, 0), extent, config))
    return replace(dataset, views=tuple(views))


def _refine(
    view: View,
    refinement: CameraRefinement,
    row: int,
    extent: float,
    config: TrainConfig,
) -> View:
    lens = None if config.undistort else view.lens
    camera = make_camera(
        viewmat=view.viewmat[None],
        K=view.K[None],
        width=view.width,
        height=view.height,
        **lens_fields([lens], distorting=config.refine_intrinsics),
    )
    camera = with_shutter_of([view], config.shutter, camera)
    moved = refine_camera(camera, refinement, jnp.asarray([row]), extent)
    if moved.coefficients is not None:
        values = tuple(np.asarray(moved.coefficients[0], float).tolist())
        lens = Distortion(moved.lens.name, values)
    return replace(
        view,
        viewmat=np.asarray(moved.viewmat[0]),
        K=np.asarray(moved.K[0]),
        lens=lens,
        twist=None if moved.twist is None else np.asarray(moved.twist[0]),
    )


def refine_photos(
    photos: Sequence[Photo], given: Sequence[View], refined: Sequence[View]
) -> list[Photo]:
    """Return photographs loaded for ``given`` views with the K of ``refined`` ones.

    The pixels stay; if they were undistorted, then by the original lens.
    """
    return [
        photo._replace(K=photo.K @ np.linalg.solve(before.K, after.K), lens=after.lens)
        if after is not before
        else photo
        for photo, before, after in zip(photos, given, refined, strict=True)
    ]


def save_cameras(path: Path, dataset: Dataset) -> None:
    """Write all cameras in the coordinates of the dataset's files; as `write_json`."""
    views = []
    for view in dataset.views:
        viewmat = _translate(view.viewmat, -dataset.origin).tolist()
        record = {"name": view.name, "viewmat": viewmat, "K": view.K.tolist()}
        if view.lens is not None:
            record |= {"lens": view.lens.model, "coefficients": view.lens.coefficients}
        if view.twist is not None:
            record["twist"] = view.twist.tolist()
        views.append(record)
    write_json(path, {"views": views})


def load_cameras(dataset: Dataset, path: Path) -> Dataset:
    """Return the dataset with the cameras of a file of `save_cameras`.

    Raises:
      InputError: if the file is damaged, or lacks a view.
    """
    data = read_json(path, "the cameras.json of a run")
    try:
        found = {view["name"]: view for view in data["views"]}
        views = []
        for view in dataset.views:
            viewmat, K = (
                np.asarray(found[view.name][name], np.float64).reshape(size, size)
                for name, size in (("viewmat", 4), ("K", 3))
            )
            if not (_is_rigid(viewmat) and np.isfinite(K).all()):
                raise ValueError(f"{view.name}: expected a rigid pose and finite K")
            viewmat, record = _translate(viewmat, dataset.origin), found[view.name]
            lens, twist = None, record.get("twist")
            if "lens" in record:
                lens = Distortion(record["lens"], tuple(record["coefficients"]))
                assert lens.lens.name == record["lens"]  # raises for an unknown lens
            if twist is not None:
                twist = np.asarray(twist, np.float64).reshape(6)
            views.append(replace(view, viewmat=viewmat, K=K, lens=lens, twist=twist))
        return replace(dataset, views=tuple(views))
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        fault = f"damaged, or of another dataset: {error!r}"
        remedy = "remove it to use the cameras of the dataset"
        raise InputError(f"{path}: {fault}; {remedy}") from error


def _is_rigid(viewmat: np.ndarray) -> bool:
    rotation = viewmat[:3, :3]
    return bool(
        (np.abs(viewmat) < MAX_COORDINATE).all()
        and np.abs(rotation @ rotation.T - np.eye(3)).max() < _RIGID_TOLERANCE
        and np.linalg.det(rotation) > 0
        and (viewmat[3] == (0, 0, 0, 1)).all()
    )


def _translate(viewmat: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the same camera in coordinates with the origin at ``origin``."""
    moved = viewmat.copy()
    moved[:3, 3] += viewmat[:3, :3] @ origin
    return moved
