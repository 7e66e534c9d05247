"""α of splats at pixels, with a derivative rule, and the absolute gradient.

Axis legend: G tiles of a step, K Gaussians of a chunk, P pixels of a tile.

α is one elementwise kernel. In the Gaussian form its derivative is α times that of
log α, a quadratic polynomial of the pixel. So the cotangents of all pixels reduce to
six moments per Gaussian, by one matrix product [G K, P] × [P, 6].
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.math.numerics import exp_negative
from gsjax.raster.compositing.types import form_of
from gsjax.raster.forms import AtPixel, Form, Plane, unmarked, values_at
from gsjax.raster.types import Array, RasterConfig

_einsum = partial(jnp.einsum, precision=lax.Precision.HIGHEST)


def pixel_centres(tile: int, dtype) -> np.ndarray:
    """Return x and y [2, P] of the pixels of a tile, from its upper left corner.

    A host constant with contiguous rows: as part of the kernels it costs nothing.
    """
    centre = np.arange(tile) + 0.5
    y, x = np.meshgrid(centre, centre, indexing="ij")
    return np.stack([x.ravel(), y.ravel()]).astype(dtype)


class Evaluated(NamedTuple):
    """Splats at the pixels of their tiles, [G, K, P] each.

    Attributes:
      alpha: α after its limits.
      depth, disparity: of the point that a pixel shows, see `AtPixel`; None without a
        form.
    """

    alpha: Array
    depth: Array | None = None
    disparity: Array | None = None


def evaluate(
    splats: tuple[Array, ...],
    pixels: np.ndarray,
    config: RasterConfig,
    alpha_min: Array | None = None,
) -> Evaluated:
    """Return Gaussians at the pixels of their tiles.

    Args:
      splats: [G, K] each: the numbers of `Splat.shape`, then the centre's x, y relative
        to the corner of the tile.
      pixels: [2, P] x and y, relative to the corner as well.
      config: primitive, ray_depth, alpha_max and alpha_min are used.
      alpha_min: [] in place of that of ``config``, or None.
    """
    form = form_of(config)
    if form is not None:
        at = _at_pixels(splats, pixels, form, config.tile_size / 2)
        raw = splats[-3][..., None] * exp_negative(at.power)
        return Evaluated(_limited(raw, config, alpha_min), at.depth, at.disparity)
    if alpha_min is not None:
        return Evaluated(_limited(_gaussian(splats, pixels), config, alpha_min))
    return Evaluated(_gaussian_alphas(splats, pixels, config))


@partial(jax.custom_jvp, nondiff_argnums=(1, 2, 3))
def _at_pixels(
    splats: tuple[Array, ...], pixels: np.ndarray, form: Form, half: float
) -> AtPixel:
    """Return a form at pixels; ``half`` is half the side of a tile."""
    del half
    *shape, _, x, y = (value[..., None] for value in splats)
    parts = form.parts(tuple(shape))
    values = values_at(parts, pixels[0] - x, pixels[1] - y)
    return form.evaluate(values, parts.depth, parts.limits, unmarked)


@_at_pixels.defjvp
def _at_pixels_jvp(pixels, form, half, primals, tangents):
    """Differentiate the planes by one matrix product each, [G K, 3] × [3, P]."""
    x, y = pixels - half
    monomials = np.stack([np.ones_like(x), x, y])

    def about_middle(*splats):
        *shape, _, x, y = splats
        parts = form.parts(tuple(shape))
        one, none = jnp.ones_like(x), jnp.zeros_like(x)
        rows = [
            jnp.stack([p.value(half - x, half - y), *_slopes(p, one, none)], -1)
            for p in parts.planes
        ]
        return rows, none if parts.depth is None else parts.depth

    _, (rows, depth_rate) = jax.jvp(about_middle, primals[0], tangents[0])
    rates = tuple(_einsum("gkm,mp->gkp", row, monomials) for row in rows)
    *shape, _, x, y = (value[..., None] for value in primals[0])
    parts = form.parts(tuple(shape))
    depth = 0 * x if parts.depth is None else parts.depth
    given = values_at(parts, pixels[0] - x, pixels[1] - y), depth

    def evaluated(values, depth):
        return form.evaluate(values, depth, parts.limits, unmarked)

    return jax.jvp(evaluated, given, (rates, depth_rate[..., None]))


def _slopes(plane: Plane, one: Array, none: Array) -> tuple[Array, Array]:
    """Return the derivatives of a plane, as arrays."""
    return one * plane.by_x + none, one * plane.by_y + none


def _limited(raw: Array, config: RasterConfig, alpha_min: Array | None) -> Array:
    """Apply the upper and the lower limit of α."""
    lowest = config.alpha_min if alpha_min is None else alpha_min
    capped = jnp.where(raw < config.alpha_max, raw, config.alpha_max)
    return jnp.where(capped >= lowest, capped, 0)


def _offsets(splats: tuple[Array, ...], pixels: np.ndarray) -> tuple[Array, Array]:
    """Return y1, y2 [G, K, P] of Gaussians at the pixels [2, P]."""
    inv_sx, slope, inv_sy, _, x, y = (value[..., None] for value in splats)
    dx, dy = pixels[0] - x, pixels[1] - y
    return inv_sx * dx, inv_sy * (dy - slope * dx)


def _gaussian(splats: tuple[Array, ...], pixels: np.ndarray) -> Array:
    y1, y2 = _offsets(splats, pixels)
    return splats[3][..., None] * exp_negative(-0.5 * (y1 * y1 + y2 * y2))


@partial(jax.custom_jvp, nondiff_argnums=(1, 2))
def _gaussian_alphas(
    splats: tuple[Array, ...], pixels: np.ndarray, config: RasterConfig
) -> Array:
    return _limited(_gaussian(splats, pixels), config, None)


@_gaussian_alphas.defjvp
def _gaussian_alphas_jvp(pixels, config, primals, tangents):
    """dα = α d(log α); zero at or above the upper limit and below the lower one."""
    alpha = _gaussian_alphas(primals[0], pixels, config)
    half = config.tile_size / 2
    polynomial = partial(_log_coefficients, half)
    _, rate = jax.jvp(polynomial, primals[0], tangents[0])
    rate = _einsum("gkm,mp->gkp", rate, _monomials(half, pixels))
    return alpha, jnp.where(alpha < config.alpha_max, alpha, 0) * rate


def _log_coefficients(half: float, *splats: Array) -> Array:
    """Return log α as coefficients [G, K, 6] of `_monomials`."""
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
    """Return x², xy, y², x, y, 1 [6, P] of the pixels, from the middle of the tile.

    Around the middle the terms of the sum cancel least.
    """
    x, y = pixels - half
    return np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)])


def collect_absolute(
    alpha: Array,
    splats: tuple[Array, ...],
    pixels: np.ndarray,
    probe: Array,
    config: RasterConfig,
) -> Array:
    """Return ``alpha`` [G, K, P] unchanged.

    The gradient by ``probe`` [G, K, 2] is Σ over pixels of |∂L/∂mean|.
    """
    return _collect(alpha, splats, probe, pixels, config)


def _slopes_by_mean(alpha, splats, pixels, config) -> tuple[Array, Array]:
    """Return ∂α/∂x and ∂α/∂y [G, K, P] by the centre's x and y."""
    form = form_of(config)
    if form is not None:
        return _slopes_of_form(form, alpha, splats, pixels, config)
    inv_sx, slope, inv_sy, *_ = (value[..., None] for value in splats)
    y1, y2 = _offsets(splats, pixels)
    free = jnp.where(alpha < config.alpha_max, alpha, 0)
    return free * (inv_sx * y1 - inv_sy * slope * y2), free * inv_sy * y2


def _slopes_of_form(form: Form, alpha, splats, pixels, config):
    *shape, _, x, y = (value[..., None] for value in splats)

    parts = form.parts(tuple(shape))

    def power(dx, dy):
        values = values_at(parts, dx, dy)
        return form.evaluate(values, parts.depth, parts.limits, unmarked).power

    at = pixels[0] - x, pixels[1] - y
    one, none = (jnp.full_like(at[0], value) for value in (1, 0))
    free = jnp.where(alpha < config.alpha_max, alpha, 0)
    ways = (one, none), (none, one)
    return tuple(-free * jax.jvp(power, at, way)[1] for way in ways)


@partial(jax.custom_vjp, nondiff_argnums=(3, 4))
def _collect(alpha, splats, probe, pixels, config) -> Array:
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
