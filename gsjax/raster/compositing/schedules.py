"""The work list of chunked compositing: which chunk of which tiles, when.

A step is one chunk of K Gaussians for each of G tiles. Tiles are taken in order of list
length, so the G tiles of a block need nearly the same number of steps and no tile waits
for the longest. No derivative is taken here.

Axis legend: T tiles, S steps, G tiles of a step, K Gaussians of a chunk, R ranks.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from gsjax.raster.lists.binning import Grid, Lists
from gsjax.raster.lists.counting import (
    COUNT_LIMIT,
    cumulative_sum,
    segment_ids,
    take,
    total_count,
)
from gsjax.raster.lists.sorting import argsort_descending
from gsjax.raster.types import Array, RasterConfig


class Schedule(NamedTuple):
    """Blocks of G tiles of similar length, each taking ``levels`` steps.

    Attributes:
      tiles: [blocks, G]; places past the last tile hold T, whose list is empty.
      levels: [blocks] steps of each block, falling; all 0 if there is no room.
      steps: [] number of steps needed, saturating.
    """

    tiles: Array
    levels: Array
    steps: Array


class Steps(NamedTuple):
    """Block and chunk of each step, [S] each."""

    block: Array
    level: Array


class Work(NamedTuple):
    """The steps, [S] each; those of a block follow one another, front to back.

    Attributes:
      ranks: [S, G, K] ranks to composite; R for none.
      block: block of tiles; one past the last block for unused steps.
      first: True for the first step of its block.
      live: False for unused steps.
    """

    ranks: Array
    block: Array
    first: Array
    live: Array


def tiles_per_step(config: RasterConfig, grid: Grid) -> int:
    """Return G; few tiles stay in a CPU's caches."""
    return max(1, min(config.tiles_per_step or 16, grid.tiles))


def make_schedule(
    lists: Lists, grid: Grid, group: int, chunk: int, room: int
) -> Schedule:
    """Return tiles by falling length, in blocks of ``group``, ``chunk`` ranks a step.

    The schedule is empty if it needs more than ``room`` steps, or the lists did not
    fit.
    """
    blocks = -(-grid.tiles // group)
    order = argsort_descending(lists.length)
    gap = (0, blocks * group - grid.tiles)
    tiles = jnp.pad(order, gap, constant_values=grid.tiles).reshape(blocks, group)
    levels = -(-take(lists.length, tiles[:, 0]) // chunk)
    steps, _ = total_count(levels)
    return Schedule(
        tiles=tiles,
        levels=jnp.where(lists.fit & (steps <= room), levels, 0),
        steps=steps,
    )


def step_capacity(capacity: int, grid: Grid, group: int, chunk: int) -> int:
    """Return the steps that a pair capacity has room for.

    Chunks are assumed to be full but for an eighth, and half a chunk more per block.
    """
    blocks = -(-grid.tiles // group)
    return -(-blocks // 2) + -(-9 * capacity // (8 * group * chunk))


def most_steps(pairs: int, ranks: int, grid: Grid, group: int, chunk: int) -> int:
    """Return an upper limit of the steps that any lists of ``pairs`` pairs need.

    Tiles come by falling length. So the longest list of a block is at most the mean of
    the block before, and that of the first block has at most all ranks.
    """
    blocks = -(-grid.tiles // group)
    return blocks + min(pairs, ranks) // chunk + pairs // (group * chunk) + 1


def pairs_for_steps(steps: Array, grid: Grid, group: int, chunk: int) -> Array:
    """Return the smallest pair capacity whose `step_capacity` holds ``steps``.

    Exact to a millionth; saturating int32.
    """
    blocks = -(-grid.tiles // group)
    extra = jnp.maximum(steps - -(-blocks // 2), 0).astype(jnp.float32)
    above = (extra - 1) * (8 * group * chunk / 9) * (1 + 1e-6)
    wanted = jnp.where(extra > 0, jnp.floor(above) + 1, 0)
    huge = wanted >= COUNT_LIMIT
    return jnp.where(huge, 2**31 - 1, jnp.where(huge, 0, wanted).astype(jnp.int32))


def ranks_at(lists: Lists, tile: Array, level: Array, chunk: int, none: int) -> Array:
    """Return the ranks [..., G, K] of a chunk of tiles [..., G]; ``none`` past the end.

    Args:
      lists: of the tiles.
      tile: [..., G].
      level: [...] number of the chunk in each list.
      chunk: K.
      none: rank that stands for no Gaussian.
    """
    offset = level[..., None, None] * chunk + lax.iota(jnp.int32, chunk)
    inside = offset < take(lists.length, tile)[..., None]
    position = take(lists.start, tile)[..., None] + offset
    return jnp.where(inside, take(lists.ranks, position), none)


def make_steps(schedule: Schedule, room: int) -> Steps:
    """Unroll the schedule into ``room`` steps; unused ones lie past the last block."""
    ends = cumulative_sum(schedule.levels)
    block = segment_ids(ends, room)
    level = lax.iota(jnp.int32, room) - take(ends - schedule.levels, block)
    return Steps(block, level)


def make_work(
    lists: Lists, schedule: Schedule, steps: Steps, chunk: int, ranks: int, room: int
) -> Work:
    """Return the work of the first ``room`` steps."""
    block, level = steps.block[:room], steps.level[:room]
    tile = schedule.tiles.at[block].get(mode="fill", fill_value=lists.length.shape[0])
    return Work(
        ranks=ranks_at(lists, tile, level, chunk, ranks),
        block=block,
        first=level == 0,
        live=block < schedule.levels.shape[0],
    )
