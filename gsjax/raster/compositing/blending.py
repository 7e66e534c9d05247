"""Blending of one chunk of Gaussians behind what is in front of it.

    C = Σ_k c_k α_k T_k,   T_k = Π_{j<k} (1 − α_j)

Axis legend: G tiles of a step, K Gaussians of a chunk, P pixels of a tile, C channels
(colour, then depth where asked for, then ones, whose sum is alpha).

How it is laid out, and why (measured on two cores): α is one elementwise kernel, and
its derivative one matrix product (`gsjax.raster.compositing.alpha`). The sums over colours are
matrix products both ways, each with its operands as XLA wants them. What is left is the
running product.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.raster.compositing.alpha import alphas, collect_absolute
from gsjax.raster.types import Array, Projected, RasterConfig

_einsum = partial(jnp.einsum, precision=lax.Precision.HIGHEST)


def running_product(alpha: Array) -> tuple[Array, Array]:
    """(Π over all K, Π over those before k [G, K, P]) of 1 − alpha [G, K, P]."""
    return _running(pass_through, _pass_both, jnp.ones_like(alpha[:, :1]), alpha)


def _running_sum(values: Array) -> tuple[Array, Array]:
    """(Σ over all K, Σ over those before k [G, K, P]) of values [G, K, P]."""
    return _running(jnp.add, _add_both, jnp.zeros_like(values[:, :1]), values)


def pass_through(product: Array, alpha: Array) -> Array:
    """T (1 − α): as T − T α where that rounds less; from a half on 1 − α is exact."""
    return jnp.where(alpha < 0.5, product - product * alpha, product * (1 - alpha))


def _pass_both(product: Array, first: Array, second: Array) -> Array:
    """T (1 − α) (1 − β), which rounds T once: what both take is α + β − αβ."""
    both = first + second * (1 - first)
    product = jnp.where(both < 0.5, product, product * (1 - first))
    return pass_through(product, jnp.where(both < 0.5, both, second))


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


class Parts(NamedTuple):
    """What is blended of Gaussians.

    Attributes:
      splats: [..., 6] u, v, inv_sx, slope, inv_sy, opacity; see `Projected`.
      channels: [..., C] what is summed.
      depth: [..., 1], or None where no median is asked for.
      probe: [..., 2] zeros that collect the absolute gradient, or None.
    """

    splats: Array
    channels: Array
    depth: Array | None = None
    probe: Array | None = None


class Chunk(NamedTuple):
    """What is blended in a step.

    Attributes:
      parts: [G, K, ...] of the Gaussians.
      corner: [G, 2] upper left corners of the tiles, px.
    """

    parts: Parts
    corner: Array


def columns_of(projected: Projected, config: RasterConfig) -> dict[str, list[Array]]:
    """Columns [R] of what is blended, for each of `Parts` that there is."""
    p, outputs = projected, config.outputs
    channels = list(p.colors) if "rgb" in outputs else []
    channels += [p.depth] if "depth" in outputs else []
    columns = {
        "splats": [p.u, p.v, p.inv_sx, p.slope, p.inv_sy, p.opacity],
        "channels": [*channels, jnp.ones_like(p.u)],
    }
    if "median_depth" in outputs:
        columns["depth"] = [p.depth]
    if p.probe is not None:
        columns["probe"] = list(p.probe)
    return columns


def table_of(columns: list[Array]) -> Array:
    """[R + 1, columns]; the last row is zeros, so opacity 0.

    By rows, so that a Gaussian is in one place of memory.
    """
    return jnp.pad(jnp.stack(columns, -1), ((0, 1), (0, 0)))


def tables_of(projected: Projected, config: RasterConfig) -> Parts:
    """Tables [R + 1, ...] of what is blended, each kind by itself: so one can have a
    derivative and another none."""
    columns = columns_of(projected, config)
    return Parts(**{name: table_of(some) for name, some in columns.items()})


def splats_of(splats: Array, corner: Array) -> tuple[Array, ...]:
    """[G, K] each: inv_sx, slope, inv_sy, opacity, and the mean's x, y relative to the
    corner of the tile.

    Behind a barrier: else every kernel would pick the columns from the rows by itself.
    """
    columns = lax.optimization_barrier(jnp.moveaxis(splats, -1, 0))
    u, v, *kept = (part[0] for part in lax.split(columns, [1] * 6))
    x, y = u - corner[:, None, 0], v - corner[:, None, 1]
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


def blend_chunk(
    carried: Array, chunk: Chunk, pixels: np.ndarray, config: RasterConfig
) -> tuple[Array, dict[str, Array]]:
    """Blend one chunk behind the transmittance ``carried`` [G, P].

    Returns:
      The transmittance behind the chunk *as if nothing stopped* (what has fallen to
      the limit never rises again, so it still tells who has stopped), and the sums
      to add: "sums" [G, C, P], "median" [G, P] where asked for.
    """
    alpha = alphas_of(chunk, pixels, config)
    total, out = sums_behind(carried, alpha, chunk.parts, config)
    # What is carried stands outside: its derivative then needs no sum over Gaussians.
    return carried * total, {**out, "sums": carried[:, None] * out["sums"]}


def alphas_of(chunk: Chunk, pixels: np.ndarray, config: RasterConfig) -> Array:
    """α [G, K, P] of a chunk; see `alphas`."""
    splats = splats_of(chunk.parts.splats, chunk.corner)
    alpha = alphas(splats, pixels, config)
    if chunk.parts.probe is not None:
        alpha = collect_absolute(alpha, splats, pixels, chunk.parts.probe, config)
    return alpha


def sums_behind(
    carried: Array,
    alpha: Array,
    parts: Parts,
    config: RasterConfig,
    left: Array | None = None,
) -> tuple[Array, dict[str, Array]]:
    """As `blend_chunk` of Gaussians whose ``alpha`` [G, K, P] is known, but what is
    returned is of the chunk by itself: ``carried`` tells who stops, and has no part in
    the transmittance or in "sums".

    ``left`` [G, P] is what the chunk behind this one is told is carried; None for the
    product.
    """
    # A cap of 1, as α has it, needs the rule that does not divide.
    apart = np.asarray(config.alpha_max, alpha.dtype) < 1
    product = transmittance if apart else running_product
    total, before = product(alpha)
    reached = carried[:, None] * before
    behind = reached * (1 - alpha)
    blended = (behind if config.stop_rule == "before" else reached) > config.stop
    weight = jnp.where(blended, alpha * before, 0)
    out = {"sums": channel_sums(weight, parts.channels)}
    if parts.depth is not None:
        # The last that more than half reaches, if less is left behind all. By their
        # number: rounding may let more reach one than the one before it.
        number = jnp.sum(reached > 0.5, axis=1, dtype=jnp.int32, keepdims=True)
        last = lax.broadcasted_iota(jnp.int32, reached.shape, 1) == number - 1
        left = carried * total if left is None else left
        half = last & (left <= 0.5)[:, None] & blended
        out["median"] = jnp.sum(jnp.where(half, parts.depth, 0), axis=1)
    return total, out
