"""Dense points against a still life whose depths are known from the ray caster."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from captures import rejects

import gsjax
from gsjax.data.types import Dataset, Photo, View
from gsjax.init import dense
from gsjax.init.dense import (
    DensePoints,
    SweepSettings,
    farthest_point_sample,
    find_points,
)
from gsjax.init.plane_sweep import (
    PlaneWarp,
    ZnccWindows,
    make_sweep_image,
    project,
    scaled_pinhole,
    unproject,
)
from gsjax.synthetic.raycaster import cast, demo_cameras, surface_points
from gsjax.train.initialisation import add_dense_points

WIDTH, HEIGHT, VIEWS = 96, 72, 5
ALL = 10**9


@cache
def still_life() -> tuple[Dataset, list[Photo], np.ndarray]:
    """Return neighbours on a ring, 15° apart, with depths [V, H, W]."""
    viewmats, K = demo_cameras(48, WIDTH, HEIGHT)
    views, photos, depths = [], [], []
    for index, viewmat in enumerate(viewmats[:VIEWS]):
        rgb, depth = cast(viewmat, K, WIDTH, HEIGHT, samples=2)
        name = f"{index}.png"
        views.append(View(name, Path(name), viewmat, K, WIDTH, HEIGHT))
        photos.append(Photo(np.uint8(255 * rgb + 0.5), None, None, K))
        depths.append(depth)
    points, colors = surface_points(400)
    dataset = Dataset(Path("still life"), "made up", tuple(views), points, colors)
    return dataset, photos, np.stack(depths)


@cache
def usual() -> DensePoints:
    """Return all points of the still life."""
    return find_points(*still_life()[:2], ALL)


@cache
def cameras():
    dataset, photos, _ = still_life()
    return [
        scaled_pinhole(view.viewmat, photo.K, (WIDTH, HEIGHT), WIDTH)
        for view, photo in zip(dataset.views, photos)
    ]


def off_surface(points: np.ndarray) -> np.ndarray:
    """Return [M] distances from the surface, as a share of depth, in the best view."""
    least = np.full(len(points), np.inf)
    for camera, depth in zip(cameras(), still_life()[2]):
        pixels, z = project(camera, points)
        col, row = np.maximum(pixels, 0).astype(int).T
        there = depth[row, col]
        good = (pixels[:, 0] >= 0) & (there > 0)
        off = np.abs(z / np.where(there > 0, there, 1) - 1)
        least = np.where(good, np.minimum(least, off), least)
    return least


def test_points_behind_a_neighbour_are_not_seen_by_it():
    """Neither upside down: the plane lies between the view and one ahead of it."""
    _, photos, _ = still_life()
    camera = scaled_pinhole(np.eye(4), photos[0].K, (WIDTH, HEIGHT), WIDTH)
    ahead = np.eye(4)
    ahead[2, 3] = -5.0
    other = make_sweep_image(camera._replace(viewmat=ahead), photos[0].pixels)
    warp = PlaneWarp(camera, other)
    assert (warp.image(1 / 3) < 0).all()
    assert (warp.image(1 / 20) >= 0).mean() > 0.5


def test_unproject_inverts_project():
    camera = cameras()[2]
    rows, cols = np.random.default_rng(0).integers(0, 70, (2, 50))
    inverse = np.random.default_rng(1).uniform(0.1, 0.4, 50)
    pixels, z = project(camera, unproject(camera, rows, cols, inverse))
    np.testing.assert_allclose(pixels, np.stack([cols, rows], 1) + 0.5, rtol=1e-9)
    np.testing.assert_allclose(z, 1 / inverse, rtol=1e-9)
    behind = unproject(camera, rows, cols, -inverse)
    assert (project(camera, behind)[0] == -1).all()


def test_zncc_is_the_correlation_of_windows():
    rng = np.random.default_rng(0)
    grey, other = rng.random((2, 12, 9), np.float32)
    other[11, 4] = -1e3  # an invalid pixel
    wanted = np.zeros(grey.shape)
    for side in (3, 7):

        def windows(image, side=side):
            wide = np.pad(image.astype(np.float64), side // 2, mode="symmetric")
            return np.lib.stride_tricks.sliding_window_view(wide, (side, side))

        mine, theirs = windows(grey), windows(other)
        axes, least = (2, 3), (1.5 / 255) ** 2
        covariance = np.mean(mine * theirs, axes) - mine.mean(axes) * theirs.mean(axes)
        variances = np.maximum([mine.var(axes), theirs.var(axes)], least)
        score = covariance / np.sqrt(variances[0] * variances[1])
        out = (theirs < 0).any(axes)
        assert 0 < out.sum() < out.size
        wanted += np.where(out, -1, score)
    np.testing.assert_allclose(ZnccWindows(grey).zncc(other), wanted, atol=1e-4)


def test_points_lie_on_surfaces():
    assert len(usual().points) > 5000
    off = off_surface(usual().points)
    assert np.mean(off < 0.02) > 0.77
    assert np.mean(off < 0.05) > 0.91
    assert np.median(off) < 0.008
    assert usual().colors.dtype == np.uint8
    assert usual().points.shape == usual().colors.shape


def test_a_subset_depends_on_the_seed_and_not_on_threads(monkeypatch):
    dataset, photos, _ = still_life()
    found = []
    for cores, seed in ((1, 1), (4, 1), (2, 2)):
        monkeypatch.setattr(dense, "usable_cores", lambda cores=cores: cores)
        found.append(find_points(dataset, photos, 500, seed=seed))
    few, again, other = found
    np.testing.assert_array_equal(few.points, again.points)
    np.testing.assert_array_equal(few.colors, again.colors)
    assert len(few.points) == 500
    rows = {row.tobytes() for row in usual().points}
    assert all(row.tobytes() in rows for row in few.points)
    assert (few.points != other.points).any()


def test_the_unit_of_length_does_not_matter():
    """A power of two changes no rounding."""
    dataset, photos, _ = still_life()
    grown = []
    for view in dataset.views:
        viewmat = view.viewmat.copy()
        viewmat[:3, 3] *= 1024
        grown.append(replace(view, viewmat=viewmat))
    large = replace(dataset, views=tuple(grown), points=1024 * dataset.points)
    found = find_points(large, photos, ALL).points
    np.testing.assert_array_equal(1024 * usual().points, found)


def test_points_of_other_photographs():
    dataset, photos, _ = still_life()
    usually = len(usual().points)
    bare = replace(dataset, points=np.zeros((0, 3)))
    two = replace(dataset, views=dataset.views[:2])
    darker = [np.uint8(p.pixels * (1 - 0.1 * i) + 4 * i) for i, p in enumerate(photos)]
    darker = [photo._replace(pixels=x) for photo, x in zip(photos, darker)]
    K = photos[2].K / [[2], [2], [1]]
    rgb, _ = cast(dataset.views[2].viewmat, K, WIDTH // 2, HEIGHT // 2)
    half = photos[2]._replace(pixels=np.uint8(255 * rgb + 0.5), K=K)
    half = [*photos[:2], half, *photos[3:]]
    small = SweepSettings(longest_side=64)
    some = SweepSettings(max_views=3, seed_views=1)
    for data, seen, settings, least, most, near, median in (
        (bare, photos, None, 2500, np.inf, 0.88, 1),
        (two, photos[:2], None, 2000, np.inf, 0.83, 1),
        (dataset, darker, None, 0.9 * usually, np.inf, 0.91, 1),
        (dataset, half, None, 0, np.inf, 0.9, 1),
        (dataset, photos, small, 2000, 0.6 * usually, 0.85, 0.012),
        (dataset, photos, some, 2000, 0.9 * usually, 0.88, 1),
    ):
        found = find_points(data, seen, ALL, settings=settings).points
        assert least < len(found) < most
        off = off_surface(found)
        assert np.mean(off < 0.05) > near
        assert np.median(off) < median


def test_few_views_are_far_apart():
    line = np.asarray([0, 1, 2.2, 3, 4, 5])[:, None] * [1, 0, 0]
    assert farthest_point_sample(line, 6) == [0, 1, 2, 3, 4, 5]
    assert farthest_point_sample(line, 3) == [0, 2, 5]
    assert farthest_point_sample(np.zeros((5, 3)), 3) == [0]


@pytest.mark.parametrize("how", ["masked", "transparent", "masked and scaled"])
def test_excluded_pixels_give_no_points(how):
    """Every point is seen in the valid part by the view and the two that agree."""
    dataset, photos, _ = still_life()
    kept = np.zeros((HEIGHT, WIDTH), bool)
    kept[:, WIDTH // 2 :] = True
    change = {"valid": kept}
    if how == "transparent":
        change = {"alpha": np.where(kept, 255, 254).astype(np.uint8)}
    settings = SweepSettings(longest_side=64) if "scaled" in how else None
    half = [photo._replace(**change) for photo in photos]
    found = find_points(dataset, half, ALL, settings=settings)
    assert len(found.points) > 400
    seen = [project(camera, found.points)[0][:, 0] for camera in cameras()]
    assert (np.sum([x >= WIDTH // 2 for x in seen], 0) >= 3).all()


def test_rotated_cameras():
    """Views rolled by 90° change no point by half a pixel."""
    dataset, photos, _ = still_life()
    views, others = list(dataset.views), list(photos)
    for index in range(1, VIEWS, 2):
        (fx, _, cx), (_, fy, cy), _ = photos[index].K
        K = np.asarray([[fy, 0, HEIGHT - cy], [0, fx, cx], [0, 0, 1]])
        roll = np.eye(4)
        roll[:2, :2] = [[0, -1], [1, 0]]
        viewmat = roll @ views[index].viewmat
        views[index] = replace(
            views[index], viewmat=viewmat, K=K, width=HEIGHT, height=WIDTH
        )
        turned = np.ascontiguousarray(np.rot90(photos[index].pixels, -1))
        others[index] = photos[index]._replace(pixels=turned, K=K)
    turned = find_points(replace(dataset, views=tuple(views)), others, ALL)
    assert len(turned.points) == pytest.approx(len(usual().points), rel=0.05)
    medians = [np.median(off_surface(f.points)) for f in (usual(), turned)]
    assert medians[1] < 1.1 * medians[0]


@pytest.mark.parametrize("extents", [8, 25])
def test_distant_walls_have_no_false_matches_in_front(extents):
    """1 / z is uncertain by a pixel of shift, which is 0.017 of the depth.

    Five parallel cameras span 2 units, an extent of 1.1; the dataset has no points.
    """
    depth = 1.1 * extents
    tiles = np.random.default_rng(0).integers(0, 256, (60, 60, 3)).astype(np.uint8)
    K = np.asarray([[120.0, 0, 48], [0, 120, 36], [0, 0, 1]])
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    views, photos = [], []
    for index in range(5):
        viewmat = np.eye(4)
        viewmat[0, 3] = -0.5 * (index - 2)
        x = (u - 48) / 120 * depth + 0.5 * (index - 2) + 30
        y = (v - 36) / 120 * depth + 30
        scale = 3 * 8.8 / depth  # tiles of equal size in the images
        pixels = tiles[(scale * y).astype(int) % 60, (scale * x).astype(int) % 60]
        name = f"{index}.png"
        views.append(View(name, Path(name), viewmat, K, WIDTH, HEIGHT))
        photos.append(Photo(pixels, None, None, K))
    dataset = Dataset(Path("wall"), "made up", tuple(views))
    found = find_points(dataset, photos, ALL).points[:, 2]
    assert len(found) > 3000
    assert np.mean(np.abs(depth / found - 1) < 0.017 * depth) > 0.95


def test_nothing_is_found_where_there_is_nothing():
    dataset, photos, _ = still_life()
    views, turned = dataset.views, []
    for index, view in enumerate(views):
        flip = np.diag([-1.0, 1, -1, 1]) if index % 2 else np.eye(4)
        aside = np.eye(4)
        aside[0, 3] = 1e3 * index
        turned.append(replace(view, viewmat=flip @ view.viewmat @ aside))
    rng, shape = np.random.default_rng(0), photos[0].pixels.shape
    grey = [p._replace(pixels=np.full_like(p.pixels, 127)) for p in photos]
    masked = [p._replace(valid=np.zeros((HEIGHT, WIDTH), bool)) for p in photos]
    noise = [p._replace(pixels=rng.integers(0, 256, shape, np.uint8)) for p in photos]
    for of, seen, most in (
        (turned, photos, 0),  # without overlap
        (views[:1], photos[:1], 0),
        (views[:1] * VIEWS, photos, 0),
        (views, grey, 0),
        (views, masked, 0),
        (views, noise, 0.001 * VIEWS * HEIGHT * WIDTH),
    ):
        found = find_points(replace(dataset, views=tuple(of)), seen, ALL)
        assert len(found.points) == len(found.colors) <= most
    # A run then starts as without dense points.
    none = np.zeros((0, 3))
    bare = replace(dataset, points=none, colors=none.astype(np.uint8))
    config = gsjax.TrainConfig(initial="dense")
    assert len(add_dense_points(bare, grey, config).points) == 0


@pytest.mark.parametrize("size", [(1, 1), (9, 5), (400, 3)])
def test_photographs_of_odd_sizes(size):
    dataset, photos, _ = still_life()
    width, height = size
    small = []
    for photo in photos:
        rows = np.linspace(0, HEIGHT - 1, height).astype(int)
        cols = np.linspace(0, WIDTH - 1, width).astype(int)
        K = photo.K * [[width / WIDTH], [height / HEIGHT], [1]]
        small.append(photo._replace(pixels=photo.pixels[rows][:, cols], K=K))
    found = find_points(dataset, small, ALL)
    assert np.isfinite(found.points).all()


def test_a_run_adds_them_to_the_points_of_the_dataset():
    dataset, photos, _ = still_life()
    config = gsjax.TrainConfig(initial="dense", dense_count=1000, seed=3)
    more = add_dense_points(dataset, photos, config)
    found = find_points(dataset, photos, 1000, seed=3)
    np.testing.assert_array_equal(more.points[:400], dataset.points)
    np.testing.assert_array_equal(more.points[400:], found.points)
    np.testing.assert_array_equal(more.colors[400:], found.colors)
    others = [config.replace(initial=x) for x in ("points", "random", "auto")]
    for other in (*others, config.replace(dense_count=0)):
        assert add_dense_points(dataset, photos, other) is dataset
    rejects(f"{VIEWS - 1}", find_points, dataset, photos[1:], ALL)
