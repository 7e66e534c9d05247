"""Front-to-back compositing of sorted tile lists, chunk by chunk.

    C = Σ_k c_k α_k T_k,   T_k = Π_{j<k} (1 − α_j)

Axis legend: S steps, G tiles of a step, K Gaussians of a chunk, P pixels of a tile,
C channels (colour, then depth where asked for, then ones, whose sum is alpha).

How it is laid out, and why (measured on two cores): α is one elementwise kernel, and
its derivative one matrix product (`gsjax.raster.alpha`). The sums over colours are
matrix products both ways, each with its operands as XLA wants them. What is left is the
running product. Chunks are recomputed in the backward pass instead of kept. A chunk
behind pixels that have all stopped is skipped, in both directions, by `lax.cond`.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.raster.alpha import alphas, collect_absolute, pixel_centres
from gsjax.raster.bins import Grid, tile_origins
from gsjax.raster.schedules import Schedule, Work
from gsjax.raster.types import Array, Projected, RasterConfig

_einsum = partial(jnp.einsum, precision=lax.Precision.HIGHEST)


def running_product(alpha: Array) -> tuple[Array, Array]:
    """(Π over all K, Π over those before k [G, K, P]) of 1 − alpha [G, K, P]."""
    return _running(_pass, _pass_both, jnp.ones_like(alpha[:, :1]), alpha)


def _running_sum(values: Array) -> tuple[Array, Array]:
    """(Σ over all K, Σ over those before k [G, K, P]) of values [G, K, P]."""
    return _running(jnp.add, _add_both, jnp.zeros_like(values[:, :1]), values)


def _pass(product: Array, alpha: Array) -> Array:
    """T (1 − α): as T − T α where that rounds less; from a half on 1 − α is exact."""
    return jnp.where(alpha < 0.5, product - product * alpha, product * (1 - alpha))


def _pass_both(product: Array, first: Array, second: Array) -> Array:
    """T (1 − α) (1 − β), which rounds T once: what both take is α + β − αβ."""
    both = first + second * (1 - first)
    product = jnp.where(both < 0.5, product, product * (1 - first))
    return _pass(product, jnp.where(both < 0.5, both, second))


def _add_both(total: Array, first: Array, second: Array) -> Array:
    return total + first + second


def _running(
    add: Callable[[Array, Array], Array],
    add_both: Callable[[Array, Array, Array], Array],
    none: Array,
    values: Array,
) -> tuple[Array, Array]:
    """(What all K come to, what those before k come to [G, K, P]), from ``none`` on.

    Two at a time, and what the first of them comes to then for all K at once: each turn
    is a kernel to be compiled and called.
    """
    groups, size, pixels = values.shape
    values = jnp.pad(values, ((0, 0), (0, size % 2), (0, 0)))
    # By `lax.split`, whose transpose is one concatenation; that of slices would be a
    # sum of padded arrays.
    parts = lax.split(values, [1] * values.shape[1], axis=1)
    so_far, before = none, []
    for first, second in zip(parts[::2], parts[1::2]):
        before.append(so_far)
        so_far = add_both(so_far, first, second)
    pairs = values.reshape(groups, -1, 2, pixels)
    first = lax.concatenate(before, 1)[:, :, None]
    is_first = lax.broadcasted_iota(jnp.int32, pairs.shape, 2) == 0
    both = jnp.where(is_first, first, add(first, pairs[:, :, :1]))
    return so_far[:, 0], both.reshape(values.shape)[:, :size]


@jax.custom_jvp
def transmittance(alpha: Array) -> tuple[Array, Array]:
    """As `running_product`, for alpha < 1, with its derivative as a running *sum*.

    dT_k = −T_k Σ_{j<k} dα_j / (1 − α_j). The transpose of a sum costs half of what
    that of a product does; tested against plain differentiation. The division is
    safe because α is capped below 1.
    """
    return running_product(alpha)


@transmittance.defjvp
def _transmittance_jvp(primals, tangents):
    (alpha,), (d_alpha,) = primals, tangents
    total, before = transmittance(alpha)
    summed, sums = _running_sum(d_alpha / (1 - alpha))
    return (total, before), (-total * summed, -before * sums)


class Chunk(NamedTuple):
    """What is blended in a step; all steps together have a leading axis S.

    Attributes:
      splats: [G, K, 6] rows of u, v, inv_sx, slope, inv_sy, opacity; see `Projected`.
      channels: [G, K, C] rows of what is summed.
      corner: [G, 2] upper left corners of the tiles, px.
      depth: [G, K, 1], or None where no median is asked for.
      probe: [G, K, 2] zeros that collect the absolute gradient, or None.
    """

    splats: Array
    channels: Array
    corner: Array
    depth: Array | None
    probe: Array | None


def gather_chunks(
    projected: Projected, work: Work, tiles: Array, grid: Grid, device: Array, config
) -> Chunk:
    """The chunks of all steps, ahead of the loop.

    So that the transpose is one scatter-add and not one a step; and by rows, so that a
    Gaussian is in one place of memory. Null ranks read zeros, and so have opacity 0.
    """

    def take(columns):
        table = jnp.pad(jnp.stack(columns, -1), ((0, 1), (0, 0)))
        return _take_rows(table, work.ranks)

    outputs = config.outputs
    channels = list(projected.colors) if "rgb" in outputs else []
    channels += [projected.depth] if "depth" in outputs else []
    corner = tile_origins(grid, tiles[work.block], device)
    return Chunk(
        splats=take(
            [
                projected.u,
                projected.v,
                projected.inv_sx,
                projected.slope,
                projected.inv_sy,
                projected.opacity,
            ]
        ),
        channels=take([*channels, jnp.ones_like(projected.u)]),
        corner=jnp.stack(corner, -1).astype(projected.u.dtype),
        depth=take([projected.depth]) if "median_depth" in outputs else None,
        probe=None if projected.probe is None else take(projected.probe),
    )


def splats_of(chunk: Chunk) -> tuple[Array, ...]:
    """[G, K] each: inv_sx, slope, inv_sy, opacity, and the mean's x, y relative to the
    corner of the tile.

    Behind a barrier: else every kernel would pick the columns from the rows by itself.
    """
    columns = lax.optimization_barrier(jnp.moveaxis(chunk.splats, -1, 0))
    u, v, *kept = (part[0] for part in lax.split(columns, [1] * 6))
    x, y = u - chunk.corner[:, None, 0], v - chunk.corner[:, None, 1]
    return *kept, x, y


@jax.custom_jvp
def channel_sums(weight: Array, channels: Array) -> Array:
    """Σ_k weight [G, K, P] · channels [G, K, C], as [G, C, P].

    The rule is the plain one but for the order of axes: XLA's products are faster where
    the rows of the left operand are what is summed over, here channels [G, C, K], and
    [G, K, C] in the transpose.
    """
    columns = lax.optimization_barrier(jnp.swapaxes(channels, 1, 2))
    return _einsum("gck,gkp->gcp", columns, weight)


@channel_sums.defjvp
def _channel_sums_jvp(primals, tangents):
    (weight, channels), (d_weight, d_channels) = primals, tangents
    by_weight = _einsum("gkp,gkc->gcp", d_weight, channels)
    by_channels = _einsum("gkp,gkc->gcp", weight, d_channels)
    return channel_sums(weight, channels), by_weight + by_channels


def _blend(
    carried: Array, chunk: Chunk, pixels: np.ndarray, config: RasterConfig
) -> tuple[Array, dict[str, Array]]:
    """Blend one chunk behind the transmittance ``carried`` [G, P].

    Returns:
      The transmittance behind the chunk *as if nothing stopped* (what has fallen to
      the limit never rises again, so it still tells who has stopped), and the sums
      to add: "sums" [G, C, P], "median" [G, P] where asked for.
    """
    splats = splats_of(chunk)
    alpha = alphas(splats, pixels, config)
    if chunk.probe is not None:
        alpha = collect_absolute(alpha, splats, pixels, chunk.probe, config)
    # A cap of 1 needs the rule that does not divide.
    product = transmittance if config.alpha_cap < 1 else running_product
    total, before = product(alpha)
    reached = lax.stop_gradient(carried[:, None] * before)
    behind = lax.stop_gradient(reached * (1 - alpha))
    blended = (behind if config.stop_rule == "before" else reached) > config.stop
    # What is carried stands outside: its derivative then needs no sum over Gaussians.
    sums = channel_sums(jnp.where(blended, alpha * before, 0), chunk.channels)
    out = {"sums": carried[:, None] * sums}
    if chunk.depth is not None:
        # The last that more than half reaches, if less is left behind all. By their
        # number: rounding may let more reach one than the one before it.
        number = jnp.sum(reached > 0.5, axis=1, dtype=jnp.int32, keepdims=True)
        last = lax.broadcasted_iota(jnp.int32, reached.shape, 1) == number - 1
        half = last & (carried * total <= 0.5)[:, None] & blended
        out["median"] = jnp.sum(jnp.where(half, chunk.depth, 0), axis=1)
    return carried * total, out


def composite(
    projected: Projected,
    work: Work,
    schedule: Schedule,
    grid: Grid,
    device: Array,
    config: RasterConfig,
) -> dict[str, Array]:
    """Images of one device's tiles, before the background.

    Returns:
      "sums" [T, C, P]: colour, depth where asked for, alpha; "median" [T, P] where
      asked for. T in the grid's order.
    """
    blocks, group = schedule.tiles.shape
    dtype = projected.u.dtype
    pixels = pixel_centres(grid.tile, dtype)
    count = pixels.shape[1]
    chunks = gather_chunks(projected, work, schedule.tiles, grid, device, config)

    nothing = {"sums": jnp.zeros((group, chunks.channels.shape[-1], count), dtype)}
    if chunks.depth is not None:
        nothing["median"] = jnp.zeros((group, count), dtype)

    # In the branch as well: what the backward pass recomputes there is compiled
    # together with what uses it, and nothing but the inputs crosses the `cond`.
    blend = jax.checkpoint(partial(_blend, pixels=pixels, config=config))

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
        go = live & jnp.any(lax.stop_gradient(carried) > config.stop)
        carried, added = advance(go, carried, chunk)

        def add(image, more):
            return image.at[block].add(more, mode="promise_in_bounds")

        return (carried, jax.tree.map(add, image, added)), None

    # One block more than there is: steps that are not live name it.
    image = {k: jnp.zeros((blocks + 1, *v.shape), dtype) for k, v in nothing.items()}
    init = (jnp.ones((group, count), dtype), image)
    steps = (work.first, work.live, work.block, chunks)
    (_, image), _ = lax.scan(step, init, steps)
    places = _places(schedule, grid)
    return {
        name: _take_rows(value.reshape(-1, *value.shape[2:]), places)
        for name, value in image.items()
    }


def _take_rows(table: Array, rows: Array) -> Array:
    return table.at[rows].get(mode="promise_in_bounds")


def _places(schedule: Schedule, grid: Grid) -> Array:
    """[T] where the blocks hold each tile, as a row of [blocks · G]."""
    rows = lax.iota(jnp.int32, schedule.tiles.size)
    none = jnp.zeros(grid.tiles, jnp.int32)
    return none.at[schedule.tiles.ravel()].set(rows, mode="drop")
