"""Where a run starts: at the points of a scene, or anywhere in view of it."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from captures import scene_of_views

import gsjax
from gsjax import look_at
from gsjax.cameras.camera import NEAR
from gsjax.data.camera_paths import focus_point
from gsjax.data.extent import extent_of, least_extent, near_plane, scene_extent
from gsjax.errors import InputError
from gsjax.init.gaussians import init_gaussians, neighbour_distance, points_in_ball
from gsjax.math.sh import dc_to_rgb

FAR = 1e3  # an extent that clips nothing


def brute_force(points):
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    nearest = np.sort(distance, axis=1)[:, 1:4]
    return np.sqrt(np.mean(nearest**2, axis=1))


@pytest.mark.parametrize("count", [2, 3, 4, 5, 200])
def test_distance_to_the_three_nearest(count):
    points = np.random.default_rng(0).normal(size=(count, 3))
    found = neighbour_distance(points, FAR)
    np.testing.assert_allclose(found, brute_force(points), rtol=1e-12)


def test_distance_where_there_are_no_neighbours():
    assert neighbour_distance(np.zeros((1, 3)), 5.0).tolist() == [0.05]
    assert neighbour_distance(np.zeros((0, 3)), 5.0).shape == (0,)
    same = neighbour_distance(np.ones((7, 3)), 5.0)
    np.testing.assert_array_equal(same, 5e-7)
    sparse = neighbour_distance(np.diag([1e6, 1e6, 1e6]), 5.0)
    np.testing.assert_allclose(sparse, np.sqrt(2) * 1e6)


@pytest.mark.parametrize(("extent", "most"), [(5.0, 0.5), (1.0, None)])
def test_distance_of_points_far_from_all_others(extent, most):
    """A tenth of the extent, or three times the median of all."""
    points = np.concatenate([np.random.default_rng(0).normal(size=(99, 3)), [[99] * 3]])
    points *= 0.1
    found, wanted = neighbour_distance(points, extent), brute_force(points)
    most = 3 * np.median(wanted) if most is None else most
    np.testing.assert_allclose(found, np.minimum(wanted, most), rtol=1e-12)
    assert found[-1] == pytest.approx(most)
    assert np.sum(found == found[-1]) < 10


def test_extent():
    centres = np.asarray([[0.0, 0, 0], [4, 0, 0], [2, 6, 0]]) + 100
    wanted = 1.1 * np.linalg.norm([0, 4, 0])  # the mean is (2, 2, 0)
    assert scene_extent(centres) == pytest.approx(wanted)
    assert scene_extent(centres[:1]) == 1.0
    assert scene_extent(np.ones((5, 3))) == 1.0


@pytest.mark.parametrize("at", [(0, 0, 0), (1.3, 2.1, 0.7), (1000, 2000, 5)])
def test_cameras_on_a_tripod_are_in_one_place(at):
    """But for the rounding of −Rᵀt."""
    views = [replace(v, viewmat=turned) for v, turned in zip(*on_a_tripod(at))]
    centres = np.stack([view.centre for view in views])
    assert np.ptp(centres, axis=0).max() < 1e-11
    assert scene_extent(centres) == 1.0
    assert near_plane(centres) == NEAR
    assert scene_extent(centres + 1e-6 * np.eye(5, 3)) < 1e-5


def on_a_tripod(at):
    views, rng = scene_of_views(5).views, np.random.default_rng(1)
    return views, [look_at(at, np.add(at, rng.normal(size=3))) for _ in views]


def test_the_extent_of_training_is_not_less_than_its_points_want():
    """In any unit; that of the cameras where they stand apart."""
    scene = scene_of_views(points=500)
    centres = np.stack([view.centre for view in scene.views])
    assert extent_of(scene) == scene_extent(centres)
    for at in ((0, 0, -4), (1000, 2000, 5)):
        views, turns = scene_of_views(5).views, []
        for index in range(5):
            turns.append(look_at(np.add(at, 1e-9 * index), np.add(at, [0, 0, 1])))
        views = tuple(replace(v, viewmat=m) for v, m in zip(views, turns))
        points = scene.points * 0.3 + at + np.asarray([0, 0, 4])
        for unit in (1e-3, 1.0, 1e3):
            resized = [v.viewmat.copy() for v in views]
            for viewmat in resized:
                viewmat[:3, 3] *= unit
            some = tuple(replace(v, viewmat=m) for v, m in zip(views, resized))
            narrow = replace(scene, views=some, points=points * unit)
            assert extent_of(narrow) == pytest.approx(0.4 * unit, rel=0.05)
            centres = np.stack([view.centre for view in narrow.views])
            near = near_plane(centres, least_extent(narrow))
            assert near == pytest.approx(min(NEAR, 8e-4 * unit), rel=0.05)
    assert extent_of(replace(scene_of_views(1), points=np.zeros((0, 3)))) == 1.0


def test_points_become_gaussians():
    scene = scene_of_views(points=40)
    gaussians = init_gaussians(scene, sh_degree=2, opacity=0.3, scale=0.5)
    params = gaussians.params
    assert gaussians.active.all()
    assert gaussians.capacity == 40
    assert params.sh.shape == (40, 9, 3)
    np.testing.assert_array_equal(params.means, scene.points)
    np.testing.assert_allclose(jax.nn.sigmoid(params.logit_opacities), 0.3, rtol=1e-12)
    rms = brute_force(scene.points)
    wanted = 0.5 * np.minimum(rms, max(0.1 * extent_of(scene), 3 * np.median(rms)))
    np.testing.assert_allclose(
        np.exp(params.log_scales), np.repeat(wanted[:, None], 3, 1), rtol=1e-12
    )
    np.testing.assert_array_equal(params.quats, np.tile([1.0, 0, 0, 0], (40, 1)))
    np.testing.assert_allclose(
        dc_to_rgb(params.sh[:, 0]) * 255, scene.colors, atol=1e-9
    )
    assert (params.sh[:, 1:] == 0).all()


@pytest.mark.parametrize(
    "points",
    [[[1.0, 2, 3]], [[0.0, 0, 0], [1, 0, 0]], [[1.0, 1, 1]] * 6, np.eye(3)],
    ids=["one", "two", "identical", "three"],
)
def test_few_points_are_finite_and_visible(points):
    points = np.asarray(points, float)
    colors = np.full((len(points), 3), 200, np.uint8)
    scene = replace(scene_of_views(), points=points, colors=colors)
    gaussians = init_gaussians(scene, capacity=8)
    assert gaussians.capacity == 8
    assert gsjax.num_active(gaussians) == len(points)
    for leaf in jax.tree.leaves(gaussians.params):
        assert np.isfinite(leaf).all()


def test_points_that_are_no_numbers_are_left_out():
    scene = scene_of_views(points=9)
    points = scene.points.copy()
    points[3, 1], points[7, 0] = np.nan, np.inf
    left = np.delete(np.arange(9), [3, 7])
    found = init_gaussians(replace(scene, points=points))
    wanted = init_gaussians(
        replace(scene, points=points[left], colors=scene.colors[left])
    )
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted)):
        np.testing.assert_array_equal(a, b)


def test_of_too_many_some_are_drawn():
    scene = scene_of_views(points=50)
    few = init_gaussians(scene, max_count=20, seed=1)
    means = np.asarray(few.params.means)
    places = [np.flatnonzero((scene.points == m).all(1)) for m in means]
    assert all(len(p) == 1 for p in places)
    assert (np.diff(np.concatenate(places)) > 0).all()  # each once, in order
    again, other = (init_gaussians(scene, max_count=20, seed=s) for s in (1, 2))
    np.testing.assert_array_equal(again.params.means, means)
    assert not np.array_equal(other.params.means, means)
    # As wide as those are apart that are left.
    np.testing.assert_allclose(
        few.params.log_scales[:, 0],
        np.log(neighbour_distance(means, extent_of(scene))),
    )


def test_random_ones_are_in_view():
    scene = scene_of_views(points=0)
    gaussians = init_gaussians(scene, random_count=3000, seed=3)
    means = np.asarray(gaussians.params.means)
    extent = scene_extent(np.stack([view.centre for view in scene.views]))
    away = (
        np.linalg.norm(means - focus_point([v.viewmat for v in scene.views]), axis=1)
        / extent
    )
    assert away.max() <= 1
    # Even in the ball: the cube of the distance is uniform.
    shares = np.histogram(away**3, 10, (0, 1))[0]
    assert np.sum((shares - 300) ** 2 / 300) < 34  # χ², 9 degrees, 0.9999
    # Cameras side by side see more of what is before them than they are apart.
    turned = [look_at((x, 0, 0), (0, 0, 10.0)) for x in (-0.6, 0.6)]
    views = tuple(replace(v, viewmat=m) for v, m in zip(scene.views, turned))
    away = points_in_ball(replace(scene, views=views), 3000, np.random.default_rng(0))
    away = np.linalg.norm(away - [0, 0, 10], axis=1)
    assert away.max() == pytest.approx(5, rel=0.01)
    colors = dc_to_rgb(np.asarray(gaussians.params.sh[:, 0]))
    assert colors.min() >= 0
    assert colors.max() <= 1
    assert init_gaussians(scene, random_count=30, max_count=10).capacity == 10


@pytest.mark.parametrize(
    ("kwargs", "named"),
    [
        *(({"opacity": value}, "opacity") for value in (0.0, 1.0, np.nan)),
        *(({"scale": value}, "scale") for value in (0.0, -1.0, np.inf, np.nan)),
    ],
    ids=str,
)
def test_out_of_range(kwargs, named):
    with pytest.raises(InputError, match=named):
        init_gaussians(scene_of_views(points=9), **kwargs)


def test_a_colour_for_each_point():
    scene = scene_of_views(points=9)
    with pytest.raises(InputError, match="9 points and 8 colours"):
        init_gaussians(replace(scene, colors=scene.colors[:8]))


def test_no_points():
    with pytest.raises(InputError, match="no points to start from"):
        init_gaussians(scene_of_views(points=0))
