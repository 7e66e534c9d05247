"""How like two pictures are: PSNR and SSIM.

Axis legend: H W image, C channels.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

Array = jax.Array

_RADIUS, _SIGMA = 5, 1.5
_C1, _C2 = 0.01**2, 0.03**2
# Rows of the window's matrix taken at a time. On CPU products with such blocks are
# faster than with the whole, than eleven shifted sums, and by far than a convolution.
_BLOCK = 128


def psnr(image: Array, target: Array, weight: Array | None = None) -> Array:
    """Peak signal-to-noise ratio in dB, for a peak of 1.

    Args:
      image, target: [H, W, C].
      weight: [H, W] of each pixel, or None for all alike.

    Returns:
      [] −10 log10 of the mean squared error; infinite for equal pictures.
    """
    image, target = seen_only(image, target, weight)
    square = jnp.mean(jnp.square(image - target), -1)
    return -10 * jnp.log10(weighted_mean(square, weight))


def seen_only(image: Array, target: Array, weight: Array | None) -> tuple[Array, Array]:
    """Both pictures [H, W, C], black where the weight [H, W] is 0.

    So that what lies there cannot show, NaN included, nor in a derivative.
    """
    if weight is None:
        return image, target
    seen = (weight > 0)[..., None]
    return jnp.where(seen, image, 0), jnp.where(seen, target, 0)


def weighted_mean(values: Array, weight: Array | None) -> Array:
    """Mean of [H, W] under weights [H, W]; 0 where all weights are."""
    if weight is None:
        return jnp.mean(values)
    total = jnp.sum(weight)
    return jnp.sum(values * weight) / jnp.where(total > 0, total, 1)


def ssim(image: Array, target: Array, weight: Array | None = None) -> Array:
    """Mean structural similarity (Wang et al. 2004), as Kerbl et al. 2023 take it.

    Gaussian window of 11 px and σ = 1.5 px, zeros beyond the border, all pixels
    counted. With a weight, both pictures are black where it is 0.

    Args:
      image, target: [H, W, C] in [0, 1].
      weight: [H, W] of each pixel, or None for all alike.

    Returns:
      [] at most 1.
    """
    image, target = seen_only(image, target, weight)
    return weighted_mean(jnp.mean(ssim_map(image, target), -1), weight)


def ssim_map(image: Array, target: Array) -> Array:
    """SSIM of every pixel and channel, [H, W, C]; see `ssim`."""
    x, y = (jnp.moveaxis(a, -1, 0) for a in (image, target))
    # By the difference d = x − y: of equal pictures, numerator and denominator are the
    # same numbers, whatever the rounding. As var x + var y = 2 covar + var d, nothing
    # else changes, and the derivative goes through three means only.
    difference = x - y
    of_x = _blur(jnp.stack([x, x * y, difference * difference]))
    (mean_x, product, square), mean_y = of_x, _blur(y)
    mean = mean_x - mean_y
    luminance = 2 * mean_x * mean_y + _C1
    contrast = 2 * (product - mean_x * mean_y) + _C2
    score = (luminance * contrast) / (
        (luminance + mean * mean) * (contrast + (square - mean * mean))
    )
    return jnp.moveaxis(score, 0, -1)


def _blur(planes: Array) -> Array:
    """The window's means of planes [..., H, W], zeros beyond the border."""
    down = [
        jnp.einsum("hk,...kw->...hw", rows, part, precision=lax.Precision.HIGHEST)
        for rows, part in _bands(planes, -2)
    ]
    planes = jnp.concatenate(down, -2)
    across = [
        jnp.einsum("...k,wk->...w", part, rows, precision=lax.Precision.HIGHEST)
        for rows, part in _bands(planes, -1)
    ]
    return jnp.concatenate(across, -1)


def _bands(planes: Array, axis: int):
    """(Rows of the banded window matrix, what they act on), block by block."""
    size = planes.shape[axis]
    for start in range(0, size, _BLOCK):
        stop = min(start + _BLOCK, size)
        low, high = max(0, start - _RADIUS), min(size, stop + _RADIUS)
        distance = np.arange(start, stop)[:, None] - np.arange(low, high)
        rows = np.exp(-0.5 * np.square(distance / _SIGMA))
        whole = np.exp(-0.5 * np.square(np.arange(-_RADIUS, _RADIUS + 1) / _SIGMA))
        rows = np.where(np.abs(distance) <= _RADIUS, rows / whole.sum(), 0)
        part = lax.slice_in_dim(planes, low, high, axis=planes.ndim + axis)
        yield jnp.asarray(rows, planes.dtype), part
