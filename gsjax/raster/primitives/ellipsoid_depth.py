"""Depth along each ray, and normals, of ellipsoids (Zhang et al. 2024, RaDe-GS).

A ray shows an ellipsoid at its densest point. With m = S⁻¹ Rᵀ μ the mean seen from the
camera and r = S⁻¹ Rᵀ (ray), both in standard deviations, that is where z = (r · m) /
(r · r). At an offset (dx, dy) of the pixel from the mean r = (m + p dx + q dy) / z₀, so

    z = z₀ e / (e² + κ²),   e = 1 + g · (dx, dy),   κ² = k₁² + k₂²,

where e − 1 is the part of p dx + q dy along m over |m|, and κ the rest over |m|, of
which k₁ and k₂ are triangular components. Exact for a pinhole; other lenses are
perspective about the mean, to first order. The normal is that of the surface of equal
density at the mean.

The image of an ellipsoid is dilated. So an offset d of a pixel stands for the offset
(1 − s Σ'⁻¹) d before the dilation by s, its expectation given d: a ray that passes
beside a thin ellipsoid shows it where it is, not where it would be extended to.

A point that is behind the camera, or much nearer than the mean, gives way to the mean.

Nothing is divided by a scale: all are taken relative to the smallest one, so flat
ellipsoids and needles keep their digits.
"""

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.cameras.shutter import Exposure, entry, image_rows
from gsjax.math import rotations
from gsjax.math.numerics import safe_normalize
from gsjax.raster.forms import (
    AtPixel,
    Form,
    Numbers,
    Once,
    Parts,
    Plane,
    gaussian_power,
)
from gsjax.raster.primitives.ewa import lens_jacobian
from gsjax.raster.primitives.rows import cross, depth_slopes, dot
from gsjax.raster.types import Array

_LEAST = 1e-6  # of e² + κ²; below, a ray hardly comes near the ellipsoid
_NEAREST = 1e-3  # depth relative to the mean's; a pixel nearer takes the mean's
_SMALL = 1e-12  # of other squares that are divided by
_THIN = 1e-5  # smallest scale, relative to the largest


def _parts(shape: Numbers) -> Parts:
    inv_sx, slope, inv_sy, gx, gy, k1x, k1y, k2x, k2y, depth = shape
    planes = (
        Plane(0.0, inv_sx, 0.0),
        Plane(0.0, -inv_sy * slope, inv_sy),
        Plane(1.0, gx, gy),
        Plane(0.0, k1x, k1y),
        Plane(0.0, k2x, k2y),
    )
    return Parts(planes, depth)


def _evaluate(values: Numbers, depth, limits: Numbers, once: Once) -> AtPixel:
    del limits
    y1, y2, e, k1, k2 = values
    depth = jnp.where(depth > 0, depth, 1)  # 0 where a list has ended
    below = e * e + k1 * k1 + k2 * k2
    over = once(_inverse(below))
    ahead = e > _NEAREST * below
    there = depth * jnp.where(ahead, e * over, 1)
    disparity = jnp.where(ahead, below / jnp.where(ahead, e, 1), 1) / depth
    return AtPixel(gaussian_power(y1, y2), there, disparity)


@jax.custom_jvp
def _inverse(x: Array) -> Array:
    """Return 1 / x for x > 0, limited."""
    return 1 / jnp.maximum(x, _LEAST)


@_inverse.defjvp
def _inverse_jvp(primals, tangents):
    over = _inverse(*primals)
    return over, -over * over * tangents[0]


RAY_FORM = Form(_parts, _evaluate, has_depth=True)


def _in_deviations(vector, quat, scales) -> tuple[Array, ...]:
    """Return S⁻¹ Rᵀ of a world vector, times the smallest scale."""
    rotation = rotations.rotation_rows(*quat)
    over = 1 / sum(q * q for q in quat)
    smallest = jnp.minimum(jnp.minimum(scales[0], scales[1]), scales[2])
    return tuple(
        dot([row[j] for row in rotation], vector) * (over * (smallest / scales[j]))
        for j in range(3)
    )


def _limited(scales) -> list[Array]:
    """Return scales, none below `_THIN` of the largest: their squares stay finite."""
    largest = jnp.maximum(jnp.maximum(scales[0], scales[1]), scales[2])
    least = _THIN * largest
    return [jnp.where(scale > least, scale, least) for scale in scales]


def _mean_from_eye(exposure: Exposure) -> tuple[Array, ...]:
    """Return the mean relative to the camera, in world axes."""
    view = exposure.viewmat
    columns = [[entry(view, i, j) for i in range(3)] for j in range(3)]
    return tuple(dot(column, exposure.point) for column in columns)


def _positive(x: Array) -> Array:
    return jnp.where(x > _SMALL, x, _SMALL)


def ray_numbers(camera: Camera, exposure: Exposure, quat, scales, filtered) -> Numbers:
    """Return the numbers of `RAY_FORM` behind those of an ellipsoid, [R] each.

    Args:
      camera: a single camera.
      exposure: from `expose`.
      quat: (w, x, y, z), any norm above zero.
      scales: three standard deviations.
      filtered: a, b, c and the determinant of the dilated covariance, and the px² by
        which it was dilated.
    """
    *steps, depth = _ray_steps(camera, exposure, quat, scales)
    gx, gy, k1, k2x, k2y = steps
    a, b, c, det, dilation = filtered

    def before(x: Array | float, y: Array | float) -> tuple[Array, Array]:
        """Return a row times 1 − s Σ'⁻¹."""
        share = dilation / det
        return x - share * (c * x - b * y), y - share * (a * y - b * x)

    rows = before(gx, gy), before(k1, 0.0), before(k2x, k2y)
    return *(number for row in rows for number in row), depth


def key_numbers(camera: Camera, exposure: Exposure, quat, scales) -> Numbers:
    """Return the numbers of `ray_key`, [R] each; arguments as of `ray_numbers`."""
    return lax.stop_gradient(_ray_steps(camera, exposure, quat, scales))


def ray_key(numbers: Numbers, dx: Array, dy: Array) -> Array:
    """Return the depth of the densest point along the ray of a pixel.

    It is that of the ray itself, whatever the dilation, so it does not change if the
    camera turns. It is negative where that point is behind the camera.

    Args:
      numbers: from `key_numbers`.
      dx, dy: offset of the pixel from the centre, px.
    """
    gx, gy, k1, k2x, k2y, depth = numbers
    e, k2 = 1 + gx * dx + gy * dy, k2x * dx + k2y * dy
    below = e * e + (k1 * dx) * (k1 * dx) + k2 * k2
    return depth * (e / jnp.maximum(below, _SMALL))


def _ray_steps(camera: Camera, exposure: Exposure, quat, scales) -> Numbers:
    """Return g, k₁ (along x) and k₂ of the module's head, and z₀."""
    scales = _limited(scales)
    depth = camera.lens.depth(exposure.point)
    u, v = image_rows(camera, exposure, lens_jacobian(camera, exposure.point))
    away = depth_slopes(camera, exposure)
    # Steps at equal depth that move the image by a pixel along u, and along v.
    over = 1 / dot(away, cross(u, v))
    p = _in_deviations([n * over for n in cross(v, away)], quat, scales)
    q = _in_deviations([n * over for n in cross(away, u)], quat, scales)
    m = _in_deviations(_mean_from_eye(exposure), quat, scales)
    square = dot(m, m)
    gx, gy = dot(m, p) / square, dot(m, q) / square
    rest = [a - gy * b for a, b in zip(q, m)]
    length = jnp.sqrt(_positive(dot(rest, rest) / square))
    across = [a - gx * b for a, b in zip(p, m)]
    # One factor after the other: the derivative of x / y has y⁻².
    k2x = dot(across, rest) / square / length
    k1 = dot(m, cross(p, q)) / square / (jnp.sqrt(square) * length)
    return gx, gy, k1, k2x, length, depth


def ray_normals(exposure: Exposure, quat, scales) -> tuple[Array, ...]:
    """Return the normal (x, y, z) in camera coordinates; it faces the camera."""
    scales = _limited(scales)
    m = _in_deviations(_mean_from_eye(exposure), quat, scales)
    smallest = jnp.minimum(jnp.minimum(scales[0], scales[1]), scales[2])
    inward = tuple(n * (smallest / s) for n, s in zip(m, scales))
    rotation = rotations.rotation_rows(*quat)
    world = [-dot(row, inward) for row in rotation]
    view = exposure.viewmat
    seen = tuple(dot([entry(view, i, j) for j in range(3)], world) for i in range(3))
    return safe_normalize(seen, (0.0, 0.0, -1.0))[0]
