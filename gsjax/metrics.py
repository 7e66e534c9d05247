"""How like two pictures are: PSNR and SSIM.

Axis legend: H W image, C channels.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.errors import InputError
from gsjax.numerics import safe_divide

Array = jax.Array

SSIM_RADIUS, _SIGMA = 5, 1.5
_C1, _C2 = 0.01**2, 0.03**2
# Pixels taken at a time: a product with a small banded matrix. On CPU that is faster
# than with a large one, than eleven shifted sums, and by far than a convolution.
_BLOCK = 32


def psnr(image: Array, target: Array, weight: Array | None = None) -> Array:
    """Peak signal-to-noise ratio in dB, for a peak of 1.

    Args:
      image, target: [H, W, C] in [0, 1].
      weight: [H, W] of each pixel, or None for all alike.

    Returns:
      [] −10 log10 of the mean squared error; infinite, without a derivative, for equal
      pictures, and NaN where no pixel counts.

    Raises:
      InputError: if a picture is of whole numbers.
    """
    image, target = seen_only(image, target, weight)
    error = weighted_mean(jnp.square(image - target), weight)
    if weight is not None:
        error = jnp.where(jnp.any(weight > 0), error, jnp.nan)
    return -10 * jnp.log10(error)


def seen_only(image: Array, target: Array, weight: Array | None) -> tuple[Array, Array]:
    """Both pictures [H, W, C], black where the weight [H, W] is 0.

    So that what lies there cannot show, NaN included, nor in a derivative.

    Raises:
      InputError: if one is of whole numbers, whose differences would wrap.
    """
    for picture in (image, target):
        if not jnp.issubdtype(jnp.result_type(picture), jnp.floating):
            raise InputError(
                f"a picture of {jnp.result_type(picture)}; floating-point numbers in "
                "[0, 1] are wanted: pass picture / 255"
            )
    if weight is None:
        return image, target
    seen = (weight > 0)[..., None]
    return jnp.where(seen, image, 0), jnp.where(seen, target, 0)


def weighted_mean(values: Array, weight: Array | None) -> Array:
    """Mean of [H, W, ...] under weights [H, W]; 0 where all weights are."""
    return jnp.mean(values) if weight is None else ratio(*weighted_sum(values, weight))


def weighted_sum(values: Array, weight: Array) -> tuple[Array, Array]:
    """Of [H, W, ...] under weights [H, W], and that of the weights.

    In one sum: XLA's sums over the few channels of each pixel are slow on a CPU.
    """
    wide = weight.reshape(*weight.shape, *(1,) * (values.ndim - weight.ndim))
    return jnp.sum(values * wide), values.size // weight.size * jnp.sum(weight)


def ratio(sums: Array, totals: Array) -> Array:
    """Of sums and what to divide them by; 0 where there is nothing to divide by."""
    return safe_divide(sums, totals, totals > 0)


def ssim(image: Array, target: Array, weight: Array | None = None) -> Array:
    """Mean structural similarity (Wang et al. 2004), as Kerbl et al. 2023 take it.

    Gaussian window of 11 px and σ = 1.5 px, zeros beyond the border, all pixels
    counted. With a weight, both pictures are black where it is 0.

    Args:
      image, target: [H, W, C] in [0, 1].
      weight: [H, W] of each pixel, or None for all alike.

    Returns:
      [] at most 1.

    Raises:
      InputError: if a picture is of whole numbers.
    """
    image, target = seen_only(image, target, weight)
    return weighted_mean(ssim_map(image, target), weight)


def ssim_map(image: Array, target: Array) -> Array:
    """SSIM of every pixel and channel, [H, W, C]; see `ssim`."""
    x, y = (jnp.moveaxis(a, -1, 0) for a in (image, target))
    # By the difference d = x − y: of equal pictures, numerator and denominator are the
    # same numbers, whatever the rounding. As var x + var y = 2 covar + var d, nothing
    # else changes, and the derivative goes through three means only.
    difference = x - y
    of_x = _blur(jnp.concatenate([x, x * y, difference * difference]))
    (mean_x, product, square), mean_y = jnp.split(of_x, 3), _blur(y)
    mean = mean_x - mean_y
    luminance = 2 * mean_x * mean_y + _C1
    contrast = 2 * (product - mean_x * mean_y) + _C2
    score = (luminance * contrast) / (
        (luminance + mean * mean) * (contrast + (square - mean * mean))
    )
    return jnp.moveaxis(score, 0, -1)


def _blur(planes: Array) -> Array:
    """The window's means of planes [N, H, W], zeros beyond the border."""
    window = jnp.asarray(_window(), planes.dtype)
    product = partial(jnp.einsum, precision=lax.Precision.HIGHEST)
    height, width = planes.shape[1:]
    planes = product("rk,nbkw->nbrw", window, _blocks(planes, 1))
    planes = planes.reshape(len(planes), -1, width)[:, :height]
    planes = product("nhbk,rk->nhbr", _blocks(planes, 2), window)
    return planes.reshape(len(planes), height, -1)[..., :width]


def _window() -> np.ndarray:
    """[block, block + 2 · radius]: weights of the pixels of a block and around it."""
    around = np.arange(-SSIM_RADIUS, _BLOCK + SSIM_RADIUS)
    offset = around - np.arange(_BLOCK)[:, None]
    weight = np.exp(-0.5 * np.square(offset / _SIGMA))
    weight = np.where(np.abs(offset) <= SSIM_RADIUS, weight, 0)
    return weight / weight.sum(1, keepdims=True)


def _blocks(planes: Array, axis: int) -> Array:
    """``axis`` in blocks, each with what is around it: [..., blocks, size, ...]."""
    length, shape = planes.shape[axis], planes.shape
    count = -(-length // _BLOCK)
    blocks = _pad(planes, axis, 0, count * _BLOCK - length)
    blocks = blocks.reshape(*shape[:axis], count, _BLOCK, *shape[axis + 1 :])
    ends = lax.slice_in_dim(blocks, _BLOCK - SSIM_RADIUS, _BLOCK, axis=axis + 1)
    before = lax.slice_in_dim(ends, 0, count - 1, axis=axis)
    starts = lax.slice_in_dim(blocks, 0, SSIM_RADIUS, axis=axis + 1)
    after = lax.slice_in_dim(starts, 1, count, axis=axis)
    parts = [_pad(before, axis, 1, 0), blocks, _pad(after, axis, 0, 1)]
    return jnp.concatenate(parts, axis + 1)


def _pad(array: Array, axis: int, before: int, after: int) -> Array:
    """Zeros along one axis."""
    padding = [(0, 0)] * array.ndim
    padding[axis] = (before, after)
    return jnp.pad(array, padding)
