"""Cameras of the views of a dataset and of paths: sizes, names and depth ranges."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import gsjax
from gsjax.cameras.camera import look_at
from gsjax.data.photos import load_photo
from gsjax.data.transforms import CameraEntry
from gsjax.data.types import Dataset, View
from gsjax.runs.trajectories import (
    CAMERA_PATHS,
    depth_limits,
    path_entries,
    view_entries,
)

K = np.asarray([[90.0, 0, 49.5], [0, 91.0, 36.0], [0, 0, 1]])


@pytest.fixture
def dataset(tmp_path) -> Dataset:
    """Three views of 101 × 75 px in two folders."""
    views = []
    for index, name in enumerate(("a/0.png", "a/1.png", "b/0.png")):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(cv2.imencode(".png", np.zeros((75, 101, 3), np.uint8))[1])
        viewmat = look_at((np.cos(index), np.sin(index), 1), (0, 0, 0))
        views.append(View(f"images/{name}", path, viewmat, K, 101, 75))
    points = np.random.default_rng(0).normal(0, 0.1, (50, 3))
    return Dataset(tmp_path, "test", tuple(views), points)


@pytest.mark.parametrize("max_size", [None, 200, 33])
def test_views_have_the_size_and_camera_of_their_photographs(dataset, max_size):
    entries = view_entries(dataset.views, max_size=max_size)
    for view, (_, camera) in zip(dataset.views, entries, strict=True):
        photo = load_photo(view, max_size)
        assert photo.pixels.shape[:2] == (camera.height, camera.width)
        np.testing.assert_allclose(camera.K, photo.K, rtol=1e-6)
        np.testing.assert_allclose(camera.viewmat, view.viewmat, atol=1e-6)
    dataset.views[0].image.unlink()  # a missing photograph has the size of its camera
    found = view_entries(dataset.views[:1], max_size=max_size)[0].camera
    assert (found.width, found.height) == (camera.width, camera.height)
    np.testing.assert_array_equal(found.K, entries[0].camera.K)


def test_names_are_relative_to_the_common_folder_and_unique(dataset):
    assert [e.name for e in view_entries(dataset.views[:2])] == ["0", "1"]
    found = [e.name for e in view_entries(dataset.views)]
    assert found == ["a_0", "a_1", "b_0"]
    for names in (("a/0.png", "a/0.jpg"), ("a/b_0.png", "a_b/0.png")):
        views = [replace(v, name=n) for v, n in zip(dataset.views, names)]
        found = [e.name.casefold() for e in view_entries(views)]
        assert len(set(found)) == 2


@pytest.mark.parametrize("path", CAMERA_PATHS)
def test_paths_have_frames_of_one_size_that_see_the_scene(dataset, path):
    entries = path_entries(dataset, CAMERA_PATHS[path], frames=5, max_size=64)
    assert [e.name for e in entries] == [f"frame_000{n}" for n in range(1, 6)]
    for _, camera in entries:
        assert (camera.width, camera.height) == (64, 48)
        local = np.asarray(camera.viewmat)[:3, 3]  # of the origin, where points are
        u, v, w = np.asarray(camera.K) @ local
        assert 0 < u / w < 64
        assert 0 < v / w < 48
        assert 0.5 < local[2] < 3


def test_interpolation_follows_the_numbers_in_names(dataset):
    poses = []
    for form in ("left/IMG_{}.png", "left/IMG_{:03}.png"):
        names = [form.format(number) for number in (10, 9, 100)]
        views = [replace(v, name=name) for v, name in zip(dataset.views, names)]
        views = sorted(views, key=lambda view: view.name)
        renamed = replace(dataset, views=tuple(views))
        entries = path_entries(renamed, CAMERA_PATHS["interpolate"], frames=4)
        poses.append(np.stack([entry.camera.viewmat for entry in entries]))
    np.testing.assert_array_equal(*poses)
    ends = [dataset.views[index].viewmat for index in (1, 2)]
    np.testing.assert_allclose(poses[0][[0, -1]], ends, atol=1e-6)


def test_an_orbit_beyond_the_cameras_is_warned_about(dataset, capsys):
    orbit = CAMERA_PATHS["orbit"]
    path_entries(dataset, orbit, frames=2)
    assert "warning: 245° of the orbit" in capsys.readouterr().err
    path_entries(dataset, CAMERA_PATHS["interpolate"], frames=2)
    poses = [look_at((np.cos(a), np.sin(a), 1), (0, 0, 0)) for a in (0, 1.5, 3, 4.5)]
    views = [replace(dataset.views[0], viewmat=pose) for pose in poses]
    path_entries(replace(dataset, views=tuple(views)), orbit, frames=2)
    assert capsys.readouterr().err == ""
    bare = Dataset(Path(), "test", dataset.views)
    assert len(path_entries(bare, orbit, frames=2)) == 2


@pytest.mark.parametrize(("lens", "focal"), [("pinhole", 90), ("orthographic", 25)])
def test_depth_limits_are_those_of_the_image(lens, focal):
    """Gaussians out of view do not count."""
    x, z = np.linspace(-4, 4, 201), np.linspace(1, 5, 201)
    means = [*np.column_stack([x, 0 * x, z]), [0, 0, -9], [900, 0, 1]]
    gaussians = gsjax.make_gaussians(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (len(means), 1)),
        log_scales=np.full((len(means), 3), -6.0),
        logit_opacities=np.full(len(means), 3.0),
        sh=np.zeros((len(means), 1, 3)),
        capacity=300,
    )
    K = [[focal, 0, 59.5], [0, focal, 36], [0, 0, 1]]
    camera = gsjax.make_camera(viewmat=np.eye(4), K=K, width=101, height=75, lens=lens)
    config = gsjax.RasterConfig(num_size_buckets=1, devices=1, occlusion=False)
    depth = np.asarray(gsjax.render_exact(gaussians, camera, config).depth)
    shown = depth[depth > 0]
    assert 1.2 < shown.min() < shown.max()
    limits = depth_limits(gaussians, [CameraEntry("a", camera)])
    np.testing.assert_allclose(limits, (shown.min(), shown.max()), atol=0.1)
    away = camera.replace(viewmat=look_at((0, 0, 9), (0, 9, 9)))
    assert depth_limits(gaussians, [CameraEntry("b", away)]) == (0, 0)
