"""α of Gaussians at pixels, with a derivative of its own, and the absolute gradient.

Axis legend: G tiles of a step, K Gaussians of a chunk, P pixels of a tile.

α is one elementwise kernel forward. Its derivative is α times that of log α, a
quadratic polynomial of the pixel: so what comes back from the pixels to a Gaussian is
six moments, one matrix product [G K, P] × [P, 6].
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.math.numerics import exp_negative
from gsjax.raster.types import Array, RasterConfig

_einsum = partial(jnp.einsum, precision=lax.Precision.HIGHEST)


def pixel_centres(tile: int, dtype) -> np.ndarray:
    """[2, P] x and y of the pixels of a tile, from its upper left corner.

    A constant, each row contiguous: as part of the kernels it costs nothing.
    """
    centre = np.arange(tile) + 0.5
    y, x = np.meshgrid(centre, centre, indexing="ij")
    return np.stack([x.ravel(), y.ravel()]).astype(dtype)


def _offsets(splats: tuple[Array, ...], pixels: np.ndarray) -> tuple[Array, Array]:
    """y1, y2 [G, K, P] of Gaussians at the pixels [2, P], x and y."""
    inv_sx, slope, inv_sy, _, x, y = (value[..., None] for value in splats)
    dx, dy = pixels[0] - x, pixels[1] - y
    return inv_sx * dx, inv_sy * (dy - slope * dx)


@partial(jax.custom_jvp, nondiff_argnums=(1, 2))
def alphas(
    splats: tuple[Array, ...], pixels: np.ndarray, config: RasterConfig
) -> Array:
    """α [G, K, P] of Gaussians at the pixels of their tiles.

    Args:
      splats: [G, K] each: inv_sx, slope, inv_sy, opacity, and the mean's x, y relative
        to the corner of the tile.
      pixels: [2, P] x and y, relative to the corner as well.
      config: its cap and its cut.
    """
    y1, y2 = _offsets(splats, pixels)
    raw = splats[3][..., None] * exp_negative(-0.5 * (y1 * y1 + y2 * y2))
    capped = jnp.where(raw < config.alpha_max, raw, config.alpha_max)
    return jnp.where(capped >= config.alpha_min, capped, 0)


def _log_coefficients(half: float, *splats: Array) -> Array:
    """[G, K, 6]: log α as a polynomial of `_monomials`."""
    inv_sx, slope, inv_sy, opacity, x, y = splats
    x, y = x - half, y - half
    # y1 = a · (x, 1) and y2 = b · (x, y, 1).
    ax, a1 = inv_sx, -inv_sx * x
    bx, by, b1 = -inv_sy * slope, inv_sy, -inv_sy * (y - slope * x)
    log_opacity = jnp.log(jnp.where(opacity > 0, opacity, 1))
    coefficients = (
        -0.5 * (ax * ax + bx * bx),
        -bx * by,
        -0.5 * by * by,
        -(ax * a1 + bx * b1),
        -by * b1,
        log_opacity - 0.5 * (a1 * a1 + b1 * b1),
    )
    return jnp.stack(coefficients, -1)


def _monomials(half: float, pixels: np.ndarray) -> np.ndarray:
    """[6, P]: x², xy, y², x, y, 1 of the pixels, from the middle of the tile: there
    the terms of a sum cancel least.
    """
    x, y = pixels - half
    return np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)])


@alphas.defjvp
def _alphas_jvp(pixels, config, primals, tangents):
    """dα = α d(log α); at the cap, and at the tie with it, and below the cut, zero."""
    alpha = alphas(primals[0], pixels, config)
    half = config.tile_size / 2
    polynomial = partial(_log_coefficients, half)
    _, rate = jax.jvp(polynomial, primals[0], tangents[0])
    rate = _einsum("gkm,mp->gkp", rate, _monomials(half, pixels))
    return alpha, jnp.where(alpha < config.alpha_max, alpha, 0) * rate


def collect_absolute(
    alpha: Array,
    splats: tuple[Array, ...],
    pixels: np.ndarray,
    probe: Array,
    config: RasterConfig,
) -> Array:
    """``alpha`` [G, K, P], which is `alphas` of the rest, unchanged.

    As the gradient by ``probe`` [G, K, 2] comes Σ over pixels of |∂L/∂mean|.
    """
    return _collect(alpha, splats, probe, pixels, config)


def _slopes_by_mean(alpha, splats, pixels, config) -> tuple[Array, Array]:
    """∂α/∂x and ∂α/∂y [G, K, P], the mean's x and y."""
    inv_sx, slope, inv_sy, *_ = (value[..., None] for value in splats)
    y1, y2 = _offsets(splats, pixels)
    free = jnp.where(alpha < config.alpha_max, alpha, 0)
    return free * (inv_sx * y1 - inv_sy * slope * y2), free * inv_sy * y2


@partial(jax.custom_vjp, nondiff_argnums=(3, 4))
def _collect(alpha, splats, probe, pixels, config) -> Array:
    """``alpha``; the probe receives the sums of |slope · cotangent|."""
    del splats, probe, pixels, config
    return alpha


def _collect_forward(alpha, splats, probe, pixels, config):
    del probe
    return alpha, _slopes_by_mean(alpha, splats, pixels, config)


def _collect_backward(pixels, config, slopes, cotangent):
    del pixels, config
    sums = [jnp.sum(jnp.abs(slope * cotangent), -1) for slope in slopes]
    return cotangent, None, jnp.stack(sums, -1)


_collect.defvjp(_collect_forward, _collect_backward)
