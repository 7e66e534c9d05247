"""Compositing in an order of each pixel's own: the path that JAX differentiates.

The splats of a tile are evaluated together. An order is found for each pixel, without
derivative, by `RasterConfig.order`. α is brought to that order, blended, and the
weights are brought back, so that the sums over splats are matrix products as in the
other kernels. It suits any platform, and is not fast on a CPU.

Axis legend: G tiles of a block, L places of a list, P pixels of a tile, C channels,
T tiles, R ranks, W places of a window.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import sequential_vmap

from gsjax.raster.compositing import schedules
from gsjax.raster.compositing.alpha import Evaluated, pixel_centres
from gsjax.raster.compositing.blending import (
    Chunk,
    Parts,
    channel_sums,
    evaluated,
    pixel_value,
    tables_of,
)
from gsjax.raster.compositing.chunked import take_rows
from gsjax.raster.compositing.fused_sorted import merge_exchange, suits
from gsjax.raster.compositing.types import (
    Compositor,
    Images,
    Task,
    Tiles,
    listed_pairs,
    pixel_channels,
    single_images,
)
from gsjax.raster.lists.binning import corners
from gsjax.raster.size_buckets import run_at_bucket
from gsjax.raster.types import Array, RasterConfig
from gsjax.raster.vmap_branching import any_in_batch

_TOGETHER = 2**22  # splats at pixels that are sorted together; 16 MB an array
_SIZES, _STEP = 4, 5  # of lists, and the ratio of one to the next
# Numbers of a splat at a pixel while a list is blended, and with gradients.
_IN_LIST, _IN_LIST_BACKWARD = 12, 24


def composite_ordered(tiles: Tiles, task: Task) -> Images:
    """Composite lists that each pixel orders; see `Compositor.differentiable`."""
    config, grid, lists = task.config, task.grid, tiles.lists
    tables = tables_of(tiles.splat, tiles.channels, config)
    none = tiles.splat.u.shape[0]
    group = schedules.tiles_per_step(config, grid)
    schedule = schedules.make_schedule(lists, grid, group, 1, 2**30)
    longest = _longest(lists.ranks.shape[0], none)
    pixels, in_loops = pixel_centres(grid.tile, tables.splats.dtype), suits(task)

    def of_tiles(size: int, tile: Array) -> Images:
        ranks = schedules.ranks_at(lists, tile, jnp.int32(0), size, none)
        corner = corners(tile, grid, tiles.device, tables.splats.dtype)
        chunk = Chunk(take_rows(tables, ranks), corner)
        at = evaluated(chunk, pixels, config, tiles.channels.alpha_min)
        keys = keys_at(chunk, at, pixels, config)
        keys = lax.stop_gradient(keys)
        return blend_ordered(at, chunk.parts, keys, config, in_loops)

    def of_size(tile: Array, size: int) -> Images:
        together = max(1, _TOGETHER // (size * pixels.shape[1]))
        some = jax.checkpoint(partial(of_tiles, size))
        if together >= group:
            return some(tile)
        found = lax.map(lambda one: some(one[None]), tile)
        return {name: image[:, 0] for name, image in found.items()}

    def of_block(_, block) -> tuple[None, Images]:
        tile, length = block
        run = partial(of_size, tile)
        return None, run_at_bucket(length, longest, _SIZES, run, _STEP)

    def if_any(_, block) -> tuple[None, Images]:
        def skip(block) -> tuple[None, Images]:
            shapes = jax.eval_shape(partial(of_block, None), block)
            return jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)

        go = any_in_batch(block[1] > 0)
        return lax.cond(go, partial(of_block, None), skip, block)

    _, images = lax.scan(if_any, None, (schedule.tiles, schedule.levels))
    places = jnp.zeros(grid.tiles, jnp.int32)
    rows = lax.iota(jnp.int32, schedule.tiles.size)
    places = places.at[schedule.tiles.ravel()].set(rows, mode="drop")
    flat = {name: v.reshape(-1, *v.shape[2:]) for name, v in images.items()}
    return take_rows(flat, places)


def _longest(pairs: int, ranks: int) -> int:
    """Return an upper limit of the length of a list."""
    return max(1, min(pairs, ranks))


def keys_at(chunk: Chunk, at: Evaluated, pixels, config: RasterConfig) -> Array:
    """Return the depths [G, K, P] by which pixels order the splats of a chunk."""
    assert config.primitive is not None
    if config.primitive.key is None:
        assert at.depth is not None
        return at.depth
    parts = chunk.parts
    assert parts.keys is not None
    numbers = lax.optimization_barrier(jnp.moveaxis(parts.keys, -1, 0))[..., None]
    x = parts.splats[..., 0] - chunk.corner[:, None, 0]
    y = parts.splats[..., 1] - chunk.corner[:, None, 1]
    dx, dy = pixels[0] - x[..., None], pixels[1] - y[..., None]
    return config.primitive.key(tuple(numbers), dx, dy)


class Order(NamedTuple):
    """An order of L splats for each pixel, [G, L, P].

    Attributes:
      order: places in the list, front to back.
      inverse: place in that order of each splat of the list.
    """

    order: Array
    inverse: Array


def order_of(
    alpha: Array, keys: Array, config: RasterConfig, in_loops: bool = False
) -> Order:
    """Return the order in which pixels blend the splats of a list.

    Equal depths keep the order of the list: by the depth of the means, then by slot.

    Args:
      alpha: [G, L, P]; splats with 0 are in any place.
      keys: [G, L, P].
      config: order and order_window are used.
      in_loops: sort by loops that are kernels, as on CPUs, instead of `lax.sort`.
    """
    groups, number, pixels = (
        lax.broadcasted_iota(jnp.int32, alpha.shape, axis) for axis in range(3)
    )
    if config.order == "pixel":
        keys = jnp.where(alpha > 0, keys, jnp.inf)
        if in_loops:
            order = _by_exchange(keys)
        else:
            both = keys, number
            _, order = lax.sort(both, dimension=1, is_stable=True, num_keys=1)
    else:
        order = _through_window(alpha, keys, config.order_window)
    places = jnp.zeros_like(order).at[groups, order, pixels]
    inverse = places.set(number, mode="promise_in_bounds", unique_indices=True)
    return Order(order, inverse)


@sequential_vmap
def _by_exchange(keys: Array) -> Array:
    """Return the places [G, L, P] in the order of keys, by `merge_exchange`."""
    groups, size, pixels = keys.shape
    number = lax.broadcasted_iota(keys.dtype, keys.shape, 1)
    rows = jnp.stack([keys, number], 2).reshape(groups, 2 * size, pixels)
    ones = lax.optimization_barrier(jnp.ones(pixels, keys.dtype))
    length = jnp.full(1, size, jnp.int32)
    rows = lax.map(lambda some: merge_exchange(some, length, ones), rows)
    return rows[:, 1::2].astype(jnp.int32)


def _through_window(alpha: Array, keys: Array, window: int) -> Array:
    """Return the places [G, L, P] in the order in which they leave a window.

    A splat that arrives sends off the first of the window and itself. One that shows
    nothing leaves at once, and takes no place.
    """
    keys = jnp.where(alpha > 0, keys, -jnp.inf)
    waiting = jnp.full((window, *keys[:, 0].shape), -jnp.inf, keys.dtype)
    numbers = jnp.full(waiting.shape, -1, jnp.int32)
    arriving = jnp.moveaxis(keys, 1, 0)
    places = lax.iota(jnp.int32, len(arriving))
    last = jnp.full(waiting.shape, jnp.inf, keys.dtype)

    def turn(state, new):
        number = jnp.full(new[0].shape, new[1])
        (_, first), state = pass_window(state, (new[0], number))
        return state, first

    state, early = lax.scan(turn, (waiting, numbers), (arriving, places))
    _, late = lax.scan(turn, state, (last, jnp.zeros(window, jnp.int32)))
    return jnp.moveaxis(jnp.concatenate([early, late])[window:], 0, 1)


def pass_window(waiting, arriving):
    """Return what leaves a sorted window when something arrives, and the window then.

    Args:
      waiting: arrays [W, …], of which the first holds rising keys.
      arriving: the same without the first axis.
    """
    before = arriving[0] < waiting[0]  # rising along the window

    def merged(waiting, arriving):
        shifted = jnp.concatenate([arriving[None], waiting])
        whole = jnp.concatenate([waiting, arriving[None]])
        at = jnp.concatenate([before, jnp.ones_like(before[:1])])
        passed = jnp.concatenate([jnp.zeros_like(before[:1]), before])
        both = jnp.where(passed, shifted, arriving[None])
        return jnp.where(at, both, whole)

    after = [merged(w, a) for w, a in zip(waiting, arriving)]
    return tuple(a[0] for a in after), tuple(a[1:] for a in after)


def _to(values: Array, places: Array) -> Array:
    """Return values [G, L, P] at ``places`` [G, L, P]; differentiable."""
    return jnp.take_along_axis(values, places, 1, mode="promise_in_bounds")


def blend_ordered(
    at: Evaluated,
    parts: Parts,
    keys: Array,
    config: RasterConfig,
    in_loops: bool = False,
) -> Images:
    """Blend whole lists in the order of each pixel.

    Args:
      at: splats at the pixels of their tiles.
      parts: their channels and depth.
      keys: [G, L, P] depths, without derivative.
      config: static settings.
      in_loops: as of `order_of`.
    """
    alpha = lax.stop_gradient(at.alpha)
    order, inverse = order_of(alpha, keys, config, in_loops)
    alpha = _to(at.alpha, order)
    behind = lax.cumprod(1 - alpha, axis=1)
    before = jnp.concatenate([jnp.ones_like(behind[:, :1]), behind[:, :-1]], 1)
    tested = behind if config.stop_rule == "before" else before
    blended = tested > config.transmittance_min
    weight = jnp.where(blended, alpha * before, 0)
    in_list = _to(weight, inverse)
    out = {"sums": channel_sums(in_list, parts.channels)}
    for name in pixel_channels(config):
        out[name] = jnp.sum(in_list * pixel_value(name, at), axis=1)
    if "median_depth" in config.outputs:
        half = (before > 0.5) & (behind <= 0.5) & blended
        # T never rises here: it is a product from the left.
        depth = pixel_value("depth", at) if parts.depth is None else parts.depth
        depth = _to(jnp.broadcast_to(depth, alpha.shape), order)
        out["median"] = jnp.sum(jnp.where(half, depth, 0), axis=1)
    there = lax.stop_gradient(weight) > 0
    keys = jnp.where(there, _to(keys, order), -jnp.inf)
    late = there & (keys < lax.cummax(keys, axis=1))
    out["misordered"] = jnp.sum(late, axis=1).astype(alpha.dtype)
    assert out.keys() == {"sums", *single_images(config)}
    return out


def _memory(pairs: int, task: Task, gradients: bool) -> tuple[int, int]:
    pixels, in_splat = task.grid.tile**2, 8 + task.channels
    numbers = _IN_LIST_BACKWARD if gradients else _IN_LIST
    return pairs * in_splat * (2 if gradients else 1) + numbers * _TOGETHER, pixels


ORDERED = Compositor(
    name="ordered",
    suits=lambda task: task.config.sorts_pixels,
    forward=composite_ordered,
    differentiable=composite_ordered,
    reverse=None,
    capacity=listed_pairs,
    memory=_memory,
)
