"""Cameras as a run refined them: worked out, written and read back."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from captures import scene_of_views

from gsjax.cameras.camera import make_camera
from gsjax.data.types import Photo
from gsjax.errors import InputError
from gsjax.runs.refined_cameras import (
    refined_photos,
    refined_scene,
    save_cameras,
    with_cameras,
)
from gsjax.train.camera_refinement import CameraRefinement, refine_camera

EXTENT, TRAINED = 2.0, [0, 2, 3]


def learnt(seed: int = 0) -> CameraRefinement:
    """Corrections of three views, as a run in float32 learns them."""
    rng = np.random.default_rng(seed)
    turns, shifts = rng.normal(scale=0.02, size=(2, len(TRAINED), 3))
    intrinsics = rng.normal(scale=0.02, size=4)
    return jax.tree.map(
        lambda a: jnp.asarray(a, jnp.float32),
        CameraRefinement(turns, shifts, intrinsics, None),
    )


def test_nothing_learnt_changes_nothing():
    scene = scene_of_views(5)
    nothing = jax.tree.map(jnp.zeros_like, learnt())
    found = refined_scene(scene, TRAINED, nothing, EXTENT)
    for before, after in zip(scene.views, found.views, strict=True):
        np.testing.assert_allclose(after.viewmat, before.viewmat, rtol=0, atol=1e-12)
        np.testing.assert_allclose(after.K, before.K, rtol=1e-12)


def test_they_are_the_cameras_that_the_steps_rendered_with():
    scene, refinement = scene_of_views(5), learnt()
    found = refined_scene(scene, TRAINED, refinement, EXTENT)
    for row, index in enumerate(TRAINED):
        view = scene.views[index]
        camera = make_camera(
            viewmat=view.viewmat[None],
            K=view.K[None],
            width=view.width + 7,  # padded, beside larger ones in a batch
            height=view.height + 20,
        )
        wanted = refine_camera(camera, refinement, jnp.asarray([row]), EXTENT)
        np.testing.assert_allclose(
            found.views[index].viewmat, wanted.viewmat[0], atol=1e-6
        )
        np.testing.assert_allclose(found.views[index].K, wanted.K[0], rtol=1e-6)
        assert np.abs(found.views[index].viewmat - view.viewmat).max() > 1e-3
    # Of the others only what all have in common is known.
    for index in {0, 1, 2, 3, 4} - set(TRAINED):
        before, after = scene.views[index], found.views[index]
        np.testing.assert_allclose(after.viewmat, before.viewmat, rtol=0, atol=1e-12)
        assert np.abs(after.K - before.K).max() > 1e-3
        np.testing.assert_allclose(
            np.linalg.inv(before.K) @ after.K,  # in focal lengths
            np.linalg.inv(scene.views[0].K) @ found.views[0].K,
            atol=1e-9,
        )


def test_written_and_read_back(tmp_path):
    """In the coordinates of the files: to the last digits that those leave."""
    scene = replace(scene_of_views(5), origin=np.asarray([4e5, -3e6, 20.0]))
    refined = refined_scene(scene, TRAINED, learnt(), EXTENT)
    path = tmp_path / "cameras.json"
    save_cameras(path, refined)
    found = with_cameras(scene, path)
    for wanted, view in zip(refined.views, found.views, strict=True):
        np.testing.assert_allclose(view.viewmat, wanted.viewmat, rtol=0, atol=1e-8)
        np.testing.assert_array_equal(view.K, wanted.K)
    # Whatever origin the reader chooses.
    at_zero = with_cameras(replace(scene, origin=np.zeros(3)), path)
    np.testing.assert_allclose(
        at_zero.views[0].centre, refined.views[0].centre + scene.origin, atol=1e-8
    )


def test_of_another_dataset(tmp_path):
    path = tmp_path / "cameras.json"
    save_cameras(path, scene_of_views(3))
    with pytest.raises(InputError, match=r"cameras\.json"):
        with_cameras(scene_of_views(5), path)


def test_photographs_keep_their_scale():
    scene = scene_of_views(3)
    refined = refined_scene(scene, [0, 1, 2], learnt(), EXTENT)
    half = np.diag([0.5, 0.5, 1.0])
    empty = np.zeros((4, 4, 3), np.uint8)
    photos = [Photo(empty, None, None, half @ view.K) for view in scene.views]
    found = refined_photos(photos, scene.views, refined.views)
    for photo, view in zip(found, refined.views, strict=True):
        np.testing.assert_allclose(photo.K, half @ view.K, atol=1e-9)
