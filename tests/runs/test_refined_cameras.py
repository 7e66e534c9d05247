"""Cameras refined by a run: computed, written and read."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from captures import dataset_of_views

import gsjax
from gsjax.cameras.camera import make_camera, with_shutter
from gsjax.data.types import Photo
from gsjax.errors import InputError
from gsjax.runs.refined_cameras import (
    load_cameras,
    refine_dataset,
    refine_photos,
    save_cameras,
)
from gsjax.train.camera_refinement import CameraRefinement, refine_camera

EXTENT, TRAINED = 2.0, [0, 2, 3]
CONFIG = gsjax.TrainConfig(
    refine_intrinsics=True, refine_shutter=True, shutter="top_to_bottom"
)


def learnt() -> CameraRefinement:
    """Return float32 corrections of three views."""
    rng = np.random.default_rng(0)
    turns, shifts = rng.normal(scale=0.02, size=(2, len(TRAINED), 3))
    found = CameraRefinement(
        turns=turns,
        shifts=shifts,
        intrinsics=rng.normal(scale=0.02, size=4),
        distortion=rng.normal(scale=0.02, size=12),
        twists=rng.normal(scale=0.02, size=(len(TRAINED), 6)),
    )
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), found)


def test_cameras_are_those_of_the_training_steps():
    dataset, refinement = dataset_of_views(5), learnt()
    found = refine_dataset(dataset, TRAINED, refinement, EXTENT, CONFIG)
    for row, index in enumerate(TRAINED):
        view = dataset.views[index]
        # Padded, beside larger ones in a batch.
        width, height = view.width + 7, view.height + 20
        pose, K = view.viewmat[None], view.K[None]
        camera = make_camera(
            viewmat=pose,
            K=K,
            width=width,
            height=height,
            lens="opencv",
            coefficients=np.zeros((1, 4)),
        )
        camera = with_shutter(camera, "top_to_bottom", twist=np.zeros(6))
        wanted = refine_camera(camera, refinement, jnp.asarray([row]), EXTENT)
        refined = found.views[index]
        np.testing.assert_allclose(refined.viewmat, wanted.viewmat[0], atol=1e-6)
        np.testing.assert_allclose(refined.K, wanted.K[0], rtol=1e-6)
        values = refined.lens.coefficients
        np.testing.assert_allclose(values, wanted.coefficients[0], atol=1e-7)
        np.testing.assert_allclose(refined.twist, wanted.twist[0], atol=1e-7)
        assert np.abs(refined.viewmat - view.viewmat).max() > 1e-3
    # Other views share only the intrinsics.
    for index in {0, 1, 2, 3, 4} - set(TRAINED):
        before, after = dataset.views[index], found.views[index]
        np.testing.assert_allclose(after.viewmat, before.viewmat, rtol=0, atol=1e-12)
        assert np.abs(after.K - before.K).max() > 1e-3
        np.testing.assert_allclose(
            np.linalg.inv(before.K) @ after.K,  # in focal lengths
            np.linalg.inv(dataset.views[0].K) @ found.views[0].K,
            atol=1e-9,
        )
    nothing = jax.tree.map(jnp.zeros_like, refinement)
    same = refine_dataset(dataset, TRAINED, nothing, EXTENT, CONFIG)
    for before, after in zip(dataset.views, same.views, strict=True):
        np.testing.assert_allclose(after.viewmat, before.viewmat, rtol=0, atol=1e-12)
        np.testing.assert_allclose(after.K, before.K, rtol=1e-12)
    # Photographs that were scaled keep their scale.
    half = np.diag([0.5, 0.5, 1.0])
    empty = np.zeros((4, 4, 3), np.uint8)
    photos = [Photo(empty, None, None, half @ view.K) for view in dataset.views]
    photos = refine_photos(photos, dataset.views, found.views)
    for photo, view in zip(photos, found.views, strict=True):
        np.testing.assert_allclose(photo.K, half @ view.K, atol=1e-9)


def test_round_trip_through_a_file_is_exact_for_any_origin(tmp_path):
    dataset = replace(dataset_of_views(5), origin=np.asarray([4e5, -3e6, 20.0]))
    refined = refine_dataset(dataset, TRAINED, learnt(), EXTENT, CONFIG)
    path = tmp_path / "cameras.json"
    save_cameras(path, refined)
    found = load_cameras(dataset, path)
    for wanted, view in zip(refined.views, found.views, strict=True):
        np.testing.assert_allclose(view.viewmat, wanted.viewmat, rtol=0, atol=1e-8)
        np.testing.assert_array_equal(view.K, wanted.K)
        assert view.lens == wanted.lens
        np.testing.assert_array_equal(view.twist, wanted.twist)
    at_zero = load_cameras(replace(dataset, origin=np.zeros(3)), path)
    np.testing.assert_allclose(
        at_zero.views[0].centre, refined.views[0].centre + dataset.origin, atol=1e-8
    )
    save_cameras(path, dataset_of_views(3))  # lacks views
    with pytest.raises(InputError, match=r"cameras\.json"):
        load_cameras(dataset, path)
