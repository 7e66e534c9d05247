"""The lists hold every pair that matters, hardly any other, in the right order."""

import dataclasses
from functools import partial
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import COUNT, HEIGHT, SCENES, WIDTH, scene_of
from stages import visible_projection

from gsjax import RasterConfig
from gsjax.raster.compositing import schedules
from gsjax.raster.lists import binning, blocks

CAPACITY = 16384
CONFIG = RasterConfig(num_size_buckets=1, devices=1)


@jax.jit
def projected_of(gaussians, camera):
    return visible_projection(gaussians, camera, CONFIG)


@partial(jax.jit, static_argnames=("grid", "capacity", "block", "platform"))
def make_lists(projected, device, grid, capacity, block, platform):
    with mock.patch.object(blocks, "BLOCK", block):
        return binning.make_lists(
            projected.footprint, grid, device, capacity, platform=platform
        )


def lists_of(
    kind: str,
    tile: int,
    stride: int = 1,
    device: int = 0,
    capacity: int = CAPACITY,
    block: int = blocks.BLOCK,
    platform: str | None = None,
):
    grid = binning.make_grid(WIDTH, HEIGHT, tile, stride)
    projected = projected_of(*scene_of(kind))
    lists = make_lists(projected, jnp.int32(device), grid, capacity, block, platform)
    return grid, jax.tree.map(np.asarray, projected), jax.tree.map(np.asarray, lists)


@pytest.mark.parametrize("kind", SCENES)
def test_radii_are_of_what_a_pixel_may_show(kind):
    """Positive exactly where the box around Q ≤ reach holds the centre of a pixel."""
    grid, projected, _ = lists_of(kind, 8)
    radii = np.asarray(
        binning.radii(jax.tree.map(jnp.asarray, projected.footprint), WIDTH, HEIGHT)
    )
    seen = projected.footprint
    extent = np.sqrt(seen.reach[:, None] * np.stack(
        [seen.inv_sx**-2.0, seen.var_y], -1))  # fmt: skip
    centre = np.stack([seen.u, seen.v], -1)
    size = np.array([WIDTH, HEIGHT])
    first = np.clip(np.ceil(centre - extent - 0.5), 0, size)
    last = np.clip(np.floor(centre + extent - 0.5), -1, size - 1)
    holds = (seen.reach > 0) & (first <= last).all(-1)
    np.testing.assert_allclose(radii[holds], extent.max(-1)[holds], rtol=1e-5)
    # Room for rounding: a hundredth of a pixel.
    clear = np.abs(np.stack([centre - extent, centre + extent]) % 1 - 0.5) > 0.02
    clear = clear.all((0, -1))
    assert not radii[~holds & clear].any()
    assert radii[touched_pairs(grid, projected).any(0)].all()


def test_a_view_that_scales_loses_nothing():
    """[s R | s t] shows what [R | t] shows; one being optimised may pass through it."""
    gaussians, camera = scene_of("random")
    far = dataclasses.replace(camera, near=camera.near * 0, far=camera.far * 1e9)

    @jax.jit
    def count(gaussians, viewmat):
        seen = dataclasses.replace(far, viewmat=viewmat)
        footprint = visible_projection(gaussians, seen, CONFIG).footprint
        return jnp.sum(binning.radii(footprint, WIDTH, HEIGHT) > 0)

    wanted = count(gaussians, camera.viewmat)
    assert 10 < wanted < COUNT
    for scale in (0.01, 10.0, 1000.0):
        scaled = camera.viewmat.at[:3].multiply(scale)
        assert count(gaussians, scaled) == wanted


def listed_pairs(grid, lists) -> np.ndarray:
    """[T, R] bool, from the sorted lists."""
    out = np.zeros((grid.tiles, COUNT), bool)
    ends = np.cumsum(lists.length)
    for tile, (end, length) in enumerate(zip(ends, lists.length)):
        ranks = lists.ranks[end - length : end]
        assert (np.diff(ranks) > 0).all(), "front to back, each once"
        out[tile, ranks] = True
    return out


def touched_pairs(grid, projected, device: int = 0) -> np.ndarray:
    """[T, R] bool, by evaluating Q at every pixel."""
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
        x, y = (int(o) for o in binning.tile_origins(grid, np.int32(tile), device))
        box = inside[:, max(y, 0) : y + grid.tile, x : x + grid.tile]
        out[tile] = box.any(axis=(1, 2))
    return out


@pytest.mark.parametrize("kind", list(SCENES))
def test_nothing_is_dropped_and_little_is_superfluous(kind):
    grid, projected, lists = lists_of(kind, tile=8)
    assert lists.pairs <= CAPACITY
    listed, touched = listed_pairs(grid, lists), touched_pairs(grid, projected)
    assert touched.sum() > 50
    assert lists.pairs == listed.sum() == lists.length.sum()
    assert not (touched & ~listed).any()
    # What is listed in vain: slivers between pixel centres, mostly of needles.
    vain = (listed & ~touched).sum() / touched.sum()
    assert vain < (0.35 if kind.startswith("needles") or kind == "tiny" else 0.12)


@pytest.mark.parametrize("tile", [4, 16, 32])
def test_other_tile_sizes(tile):
    grid, projected, lists = lists_of("random", tile)
    listed, touched = listed_pairs(grid, lists), touched_pairs(grid, projected)
    assert touched.any()
    assert not (touched & ~listed).any()


@pytest.mark.parametrize("block", [7, 32])
@pytest.mark.parametrize("kind", ["random", "huge"])
def test_blocks_of_any_size_make_the_same_lists(kind, block):
    _, _, whole = lists_of(kind, 8)
    _, _, lists = lists_of(kind, 8, block=block)
    assert whole.pairs > 4 * 2 * block
    np.testing.assert_array_equal(lists.length, whole.length)
    count = int(whole.pairs)
    np.testing.assert_array_equal(lists.ranks[:count], whole.ranks[:count])


@pytest.mark.parametrize("platform", ["cpu", "gpu"])
@pytest.mark.parametrize("kind", ["random", "huge", "tiny"])
def test_dealt_or_sorted_the_lists_are_the_same(kind, platform):
    _, _, whole = lists_of(kind, 8)
    _, _, lists = lists_of(kind, 8, block=32, platform=platform)
    count = int(whole.pairs)
    assert lists.pairs == count > 100
    np.testing.assert_array_equal(lists.start, whole.start)
    np.testing.assert_array_equal(lists.length, whole.length)
    np.testing.assert_array_equal(lists.ranks[:count], whole.ranks[:count])


@pytest.mark.parametrize("platform", ["cpu", "gpu"])
@pytest.mark.parametrize("block", [7, 8192])
def test_room_changes_no_count(block, platform):
    """What is wanted is told whatever the room; with room for it, so are the lists."""
    _, _, whole = lists_of("random", 8)
    count = int(whole.pairs)
    for capacity in (1, count - 1, count):
        _, _, lists = lists_of(
            "random", 8, capacity=capacity, block=block, platform=platform
        )
        assert lists.pairs == count
        np.testing.assert_array_equal(lists.length, whole.length)
        assert lists.fit == (capacity >= count)
        assert lists.ranks.shape == (capacity,)
        if lists.fit:
            np.testing.assert_array_equal(lists.ranks[:count], whole.ranks[:count])


def test_devices_share_the_rows():
    """The lists of two devices are those of one, dealt out by rows of tiles."""
    whole, _, all_lists = lists_of("random", 8)
    listed = listed_pairs(whole, all_lists).reshape(whole.rows, whole.cols, COUNT)
    for device in range(2):
        grid, _, lists = lists_of("random", 8, stride=2, device=device)
        part = listed_pairs(grid, lists).reshape(grid.rows, grid.cols, COUNT)
        wanted = listed[device::2]
        np.testing.assert_array_equal(part[: len(wanted)], wanted)
        assert not part[len(wanted) :].any()


@pytest.mark.parametrize(("group", "chunk"), [(1, 1), (8, 16), (8, 32), (2048, 32)])
def test_steps_and_pairs_that_have_room_for_one_another(group, chunk):
    """The capacity named for so many steps holds them, and a smaller one does not."""
    grid = binning.make_grid(800, 600, 8, 1)
    steps = np.unique(np.geomspace(1, 5000, 60).astype(int))
    for wanted in steps:
        count = jnp.int32(wanted)
        pairs = int(schedules.pairs_for_steps(count, grid, group, chunk))
        assert schedules.step_capacity(pairs, grid, group, chunk) >= wanted
        if pairs > 0:
            fewer = int(pairs * (1 - 2e-6)) - 1
            assert schedules.step_capacity(fewer, grid, group, chunk) < wanted


@pytest.mark.parametrize("chunk", [8, 16])
def test_schedule_covers_every_chunk_once(chunk):
    """Steps hold each pair exactly once, blocks in order, front to back."""
    group = 4
    grid, _, lists = lists_of("random", 8)
    room = schedules.step_capacity(CAPACITY, grid, group, chunk)
    lists = jax.tree.map(jnp.asarray, lists)
    schedule = schedules.make_schedule(lists, grid, group, chunk, room)
    steps = schedules.make_steps(schedule, room)
    work = schedules.make_work(lists, schedule, steps, chunk, COUNT, room)
    ranks, block = np.asarray(work.ranks), np.asarray(work.block)
    live, first = np.asarray(work.live), np.asarray(work.first)
    assert live.sum() == int(schedule.steps)
    assert (ranks[~live] == COUNT).all()
    rebuilt = np.zeros((grid.tiles, COUNT), int)
    last = np.full(grid.tiles + 1, -1)
    for step in np.flatnonzero(live):
        assert first[step] == (step == 0 or block[step] != block[step - 1])
        for place, tile in enumerate(np.asarray(schedule.tiles)[block[step]]):
            mine = ranks[step, place]
            mine = mine[mine < COUNT]
            if len(mine):
                assert mine[0] > last[tile]
                assert (np.diff(mine) > 0).all()
                last[tile] = mine[-1]
                rebuilt[tile, mine] += 1
    np.testing.assert_array_equal(rebuilt, listed_pairs(grid, lists))
