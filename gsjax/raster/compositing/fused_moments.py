"""Reduction of a Gaussian's cotangents over the pixels of a tile, for `fused_vjp`.

In the Gaussian form α depends on its Gaussian through y1 and y2 alone (see `Splat`),
and both are linear over a tile. So the cotangents follow from six moments of
q = α ∂L/∂α over the pixels: of 1, y1, y2, y1², y1 y2, y2².

A `Form` depends on the pixel through its planes. So its cotangents follow from the
moments of 1, x and y of the cotangents of the planes, and from the sums of those of its
other numbers and of q. The rest is done once a splat, by automatic differentiation.

Axis legend: P pixels of a tile, R ranks, M moments.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.raster.compositing.alpha import pixel_centres
from gsjax.raster.compositing.blending import pixel_value
from gsjax.raster.compositing.types import Images, Task, form_of, pixel_channels
from gsjax.raster.forms import AtPixel, Form, Plane, values_at
from gsjax.raster.types import Array, RasterConfig, Splat

_product = partial(jnp.matmul, precision=lax.Precision.HIGHEST)
Moments = Callable[[Array, Array], Array]


class Reduction(NamedTuple):
    """Cotangents of splats by sums over pixels.

    Attributes:
      size: splat → M.
      at: (corner (x, y) of a tile, ones [P] that XLA does not know, row [S] of a
        splat, value [P] of its constant channels times their cotangents, cotangents of
        the images at the tile) → (the value with what varies from pixel to pixel; a
        function of q and of the weight α T [P] → moments [M]).
      cotangent: (splat, sums of moments [M, R]) → cotangent of the splat.
    """

    size: Callable[[Splat], int]
    at: Callable[..., tuple[Array, Moments]]
    cotangent: Callable[[Splat, Array], Splat]


def reduction_of(task: Task) -> Reduction:
    """Return the reduction for the splats of a task."""
    form = form_of(task.config)
    if form is None:
        return Reduction(
            size=lambda _: 6,
            at=partial(_gaussian_at, task.grid.tile),
            cotangent=_gaussian_cotangent,
        )
    return Reduction(
        size=partial(_size, form, task.config),
        at=partial(_form_at, form, task),
        cotangent=partial(_form_cotangent, form),
    )


def _over(moment: Array, number: Array) -> Array:
    # Gaussians that are not drawn may hold anything, and have no moments.
    return jnp.where(number != 0, moment / jnp.where(number != 0, number, 1), 0)


def _gaussian_at(tile: int, corner, ones, row, worth, image):
    del image, ones
    half = tile / 2
    monomials = _monomials(pixel_centres(tile, row.dtype) - half)
    middle = corner[0] + half, corner[1] + half

    def moments(slope: Array, weight: Array) -> Array:
        del weight
        return _moments_about_mean(row, middle, _product(monomials, slope))

    return worth, moments


def _monomials(pixels: np.ndarray) -> np.ndarray:
    """Return 1, x, y, x², xy, y² [6, P] of pixels, from the middle of the tile."""
    x, y = pixels
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])


def _moments_about_mean(
    row: Array, middle: tuple[Array, Array], moments: Array
) -> Array:
    """Return the moments [6] in y1 and y2 of a Gaussian, from those of `_monomials`.

    y1 and y2 are a few standard deviations in the middle of any tile that the Gaussian
    touches, and change by no more within it. So little cancels, however far the mean.
    """
    u, v, inv_sx, slope, inv_sy, _ = lax.split(row, [1] * 6)
    one, x, y, xx, xy, yy = lax.split(moments, [1] * 6)
    dx, dy = middle[0] - u, middle[1] - v
    y1, y2 = inv_sx * dx, inv_sy * (dy - slope * dx)
    by_1, by_2 = inv_sx * x, inv_sy * (y - slope * x)
    by_11 = inv_sx * inv_sx * xx
    by_12 = inv_sx * inv_sy * (xy - slope * xx)
    by_22 = inv_sy * inv_sy * (yy - slope * (2 * xy - slope * xx))
    about = (
        one,
        y1 * one + by_1,
        y2 * one + by_2,
        y1 * (y1 * one + 2 * by_1) + by_11,
        y2 * (y1 * one + by_1) + y1 * by_2 + by_12,
        y2 * (y2 * one + 2 * by_2) + by_22,
    )
    return jnp.concatenate(about)


def _gaussian_cotangent(splat: Splat, sums: Array) -> Splat:
    """Return the cotangent, from d log α = d log opacity − y1 dy1 − y2 dy2."""
    one, y1, y2, y11, y12, y22 = sums
    inv_sx, slope, inv_sy, opacity = splat.shape
    by_shape = (
        -_over(y11, inv_sx),
        _over(inv_sy * y12, inv_sx),
        -_over(y22, inv_sy),
        _over(one, opacity),
    )
    return Splat(inv_sx * y1 - inv_sy * slope * y2, inv_sy * y2, by_shape)


def _size(form: Form, config: RasterConfig, splat: Splat) -> int:
    planes = form.parts(splat.shape[:-1]).planes
    depth = bool(pixel_channels(config))
    return sum(len(_wanted(plane)) for plane in planes) + depth + 1


def _wanted(plane: Plane) -> list[int]:
    """Return which of the moments of 1, x, y a plane needs."""
    slopes = enumerate((plane.by_x, plane.by_y), 1)
    return [0, *(i for i, slope in slopes if not isinstance(slope, float))]


def _form_at(
    form: Form, task: Task, corner, ones, row, worth, image
) -> tuple[Array, Moments]:
    def once(value: Array) -> Array:
        return value / ones

    tile, varying = task.grid.tile, pixel_channels(task.config)
    pixels = pixel_centres(tile, row.dtype)
    u, v, *shape, _ = lax.split(row, [1] * row.shape[0])
    dx, dy = pixels[0] - (u - corner[0]), pixels[1] - (v - corner[1])
    half = tile / 2
    middle = half - (u - corner[0]), half - (v - corner[1])
    x, y = pixels - half
    monomials = np.stack([np.ones_like(x), x, y])
    shape = tuple(number[0] for number in shape)
    parts = form.parts(shape)
    values = values_at(parts, dx, dy)
    depths: tuple[Array, ...] = ()
    if varying and parts.depth is not None:
        depths = (parts.depth + jnp.zeros_like(dx),)

    def evaluated(values, *depths):
        depth = depths[0] if depths else parts.depth
        at = form.evaluate(values, depth, parts.limits, once)
        return at if depths else AtPixel(at.power)

    at, pull = jax.vjp(evaluated, values, *depths)
    for name in varying:
        worth = worth + pixel_value(name, at) * image[name]

    def moments(slope: Array, weight: Array) -> Array:
        by_at = _by_evaluated(at, once(slope), once(weight), image)
        by_values, *by_depth = pull(by_at)
        about, single = [], []
        for plane, by_value in zip(parts.planes, by_values):
            if len(_wanted(plane)) == 1:
                single.append(by_value)
                continue
            one, x, y = lax.split(_product(monomials, by_value), [1] * 3)
            sums = one, x + middle[0] * one, y + middle[1] * one
            about += [sums[i] for i in _wanted(plane)]
        single = jnp.stack([*single, *by_depth, by_at.power])
        # As a product: XLA makes slow loops of single sums.
        return jnp.concatenate([*about, _product(single, monomials[0])])

    return worth, moments


def _by_evaluated(at: AtPixel, slope: Array, weight: Array, image: Images) -> AtPixel:
    """Return the cotangent of a form at the pixels."""
    if at.depth is None or at.disparity is None:
        return AtPixel(slope)
    none = jnp.zeros_like(slope)
    by_depth = weight * image["depth"] if "depth" in image else none
    by_disparity = none
    if "disparity" in image:
        by_disparity = weight * (
            image["disparity"] + 2 * at.disparity * image["square"]
        )
    return AtPixel(slope, by_depth, by_disparity)


def _form_cotangent(form: Form, splat: Splat, sums: Array) -> Splat:
    """Return the cotangent: that of the planes, pulled back to the splat's numbers."""
    *shape, opacity = splat.shape
    _, pull = jax.vjp(partial(_arrays, form), tuple(shape))
    about, rest = [], iter(sums)
    by_u, by_v = jnp.zeros_like(opacity), jnp.zeros_like(opacity)
    planes = form.parts(tuple(shape)).planes
    several = [plane for plane in planes if len(_wanted(plane)) > 1]
    found = {id(p): [next(rest) for _ in _wanted(p)] for p in several}
    for plane in planes:
        total, *slopes = found.get(id(plane)) or [next(rest)]
        by_u, by_v = by_u - plane.by_x * total, by_v - plane.by_y * total
        at = [] if isinstance(plane.at, float) else [total]
        about.append([*at, *slopes])
    *by_depth, by_opacity = rest
    by_depth = by_depth[0] if by_depth else jnp.zeros_like(opacity)
    (by_shape,) = pull((about, by_depth))
    return Splat(by_u, by_v, (*by_shape, _over(by_opacity, opacity)))


def _arrays(form: Form, shape) -> tuple[list[list[Any]], Array]:
    """Return the numbers of the planes that are arrays, and the depth."""
    parts = form.parts(shape)
    arrays = [[n for n in plane if not isinstance(n, float)] for plane in parts.planes]
    return arrays, jnp.zeros_like(shape[0]) if parts.depth is None else parts.depth
