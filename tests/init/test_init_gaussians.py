"""Initial Gaussians at the points of a dataset or at random, and their extents."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from captures import dataset_of_views, rejects

import gsjax
from gsjax import look_at
from gsjax.cameras.camera import NEAR
from gsjax.data.camera_paths import focus_point
from gsjax.data.extent import extent_of, least_extent, near_plane, scene_extent
from gsjax.init.gaussians import init_gaussians, neighbour_distance, points_in_ball
from gsjax.math.sh import dc_to_rgb


def brute_force(points):
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    nearest = np.sort(distance, axis=1)[:, 1:4]
    return np.sqrt(np.mean(nearest**2, axis=1))


@pytest.mark.parametrize("count", [2, 3, 4, 5, 200])
def test_neighbour_distance_matches_brute_force(count):
    points = np.random.default_rng(0).normal(size=(count, 3))
    found = neighbour_distance(points, 1e3)  # an extent that clips nothing
    np.testing.assert_allclose(found, brute_force(points), rtol=1e-12)


def test_neighbour_distance_without_neighbours():
    assert neighbour_distance(np.zeros((1, 3)), 5.0).tolist() == [0.05]
    assert neighbour_distance(np.zeros((0, 3)), 5.0).shape == (0,)
    same = neighbour_distance(np.ones((7, 3)), 5.0)
    np.testing.assert_array_equal(same, 5e-7)
    sparse = neighbour_distance(np.diag([1e6, 1e6, 1e6]), 5.0)
    np.testing.assert_allclose(sparse, np.sqrt(2) * 1e6)


@pytest.mark.parametrize(("extent", "most"), [(5.0, 0.5), (1.0, None)])
def test_neighbour_distance_of_outliers_is_clipped(extent, most):
    """To a tenth of the extent, or three times the median."""
    points = np.concatenate([np.random.default_rng(0).normal(size=(99, 3)), [[99] * 3]])
    points *= 0.1
    found, wanted = neighbour_distance(points, extent), brute_force(points)
    most = 3 * np.median(wanted) if most is None else most
    np.testing.assert_allclose(found, np.minimum(wanted, most), rtol=1e-12)
    assert found[-1] == pytest.approx(most)
    assert np.sum(found == found[-1]) < 10


def test_scene_extent():
    centres = np.asarray([[0.0, 0, 0], [4, 0, 0], [2, 6, 0]]) + 100
    wanted = 1.1 * np.linalg.norm([0, 4, 0])  # the mean is (2, 2, 0)
    assert scene_extent(centres) == pytest.approx(wanted)
    assert scene_extent(centres[:1]) == 1.0
    assert scene_extent(np.ones((5, 3))) == 1.0


def test_extent_has_a_lower_bound_from_the_points_in_any_unit():
    dataset = dataset_of_views(points=500)
    centres = np.stack([view.centre for view in dataset.views])
    assert extent_of(dataset) == scene_extent(centres)
    for at in ((0, 0, -4), (1000, 2000, 5)):
        points = dataset.points * 0.3 + at + np.asarray([0, 0, 4])
        for unit in (1e-3, 1.0, 1e3):
            views = []
            for index, view in enumerate(dataset_of_views(5).views):
                viewmat = look_at(np.add(at, 1e-9 * index), np.add(at, [0, 0, 1]))
                viewmat[:3, 3] *= unit
                views.append(replace(view, viewmat=viewmat))
            narrow = replace(dataset, views=tuple(views), points=points * unit)
            assert extent_of(narrow) == pytest.approx(0.4 * unit, rel=0.05)
            centres = np.stack([view.centre for view in narrow.views])
            near = near_plane(centres, least_extent(narrow))
            assert near == pytest.approx(min(NEAR, 8e-4 * unit), rel=0.05)
    assert extent_of(replace(dataset_of_views(1), points=np.zeros((0, 3)))) == 1.0


def test_points_become_gaussians():
    dataset = dataset_of_views(points=40)
    options = {"sh_degree": 2, "opacity": 0.3, "scale": 0.5}
    spare = init_gaussians(dataset, **options, capacity=48)
    assert (spare.capacity, gsjax.num_active(spare)) == (48, 40)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(spare.params))
    gaussians = init_gaussians(dataset, **options)
    params = gaussians.params
    assert gaussians.active.all()
    assert gaussians.capacity == 40
    assert params.sh.shape == (40, 9, 3)
    np.testing.assert_array_equal(params.means, dataset.points)
    np.testing.assert_allclose(jax.nn.sigmoid(params.logit_opacities), 0.3, rtol=1e-12)
    rms = brute_force(dataset.points)
    wanted = 0.5 * np.minimum(rms, max(0.1 * extent_of(dataset), 3 * np.median(rms)))
    scales = np.exp(params.log_scales)
    np.testing.assert_allclose(scales, np.repeat(wanted[:, None], 3, 1), rtol=1e-12)
    np.testing.assert_array_equal(params.quats, np.tile([1.0, 0, 0, 0], (40, 1)))
    colors = dc_to_rgb(params.sh[:, 0]) * 255
    np.testing.assert_allclose(colors, dataset.colors, atol=1e-9)
    assert (params.sh[:, 1:] == 0).all()


def test_nonfinite_points_are_ignored():
    dataset = dataset_of_views(points=9)
    points = dataset.points.copy()
    points[3, 1], points[7, 0] = np.nan, np.inf
    left = np.delete(np.arange(9), [3, 7])
    fewer = replace(dataset, points=points[left], colors=dataset.colors[left])
    found = init_gaussians(replace(dataset, points=points))
    jax.tree.map(np.testing.assert_array_equal, found, init_gaussians(fewer))


def test_a_subset_is_drawn_from_too_many_points():
    dataset = dataset_of_views(points=50)
    few, again, other = (
        init_gaussians(dataset, max_count=20, seed=s) for s in (1, 1, 2)
    )
    means = np.asarray(few.params.means)
    places = [np.flatnonzero((dataset.points == m).all(1)) for m in means]
    assert all(len(p) == 1 for p in places)
    assert (np.diff(np.concatenate(places)) > 0).all()  # each once, in order
    np.testing.assert_array_equal(again.params.means, means)
    assert not np.array_equal(other.params.means, means)
    spacing = np.log(neighbour_distance(means, extent_of(dataset)))  # of the subset
    np.testing.assert_allclose(few.params.log_scales[:, 0], spacing)


def test_random_points_are_uniform_in_a_visible_ball():
    dataset = dataset_of_views(points=0)
    gaussians = init_gaussians(dataset, random_count=3000, seed=3)
    means = np.asarray(gaussians.params.means)
    extent = scene_extent(np.stack([view.centre for view in dataset.views]))
    middle = focus_point([view.viewmat for view in dataset.views])
    away = np.linalg.norm(means - middle, axis=1) / extent
    assert away.max() <= 1
    # In a uniform ball the cube of the distance is uniform.
    shares = np.histogram(away**3, 10, (0, 1))[0]
    assert np.sum((shares - 300) ** 2 / 300) < 34  # χ², 9 degrees, 0.9999
    # Parallel cameras see a larger region than their distance.
    turned = [look_at((x, 0, 0), (0, 0, 10.0)) for x in (-0.6, 0.6)]
    views = tuple(replace(v, viewmat=m) for v, m in zip(dataset.views, turned))
    away = points_in_ball(replace(dataset, views=views), 3000, np.random.default_rng(0))
    away = np.linalg.norm(away - [0, 0, 10], axis=1)
    assert away.max() == pytest.approx(5, rel=0.01)
    colors = dc_to_rgb(np.asarray(gaussians.params.sh[:, 0]))
    assert colors.min() >= 0
    assert colors.max() <= 1
    assert init_gaussians(dataset, random_count=30, max_count=10).capacity == 10


@pytest.mark.parametrize(
    ("changes", "kwargs", "message"),
    [
        *(({}, {"opacity": value}, "opacity") for value in (0.0, 1.0, np.nan)),
        *(({}, {"scale": value}, "scale") for value in (0.0, -1.0, np.inf, np.nan)),
        ({"colors": np.zeros((8, 3), np.uint8)}, {}, "9 points and 8 colours"),
        ({"points": np.zeros((0, 3))}, {}, "no points"),
    ],
    ids=str,
)
def test_rejected(changes, kwargs, message):
    dataset = replace(dataset_of_views(points=9), **changes)
    rejects(message, init_gaussians, dataset, **kwargs)
