"""Image similarity: PSNR and SSIM.

Axis legend: H W image, C channels.
"""

import jax
import jax.numpy as jnp

from gsjax.errors import InputError
from gsjax.math.numerics import safe_divide
from gsjax.train.ssim_window import window_means

Array = jax.Array

_C1, _C2 = 0.01**2, 0.03**2


def psnr(image: Array, target: Array, weight: Array | None = None) -> Array:
    """Return the peak signal-to-noise ratio in dB, for a peak of 1.

    Args:
      image, target: [H, W, C] in [0, 1].
      weight: [H, W] pixel weights; None for equal weights.

    Returns:
      [] −10 log10 of the mean squared error. Infinite and not differentiable for equal
      images; NaN if all weights are 0.

    Raises:
      InputError: if an image holds integers.
    """
    image, target = mask_excluded(image, target, weight)
    error = weighted_mean(jnp.square(image - target), weight)
    if weight is not None:
        error = jnp.where(jnp.any(weight > 0), error, jnp.nan)
    return -10 * jnp.log10(error)


def mask_excluded(
    image: Array, target: Array, weight: Array | None
) -> tuple[Array, Array]:
    """Return both images [H, W, C] with 0 where the weight [H, W] is 0.

    Excluded pixels, NaN included, then affect neither value nor derivative.

    Raises:
      InputError: if an image holds integers, whose differences would wrap.
    """
    for array in (image, target):
        if not jnp.issubdtype(jnp.result_type(array), jnp.floating):
            raise InputError(
                "image: expected floating-point numbers in [0, 1], got "
                f"{jnp.result_type(array)}; pass image / 255"
            )
    if weight is None:
        return image, target
    seen = (weight > 0)[..., None]
    return jnp.where(seen, image, 0), jnp.where(seen, target, 0)


def weighted_mean(values: Array, weight: Array | None) -> Array:
    """Return the weighted mean of [H, W, …]; 0 if all weights [H, W] are 0."""
    if weight is None:
        return jnp.mean(values)
    total, count = weighted_sum(values, weight)
    return safe_divide(total, count, count > 0)


def weighted_sum(values: Array, weight: Array) -> tuple[Array, Array]:
    """Return the weighted sum of [H, W, …], and the sum of the weights.

    The sum runs over all axes at once: reducing a short channel axis is slow on CPUs.
    """
    wide = weight.reshape(*weight.shape, *(1,) * (values.ndim - weight.ndim))
    return jnp.sum(values * wide), values.size // weight.size * jnp.sum(weight)


def ssim(image: Array, target: Array, weight: Array | None = None) -> Array:
    """Return the mean structural similarity, with the constants of Kerbl et al. 2023.

    Wang et al., "Image Quality Assessment: From Error Visibility to Structural
    Similarity", 2004. Gaussian window of 11 px and σ = 1.5 px, zero padding, mean over
    all pixels. Pixels of weight 0 are black in both images.

    Args:
      image, target: [H, W, C] in [0, 1].
      weight: [H, W] pixel weights; None for equal weights.

    Returns:
      [] at most 1.

    Raises:
      InputError: if an image holds integers.
    """
    image, target = mask_excluded(image, target, weight)
    return weighted_mean(ssim_map(image, target), weight)


def ssim_map(image: Array, target: Array) -> Array:
    """Return the SSIM [H, W, C] of each pixel and channel; see `ssim`."""
    dtype = jnp.result_type(image, target)
    x, y = jnp.broadcast_arrays(*(jnp.asarray(a, dtype) for a in (image, target)))
    # In terms of d = x − y, with var x + var y = 2 covar + var d: for equal images the
    # numerator and denominator are equal whatever the rounding, and the derivative
    # passes through three means only.
    difference = x - y
    mean_x, product, square = window_means((x, x * y, difference * difference))
    (mean_y,) = window_means((y,))
    mean = mean_x - mean_y
    luminance = 2 * mean_x * mean_y + _C1
    contrast = 2 * (product - mean_x * mean_y) + _C2
    return (luminance * contrast) / (
        (luminance + mean * mean) * (contrast + (square - mean * mean))
    )
