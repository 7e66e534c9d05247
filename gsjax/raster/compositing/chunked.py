"""Front-to-back compositing on a CPU chunk by chunk: where XLA makes no single kernel
of it, and for derivatives other than the gradient.

Axis legend: S steps, G tiles of a step, K Gaussians of a chunk, P pixels of a tile,
C channels, R ranks.

Where no derivative is taken, a chunk is looked up when it is due, for as long as a
block of tiles has chunks and pixels that have not stopped. Loops of unknown length have
no transpose, so where a derivative is taken the steps are a `lax.scan` over all there
is room for, with the chunks gathered ahead. There chunks are recomputed in the backward
pass instead of kept, and those behind pixels that have all stopped are skipped, in both
directions, by `lax.cond`. Both blend the same chunks in the same order
(`gsjax.raster.compositing.blending`).
"""

from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.raster.compositing.alpha import pixel_centres
from gsjax.raster.compositing.blending import (
    Chunk,
    Parts,
    blend_chunk,
    columns_of,
    table_of,
    tables_of,
)
from gsjax.raster.compositing.schedules import (
    Schedule,
    Work,
    make_steps,
    make_work,
    ranks_at,
)
from gsjax.raster.lists.binning import Grid, Lists, corners
from gsjax.raster.size_buckets import run_at_bucket
from gsjax.raster.types import Array, Projected, RasterConfig
from gsjax.raster.vmap_branching import any_in_batch

T = TypeVar("T")


def composite_chunks(
    projected: Projected,
    lists: Lists,
    schedule: Schedule,
    device: Array,
    grid: Grid,
    config: RasterConfig,
) -> dict[str, Array]:
    """Images of one device's tiles, before the background, by loops that are as long as
    need be; as `gsjax.raster.compositing.compositor.composite`. No derivative can be taken backward.
    """
    columns = columns_of(projected._replace(probe=None), config)
    # In one table: a Gaussian is looked up once.
    rows = table_of([column for some in columns.values() for column in some])
    widths = [len(some) for some in columns.values()]

    def parts_of(rows):
        parts = lax.split(rows, widths, axis=rows.ndim - 1)
        return Parts(**dict(zip(columns, parts)))

    pixels = pixel_centres(grid.tile, rows.dtype)
    group = schedule.tiles.shape[1]
    nothing = _nothing(jax.eval_shape(parts_of, rows), group, pixels.shape[1])
    none = projected.u.shape[0]

    def of_block(block, images):
        tile = schedule.tiles[block]
        corner = corners(tile, grid, device, rows.dtype)

        def ranks_of(level):
            return ranks_at(lists, tile, level, config.chunk_size, none)

        def more(state):
            level, _, carried, _ = state
            left = level < schedule.levels[block]
            return left & jnp.any(carried > config.stop)

        def advance(state):
            level, ranks, carried, image = state
            chunk = Chunk(parts_of(take_rows(rows, ranks)), corner)
            carried, added = blend_chunk(carried, chunk, pixels, config)
            image = jax.tree.map(jnp.add, image, added)
            # From one turn to the next: within one, XLA would look up the rank of a
            # row again for every number in it.
            return level + 1, ranks_of(level + 1), carried, image

        first = jnp.int32(0)
        start = (first, ranks_of(first), jnp.ones_like(nothing["sums"][:, 0]), nothing)
        *_, image = lax.while_loop(more, advance, start)
        return jax.tree.map(lambda all_, one: all_.at[block].set(one), images, image)

    used = jnp.sum(schedule.levels > 0, dtype=jnp.int32)
    blocks = schedule.tiles.shape[0]
    images = {k: jnp.zeros((blocks, *v.shape), v.dtype) for k, v in nothing.items()}
    images = lax.fori_loop(0, used, of_block, images)
    return _in_grid_order(images, schedule, grid)


def composite_steps(
    projected: Projected,
    lists: Lists,
    schedule: Schedule,
    device: Array,
    grid: Grid,
    room: int,
    config: RasterConfig,
) -> dict[str, Array]:
    """The same by steps of a known number, whose derivatives can be taken, of any kind
    and order.

    Args:
      projected, lists, schedule, device, grid, config: as `composite_chunks`.
      room: steps there is room for.
    """
    steps = make_steps(schedule, room)

    def of_size(size):
        ranks = projected.u.shape[0]
        work = make_work(lists, schedule, steps, config.chunk_size, ranks, size)
        tables = tables_of(projected, config)
        return _scan(tables, work, schedule, device, grid, config)

    # Every size more costs seconds of compiling, and empty steps cost little.
    return run_at_bucket(
        schedule.steps, room, max(1, config.num_size_buckets - 2), of_size
    )


def _scan(
    tables: Parts,
    work: Work,
    schedule: Schedule,
    device: Array,
    grid: Grid,
    config: RasterConfig,
) -> dict[str, Array]:
    dtype = tables.splats.dtype
    pixels = pixel_centres(grid.tile, dtype)
    blocks, group = schedule.tiles.shape
    nothing = _nothing(tables, group, pixels.shape[1])
    # Ahead of the loop, so that the transpose is one scatter-add and not one a step.
    corner = corners(schedule.tiles[work.block], grid, device, dtype)
    chunks = Chunk(take_rows(tables, work.ranks), corner)

    # In the branch as well: what the backward pass recomputes there is compiled
    # together with what uses it, and nothing but the inputs crosses the `cond`.
    blend = jax.checkpoint(partial(blend_chunk, pixels=pixels, config=config))

    def skip(carried, _):
        return carried, nothing

    @jax.checkpoint
    def advance(go, carried, chunk):
        return lax.cond(go, blend, skip, carried, chunk)

    # The image is added to, never overwritten: its cotangent then passes through the
    # steps of the backward pass unchanged, and is not copied there.
    def step(carry, inputs):
        carried, image = carry
        first, live, block, chunk = inputs
        carried = jnp.where(first, 1, carried)
        go = any_in_batch(live & jnp.any(carried > config.stop))
        carried, added = advance(go, carried, chunk)

        def add(image, more):
            return image.at[block].add(more, mode="promise_in_bounds")

        return (carried, jax.tree.map(add, image, added)), None

    # One block more than there is: steps that are not live name it.
    images = {k: jnp.zeros((blocks + 1, *v.shape), v.dtype) for k, v in nothing.items()}
    init = (jnp.ones_like(nothing["sums"][:, 0]), images)
    steps = (work.first, work.live, work.block, chunks)
    (_, images), _ = lax.scan(step, init, steps)
    return _in_grid_order(images, schedule, grid)


def take_rows(rows: T, index: Array) -> T:
    """Of every array those rows; all there."""
    return jax.tree.map(lambda a: a.at[index].get(mode="promise_in_bounds"), rows)


def _nothing(tables: Parts, group: int, pixels: int) -> dict[str, Array]:
    """What a chunk adds that is not blended."""
    dtype = tables.channels.dtype
    nothing = {"sums": jnp.zeros((group, tables.channels.shape[1], pixels), dtype)}
    if tables.depth is not None:
        nothing["median"] = jnp.zeros((group, pixels), dtype)
    return nothing


def _in_grid_order(
    images: dict[str, Array], schedule: Schedule, grid: Grid
) -> dict[str, Array]:
    """[blocks, G, ...] as [T, ...]."""
    flat = {name: v.reshape(-1, *v.shape[2:]) for name, v in images.items()}
    return take_rows(flat, _places(schedule, grid))


def _places(schedule: Schedule, grid: Grid) -> Array:
    """[T] where the blocks hold each tile, as a row of [blocks · G]."""
    rows = lax.iota(jnp.int32, schedule.tiles.size)
    none = jnp.zeros(grid.tiles, jnp.int32)
    return none.at[schedule.tiles.ravel()].set(rows, mode="drop")
