"""The lists hold every pair that matters, hardly any other, in the right order."""

from functools import partial
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import COUNT, HEIGHT, SCENES, WIDTH, scene_of

from gsjax import RasterConfig
from gsjax.raster.lists import binning, blocks
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.render_camera import visible_order
from gsjax.raster.types import Inputs

CAPACITY = 16384
CONFIG = RasterConfig(num_size_buckets=1, devices=1)


@jax.jit
def projected_of(gaussians, camera):
    """Return the projection of the visible slots, front to back."""
    inputs = Inputs(gaussians, camera)
    order = visible_order(ELLIPSOID, inputs, CONFIG)
    return ELLIPSOID.project(inputs, CONFIG, *order)


@jax.jit
def radii_of(footprint):
    return binning.radii(footprint, WIDTH, HEIGHT)


@partial(jax.jit, static_argnames=("grid", "capacity", "block", "platform"))
def make_lists(footprint, grid, capacity=CAPACITY, block=blocks.BLOCK, platform=None):
    with mock.patch.object(blocks, "BLOCK", block):
        return binning.make_lists(
            footprint, grid, jnp.int32(0), capacity, platform=platform
        )


def lists_of(kind, tile=8, **options):
    grid = binning.make_grid(WIDTH, HEIGHT, tile, 1)
    projected = projected_of(*scene_of(kind))
    lists = make_lists(projected.footprint, grid, **options)
    return grid, jax.tree.map(np.asarray, projected), jax.tree.map(np.asarray, lists)


def listed_pairs(grid, lists) -> np.ndarray:
    """Return [T, R] bool from the sorted lists."""
    out = np.zeros((grid.tiles, COUNT), bool)
    ends = np.cumsum(lists.length)
    for tile, (end, length) in enumerate(zip(ends, lists.length)):
        ranks = lists.ranks[end - length : end]
        assert (np.diff(ranks) > 0).all(), "front to back, each once"
        out[tile, ranks] = True
    return out


def touched_pairs(grid, projected) -> np.ndarray:
    """Return [T, R] bool by evaluating Q at every pixel."""
    ys, xs = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    splat, reach = projected.splat, projected.footprint.reach
    u, v, sx, slope, sy, _, reach = (
        a[:, None, None] for a in (splat.u, splat.v, *splat.shape, reach)
    )
    dx, dy = xs - u, ys - v
    inside = (sx * dx) ** 2 + (sy * (dy - slope * dx)) ** 2 <= reach
    inside &= reach > 0
    out = np.zeros((grid.tiles, COUNT), bool)
    for tile in range(grid.tiles):
        x, y = (int(o) for o in binning.tile_origins(grid, np.int32(tile), 0))
        box = inside[:, max(y, 0) : y + grid.tile, x : x + grid.tile]
        out[tile] = box.any(axis=(1, 2))
    return out


@pytest.mark.parametrize(
    ("kind", "tile"), [*((kind, 8) for kind in SCENES), ("random", 4), ("random", 32)]
)
def test_nothing_is_dropped_and_little_is_superfluous(kind, tile):
    grid, projected, lists = lists_of(kind, tile)
    assert lists.pairs <= CAPACITY
    listed, touched = listed_pairs(grid, lists), touched_pairs(grid, projected)
    assert touched.sum() > 50
    assert lists.pairs == listed.sum() == lists.length.sum()
    assert not (touched & ~listed).any()
    # Listed in vain are slivers between pixel centres, mostly of needles.
    vain = (listed & ~touched).sum() / touched.sum()
    limit = 0.35 if kind.startswith("needles") or kind == "tiny" else 0.12
    assert tile < 8 or vain < limit

    # A radius is positive where the box around Q ≤ reach holds the centre of a pixel.
    seen = projected.footprint
    radii = np.asarray(radii_of(seen))
    variances = np.stack([seen.inv_sx**-2.0, seen.var_y], -1)
    extent = np.sqrt(seen.reach[:, None] * variances)
    centre = np.stack([seen.u, seen.v], -1)
    size = np.array([WIDTH, HEIGHT])
    first = np.clip(np.ceil(centre - extent - 0.5), 0, size)
    last = np.clip(np.floor(centre + extent - 0.5), -1, size - 1)
    holds = (seen.reach > 0) & (first <= last).all(-1)
    np.testing.assert_allclose(radii[holds], extent.max(-1)[holds], rtol=1e-5)
    # Rounding may move an edge by a hundredth of a pixel.
    clear = np.abs(np.stack([centre - extent, centre + extent]) % 1 - 0.5) > 0.02
    assert not radii[~holds & clear.all((0, -1))].any()
    assert radii[touched.any(0)].all()


def test_a_view_that_scales_loses_nothing():
    """[s R | s t] shows the same as [R | t]; an optimised view may pass through it."""
    gaussians, camera = scene_of("random")
    far = camera.replace(near=camera.near * 0, far=camera.far * 1e9)

    def count(scale):
        seen = far.replace(viewmat=camera.viewmat.at[:3].multiply(scale))
        return int((radii_of(projected_of(gaussians, seen).footprint) > 0).sum())

    assert 10 < count(1.0) < COUNT
    for scale in (0.01, 10.0, 1000.0):
        assert count(scale) == count(1.0)


@pytest.mark.parametrize(
    ("block", "platform"), [(7, "cpu"), (32, None), (32, "gpu"), (8192, "gpu")]
)
def test_blocks_platforms_and_capacities_make_the_same_lists(block, platform):
    """CPUs scatter pairs in blocks; accelerators sort them.

    The need is reported at any capacity; lists are right if it is enough.
    """
    options = {"block": block, "platform": platform}
    for kind in ("random", "huge", "tiny"):
        _, _, whole = lists_of(kind)
        count = int(whole.pairs)
        assert count > 100
        few = (1, count - 1, count) if kind == "random" else ()
        for capacity in (*few, CAPACITY):
            _, _, lists = lists_of(kind, capacity=capacity, **options)
            assert lists.pairs == count
            np.testing.assert_array_equal(lists.length, whole.length)
            assert lists.fit == (capacity >= count)
            assert lists.ranks.shape == (capacity,)
            if lists.fit:
                np.testing.assert_array_equal(lists.start, whole.start)
                np.testing.assert_array_equal(lists.ranks[:count], whole.ranks[:count])
