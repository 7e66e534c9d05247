"""Front-to-back compositing of sorted tile lists on a CPU; see `gsjax.raster.flat` for
accelerators.

Axis legend: S steps, G tiles of a step, K Gaussians of a chunk, P pixels of a tile,
C channels, R ranks.

There are three ways through the lists. Where no derivative is taken, nothing is kept,
nothing is paid for room, and a Gaussian is looked up when it is due: one by one
(`gsjax.raster.single`) where XLA makes one kernel of that, else chunk by chunk, for as
long as a block of tiles has chunks and pixels that have not stopped. Loops of unknown
length have no transpose, so where a derivative is taken the steps are a `lax.scan` over
all there is room for, with the chunks gathered ahead. There chunks are recomputed in
the backward pass instead of kept, and those behind pixels that have all stopped are
skipped, in both directions, by `lax.cond`. Both ways by chunks blend the same chunks in
the same order (`gsjax.raster.blend`).
"""

from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import sequential_vmap
from jax.custom_derivatives import SymbolicZero, zero_from_primal

from gsjax.raster import adjoint, single
from gsjax.raster.alpha import pixel_centres
from gsjax.raster.batches import any_of_batch
from gsjax.raster.bins import Grid, Lists, corners
from gsjax.raster.blend import (
    Chunk,
    Parts,
    blend_chunk,
    columns_of,
    table_of,
    tables_of,
)
from gsjax.raster.ladder import on_ladder
from gsjax.raster.schedules import Schedule, Work, make_steps, make_work, ranks_at
from gsjax.raster.single import Kept, composite_singly
from gsjax.raster.transposed import moving_jvp, with_transpose
from gsjax.raster.types import Array, Projected, RasterConfig

T = TypeVar("T")
# Under `jax.vmap`: side by side each would wait for the longest, and every turn of a
# loop copy the images of all.
_one_by_one = sequential_vmap


@partial(jax.custom_jvp, nondiff_argnums=(4, 5, 6))
def composite(
    projected: Projected,
    lists: Lists,
    schedule: Schedule,
    device: Array,
    grid: Grid,
    room: int,
    config: RasterConfig,
) -> dict[str, Array]:
    """Images of one device's tiles, before the background.

    Args:
      projected: [R].
      lists: of the tiles.
      schedule: of the lists.
      device: [] its number.
      grid: its tiles.
      room: steps there is room for where a derivative is taken.
      config: static settings.

    Returns:
      "sums" [T, C, P]: colour, depth where asked for, alpha; "median" [T, P] where
      asked for. T in the grid's order.
    """
    del room

    @_one_by_one
    def one(projected, lists, schedule, device):
        if single.suits(projected, grid):
            return composite_singly(projected, lists, device, grid, config)[0]
        return by_chunks(projected, lists, schedule, device, grid, config)

    return one(projected, lists, schedule, device)


@partial(composite.defjvp, symbolic_zeros=True)
def _composite_jvp(grid, room, config, primals, tangents):
    """By what is differentiated alone."""
    leaves, tree = jax.tree.flatten(primals)
    slopes = tree.flatten_up_to(tangents)

    def by_steps(*leaves):
        return _by_steps(*jax.tree.unflatten(tree, leaves), grid, room, config)

    if not adjoint.suits(primals[0], grid, config):
        return moving_jvp(by_steps, leaves, slopes, SymbolicZero)
    images, kept = _keeping(*primals, grid, room, config)
    moving = [i for i, s in enumerate(slopes) if not isinstance(s, SymbolicZero)]
    count, by = len(leaves), _kinds(moving)
    kept, of_kept = jax.tree.flatten(kept)

    def forward(*values):
        slopes = dict(zip(moving, values[count + len(kept) :]))
        slopes = [slopes.get(i) for i in range(count)]
        return [moving_jvp(by_steps, values[:count], slopes, type(None))[1]["sums"]]

    def transpose(*values):
        primals = jax.tree.unflatten(tree, values[:count])
        kept = jax.tree.unflatten(of_kept, values[count:-1])
        back = _pulled_back(*primals, kept, values[-1], grid, room, config, by)
        return [jax.tree.leaves(back)[i] for i in moving]

    slopes = [slopes[i] for i in moving]
    like = [images["sums"]]
    (sums,) = with_transpose(forward, transpose, (*leaves, *kept), slopes, like)
    return images, {"sums": sums}


def _kinds(moving: list[int]) -> frozenset[str]:
    """What `adjoint.pulled_back` is asked for, given which fields of `Projected`, its
    probe None, are differentiated by."""
    fields = {Projected._fields[i] for i in moving}
    channels = {"colors", "depth"}
    kinds = {"splats": fields - channels, "channels": fields & channels}
    return frozenset(kind for kind, some in kinds.items() if some)


@partial(jax.custom_jvp, nondiff_argnums=(4, 5, 6))
def _keeping(
    projected: Projected,
    lists: Lists,
    schedule: Schedule,
    device: Array,
    grid: Grid,
    room: int,
    config: RasterConfig,
) -> tuple[dict[str, Array], Kept]:
    """`composite`, one by one, and what the way back needs, of which no derivative is
    taken."""
    del schedule, room

    @_one_by_one
    def one(projected, lists, device):
        return composite_singly(projected, lists, device, grid, config, keeping=True)

    return one(projected, lists, device)


@partial(_keeping.defjvp, symbolic_zeros=True)
def _keeping_jvp(grid, room, config, primals, tangents):
    images, kept = _keeping(*primals, grid, room, config)
    _, slopes = _composite_jvp(grid, room, config, primals, tangents)
    return (images, kept), (slopes, jax.tree.map(zero_from_primal, kept))


@partial(jax.custom_jvp, nondiff_argnums=(6, 7, 8, 9))
def _pulled_back(
    projected: Projected,
    lists: Lists,
    schedule: Schedule,
    device: Array,
    kept: Kept,
    cotangent: Array,
    grid: Grid,
    room: int,
    config: RasterConfig,
    by: frozenset[str],
) -> Projected:
    """`adjoint.pulled_back`, whose own derivative is that of the steps."""
    del schedule, room

    @_one_by_one
    def one(projected, lists, device, kept, cotangent):
        given = projected, lists, device, kept, cotangent
        return adjoint.pulled_back(*given, grid, config, by)

    return one(projected, lists, device, kept, cotangent)


@_pulled_back.defjvp
def _pulled_back_jvp(grid, room, config, by, primals, tangents):
    projected, lists, schedule, device, _, cotangent = primals

    def by_steps(projected, cotangent):
        def sums(projected):
            given = projected, lists, schedule, device
            return _by_steps(*given, grid, room, config)["sums"]

        return jax.vjp(sums, projected)[1](cotangent)[0]

    given, slopes = (projected, cotangent), (tangents[0], tangents[-1])
    back = _pulled_back(*primals, grid, room, config, by)
    return back, jax.jvp(by_steps, given, slopes)[1]


def by_chunks(
    projected: Projected,
    lists: Lists,
    schedule: Schedule,
    device: Array,
    grid: Grid,
    config: RasterConfig,
) -> dict[str, Array]:
    """`composite` without a derivative, by loops that are as long as need be."""
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


def _by_steps(
    projected: Projected,
    lists: Lists,
    schedule: Schedule,
    device: Array,
    grid: Grid,
    room: int,
    config: RasterConfig,
) -> dict[str, Array]:
    """`composite` by steps of a known number, whose derivative can be taken."""
    steps = make_steps(schedule, room)

    def of_size(size):
        ranks = projected.u.shape[0]
        work = make_work(lists, schedule, steps, config.chunk_size, ranks, size)
        tables = tables_of(projected, config)
        return _scan(tables, work, schedule, device, grid, config)

    # Every size more costs seconds of compiling, and empty steps cost little.
    return on_ladder(schedule.steps, room, max(1, config.rungs - 2), of_size)


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
        go = any_of_batch(live & jnp.any(carried > config.stop))
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
