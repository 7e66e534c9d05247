"""Compositing for accelerators: the chunks of all tiles side by side.

A loop through the lists waits at every turn for launches, as often as the longest list
has chunks, and most tiles wait for the longest. So here each chunk of a list is
blended by itself, many at a time, and then joined with what is in front of it:

    (C₁, T₁) ∘ (C₂, T₂) = (C₁ + T₁ C₂, T₁ T₂).

Where a pixel stops goes by what is in front. So the transmittance of every chunk is
found first, by itself and without derivative; what lies behind pixels that have all
stopped is left out of the second pass, which blends, and is differentiated as it
stands. No sum depends on the order in which threads come: pictures are the same bit for
bit, where gradients, which are scattered to the Gaussians, are not.

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
    alphas_of,
    columns_of,
    sums_behind,
)
from gsjax.raster.compositing.schedules import ranks_at
from gsjax.raster.lists.binning import Grid, Lists, corners
from gsjax.raster.lists.counting import (
    compact_indices,
    cumulative_sum,
    segment_ids,
    take,
)
from gsjax.raster.size_buckets import run_at_bucket
from gsjax.raster.types import Array, Projected, RasterConfig
from gsjax.raster.vmap_branching import any_in_batch

T = TypeVar("T")

_BATCH = 2**25  # Gaussians at pixels, half a gigabyte at work: launches are then few


class Entries(NamedTuple):
    """Chunks of lists, those of a tile one after another, front to back; [E] each.

    Attributes:
      tile: whose; T past the last.
      level: which chunk of its list.
    """

    tile: Array
    level: Array


def entry_capacity(capacity: int, grid: Grid, chunk: int) -> int:
    """Entries that lists of ``capacity`` pairs come to, at most."""
    return capacity // chunk + grid.tiles


def batch_size(config: RasterConfig) -> int:
    """B: 16,384 with 8 × 8 pixels and 32 Gaussians."""
    each = config.chunk_size * config.tile_size**2
    return config.tiles_per_step or max(1, _BATCH // each)


def composite_parallel(
    projected: Projected, lists: Lists, device: Array, grid: Grid, config: RasterConfig
) -> dict[str, Array]:
    """Images of one device's tiles, before the background.

    Args:
      projected: [R].
      lists: of the tiles.
      device: [] its number.
      grid: its tiles.
      config: static settings.

    Returns:
      "sums" [T, C, P]: colour, depth where asked for, alpha; "median" [T, P] where
      asked for.
    """
    room = entry_capacity(lists.ranks.shape[0], grid, config.chunk_size)
    length = jnp.where(lists.fit, lists.length, 0)
    chunks = -(-length // config.chunk_size)
    ends = cumulative_sum(chunks)
    tile = segment_ids(ends, room)
    level = lax.iota(jnp.int32, room) - take(ends - chunks, tile)
    entries = Entries(tile, level)
    columns = columns_of(projected, config)
    tables = Parts(**{name: jnp.stack(some, -1) for name, some in columns.items()})
    chunk_of = partial(_chunk_of, lists=lists, device=device, grid=grid, config=config)
    bare = lax.stop_gradient(tables)
    carried, left = _transmittances(bare, entries, chunk_of, grid, config)
    live = jnp.any(carried > config.stop, axis=1) & (tile < grid.tiles)
    index, count = compact_indices(live, room)
    # The last of each tile that is live: the first is, wherever there is one.
    last = jnp.where(chunks > 0, take(cumulative_sum(live), ends - 1) - 1, room)

    def of_size(size: int) -> dict[str, Array]:
        some = index[:size]
        there = lax.iota(jnp.int32, size) < count
        tile_of = jnp.where(there, tile.at[some].get(mode="clip"), grid.tiles)
        mine = Entries(tile_of, take(level, some))
        through = take(carried, some), take(left, some)
        added = _blended(tables, mine, through, chunk_of, grid, config)
        sums = {"sums": _along_lists(jnp.add, mine, added["sums"])}
        if "median" in added:
            sums["median"] = _along_lists(_first, mine, added["median"])
        return {name: take(value, last) for name, value in sums.items()}

    return run_at_bucket(count, room, max(1, config.num_size_buckets - 1), of_size)


def _chunk_of(
    tables: Parts,
    entries: Entries,
    lists: Lists,
    device: Array,
    grid: Grid,
    config: RasterConfig,
) -> Chunk:
    """What is to be blended, [E, K, …]; zeros, so opacity 0, past the end of a list."""
    # Past the last row, so that no gradient goes to one: threads would wait there.
    none = tables.splats.shape[0]
    tile = entries.tile[:, None]
    ranks = ranks_at(lists, tile, entries.level, config.chunk_size, none)[:, 0]
    parts = jax.tree.map(lambda table: take(table, ranks), tables)
    return Chunk(parts, corners(entries.tile, grid, device, tables.splats.dtype))


def _transmittances(
    tables: Parts,
    entries: Entries,
    chunk_of: Callable[[Parts, Entries], Chunk],
    grid: Grid,
    config: RasterConfig,
) -> tuple[Array, Array]:
    """Transmittance [E, P] in front of each entry, and that behind it: what is behind
    one is, bit for bit, in front of the next.

    By logarithms: their sums, in whatever order, are off by less than products of 1 − α
    where there are many faint Gaussians.
    """
    bare = Parts(tables.splats, tables.channels[:, :0])
    pixels = pixel_centres(grid.tile, tables.splats.dtype)

    def through(entries: Entries) -> Array:
        alpha = alphas_of(chunk_of(bare, entries), pixels, config)
        return jnp.sum(jnp.log1p(-alpha), axis=1)

    there = entries.tile < grid.tiles
    log_total = _in_batches(through, there, entries, batch_size(config))
    left = jnp.exp(_along_lists(jnp.add, entries, log_total))
    # Else what is asked of it would be computed anew from the steps of the sum.
    left = lax.optimization_barrier(left)
    return _before(entries, left, 1), left


def _blended(
    tables: Parts,
    entries: Entries,
    through: tuple[Array, Array],
    chunk_of: Callable[[Parts, Entries], Chunk],
    grid: Grid,
    config: RasterConfig,
) -> dict[str, Array]:
    """What each entry adds to its tile's image, [E, …]; ``through`` as of
    `_transmittances`."""
    pixels = pixel_centres(grid.tile, tables.splats.dtype)

    @jax.checkpoint
    def blend(inputs) -> tuple[Array, dict[str, Array]]:
        (carried, left), chunk = inputs
        alpha = alphas_of(chunk, pixels, config)
        return sums_behind(carried, alpha, chunk.parts, config, left)

    # Ahead of the loop, so that the transpose is one scatter-add and not one a batch.
    inputs = through, chunk_of(tables, entries)
    there = entries.tile < grid.tiles
    total, out = _in_batches(blend, there, inputs, batch_size(config))
    front = _in_front(total, through[0], entries)
    return {**out, "sums": front[:, None] * out["sums"]}


@jax.custom_jvp
def _in_front(total: Array, carried: Array, entries: Entries) -> Array:
    """``carried`` [E, P], with its derivative by the transmittance ``total`` [E, P] of
    each entry.

    dT_c = T_c Σ_{b<c} dT_b / T_b along a list. Where a factor is 0, what lies behind is
    0 too, and stopped.
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
    """``run`` of ``size`` entries at a time, zeros where none of them is needed.

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
    """What the values [E, …] come to along each list, each with those before it."""
    first = (entries.level == 0).reshape(-1, *[1] * (values.ndim - 1))

    def both(a, b):
        return a[0] | b[0], jnp.where(b[0], b[1], join(a[1], b[1]))

    return lax.associative_scan(both, (first, values))[1]


def _first(one: Array, other: Array) -> Array:
    """Of two the first that there is. Where T rises by rounding, it falls through a
    half once more."""
    return jnp.where(one != 0, one, other)


def _before(entries: Entries, values: Array, none: float) -> Array:
    """Of values [E, P] those of the entry before; ``none`` at the first of a list."""
    moved = jnp.concatenate([jnp.zeros_like(values[:1]), values[:-1]])
    return jnp.where((entries.level == 0)[:, None], none, moved)
