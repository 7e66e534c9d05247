"""Blending of one chunk of Gaussians behind the chunks in front of it.

    C = Σ_k c_k α_k T_k,   T_k = Π_{j<k} (1 − α_j)

Axis legend: G tiles of a step, K Gaussians of a chunk, P pixels of a tile, C channels
(colour, depth if asked for, then ones, whose sum is alpha), S numbers of a splat.

α is one elementwise kernel and its derivative one matrix product
(`gsjax.raster.compositing.alpha`). The sums over colours are matrix products both ways.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.math.numerics import safe_divide
from gsjax.raster.compositing.alpha import Evaluated, collect_absolute, evaluate
from gsjax.raster.compositing.types import (
    has_ray_depth,
    pixel_channels,
    summed_channels,
)
from gsjax.raster.forms import AtPixel
from gsjax.raster.types import Array, Channels, RasterConfig, Splat

_einsum = partial(jnp.einsum, precision=lax.Precision.HIGHEST)


def running_product(alpha: Array) -> tuple[Array, Array]:
    """Return Π (1 − α) over all K, and over those before k [G, K, P]."""
    return _running(pass_through, _pass_both, jnp.ones_like(alpha[:, :1]), alpha)


def _running_sum(values: Array) -> tuple[Array, Array]:
    """Return the sum over all K, and over those before k [G, K, P]."""
    return _running(jnp.add, _add_both, jnp.zeros_like(values[:, :1]), values)


def pass_through(product: Array, alpha: Array) -> Array:
    """Return T (1 − α), as T − T α for α < 1/2, which rounds less."""
    return jnp.where(alpha < 0.5, product - product * alpha, product * (1 - alpha))


def _pass_both(product: Array, first: Array, second: Array) -> Array:
    """Return T (1 − α) (1 − β), rounding T once: both together take α + β − αβ."""
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
    """Accumulate from ``none``: over all K, and over those before k [G, K, P].

    Two at a time, because each turn is a kernel to be compiled and called; the first of
    each pair follows for all K at once.
    """
    groups, size, pixels = values.shape
    values = jnp.pad(values, ((0, 0), (0, size % 2), (0, 0)))
    # The transpose of `lax.split` is one concatenation; that of slices is a sum of
    # padded arrays.
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
    """Return `running_product` for alpha < 1, differentiated by a running sum.

    dT_k = −T_k Σ_{j<k} dα_j / (1 − α_j). The transpose of a sum costs half of that of a
    product. The division is safe because α is limited below 1.
    """
    return running_product(alpha)


@transmittance.defjvp
def _transmittance_jvp(primals, tangents):
    (alpha,), (d_alpha,) = primals, tangents
    total, before = transmittance(alpha)
    summed, sums = _running_sum(d_alpha / (1 - alpha))
    return (total, before), (-total * summed, -before * sums)


class Parts(NamedTuple):
    """Values of Gaussians that are blended.

    Attributes:
      splats: [..., S] u, v and the numbers of `Splat.shape`.
      channels: [..., C] values that are summed.
      depth: [..., 1], or None unless a median of it is asked for.
      probe: [..., 2] zeros that collect the absolute gradient, or None.
      keys: [..., K] numbers of `Splat.key`, or None.
    """

    splats: Array
    channels: Array
    depth: Array | None = None
    probe: Array | None = None
    keys: Array | None = None


class Chunk(NamedTuple):
    """The Gaussians of a step.

    Attributes:
      parts: [G, K, ...].
      corner: [G, 2] upper left corners of the tiles, px.
    """

    parts: Parts
    corner: Array


def columns_of(
    splat: Splat, channels: Channels, config: RasterConfig
) -> dict[str, list[Array]]:
    """Return the columns [R] of each of `Parts` that is needed."""
    parts, depth = [], channels.depth
    for name in summed_channels(config, len(channels.colors)):
        if name == "disparities":
            there = depth != 0
            disparity = safe_divide(jnp.ones_like(depth), depth, there)
            parts += [disparity, disparity * disparity]
        elif name == "ones":
            parts.append(jnp.ones_like(splat.u))
        else:
            values = getattr(channels, name)
            parts += [values] if values.ndim == 1 else list(values)
    columns = {"splats": [splat.u, splat.v, *splat.shape], "channels": parts}
    if "median_depth" in config.outputs and not has_ray_depth(config):
        columns["depth"] = [depth]
    if channels.probe is not None:
        columns["probe"] = list(channels.probe)
    if splat.key:
        columns["keys"] = list(splat.key)
    return columns


def table_of(columns: list[Array]) -> Array:
    """Return rows [R + 1, columns]; the last row is zeros, so its opacity is 0."""
    return jnp.pad(jnp.stack(columns, -1), ((0, 1), (0, 0)))


def tables_of(splat: Splat, channels: Channels, config: RasterConfig) -> Parts:
    """Return tables [R + 1, ...], one each, so that one can have a derivative alone."""
    columns = columns_of(splat, channels, config)
    return Parts(**{name: table_of(some) for name, some in columns.items()})


def splats_of(splats: Array, corner: Array) -> tuple[Array, ...]:
    """Return `Splat.shape`, then the centre's x, y relative to the tile, [G, K] each.

    Behind a barrier: else every kernel would pick the columns from the rows by itself.
    """
    columns = lax.optimization_barrier(jnp.moveaxis(splats, -1, 0))
    u, v, *shape = (part[0] for part in lax.split(columns, [1] * columns.shape[0]))
    x, y = u - corner[:, None, 0], v - corner[:, None, 1]
    return *shape, x, y


@jax.custom_jvp
def channel_sums(weight: Array, channels: Array) -> Array:
    """Return Σ_k weight [G, K, P] · channels [G, K, C], as [G, C, P].

    The rule is the plain one with another order of axes: XLA's products are faster if
    the rows of the left operand are summed over.
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
    carried: Array,
    chunk: Chunk,
    pixels: np.ndarray,
    config: RasterConfig,
    alpha_min: Array | None = None,
) -> tuple[Array, dict[str, Array]]:
    """Blend one chunk behind the transmittance ``carried`` [G, P].

    Returns:
      The transmittance behind the chunk as if no pixel stopped (it never rises again,
      so it still tells which pixels have stopped), and the images to add, see
      `Compositor`.
    """
    at = evaluated(chunk, pixels, config, alpha_min)
    total, out = sums_behind(carried, at, chunk.parts, config)
    # ``carried`` is a factor outside: its derivative then needs no sum over Gaussians.
    return carried * total, times(carried, out)


def times(factor: Array, images: dict[str, Array]) -> dict[str, Array]:
    """Return images times a factor [G, P], except the median."""

    def one(name: str, image: Array) -> Array:
        if name == "median":
            return image
        return (factor[:, None] if name == "sums" else factor) * image

    return {name: one(name, image) for name, image in images.items()}


def evaluated(
    chunk: Chunk,
    pixels: np.ndarray,
    config: RasterConfig,
    alpha_min: Array | None = None,
) -> Evaluated:
    """Return a chunk at the pixels of its tiles; see `evaluate`."""
    splats = splats_of(chunk.parts.splats, chunk.corner)
    at = evaluate(splats, pixels, config, alpha_min)
    if chunk.parts.probe is None:
        return at
    probe = chunk.parts.probe
    return at._replace(alpha=collect_absolute(at.alpha, splats, pixels, probe, config))


def sums_behind(
    carried: Array,
    at: Evaluated,
    parts: Parts,
    config: RasterConfig,
    left: Array | None = None,
) -> tuple[Array, dict[str, Array]]:
    """Return `blend_chunk` for known α [G, K, P], without factor ``carried``.

    ``carried`` [G, P] only decides which pixels stop. ``left`` [G, P] is the
    transmittance that the chunk behind receives; None for the product.
    """
    # A limit of 1 needs the rule that does not divide by 1 − α.
    alpha = at.alpha
    apart = np.asarray(config.alpha_max, alpha.dtype) < 1
    product = transmittance if apart else running_product
    total, before = product(alpha)
    reached = carried[:, None] * before
    behind = reached * (1 - alpha)
    blended = (
        behind if config.stop_rule == "before" else reached
    ) > config.transmittance_min
    weight = jnp.where(blended, alpha * before, 0)
    out = {"sums": channel_sums(weight, parts.channels)}
    for name in pixel_channels(config):
        out[name] = jnp.sum(weight * pixel_value(name, at), axis=1)
    if "median_depth" in config.outputs:
        # The last Gaussian that more than half reaches, if less is left behind all. It
        # is found by counting: rounding may let T rise from one to the next.
        number = jnp.sum(reached > 0.5, axis=1, dtype=jnp.int32, keepdims=True)
        last = lax.broadcasted_iota(jnp.int32, reached.shape, 1) == number - 1
        left = carried * total if left is None else left
        half = last & (left <= 0.5)[:, None] & blended
        depth = pixel_value("depth", at) if parts.depth is None else parts.depth
        out["median"] = jnp.sum(jnp.where(half, depth, 0), axis=1)
    return total, out


def pixel_value(name: str, at: Evaluated | AtPixel) -> Array:
    """Return the value of a channel of `pixel_channels`."""
    if name == "depth":
        assert at.depth is not None
        return at.depth
    assert at.disparity is not None
    return at.disparity * at.disparity if name == "square" else at.disparity
