"""Cameras of a run's views and paths: sizes, names, and ranges of depth."""

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
from gsjax.plots.contact_sheets import depth_colors
from gsjax.runs.folder import Data
from gsjax.runs.trajectories import PATHS, path_entries
from gsjax.runs.trajectories import _depth_limits as depth_limits

K = np.asarray([[90.0, 0, 49.5], [0, 91.0, 36.0], [0, 0, 1]])


@pytest.fixture
def data(tmp_path) -> Data:
    """Three views of 101 × 75 px in two folders, the last one held out."""
    views = []
    for index, name in enumerate(("a/0.png", "a/1.png", "b/0.png")):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(cv2.imencode(".png", np.zeros((75, 101, 3), np.uint8))[1])
        viewmat = look_at((np.cos(index), np.sin(index), 1), (0, 0, 0))
        views.append(View(f"images/{name}", path, viewmat, K, 101, 75))
    points = np.random.default_rng(0).normal(0, 0.1, (50, 3))
    return Data(Dataset(tmp_path, "test", tuple(views), points), [0, 1], [2])


@pytest.mark.parametrize("max_size", [None, 200, 64, 33])
def test_views_have_the_size_and_camera_of_their_photographs(data, max_size):
    for path, chosen in (("test", data.test), ("train", data.train)):
        entries = path_entries(data, path, max_size=max_size)
        assert len(entries) == len(chosen)
        for index, (_, camera) in zip(chosen, entries):
            photo = load_photo(data.scene.views[index], max_size)
            assert photo.pixels.shape[:2] == (camera.height, camera.width)
            np.testing.assert_allclose(camera.K, photo.K, rtol=1e-6)
            wanted = data.scene.views[index].viewmat
            np.testing.assert_allclose(camera.viewmat, wanted, atol=1e-6)


def test_without_its_photograph_a_view_has_the_size_of_its_camera(data):
    view = data.scene.views[0]
    wanted = path_entries(data, "train", max_size=64)
    view.image.unlink()
    for (_, found), (_, camera) in zip(
        path_entries(data, "train", max_size=64), wanted, strict=True
    ):
        assert (found.width, found.height) == (camera.width, camera.height)
        np.testing.assert_array_equal(found.K, camera.K)


def test_names_are_those_of_the_views_without_what_all_share(data):
    assert [e.name for e in path_entries(data, "train")] == ["0", "1"]
    everything = data._replace(test=[0, 1, 2])
    assert [e.name for e in path_entries(everything, "test")] == ["a_0", "a_1", "b_0"]


def test_names_stay_apart(data):
    """Of photographs of one stem, and of folders that are called like one."""
    for names in (("a/0.png", "a/0.jpg"), ("a/b_0.png", "a_b/0.png")):
        views = data.scene.views
        views = tuple(replace(v, name=n) for v, n in zip(views, names))
        two = Data(replace(data.scene, views=views), [0, 1], [])
        found = [e.name.casefold() for e in path_entries(two, "train")]
        assert len(set(found)) == 2


@pytest.mark.parametrize("path", PATHS[2:])
def test_paths_have_frames_of_one_size_that_see_the_scene(data, path):
    entries = path_entries(data, path, frames=5, max_size=64)
    assert [e.name for e in entries] == [f"frame_000{n}" for n in range(1, 6)]
    for _, camera in entries:
        assert (camera.width, camera.height) == (64, 48)
        local = np.asarray(camera.viewmat)[:3, 3]  # of the origin, where points are
        u, v, w = np.asarray(camera.K) @ local
        assert 0 < u / w < 64
        assert 0 < v / w < 48
        assert 0.5 < local[2] < 3
    larger = path_entries(data, path, frames=5, max_size=64, size=(128, 96))
    for (_, small), (_, large) in zip(entries, larger):
        assert (large.width, large.height) == (128, 96)
        np.testing.assert_allclose(large.K[:2], 2 * np.asarray(small.K[:2]))
        np.testing.assert_array_equal(large.viewmat, small.viewmat)


def test_interpolation_goes_by_the_numbers_in_names(data):
    """In which they were taken, though the views are sorted as text."""
    flown = []
    for form in ("left/IMG_{}.png", "left/IMG_{:03}.png"):
        views = [
            replace(view, name=form.format(number))
            for view, number in zip(data.scene.views, (10, 9, 100))
        ]
        views.sort(key=lambda view: view.name)
        scene = replace(data.scene, views=tuple(views))
        entries = path_entries(data._replace(scene=scene), "interpolate", frames=4)
        flown.append(np.stack([entry.camera.viewmat for entry in entries]))
    np.testing.assert_array_equal(*flown)
    ends = [data.scene.views[index].viewmat for index in (1, 2)]
    np.testing.assert_allclose(flown[0][[0, -1]], ends, atol=1e-6)


def test_an_orbit_past_the_cameras_is_warned_of(data, capsys):
    path_entries(data, "orbit", frames=2)
    assert "warning: 245° of the orbit are on sides that" in capsys.readouterr().err
    path_entries(data, "interpolate", frames=2)
    eyes = [(np.cos(angle), np.sin(angle), 1) for angle in (0, 1.5, 3, 4.5)]
    view = data.scene.views[0]
    views = [replace(view, viewmat=look_at(eye, (0, 0, 0))) for eye in eyes]
    around = replace(data.scene, views=tuple(views))
    path_entries(data._replace(scene=around), "orbit", frames=2)
    assert capsys.readouterr().err == ""


def test_no_views_and_no_points(data):
    assert path_entries(data._replace(test=[]), "test") == []
    bare = Dataset(Path(), "test", data.scene.views)
    assert len(path_entries(data._replace(scene=bare), "orbit", frames=2)) == 2
    with pytest.raises(gsjax.InputError, match="frames is 0"):
        path_entries(data, "orbit", frames=0)


@pytest.mark.parametrize(("model", "focal"), [("pinhole", 90), ("orthographic", 25)])
def test_limits_of_depth_are_of_what_the_picture_shows(model, focal):
    """At any lens: those of the centres that cover a pixel of their own picture."""
    x, z = np.linspace(-4, 4, 201), np.linspace(1, 5, 201)
    gaussians = gsjax.make_gaussians(
        means=np.column_stack([x, 0 * x, z]),
        quats=np.tile([1.0, 0, 0, 0], (201, 1)),
        log_scales=np.full((201, 3), -6.0),
        logit_opacities=np.full(201, 3.0),
        sh=np.zeros((201, 1, 3)),
    )
    camera = gsjax.make_camera(
        viewmat=np.eye(4),
        K=K * [[focal / 90], [focal / 91], [1]] + [[0, 0, 10], [0] * 3, [0] * 3],
        width=101,
        height=75,
        model=model,
    )
    depth = np.asarray(gsjax.render_exact(gaussians, camera).depth)
    shown = depth[depth > 0]
    assert 1.2 < shown.min() < shown.max()
    limits = depth_limits(gaussians, [CameraEntry("a", camera)])
    np.testing.assert_allclose(limits, (shown.min(), shown.max()), atol=0.1)


def test_limits_of_depth_are_of_what_is_seen():
    z = np.linspace(2, 4, 201)
    means = np.column_stack([0 * z, 0 * z, z])
    unseen = [[0, 0, -9], [900, 0, 1]]
    count = len(z) + len(unseen)
    gaussians = gsjax.make_gaussians(
        means=np.concatenate([means, unseen]),
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.zeros((count, 3)),
        logit_opacities=np.zeros(count),
        sh=np.zeros((count, 1, 3)),
        capacity=300,
    )
    camera = gsjax.make_camera(viewmat=np.eye(4), K=K, width=101, height=75)
    limits = depth_limits(gaussians, [CameraEntry("a", camera)])
    np.testing.assert_allclose(limits, (2.02, 3.98), atol=1e-6)
    away = gsjax.make_camera(
        viewmat=look_at((0, 0, 9), (0, 9, 9)), K=K, width=9, height=9
    )
    assert depth_limits(gaussians, [CameraEntry("b", away)]) == (0, 0)
    # One colour for one depth, whatever else is in the picture.
    first, second = np.full((4, 4), 2.5), np.full((4, 4), 2.5)
    second[:2] = 3.9
    one, *told = depth_colors(first, limits)
    other, *_ = depth_colors(second, limits)
    assert tuple(told) == limits
    np.testing.assert_array_equal(one[3], other[3])
    assert (one[0] != other[0]).any()
