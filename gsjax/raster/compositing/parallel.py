"""Parallel compositing for accelerators: the chunks of all tiles side by side.

A loop through the lists would wait for launches as often as the longest list has
chunks, and most tiles would wait for the longest. So each chunk of a list is blended by
itself, many at a time, and then joined with the chunks in front of it:

    (C₁, T₁) ∘ (C₂, T₂) = (C₁ + T₁ C₂, T₁ T₂).

Where a pixel stops depends on what is in front. So the transmittance of every chunk is
found first, without derivative; chunks behind pixels that have all stopped are left out
of the second pass, which blends and is differentiated by JAX. No sum depends on the
order of threads: images are reproducible bit for bit. Gradients are scattered to the
Gaussians and are not.

Axis legend: E entries (chunks of lists), B entries of a batch, K Gaussians of a chunk,
P pixels of a tile, C channels, T tiles, R ranks.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.raster.compositing.alpha import pixel_centres
from gsjax.raster.compositing.blending import (
    Chunk,
    Parts,
    columns_of,
    evaluated,
    sums_behind,
    times,
)
from gsjax.raster.compositing.schedules import ranks_at
from gsjax.raster.compositing.types import (
    Compositor,
    Images,
    Task,
    Tiles,
    listed_pairs,
)
from gsjax.raster.lists.binning import Grid, corners
from gsjax.raster.lists.counting import (
    compact_indices,
    cumulative_sum,
    segment_ids,
    take,
)
from gsjax.raster.size_buckets import run_at_bucket
from gsjax.raster.types import Array, RasterConfig
from gsjax.raster.vmap_branching import any_in_batch

T = TypeVar("T")

_BATCH = 2**25  # Gaussians at pixels in a batch; half a gigabyte, few launches
# Numbers of a Gaussian in a chunk beside its channels, and how many more the backward
# pass makes of it; numbers of a Gaussian at a pixel while a chunk is blended.
_IN_CHUNK, _IN_CHUNK_BACKWARD, _IN_STEP = 7, 8, 3


class Entries(NamedTuple):
    """Chunks of lists, those of a tile one after another, front to back; [E] each.

    Attributes:
      tile: tile of the list; T past the last entry.
      level: number of the chunk in its list.
    """

    tile: Array
    level: Array


def entry_capacity(capacity: int, grid: Grid, chunk: int) -> int:
    """Return the largest number of entries of lists with ``capacity`` pairs."""
    return capacity // chunk + grid.tiles


def batch_size(config: RasterConfig) -> int:
    """Return B: 16,384 with 8 × 8 pixels and 32 Gaussians."""
    each = config.chunk_size * config.tile_size**2
    return config.tiles_per_step or max(1, _BATCH // each)


def composite_parallel(tiles: Tiles, task: Task) -> Images:
    """Composite all chunks side by side; see `Compositor.differentiable`."""
    config, grid, lists = task.config, task.grid, tiles.lists
    room = entry_capacity(lists.ranks.shape[0], grid, config.chunk_size)
    length = jnp.where(lists.fit, lists.length, 0)
    chunks = -(-length // config.chunk_size)
    ends = cumulative_sum(chunks)
    tile = segment_ids(ends, room)
    level = lax.iota(jnp.int32, room) - take(ends - chunks, tile)
    entries = Entries(tile, level)
    columns = columns_of(tiles.splat, tiles.channels, config)
    tables = Parts(**{name: jnp.stack(some, -1) for name, some in columns.items()})
    chunk_of = partial(_chunk_of, tiles=tiles, task=task)
    bare = lax.stop_gradient(tables)
    carried, left = _transmittances(bare, entries, chunk_of, tiles, task)
    live = jnp.any(carried > config.transmittance_min, axis=1) & (tile < grid.tiles)
    index, count = compact_indices(live, room)
    # The last of each tile that is live: the first is, wherever there is one.
    last = jnp.where(chunks > 0, take(cumulative_sum(live), ends - 1) - 1, room)

    def of_size(size: int) -> dict[str, Array]:
        some = index[:size]
        there = lax.iota(jnp.int32, size) < count
        tile_of = jnp.where(there, tile.at[some].get(mode="clip"), grid.tiles)
        mine = Entries(tile_of, take(level, some))
        through = take(carried, some), take(left, some)
        added = _blended(tables, mine, through, chunk_of, tiles, task)
        sums = {
            name: _along_lists(_first if name == "median" else jnp.add, mine, image)
            for name, image in added.items()
        }
        return {name: take(value, last) for name, value in sums.items()}

    return run_at_bucket(count, room, max(1, config.num_size_buckets - 1), of_size)


def _chunk_of(tables: Parts, entries: Entries, tiles: Tiles, task: Task) -> Chunk:
    """Return the chunks [E, K, …]; zeros, so opacity 0, past the end of a list."""
    # Past the last row, so that no gradient goes to one: threads would wait there.
    none = tables.splats.shape[0]
    tile, size = entries.tile[:, None], task.config.chunk_size
    ranks = ranks_at(tiles.lists, tile, entries.level, size, none)[:, 0]
    parts = jax.tree.map(lambda table: take(table, ranks), tables)
    corner = corners(entries.tile, task.grid, tiles.device, tables.splats.dtype)
    return Chunk(parts, corner)


def _transmittances(
    tables: Parts,
    entries: Entries,
    chunk_of: Callable[[Parts, Entries], Chunk],
    tiles: Tiles,
    task: Task,
) -> tuple[Array, Array]:
    """Return the transmittance [E, P] in front of each entry, and that behind it.

    The value behind an entry is, bit for bit, the value in front of the next. Sums of
    logarithms are off by less, in any order, than products of 1 − α over many faint
    Gaussians.
    """
    grid, config, alpha_min = task.grid, task.config, tiles.channels.alpha_min
    bare = Parts(tables.splats, tables.channels[:, :0])
    pixels = pixel_centres(grid.tile, tables.splats.dtype)

    def through(entries: Entries) -> Array:
        at = evaluated(chunk_of(bare, entries), pixels, config, alpha_min)
        return jnp.sum(jnp.log1p(-at.alpha), axis=1)

    there = entries.tile < grid.tiles
    log_total = _in_batches(through, there, entries, batch_size(config))
    left = jnp.exp(_along_lists(jnp.add, entries, log_total))
    # Without a barrier its users would compute it again from the steps of the sum.
    left = lax.optimization_barrier(left)
    return _before(entries, left, 1), left


def _blended(
    tables: Parts,
    entries: Entries,
    through: tuple[Array, Array],
    chunk_of: Callable[[Parts, Entries], Chunk],
    tiles: Tiles,
    task: Task,
) -> dict[str, Array]:
    """Return what each entry adds to its tile's image, [E, …].

    ``through`` is the result of `_transmittances`.
    """
    grid, config, alpha_min = task.grid, task.config, tiles.channels.alpha_min
    pixels = pixel_centres(grid.tile, tables.splats.dtype)

    @jax.checkpoint
    def blend(inputs) -> tuple[Array, dict[str, Array]]:
        (carried, left), chunk = inputs
        at = evaluated(chunk, pixels, config, alpha_min)
        return sums_behind(carried, at, chunk.parts, config, left)

    # Ahead of the loop, so that the transpose is one scatter-add and not one a batch.
    inputs = through, chunk_of(tables, entries)
    there = entries.tile < grid.tiles
    total, out = _in_batches(blend, there, inputs, batch_size(config))
    front = _in_front(total, through[0], entries)
    return times(front, out)


@jax.custom_jvp
def _in_front(total: Array, carried: Array, entries: Entries) -> Array:
    """Return ``carried`` [E, P], differentiable by the transmittance ``total`` [E, P].

    dT_c = T_c Σ_{b<c} dT_b / T_b along a list. Where a factor is 0, everything behind
    it is 0 too, and stopped.
    """
    del total, entries
    return carried


@_in_front.defjvp
def _in_front_jvp(primals, tangents):
    total, _, entries = primals
    front = _in_front(*primals)
    rate = tangents[0] / jnp.where(total > 0, total, 1)
    return front, front * _before(entries, _along_lists(jnp.add, entries, rate), 0)


def _in_batches(run: Callable[[Any], T], needed: Array, inputs: Any, size: int) -> T:
    """Return ``run`` of ``size`` entries at a time, zeros where none of them is needed.

    Args:
      run: from arrays [B, …] to arrays [B, …].
      needed: [E] bool.
      inputs: arrays [E, …].
    """
    count = needed.shape[0]
    size = min(size, count)

    def split(values: Array) -> Array:
        rest = [(0, -count % size)] + [(0, 0)] * (values.ndim - 1)
        return jnp.pad(values, rest).reshape(-1, size, *values.shape[1:])

    def skip(inputs: Any) -> T:
        shapes = jax.eval_shape(run, inputs)
        return jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)

    def turn(_, batch):
        needed, inputs = batch
        return None, lax.cond(any_in_batch(jnp.any(needed)), run, skip, inputs)

    _, out = lax.scan(turn, None, jax.tree.map(split, (needed, inputs)))
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:count], out)


def _along_lists(
    join: Callable[[Array, Array], Array], entries: Entries, values: Array
) -> Array:
    """Accumulate values [E, …] along each list."""
    first = (entries.level == 0).reshape(-1, *[1] * (values.ndim - 1))

    def both(a, b):
        return a[0] | b[0], jnp.where(b[0], b[1], join(a[1], b[1]))

    return lax.associative_scan(both, (first, values))[1]


def _first(one: Array, other: Array) -> Array:
    """Return the first of two values that is not 0.

    T may rise by rounding and fall through a half twice.
    """
    return jnp.where(one != 0, one, other)


def _before(entries: Entries, values: Array, none: float) -> Array:
    """Return the values [E, P] of the entry before; ``none`` at the first of a list."""
    moved = jnp.concatenate([jnp.zeros_like(values[:1]), values[:-1]])
    return jnp.where((entries.level == 0)[:, None], none, moved)


def _memory(pairs: int, task: Task, gradients: bool) -> tuple[int, int]:
    config, channels, pixels = task.config, task.channels, task.grid.tile**2
    entries = entry_capacity(pairs, task.grid, config.chunk_size)
    batch = min(batch_size(config), entries)
    in_chunk = _IN_CHUNK + channels
    kept = entries * (config.chunk_size * in_chunk + (2 + channels) * pixels)
    step = batch * config.chunk_size * pixels
    if not gradients:
        return _IN_STEP * step + kept + entries * channels * pixels, kept
    backward = config.chunk_size * (in_chunk + _IN_CHUNK_BACKWARD)
    more = entries * (backward + 2 * channels * pixels)
    return 2 * _IN_STEP * step + kept + more, kept


PARALLEL = Compositor(
    name="parallel",
    suits=lambda task: not task.config.sorts_pixels,
    forward=composite_parallel,
    differentiable=composite_parallel,
    reverse=None,
    capacity=listed_pairs,
    memory=_memory,
)
