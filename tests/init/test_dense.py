"""Points on which photographs agree, held against a still life whose depths are known:
that of the analytic ray caster."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import gsjax
import gsjax.train.initialisation as start_module
from gsjax.data.types import Dataset, Photo, View
from gsjax.errors import InputError
from gsjax.init import dense
from gsjax.init import plane_sweep as sweep_module
from gsjax.init.dense import find_points
from gsjax.init.plane_sweep import make_shot, pinhole, project, sweep, unproject
from gsjax.synthetic.raycaster import cast, demo_cameras, surface_points
from gsjax.train.initialisation import add_dense_points, initial_state

WIDTH, HEIGHT, VIEWS = 160, 120, 6
ALL = 10**9


@cache
def taken() -> tuple[Dataset, list[Photo], np.ndarray]:
    """Six neighbours of a ring, 15° apart, with depths [V, H, W]."""
    viewmats, K = demo_cameras(48, WIDTH, HEIGHT)
    views, photos, depths = [], [], []
    for index, viewmat in enumerate(viewmats[:VIEWS]):
        rgb, depth = cast(viewmat, K, WIDTH, HEIGHT, samples=2)
        name = f"{index}.png"
        views.append(View(name, Path(name), viewmat, K, WIDTH, HEIGHT))
        photos.append(Photo(np.uint8(255 * rgb + 0.5), None, None, K))
        depths.append(depth)
    points, colors = surface_points(400)
    scene = Dataset(Path("still life"), "made up", tuple(views), points, colors)
    return scene, photos, np.stack(depths)


def cameras_of(scene, photos):
    size = (WIDTH, HEIGHT)
    return [
        pinhole(view.viewmat, photo.K, size, WIDTH)
        for view, photo in zip(scene.views, photos)
    ]


def shots_of(scene, photos):
    cameras = cameras_of(scene, photos)
    return [make_shot(c, photo.pixels) for c, photo in zip(cameras, photos)]


def off_surface(points: np.ndarray) -> np.ndarray:
    """[M] how far points are from what some view sees there, as a share of its depth;
    of the view in which it is least."""
    scene, photos, depths = taken()
    least = np.full(len(points), np.inf)
    for camera, depth in zip(cameras_of(scene, photos), depths):
        pixels, z = project(camera, points)
        col, row = np.maximum(pixels, 0).astype(int).T
        there = depth[row, col]
        good = (pixels[:, 0] >= 0) & (there > 0)
        least = np.where(good, np.minimum(least, np.abs(z / np.where(
            there > 0, there, 1) - 1)), least)  # fmt: skip
    return least


def with_photos(change) -> list[Photo]:
    return [change(index, photo) for index, photo in enumerate(taken()[1])]


def test_a_sweep_finds_the_depth():
    scene, photos, depths = taken()
    first, *others = shots_of(scene, photos)
    found = sweep(first, others[:3], 2.5, 12.0)
    there = (found.score > 0.6) & (depths[0] > 0)
    assert np.mean(there[depths[0] > 0]) > 0.5
    # A step is 1.5 % there, and the floor is seen at 23°.
    off = np.abs(found.inverse[there] * depths[0][there] - 1)
    assert np.mean(off < 0.05) > 0.8
    assert np.median(off) < 0.0125


def test_what_is_behind_a_neighbour_is_not_seen_by_it():
    """Nor upside down: of a plane between the view and one that stands ahead of it."""
    _, photos, _ = taken()
    camera = pinhole(np.eye(4), photos[0].K, (WIDTH, HEIGHT), WIDTH)
    ahead = np.eye(4)
    ahead[2, 3] = -5.0
    other = make_shot(camera._replace(viewmat=ahead), photos[0].pixels)
    warp = sweep_module._Warp(camera, other)
    assert (warp.image(1 / 3) == sweep_module._OUTSIDE).all()
    assert (warp.image(1 / 20) >= 0).mean() > 0.5


def test_points_are_there_and_back_again():
    scene, photos, _ = taken()
    camera = cameras_of(scene, photos)[2]
    rows, cols = np.random.default_rng(0).integers(0, 100, (2, 50))
    inverse = np.random.default_rng(1).uniform(0.1, 0.4, 50)
    pixels, z = project(camera, unproject(camera, rows, cols, inverse))
    np.testing.assert_allclose(pixels, np.stack([cols, rows], 1) + 0.5, rtol=1e-9)
    np.testing.assert_allclose(z, 1 / inverse, rtol=1e-9)
    behind = unproject(camera, rows, cols, -inverse)
    assert (project(camera, behind)[0] == -1).all()


def test_what_is_found_lies_on_surfaces():
    scene, photos, _ = taken()
    found = find_points(scene, photos, ALL)
    assert len(found.points) > 10_000
    off = off_surface(found.points)
    assert np.mean(off < 0.02) > 0.85
    assert np.mean(off < 0.05) > 0.95
    assert np.median(off) < 0.005
    assert found.colors.dtype == np.uint8
    assert found.points.shape == found.colors.shape


def test_without_points_it_is_looked_for_where_the_cameras_look():
    scene, photos, _ = taken()
    found = find_points(replace(scene, points=np.zeros((0, 3))), photos, ALL)
    assert len(found.points) > 5_000
    assert np.mean(off_surface(found.points) < 0.05) > 0.9


def test_so_many_are_drawn_and_the_same_each_time():
    scene, photos, _ = taken()
    every = find_points(scene, photos, ALL, seed=1)
    few, again = (find_points(scene, photos, 500, seed=1) for _ in range(2))
    np.testing.assert_array_equal(few.points, again.points)
    np.testing.assert_array_equal(few.colors, again.colors)
    assert len(few.points) == 500
    rows = {row.tobytes() for row in every.points}
    assert all(row.tobytes() in rows for row in few.points)
    other = find_points(scene, photos, 500, seed=2)
    assert (few.points != other.points).any()


def test_the_unit_of_length_does_not_matter():
    """A power of two, so that nothing is rounded otherwise."""
    scene, photos, _ = taken()
    grown = []
    for view in scene.views:
        viewmat = view.viewmat.copy()
        viewmat[:3, 3] *= 1024
        grown.append(replace(view, viewmat=viewmat))
    large = replace(scene, views=tuple(grown), points=1024 * scene.points)
    one, other = (find_points(s, photos, ALL).points for s in (scene, large))
    np.testing.assert_array_equal(1024 * one, other)


def test_exposures_do_not_matter():
    """Windows are compared by how they vary, not by how bright they are."""
    scene, photos, _ = taken()

    def darker(index, photo):
        pixels = photo.pixels * (1 - 0.1 * index) + 4 * index
        return photo._replace(pixels=np.uint8(pixels))

    usual = find_points(scene, photos, ALL)
    found = find_points(scene, with_photos(darker), ALL)
    assert len(found.points) > 0.9 * len(usual.points)
    assert np.mean(off_surface(found.points) < 0.05) > 0.95


@pytest.mark.parametrize("how", ["masked", "transparent"])
def test_what_does_not_count_is_no_point(how):
    """Whatever is found is seen, where it counts, by the view that found it and by two
    that agree."""
    scene, _, _ = taken()
    kept = np.zeros((HEIGHT, WIDTH), bool)
    kept[:, WIDTH // 2 :] = True

    def half(_, photo):
        if how == "masked":
            return photo._replace(valid=kept)
        return photo._replace(alpha=np.where(kept, 255, 254).astype(np.uint8))

    photos = with_photos(half)
    found = find_points(scene, photos, ALL)
    assert len(found.points) > 1000
    seen = np.zeros(len(found.points), int)
    for camera in cameras_of(scene, photos):
        pixels, _ = project(camera, found.points)
        seen += pixels[:, 0] >= WIDTH // 2
    assert (seen >= 3).all()


def no_view_overlaps(scene, photos):
    turned = []
    for index, view in enumerate(scene.views):
        flip = np.diag([-1.0, 1, -1, 1]) if index % 2 else np.eye(4)
        aside = np.eye(4)
        aside[0, 3] = 1e3 * index
        turned.append(replace(view, viewmat=flip @ view.viewmat @ aside))
    return replace(scene, views=tuple(turned)), photos


def one_view(scene, photos):
    return replace(scene, views=scene.views[:1]), photos[:1]


def nothing_to_tell_apart(scene, photos):
    return scene, [p._replace(pixels=np.full_like(p.pixels, 127)) for p in photos]


def all_masked(scene, photos):
    none = np.zeros((HEIGHT, WIDTH), bool)
    return scene, [p._replace(valid=none) for p in photos]


def noise(scene, photos):
    rng = np.random.default_rng(0)
    shape = photos[0].pixels.shape
    return scene, [
        p._replace(pixels=rng.integers(0, 256, shape, np.uint8)) for p in photos
    ]


def of_one_place(scene, photos):
    return replace(scene, views=(scene.views[0],) * len(photos)), photos


@pytest.mark.parametrize(
    "case",
    [no_view_overlaps, one_view, nothing_to_tell_apart, all_masked, of_one_place],
)
def test_nothing_is_found_where_there_is_nothing(case):
    scene, photos = case(*taken()[:2])
    found = find_points(scene, photos, ALL)
    assert found.points.shape == found.colors.shape == (0, 3)


def test_of_noise_next_to_nothing_is_found():
    scene, photos = noise(*taken()[:2])
    found = find_points(scene, photos, ALL)
    assert len(found.points) < 0.001 * VIEWS * HEIGHT * WIDTH


@pytest.mark.parametrize("size", [(1, 1), (9, 5), (400, 3)])
def test_photographs_of_odd_sizes(size):
    scene, photos, _ = taken()
    width, height = size
    small = []
    for photo in photos:
        rows = np.linspace(0, HEIGHT - 1, height).astype(int)
        cols = np.linspace(0, WIDTH - 1, width).astype(int)
        K = photo.K * [[width / WIDTH], [height / HEIGHT], [1]]
        small.append(photo._replace(pixels=photo.pixels[rows][:, cols], K=K))
    found = find_points(scene, small, ALL)
    assert np.isfinite(found.points).all()


def test_photographs_are_made_smaller(monkeypatch):
    """Cameras and masks with them."""
    scene, photos, _ = taken()
    monkeypatch.setattr(dense, "_LONGEST", 80)
    found = find_points(scene, photos, ALL)
    assert len(found.points) > 4_000
    off = off_surface(found.points)
    assert np.mean(off < 0.05) > 0.88
    assert np.median(off) < 0.012
    right = np.zeros((HEIGHT, WIDTH), bool)
    right[:, WIDTH // 2 :] = True
    half = find_points(scene, [p._replace(valid=right) for p in photos], ALL)
    seen = [project(camera, half.points)[0] for camera in cameras_of(scene, photos)]
    assert (np.sum([p[:, 0] >= WIDTH // 2 for p in seen], 0) >= 3).all()
    assert len(half.points) > 500


def test_photographs_of_other_sizes_and_upright_ones():
    """Every other view rolled by 90° about its axis, and one of half the size: nothing
    is found where it is not, nor half a pixel aside."""
    scene, photos, _ = taken()
    usual = find_points(scene, photos, ALL)
    views, others = list(scene.views), list(photos)
    for index in range(1, VIEWS, 2):
        (fx, _, cx), (_, fy, cy), _ = photos[index].K
        K = np.asarray([[fy, 0, HEIGHT - cy], [0, fx, cx], [0, 0, 1]])
        roll = np.eye(4)
        roll[:2, :2] = [[0, -1], [1, 0]]  # x is what −y was, y what x was
        viewmat = roll @ views[index].viewmat
        views[index] = replace(
            views[index], viewmat=viewmat, K=K, width=HEIGHT, height=WIDTH
        )
        turned = np.ascontiguousarray(np.rot90(photos[index].pixels, -1))
        others[index] = photos[index]._replace(pixels=turned, K=K)
    turned = find_points(replace(scene, views=tuple(views)), others, ALL)
    assert len(turned.points) == pytest.approx(len(usual.points), rel=0.05)
    medians = [np.median(off_surface(f.points)) for f in (usual, turned)]
    assert medians[1] < 1.1 * medians[0]
    rgb, _ = cast(scene.views[2].viewmat, photos[2].K / [[2], [2], [1]], 80, 60)
    pixels = np.uint8(255 * rgb + 0.5)
    smaller = [*photos]
    smaller[2] = photos[2]._replace(pixels=pixels, K=photos[2].K / [[2], [2], [1]])
    found = find_points(scene, smaller, ALL)
    assert np.mean(off_surface(found.points) < 0.05) > 0.92


def test_two_views_are_enough():
    scene, photos, _ = taken()
    found = find_points(replace(scene, views=scene.views[:2]), photos[:2], ALL)
    assert len(found.points) > 4_000
    assert np.mean(off_surface(found.points) < 0.05) > 0.85


def wall_at(depth: float) -> np.ndarray:
    """Depths [M] that are found of a wall before five cameras side by side, 2 apart in
    all, which is of an extent of 1.1. No points are known."""
    rng = np.random.default_rng(0)
    tiles = rng.integers(0, 256, (60, 60, 3)).astype(np.uint8)
    K = np.asarray([[120.0, 0, 80], [0, 120, 60], [0, 0, 1]])
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    views, photos = [], []
    for index in range(5):
        viewmat = np.eye(4)
        viewmat[0, 3] = -0.5 * (index - 2)
        x = (u - 80) / 120 * depth + 0.5 * (index - 2) + 30
        y = (v - 60) / 120 * depth + 30
        scale = 3 * 8.8 / depth  # tiles as large in the pictures, wherever it is
        pixels = tiles[(scale * y).astype(int) % 60, (scale * x).astype(int) % 60]
        name = f"{index}.png"
        views.append(View(name, Path(name), viewmat, K, WIDTH, HEIGHT))
        photos.append(Photo(pixels, None, None, K))
    scene = Dataset(Path("wall"), "made up", tuple(views))
    return find_points(scene, photos, ALL).points[:, 2]


def test_a_wall_before_parallel_cameras():
    """As of LLFF: the wall is eight extents away."""
    found = wall_at(8.8)
    assert len(found) > 10_000
    off = np.abs(found / 8.8 - 1)  # 0.07 is half a pixel
    assert np.median(off) < 0.04
    assert np.mean(off < 0.14) > 0.95


@pytest.mark.parametrize("extents", [15, 25])
def test_a_wall_farther_away_is_not_found_before_it(extents):
    """Where something looks alike by chance."""
    depth = 1.1 * extents
    found = wall_at(depth)
    assert len(found) > 5000
    off = np.abs(depth / found - 1)  # 1 / z is what a shift tells: 1 px is 0.017 depth
    assert np.mean(off < 0.017 * depth) > 0.95


def test_nor_do_cores_matter(monkeypatch):
    scene, photos, _ = taken()
    found = []
    for cores in (1, 4):
        monkeypatch.setattr(dense, "usable_cores", lambda cores=cores: cores)
        found.append(find_points(scene, photos, ALL))
    np.testing.assert_array_equal(found[0].points, found[1].points)


def test_of_many_views_some_far_apart_and_their_neighbours(monkeypatch):
    scene, photos, _ = taken()
    line = np.asarray([0, 1, 2.2, 3, 4, 5])[:, None] * [1, 0, 0]
    assert dense._spread_out(line, 6) == [0, 1, 2, 3, 4, 5]
    assert dense._spread_out(line, 3) == [0, 2, 5]
    assert dense._spread_out(np.zeros((5, 3)), 3) == [0]
    swept = []

    def counted(shot, *rest):
        swept.append(shot)
        return sweep(shot, *rest)

    monkeypatch.setattr(dense, "sweep", counted)
    monkeypatch.setattr(dense, "_MOST_VIEWS", 3)
    monkeypatch.setattr(dense, "_SEEDS", 1)
    found = find_points(scene, photos, ALL)
    assert len(swept) == 3
    assert len(found.points) > 5_000
    assert np.mean(off_surface(found.points) < 0.05) > 0.9


def test_a_run_starts_from_them_and_from_the_points_of_the_dataset():
    scene, photos, _ = taken()
    config = gsjax.TrainConfig(initial="dense", dense_count=1000, seed=3)
    more = add_dense_points(scene, photos, config)
    found = find_points(scene, photos, 1000, seed=3)
    np.testing.assert_array_equal(more.points[:400], scene.points)
    np.testing.assert_array_equal(more.points[400:], found.points)
    np.testing.assert_array_equal(more.colors[400:], found.colors)
    assert int(initial_state(more, config).gaussians.active.sum()) == 1400
    for initial in ("points", "random", "auto"):
        assert add_dense_points(scene, photos, config.replace(initial=initial)) is scene
    assert add_dense_points(scene, photos, config.replace(dense_count=0)) is scene
    with pytest.raises(InputError, match="5 photos for 6 views"):
        find_points(scene, photos[1:], ALL)


def test_where_nothing_is_found_it_starts_as_without(monkeypatch):
    scene, photos = nothing_to_tell_apart(*taken()[:2])
    config = gsjax.TrainConfig(initial="dense", initial_count=77)
    usual = add_dense_points(scene, photos, config)
    assert int(initial_state(usual, config).gaussians.active.sum()) == 400
    bare = replace(scene, points=np.zeros((0, 3)), colors=np.zeros((0, 3), np.uint8))
    random = add_dense_points(bare, photos, config)
    assert int(initial_state(random, config).gaussians.active.sum()) == 77
    some = add_dense_points(bare, taken()[1], config.replace(dense_count=5))
    assert int(initial_state(some, config).gaussians.active.sum()) == 5
    monkeypatch.setattr(start_module, "_LEAST_FOUND", ALL)
    assert add_dense_points(bare, taken()[1], config) is bare


def test_likeness_is_the_correlation_of_the_windows():
    rng = np.random.default_rng(0)
    grey, other = rng.random((2, 12, 9), np.float32)
    other[11, 4] = sweep_module._OUTSIDE
    wanted = np.zeros(grey.shape)
    for side in sweep_module._WINDOWS:

        def windows(image, side=side):
            wide = np.pad(image.astype(np.float64), side // 2, mode="symmetric")
            return np.lib.stride_tricks.sliding_window_view(wide, (side, side))

        mine, theirs = windows(grey), windows(other)
        axes, least = (2, 3), sweep_module._LEAST_VARIANCE
        covariance = np.mean(mine * theirs, axes) - mine.mean(axes) * theirs.mean(axes)
        variances = np.maximum([mine.var(axes), theirs.var(axes)], least)
        score = covariance / np.sqrt(variances[0] * variances[1])
        out = (theirs == sweep_module._OUTSIDE).any(axes)
        assert out.any()
        assert not out.all()
        wanted += np.where(out, -1, score)
    found = sweep_module._View(grey).likeness(other)
    np.testing.assert_allclose(found, wanted, atol=1e-4)
