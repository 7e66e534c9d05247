"""Camera paths: rigid, closed, where they are said to be, and never NaN."""

from pathlib import Path

import numpy as np
import pytest

import gsjax
from gsjax.cameras.camera import look_at
from gsjax.data import camera_paths
from gsjax.data.types import View

TARGET = np.array([0.4, -0.3, 1.1])
FRAMES = 40


def ring(count=12, elevation=0.5, radius=3.0, turn=2 * np.pi, up=(0, 0, 1.0)):
    """Cameras on a circle (or an arc of it) about TARGET, at right angles to ``up``."""
    up = np.asarray(up) / np.linalg.norm(up)
    first = np.cross(up, (0.3, 0.8, -0.1))
    first /= np.linalg.norm(first)
    angles = turn * np.arange(count)[:, None] / count
    flat = np.cos(angles) * first + np.sin(angles) * np.cross(up, first)
    eyes = TARGET + radius * (np.cos(elevation) * flat + np.sin(elevation) * up)
    return np.stack([look_at(eye, TARGET, up) for eye in eyes])


def facing(count=15, seed=0):
    """Cameras about z = 0 that look along y at what is 5 away."""
    rng = np.random.default_rng(seed)
    eyes = rng.uniform(-1, 1, (count, 3)) * (0.8, 0.2, 0.5)
    return np.stack([look_at(eye, (0.1, 5.0, 0.2)) for eye in eyes])


def centres(viewmats):
    return -np.einsum("bij,bi->bj", viewmats[:, :3, :3], viewmats[:, :3, 3])


def assert_rigid(viewmats, frames=FRAMES):
    assert viewmats.shape == (frames, 4, 4)
    assert viewmats.dtype == np.float64
    rotations = viewmats[:, :3, :3]
    eye = np.broadcast_to(np.eye(3), rotations.shape)
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), eye, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-12)
    np.testing.assert_array_equal(viewmats[:, 3], np.tile([0, 0, 0, 1.0], (frames, 1)))


def line(count=5):
    """Cameras in a row that all look the same way."""
    return np.stack([look_at((x, 0, 0), (x, 4.0, 1.0)) for x in range(count)])


DEGENERATE = {
    "one": ring(1),
    "two": ring(2, turn=0.8),
    "two opposite": ring(2),
    "two opposite, level": ring(2, elevation=0),
    "equal": np.repeat(ring(1), 4, axis=0),
    "a row": line(),
    "a row, straight down": np.stack(
        [look_at((x, 0, 3), (x, 0, 0)) for x in range(4)]
    ),
    "straight down at one point": ring(6, elevation=np.pi / 2),
    "on the spot": np.stack([look_at((0, 0, 0), (np.cos(a), np.sin(a), 0.1))
                             for a in range(6)]),
    "outward": np.stack([look_at(e, e * 2) for e in np.eye(3) + 0.1]),
    "doubled": np.repeat(ring(5), 2, axis=0),
    "upside down": np.stack([look_at(TARGET + e, TARGET, (0, 0, s)) for e, s in
                             zip(np.eye(3) * 2 + 0.3, (1, -1, 1))]),
}  # fmt: skip
MAKERS = {
    "orbit": camera_paths.orbit,
    "spiral": camera_paths.spiral,
    "interpolate": camera_paths.interpolate,
    "closed": lambda v, f: camera_paths.interpolate(v, f, closed=True),
}


@pytest.mark.parametrize("kind", DEGENERATE)
@pytest.mark.parametrize("name", MAKERS)
def test_degenerate_input_gives_rigid_matrices(kind, name):
    for frames in (1, 2, FRAMES):
        assert_rigid(MAKERS[name](DEGENERATE[kind], frames), frames)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0.3, 0.5, -0.8)])
@pytest.mark.parametrize("turn", [2 * np.pi, 1.2])
def test_orbit_of_a_ring_is_the_ring(up, turn):
    """Focus, axis, radius, elevation and start are found again from the cameras."""
    cameras = ring(11, turn=turn, up=up)
    np.testing.assert_allclose(camera_paths.focus_point(cameras), TARGET, atol=1e-9)
    direction = np.asarray(up) / np.linalg.norm(up)
    np.testing.assert_allclose(camera_paths.up_direction(cameras), direction, atol=1e-9)
    path = camera_paths.orbit(cameras, FRAMES)
    assert_rigid(path)
    np.testing.assert_allclose(path[0], cameras[0], atol=1e-9)
    offsets = centres(path) - TARGET
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 3, atol=1e-9)
    np.testing.assert_allclose(offsets @ direction, 3 * np.sin(0.5), atol=1e-9)
    steps = np.linalg.norm(np.diff(centres(path)[[*range(FRAMES), 0]], axis=0), axis=1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)  # and so it closes


@pytest.mark.parametrize("up", [(0, 0, 1), (0.3, 0.5, -0.8)])
def test_how_much_of_an_orbit_no_camera_sees(up):
    def unseen(*ring_of, **how):
        return camera_paths.unseen_angle(ring(*ring_of, up=up, **how))

    assert unseen(12) == pytest.approx(30)
    assert unseen(4, turn=1.0) == pytest.approx(360 - np.degrees(0.75))
    assert unseen(1) == pytest.approx(360)


def test_orbit_takes_mean_elevation_and_median_distance():
    cameras = np.concatenate([ring(8, 0.2, 2.0), ring(8, 0.6, 3.0), ring(8, 0.7, 9.0)])
    offsets = centres(camera_paths.orbit(cameras, 7)) - TARGET
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 3, atol=1e-9)
    np.testing.assert_allclose(offsets[:, 2], 3 * np.sin(0.5), atol=1e-9)


def test_the_focus_of_cameras_that_do_not_say_is_ahead():
    camera = look_at((1, 2, 3), (1, 9, 3))
    np.testing.assert_allclose(camera_paths.focus_point(camera[None], 4), (1, 6, 3))
    np.testing.assert_allclose(camera_paths.focus_point(camera[None]), (1, 3, 3))
    ahead = np.array([0, 4, 1]) / np.sqrt(17)
    np.testing.assert_allclose(camera_paths.focus_point(line(5)), (2, 0, 0) + 4 * ahead)
    path = camera_paths.orbit(camera[None], FRAMES, depth=4)
    np.testing.assert_allclose(path[0], camera, atol=1e-9)


def test_spiral_stays_among_the_cameras_and_looks_at_the_focus():
    cameras = facing()
    path = camera_paths.spiral(cameras, FRAMES)
    assert_rigid(path)
    where = centres(path)
    assert (np.abs(where) <= 1.05 * np.abs(centres(cameras)).max(axis=0)).all()
    assert (np.ptp(where, axis=0) > 0.5 * np.ptp(centres(cameras), axis=0)).all()
    focus = path[:, :3, :3] @ (0.1, 5.0, 0.2) + path[:, :3, 3]
    assert np.abs(focus[:, :2] / focus[:, 2:]).max() < 0.05
    closing = np.linalg.norm(where[0] - where[-1])
    assert closing < 1.5 * np.linalg.norm(np.diff(where, axis=0), axis=1).max()


@pytest.mark.parametrize("elevation", [0.0, 0.5, 0.9])
def test_a_spiral_of_cameras_all_around_is_before_the_first(elevation):
    """They have no mean pose: it stays upright, and off what they look at."""
    cameras = np.concatenate([ring(24, elevation), ring(16, elevation + 0.3)])
    path = camera_paths.spiral(cameras, FRAMES)
    assert_rigid(path)
    assert (-path[:, 1, :3] @ (0, 0, 1) > 0).all()
    away = centres(path) - TARGET
    assert (np.linalg.norm(away, axis=1) > 1.0).all()
    assert (away @ (centres(cameras)[0] - TARGET) > 0).all()
    seen = path[:, :3, :3] @ TARGET + path[:, :3, 3]
    assert (np.abs(seen[:, :2] / seen[:, 2:]) < 0.3).all()
    assert (seen[:, 2] > 0).all()


@pytest.mark.parametrize("closed", [False, True])
def test_interpolation_passes_through_the_cameras(closed):
    rng = np.random.default_rng(1)
    cameras = np.stack(
        [look_at(rng.normal(size=3) * 2, rng.normal(size=3) + 5) for _ in range(7)]
    )
    path = camera_paths.interpolate(cameras, 4000, closed=closed)
    assert_rigid(path, 4000)
    np.testing.assert_allclose(path[0], cameras[0], atol=1e-9)
    if not closed:
        np.testing.assert_allclose(path[-1], cameras[-1], atol=1e-9)
    gaps = np.abs(path[:, None] - cameras).max(axis=(2, 3))
    assert gaps.min(axis=0).max() < 0.02
    assert (np.diff(gaps.argmin(axis=0)) > 0).all()  # in their order
    # Continuous, and so is the derivative, also where the path closes: the change of
    # a step falls with the step (that of a corner would not).
    kinks = []
    for frames in (4000, 16000):
        path = camera_paths.interpolate(cameras, frames, closed=closed)
        path = path[[*range(frames), 0, 1]] if closed else path
        steps = np.diff(path, axis=0)
        kinks.append(np.abs(np.diff(steps, axis=0)).max() / np.abs(steps).max())
        assert np.abs(steps).max() < 60 / frames
    assert kinks[1] < 0.4 * kinks[0]


def test_interpolation_of_an_arc_is_the_arc_at_constant_speed():
    cameras = ring(9, turn=3.0)
    # Uneven keyframes: their spacing is not the speed.
    path = camera_paths.interpolate(cameras[[0, 1, 2, 4, 5, 7, 8]], 60)
    offsets = centres(path) - TARGET
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 3, atol=0.06)
    steps = np.linalg.norm(np.diff(centres(path), axis=0), axis=1)
    # Turning counts too, so the positions alone are not quite even.
    np.testing.assert_allclose(steps, steps.mean(), rtol=0.06)
    ahead = path[:, 2, :3]
    aim = (-offsets * ahead).sum(axis=1) / np.linalg.norm(offsets, axis=1)
    assert aim.min() > 0.9995


def test_interpolation_of_two_turns_is_the_shortest_turn():
    """On the spot: slerp, evenly, whatever the signs of the quaternions are."""
    a, b = look_at((0, 0, 0), (1, 0, 0)), look_at((0, 0, 0), (-0.9, 0.5, 0))
    ahead = camera_paths.interpolate(np.stack([a, b]), 31)[:, 2, :3]
    angles = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    total = np.arctan2(0.5, -0.9)
    np.testing.assert_allclose(ahead[:, 2], 0, atol=1e-12)
    np.testing.assert_allclose(angles, np.linspace(0, total, 31), atol=2e-3)


def test_equal_cameras_stand_still():
    cameras = np.repeat(ring(1), 3, axis=0)
    path = camera_paths.interpolate(cameras, 5)
    np.testing.assert_allclose(path, np.tile(cameras[0], (5, 1, 1)), atol=1e-12)


def view_of(width, height, focal):
    K = np.array([[focal, 0, width / 2], [0, focal * 1.1, height / 3], [0, 0, 1.0]])
    return View("a.png", Path("a.png"), np.eye(4), K, width, height)


def test_median_intrinsics():
    views = [view_of(80, 60, f) for f in (90, 100, 140)] + [view_of(160, 120, 190)] * 2
    found = camera_paths.median_intrinsics(views)
    assert (found.width, found.height) == (80, 60)
    wanted = [[95, 0, 40], [0, 104.5, 20], [0, 0, 1]]
    np.testing.assert_allclose(found.K, wanted)
    with pytest.raises(gsjax.InputError, match="views: expected"):
        camera_paths.median_intrinsics([])


def test_bad_input():
    with pytest.raises(gsjax.InputError, match="at least one camera"):
        camera_paths.orbit(np.zeros((0, 4, 4)), 5)
    with pytest.raises(gsjax.InputError, match=r"got \(4, 4\)"):
        camera_paths.spiral(np.eye(4), 5)
    with pytest.raises(gsjax.InputError, match="finite"):
        camera_paths.focus_point(np.full((1, 4, 4), np.nan))
    for make in MAKERS.values():
        with pytest.raises(gsjax.InputError, match="at least 1"):
            make(ring(3), 0)
