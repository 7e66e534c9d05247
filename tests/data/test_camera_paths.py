"""Camera paths: rigid, closed, at their documented positions, and never NaN."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from captures import rejects

from gsjax.cameras.camera import look_at
from gsjax.data.camera_paths import (
    focus_point,
    interpolate,
    median_intrinsics,
    orbit,
    spiral,
    unseen_angle,
    up_direction,
)
from gsjax.data.types import View

TARGET = np.array([0.4, -0.3, 1.1])
FRAMES = 40
TILTED = (0.3, 0.5, -0.8)


def ring(count=12, elevation=0.5, radius=3.0, turn=2 * np.pi, up=(0, 0, 1.0)):
    """Cameras on a circle (or an arc of it) about TARGET, orthogonal to ``up``."""
    up = np.asarray(up) / np.linalg.norm(up)
    first = np.cross(up, (0.3, 0.8, -0.1))
    first /= np.linalg.norm(first)
    angles = turn * np.arange(count)[:, None] / count
    flat = np.cos(angles) * first + np.sin(angles) * np.cross(up, first)
    eyes = TARGET + radius * (np.cos(elevation) * flat + np.sin(elevation) * up)
    return np.stack([look_at(eye, TARGET, up) for eye in eyes])


def looking(*pairs):
    return np.stack([look_at(*pair) for pair in pairs])


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


AXES = np.eye(3)
ROW = looking(*(((x, 0, 0), (x, 4.0, 1.0)) for x in range(5)))  # parallel
DEGENERATE = {
    "one": ring(1),
    "two": ring(2, turn=0.8),
    "two opposite": ring(2),
    "two opposite, level": ring(2, elevation=0),
    "equal": np.repeat(ring(1), 4, axis=0),
    "a row": ROW,
    "a row, straight down": looking(*(((x, 0, 3), (x, 0, 0)) for x in range(4))),
    "straight down at one point": ring(6, elevation=np.pi / 2),
    "on the spot": looking(
        *((AXES[0] * 0, (np.cos(a), np.sin(a), 0.1)) for a in range(6))
    ),
    "outward": looking(*((e, e * 2) for e in AXES + 0.1)),
    "doubled": np.repeat(ring(5), 2, axis=0),
    "upside down": looking(
        *((TARGET + e, TARGET, (0, 0, s)) for e, s in zip(AXES * 2 + 0.3, (1, -1, 1)))
    ),
}
MAKERS = {
    "orbit": orbit,
    "spiral": spiral,
    "interpolate": interpolate,
    "closed": partial(interpolate, closed=True),
}


@pytest.mark.parametrize("kind", DEGENERATE)
@pytest.mark.parametrize("name", MAKERS)
def test_degenerate_input_gives_rigid_matrices(kind, name):
    for frames in (1, 2, FRAMES):
        assert_rigid(MAKERS[name](DEGENERATE[kind], frames), frames)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), TILTED])
@pytest.mark.parametrize("turn", [2 * np.pi, 1.2])
def test_the_orbit_of_a_ring_is_the_ring(up, turn):
    """Focus, axis, radius, elevation and start are recovered from the cameras."""
    cameras = ring(11, turn=turn, up=up)
    np.testing.assert_allclose(focus_point(cameras), TARGET, atol=1e-9)
    direction = np.asarray(up) / np.linalg.norm(up)
    np.testing.assert_allclose(up_direction(cameras), direction, atol=1e-9)
    path = orbit(cameras, FRAMES)
    assert_rigid(path)
    np.testing.assert_allclose(path[0], cameras[0], atol=1e-9)
    offsets = centres(path) - TARGET
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 3, atol=1e-9)
    np.testing.assert_allclose(offsets @ direction, 3 * np.sin(0.5), atol=1e-9)
    steps = np.linalg.norm(np.diff(centres(path)[[*range(FRAMES), 0]], axis=0), axis=1)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)  # and so it closes


def test_an_orbit_has_the_mean_elevation_and_median_distance():
    cameras = np.concatenate([ring(8, 0.2, 2.0), ring(8, 0.6, 3.0), ring(8, 0.7, 9.0)])
    offsets = centres(orbit(cameras, 7)) - TARGET
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 3, atol=1e-9)
    np.testing.assert_allclose(offsets[:, 2], 3 * np.sin(0.5), atol=1e-9)


@pytest.mark.parametrize("up", [(0, 0, 1), TILTED])
@pytest.mark.parametrize(
    ("count", "turn", "angle"),
    [(12, 2 * np.pi, 30), (4, 1.0, 360 - np.degrees(0.75)), (1, 2 * np.pi, 360)],
)
def test_unseen_angle(up, count, turn, angle):
    assert unseen_angle(ring(count, turn=turn, up=up)) == pytest.approx(angle)


def test_the_focus_of_parallel_cameras_is_ahead():
    camera = look_at((1, 2, 3), (1, 9, 3))
    np.testing.assert_allclose(focus_point(camera[None], 4), (1, 6, 3))
    np.testing.assert_allclose(focus_point(camera[None]), (1, 3, 3))
    ahead = np.array([0, 4, 1]) / np.sqrt(17)
    np.testing.assert_allclose(focus_point(ROW), (2, 0, 0) + 4 * ahead)
    np.testing.assert_allclose(orbit(camera[None], 9, depth=4)[0], camera, atol=1e-9)


def test_a_spiral_stays_among_the_cameras_and_looks_at_the_focus():
    eyes = np.random.default_rng(0).uniform(-1, 1, (15, 3)) * (0.8, 0.2, 0.5)
    cameras = looking(*((eye, (0.1, 5.0, 0.2)) for eye in eyes))
    path = spiral(cameras, FRAMES)
    assert_rigid(path)
    where = centres(path)
    assert (np.abs(where) <= 1.05 * np.abs(centres(cameras)).max(axis=0)).all()
    assert (np.ptp(where, axis=0) > 0.5 * np.ptp(centres(cameras), axis=0)).all()
    focus = path[:, :3, :3] @ (0.1, 5.0, 0.2) + path[:, :3, 3]
    assert np.abs(focus[:, :2] / focus[:, 2:]).max() < 0.05
    closing = np.linalg.norm(where[0] - where[-1])
    assert closing < 1.5 * np.linalg.norm(np.diff(where, axis=0), axis=1).max()


@pytest.mark.parametrize("elevation", [0.0, 0.5, 0.9])
def test_a_spiral_of_surrounding_cameras_is_near_the_first(elevation):
    """They have no mean pose: it stays upright, and away from the focus."""
    cameras = np.concatenate([ring(24, elevation), ring(16, elevation + 0.3)])
    path = spiral(cameras, FRAMES)
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
    pairs = [(rng.normal(size=3) * 2, rng.normal(size=3) + 5) for _ in range(7)]
    cameras = looking(*pairs)
    path = interpolate(cameras, 4000, closed=closed)
    assert_rigid(path, 4000)
    np.testing.assert_allclose(path[0], cameras[0], atol=1e-9)
    if not closed:
        np.testing.assert_allclose(path[-1], cameras[-1], atol=1e-9)
    gaps = np.abs(path[:, None] - cameras).max(axis=(2, 3))
    assert gaps.min(axis=0).max() < 0.02
    assert (np.diff(gaps.argmin(axis=0)) > 0).all()  # in their order
    # Path and derivative are continuous, also where it closes: the change of a step
    # decreases with the step, unlike at a corner.
    kinks = []
    for frames in (4000, 16000):
        path = interpolate(cameras, frames, closed=closed)
        steps = np.diff(path[[*range(frames), 0, 1]] if closed else path, axis=0)
        kinks.append(np.abs(np.diff(steps, axis=0)).max() / np.abs(steps).max())
        assert np.abs(steps).max() < 60 / frames
    assert kinks[1] < 0.4 * kinks[0]


def test_interpolation_of_an_arc_has_constant_speed():
    """The spacing of keyframes does not matter."""
    path = interpolate(ring(9, turn=3.0)[[0, 1, 2, 4, 5, 7, 8]], 60)
    offsets = centres(path) - TARGET
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), 3, atol=0.06)
    steps = np.linalg.norm(np.diff(centres(path), axis=0), axis=1)
    # Rotation counts too, so the positions alone are not quite even.
    np.testing.assert_allclose(steps, steps.mean(), rtol=0.06)
    aim = (-offsets * path[:, 2, :3]).sum(axis=1) / np.linalg.norm(offsets, axis=1)
    assert aim.min() > 0.9995


def test_interpolation_of_two_rotations_is_the_shortest():
    """Evenly, whatever the signs of the quaternions are; equal cameras stand still."""
    two = looking(((0, 0, 0), (1, 0, 0)), ((0, 0, 0), (-0.9, 0.5, 0)))
    ahead = interpolate(two, 31)[:, 2, :3]
    angles = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    np.testing.assert_allclose(ahead[:, 2], 0, atol=1e-12)
    total = np.arctan2(0.5, -0.9)
    np.testing.assert_allclose(angles, np.linspace(0, total, 31), atol=2e-3)
    path = interpolate(np.repeat(ring(1), 3, axis=0), 5)
    np.testing.assert_allclose(path, np.tile(ring(1), (5, 1, 1)), atol=1e-12)


def test_median_intrinsics():
    views = []
    for size, focal in ((1, 90), (1, 100), (1, 140), (2, 190), (2, 190)):
        width, height = 80 * size, 60 * size
        K = np.array([[focal, 0, width / 2], [0, focal * 1.1, height / 3], [0, 0, 1.0]])
        views.append(View("a.png", Path("a.png"), np.eye(4), K, width, height))
    found = median_intrinsics(views)
    assert (found.width, found.height) == (80, 60)
    np.testing.assert_allclose(found.K, [[95, 0, 40], [0, 104.5, 20], [0, 0, 1]])


@pytest.mark.parametrize(
    ("make", "views", "expected"),
    [
        (median_intrinsics, [], "views: expected at least one"),
        (focus_point, np.zeros((0, 4, 4)), "at least one camera"),
        (focus_point, np.eye(4), r"got \(4, 4\)"),
        (focus_point, np.full((1, 4, 4), np.nan), "expected finite"),
        *((partial(m, frames=0), ring(3), "at least 1") for m in MAKERS.values()),
    ],
)
def test_bad_input(make, views, expected):
    rejects(expected, make, views)
