"""How like two pictures are: PSNR and SSIM.

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
    dtype = jnp.result_type(image, target)
    x, y = jnp.broadcast_arrays(*(jnp.asarray(a, dtype) for a in (image, target)))
    # By the difference d = x − y: of equal pictures, numerator and denominator are the
    # same numbers, whatever the rounding. As var x + var y = 2 covar + var d, nothing
    # else changes, and the derivative goes through three means only.
    difference = x - y
    mean_x, product, square = window_means((x, x * y, difference * difference))
    (mean_y,) = window_means((y,))
    mean = mean_x - mean_y
    luminance = 2 * mean_x * mean_y + _C1
    contrast = 2 * (product - mean_x * mean_y) + _C2
    return (luminance * contrast) / (
        (luminance + mean * mean) * (contrast + (square - mean * mean))
    )
