"""What training minimises.

Axis legend: B pictures, H W image, C channels.
"""

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.runtime.devices import spread
from gsjax.train import ssim_window
from gsjax.train.metrics import (
    ratio,
    seen_only,
    ssim_map,
    weighted_mean,
    weighted_sum,
)

Array = jax.Array


def l1(image: Array, target: Array, weight: Array | None = None) -> Array:
    """Mean absolute difference, [].

    Args:
      image, target: [H, W, C].
      weight: [H, W], 0 where a pixel is to be left out; or None.
    """
    image, target = seen_only(image, target, weight)
    return weighted_mean(_absolute(image - target), weight)


def _absolute(difference: Array) -> Array:
    """|x|, of slope 0 at 0, where that of `jnp.abs` is 1: what is right stays so."""
    return difference * lax.stop_gradient(jnp.sign(difference))


def photometric(
    image: Array, target: Array, weight: Array | None = None, ssim_weight: float = 0.2
) -> Array:
    """(1 − λ) L1 + λ (1 − SSIM), Kerbl et al. 2023, Eq. 7 (their D-SSIM is this one).

    Args:
      image, target: [H, W, C] in [0, 1].
      weight: [H, W], 0 where a pixel is to be left out; or None.
      ssim_weight: λ; at 0 the SSIM is not in the program.
    """
    return weighted_mean(_of_pixels(image, target, weight, ssim_weight), weight)


def photometric_spread(
    images: Array,
    targets: Array,
    weights: Array | None = None,
    ssim_weight: float = 0.2,
    devices: int = 1,
) -> Array:
    """`photometric` of B pictures, [B], each device at work on a band of their rows.

    What stands beside a `jax.shard_map` in a program is computed by every device in
    whole; on one machine they then only wait for one another.

    Args:
      images, targets: [B, H, W, C] in [0, 1].
      weights: [B, H, W], 0 where a pixel is to be left out; or None.
      ssim_weight: λ, see `photometric`.
      devices: how many; 1 shares nothing.
    """
    height = images.shape[1]
    rows = -(-height // devices)
    margin = ssim_window.RADIUS if ssim_weight > 0 else 0
    if weights is None:
        weights = jnp.ones(images.shape[:-1], images.dtype)

    def band(device: Array, *pictures: Array) -> tuple[Array, Array]:
        def cut(picture: Array) -> Array:
            padding = [(0, 0)] * picture.ndim
            padding[0] = (margin, margin + devices * rows - height)
            start = device[0] * rows
            wide = jnp.pad(picture, padding)
            return lax.dynamic_slice_in_dim(wide, start, rows + 2 * margin)

        def sums(*one: Array) -> tuple[Array, Array]:
            image, target, weight = map(cut, one)
            values = _of_pixels(image, target, weight, ssim_weight)
            own = slice(margin, margin + rows)
            return weighted_sum(values[own], weight[own])

        return jax.tree.map(lambda x: x[None], jax.vmap(sums)(*pictures))

    values, totals = spread(band, devices, images, targets, weights)
    return ratio(jnp.sum(values, 0), jnp.sum(totals, 0))


def _of_pixels(
    image: Array, target: Array, weight: Array | None, ssim_weight: float
) -> Array:
    """What `photometric` is the mean of, [H, W, C]."""
    image, target = seen_only(image, target, weight)
    loss = (1 - ssim_weight) * _absolute(image - target)
    if ssim_weight > 0:
        loss += ssim_weight * (1 - ssim_map(image, target))
    return loss
