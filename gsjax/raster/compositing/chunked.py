"""Chunked compositing on CPUs: the path that JAX differentiates in any mode and order.

Axis legend: S steps, G tiles of a step, K Gaussians of a chunk, P pixels of a tile,
C channels, R ranks.

Without a derivative, a chunk is looked up when it is due, for as long as a block of
tiles has chunks and open pixels. Loops of unknown length have no transpose. So for
derivatives the steps are a `lax.scan` over all there is room for, with the chunks
gathered ahead of it; chunks are recomputed in the backward pass instead of stored, and
those behind pixels that have all stopped are skipped in both directions by `lax.cond`.
Both blend the same chunks in the same order (`gsjax.raster.compositing.blending`).
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.raster.compositing import schedules
from gsjax.raster.compositing.alpha import pixel_centres
from gsjax.raster.compositing.blending import (
    Chunk,
    Parts,
    blend_chunk,
    columns_of,
    table_of,
    tables_of,
)
from gsjax.raster.compositing.schedules import Schedule, Work
from gsjax.raster.compositing.types import (
    Compositor,
    Images,
    Task,
    Tiles,
    single_images,
)
from gsjax.raster.lists.binning import Grid, Lists, corners
from gsjax.raster.size_buckets import run_at_bucket
from gsjax.raster.types import Array, RasterConfig
from gsjax.raster.vmap_branching import any_in_batch

T = TypeVar("T")

# Numbers of a Gaussian in a chunk beside its channels, and how many more the backward
# pass makes of it; numbers of a Gaussian at a pixel while a chunk is blended.
_IN_CHUNK, _IN_CHUNK_BACKWARD, _IN_STEP = 7, 8, 3


def _sizes(task: Task) -> tuple[int, int]:
    """Return G and K."""
    return schedules.tiles_per_step(task.config, task.grid), task.config.chunk_size


def _room(pairs: int, ranks: int, task: Task) -> int:
    """Return the number of steps there is room for."""
    group, chunk = _sizes(task)
    if task.room_for_all:
        return schedules.most_steps(pairs, ranks, task.grid, group, chunk)
    return schedules.step_capacity(pairs, task.grid, group, chunk)


def _schedule(lists: Lists, ranks: int, task: Task) -> tuple[Schedule, int]:
    group, chunk = _sizes(task)
    room = _room(lists.ranks.shape[0], ranks, task)
    return schedules.make_schedule(lists, task.grid, group, chunk, room), room


def composite_chunks(tiles: Tiles, task: Task) -> Images:
    """Composite by loops that end with the lists; see `Compositor.forward`."""
    config, grid, lists = task.config, task.grid, tiles.lists
    channels = tiles.channels._replace(probe=None)
    columns = columns_of(tiles.splat, channels, config)
    # One table: a Gaussian is looked up once.
    rows = table_of([column for some in columns.values() for column in some])
    widths = [len(some) for some in columns.values()]
    none, alpha_min = tiles.splat.u.shape[0], channels.alpha_min
    schedule, _ = _schedule(lists, none, task)

    def parts_of(rows):
        parts = lax.split(rows, widths, axis=rows.ndim - 1)
        return Parts(**dict(zip(columns, parts)))

    pixels = pixel_centres(grid.tile, rows.dtype)
    group = schedule.tiles.shape[1]
    nothing = _nothing(jax.eval_shape(parts_of, rows), group, pixels.shape[1], config)

    def of_block(block, images):
        tile = schedule.tiles[block]
        corner = corners(tile, grid, tiles.device, rows.dtype)

        def ranks_of(level):
            return schedules.ranks_at(lists, tile, level, config.chunk_size, none)

        def unfinished(state):
            level, _, carried, _ = state
            left = level < schedule.levels[block]
            return left & jnp.any(carried > config.transmittance_min)

        def advance(state):
            level, ranks, carried, image = state
            chunk = Chunk(parts_of(take_rows(rows, ranks)), corner)
            carried, added = blend_chunk(carried, chunk, pixels, config, alpha_min)
            image = jax.tree.map(jnp.add, image, added)
            # Carried to the next turn: within one, XLA would look up the rank of a row
            # again for every number in it.
            return level + 1, ranks_of(level + 1), carried, image

        first = jnp.int32(0)
        start = (first, ranks_of(first), jnp.ones_like(nothing["sums"][:, 0]), nothing)
        *_, image = lax.while_loop(unfinished, advance, start)
        return jax.tree.map(lambda all_, one: all_.at[block].set(one), images, image)

    used = jnp.sum(schedule.levels > 0, dtype=jnp.int32)
    blocks = schedule.tiles.shape[0]
    images = {k: jnp.zeros((blocks, *v.shape), v.dtype) for k, v in nothing.items()}
    images = lax.fori_loop(0, used, of_block, images)
    return _in_grid_order(images, schedule, grid)


def composite_steps(tiles: Tiles, task: Task) -> Images:
    """Composite by a known number of steps; see `Compositor.differentiable`."""
    ranks, config = tiles.splat.u.shape[0], task.config
    schedule, room = _schedule(tiles.lists, ranks, task)
    steps = schedules.make_steps(schedule, room)

    def of_size(size):
        work = schedules.make_work(
            tiles.lists, schedule, steps, config.chunk_size, ranks, size
        )
        tables = tables_of(tiles.splat, tiles.channels, config)
        return _scan(tables, work, schedule, tiles, task)

    # Each further size costs seconds of compiling, and empty steps cost little.
    sizes = max(1, config.num_size_buckets - 2)
    return run_at_bucket(schedule.steps, room, sizes, of_size)


def _scan(
    tables: Parts, work: Work, schedule: Schedule, tiles: Tiles, task: Task
) -> Images:
    config, grid = task.config, task.grid
    dtype = tables.splats.dtype
    pixels = pixel_centres(grid.tile, dtype)
    blocks, group = schedule.tiles.shape
    nothing = _nothing(tables, group, pixels.shape[1], config)
    # Ahead of the loop, so that the transpose is one scatter-add and not one a step.
    corner = corners(schedule.tiles[work.block], grid, tiles.device, dtype)
    chunks = Chunk(take_rows(tables, work.ranks), corner)
    alpha_min = tiles.channels.alpha_min

    # In the branch as well: what the backward pass recomputes there is compiled
    # together with its users, and only the inputs cross the `cond`.
    @jax.checkpoint
    def blend(carried, chunk):
        return blend_chunk(carried, chunk, pixels, config, alpha_min)

    def skip(carried, _):
        return carried, nothing

    @jax.checkpoint
    def advance(go, carried, chunk):
        return lax.cond(go, blend, skip, carried, chunk)

    # The image is added to, never overwritten: its cotangent then passes through the
    # steps of the backward pass unchanged, without copies.
    def step(carry, inputs):
        carried, image = carry
        first, live, block, chunk = inputs
        carried = jnp.where(first, 1, carried)
        go = any_in_batch(live & jnp.any(carried > config.transmittance_min))
        carried, added = advance(go, carried, chunk)

        def add(image, more):
            return image.at[block].add(more, mode="promise_in_bounds")

        return (carried, jax.tree.map(add, image, added)), None

    # One block more than there is: unused steps name it.
    images = {k: jnp.zeros((blocks + 1, *v.shape), v.dtype) for k, v in nothing.items()}
    init = (jnp.ones_like(nothing["sums"][:, 0]), images)
    steps = (work.first, work.live, work.block, chunks)
    (_, images), _ = lax.scan(step, init, steps)
    return _in_grid_order(images, schedule, grid)


def take_rows(rows: T, index: Array) -> T:
    """Return the rows ``index`` of every array; all must exist."""
    return jax.tree.map(lambda a: a.at[index].get(mode="promise_in_bounds"), rows)


def _nothing(tables: Parts, group: int, pixels: int, config: RasterConfig) -> Images:
    """Return what a skipped chunk adds."""
    dtype = tables.channels.dtype
    nothing = {"sums": jnp.zeros((group, tables.channels.shape[1], pixels), dtype)}
    for name in single_images(config):
        nothing[name] = jnp.zeros((group, pixels), dtype)
    return nothing


def _in_grid_order(images: Images, schedule: Schedule, grid: Grid) -> Images:
    """Reorder [blocks, G, ...] to [T, ...]."""
    flat = {name: v.reshape(-1, *v.shape[2:]) for name, v in images.items()}
    rows = lax.iota(jnp.int32, schedule.tiles.size)
    places = jnp.zeros(grid.tiles, jnp.int32)
    places = places.at[schedule.tiles.ravel()].set(rows, mode="drop")
    return take_rows(flat, places)


def _capacity(lists: Lists, task: Task) -> Array:
    group, chunk = _sizes(task)
    schedule = schedules.make_schedule(lists, task.grid, group, chunk, 2**30)
    for_steps = schedules.pairs_for_steps(schedule.steps, task.grid, group, chunk)
    return jnp.maximum(lists.pairs, for_steps)


def _memory(pairs: int, task: Task, gradients: bool) -> tuple[int, int]:
    group, chunk = _sizes(task)
    rows = group * schedules.step_capacity(pairs, task.grid, group, chunk)
    pixels, in_chunk = task.grid.tile**2, _IN_CHUNK + task.channels
    taken = _IN_STEP * group * chunk * pixels
    if gradients:
        numbers = 2 * in_chunk + _IN_CHUNK_BACKWARD
        taken += rows * (chunk * numbers + pixels)
    return taken, rows * (chunk * in_chunk + pixels)


CHUNKED = Compositor(
    name="chunked",
    suits=lambda task: task.platform == "cpu" and not task.config.sorts_pixels,
    forward=composite_chunks,
    differentiable=composite_steps,
    reverse=None,
    capacity=_capacity,
    memory=_memory,
)
