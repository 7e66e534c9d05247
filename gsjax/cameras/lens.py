"""The protocol of a lens, and the pieces that several lenses share.

All functions take components of any one shape, so that they vectorise over points.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.math.numerics import materialize

Array = Any  # jax.Array or numpy.ndarray
Point = tuple[Array, Array, Array]
Pixel = tuple[Array, Array]
Length = int | jax.Array  # px

# The Jacobian is limited at this multiple of the distance from the principal point to
# the farthest corner of the image.
EDGE = 1.15


class Lens(NamedTuple):
    """A lens as pure functions. ``K`` is [3, 3], ``c`` the coefficients [M] or None.

    Attributes:
      name: the name in files and messages.
      counts: the accepted numbers of coefficients; (0,) for none.
      project: (K, c, (x, y, z)) → (u, v) in px.
      unproject: (K, c, (u, v)) → (x, y, z), a point on the ray of a pixel; z = 1 for
        lenses of less than 180°.
      valid: (K, c, (x, y, z)) → bool; False beyond the largest angle of the lens, where
        the projection folds back onto the image.
      depth: (x, y, z) → the depth by which splats are ordered and reported.
      linearise: (K, c, (width, height), (x, y, z)) → the point at which the EWA
        Jacobian is evaluated. It limits the Jacobian far outside the image.
      period: (K, c) → the width in px of one turn, for images that wrap around; None
        for others. Splats across the seam are drawn on both sides.
      fault: concrete coefficients [..., M] → what is wrong with them and what to do, or
        None; the values are finite. None if the lens accepts all.
    """

    name: str
    counts: tuple[int, ...]
    project: Callable[[Array, Array, Point], Pixel]
    unproject: Callable[[Array, Array, Pixel], Point]
    valid: Callable[[Array, Array, Point], Array]
    depth: Callable[[Point], Array]
    linearise: Callable[[Array, Array, tuple[Length, Length], Point], Point]
    period: Callable[[Array, Array], Array] | None = None
    fault: Callable[[np.ndarray], str | None] | None = None


def copies(lens: Lens) -> int:
    """Return how often a point may appear in one image."""
    return 1 if lens.period is None else 3


def z_depth(point: Point) -> Array:
    """Return camera z, the ordering depth of lenses of less than 180°."""
    return point[2]


def range_depth(point: Point) -> Array:
    """Return the distance from the camera, the ordering depth of wider lenses."""
    x, y, z = point
    square = x * x + y * y + z * z
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def everywhere(K: Array, c: Array, point: Point) -> Array:
    """Return True: every point in front of the camera is projected."""
    del K, c
    return point[2] == point[2]


def linearise_in_place(
    K: Array, c: Array, size: tuple[Length, Length], point: Point
) -> Point:
    """Return ``point`` itself."""
    del K, c, size
    return point


def limit_to_image(
    K: Array, c: Array, size: tuple[Length, Length], point: Point
) -> Point:
    """Move ``point`` sideways to at most 15 % of the image size beyond its border.

    The limits are those of gsplat: 30 % of half the field of view beyond each side of
    the image, which treats a principal point off the centre evenly.
    """
    del c
    x, y, z = point

    def limit(ratio, focal, centre, length):
        margin = 0.3 * 0.5 * length / focal
        low = -(centre / focal + margin)
        high = (length - centre) / focal + margin
        # `where` instead of `clip`: a tie has the derivative of the inside.
        return jnp.where(ratio < low, low, jnp.where(ratio > high, high, ratio))

    width, height = size
    return (
        z * limit(x / z, K[0, 0], K[0, 2], width),
        z * limit(y / z, K[1, 1], K[1, 2], height),
        z,
    )


def to_pixel(K: Array, a: Array, b: Array) -> Pixel:
    """Return the pixel of coordinates at unit focal length."""
    return K[0, 0] * a + K[0, 2], K[1, 1] * b + K[1, 2]


def from_pixel(K: Array, pixel: Pixel) -> Pixel:
    """Return the coordinates of a pixel at unit focal length."""
    return (pixel[0] - K[0, 2]) / K[0, 0], (pixel[1] - K[1, 2]) / K[1, 1]


def edge_radius(K: Array, size: tuple[Length, Length]) -> Array:
    """Return `EDGE` times the farthest corner's distance, at unit focal length."""
    x = jnp.maximum(K[0, 2], size[0] - K[0, 2]) / K[0, 0]
    y = jnp.maximum(K[1, 2], size[1] - K[1, 2]) / K[1, 1]
    return EDGE * jnp.sqrt(x * x + y * y)


# Terms of atan(t) / t in t²; the rest is below 1e-17 up to the limit.
_ATAN = tuple((-1.0) ** k / (2 * k + 1) for k in range(8))
_ATAN_SLOPE = tuple(k * term for k, term in enumerate(_ATAN))[1:]
_SMALL = 1e-2


def atan_ratio(square: Array) -> Array:
    """Return atan(t) / t of t², with all derivatives at 0."""
    small = square < _SMALL
    few = polynomial(_ATAN, jnp.where(small, square, 0))
    t = jnp.sqrt(jnp.where(small, 1, square))
    return jnp.where(small, few, jnp.arctan(t) / t)


# atan(t) / t is Σ c[k] t²ᵏ on [0, 1]: a minimax fit, relative error 2e-9.
_ATAN_FIT = (
    *(0.999999998, -0.333332836, 0.199982658, -0.14261931, 0.109420196, -0.083772833),
    *(0.057551555, -0.030804055, 0.010726654, -0.0017538656),
)


def _angle(rho: Array, z: Array) -> Array:
    """Return atan2(rho, z) for rho ≥ 0, to 2e-7; no derivative is taken.

    Five times as fast in float32 on a CPU, where XLA calls the C library for each
    element (jax 0.10.2).
    """
    if rho.dtype != jnp.float32:
        return jnp.arctan2(rho, z)
    flat = jnp.abs(z)
    t = jnp.minimum(rho, flat) / jnp.maximum(rho, flat)
    angle = t * polynomial(_ATAN_FIT, t * t)
    angle = jnp.where(rho > flat, np.float32(np.pi / 2) - angle, angle)
    return jnp.where(z < 0, np.float32(np.pi) - angle, angle)


@jax.custom_jvp
def angle_ratio(point: Point) -> Array:
    """Return θ / ρ of camera points: the angle from the axis over hypot(x, y).

    Smooth on the axis in front of the camera; finite on the axis behind it, where the
    ratio has no limit.
    """
    square, near, ahead, off = _beside_axis(point)
    few = polynomial(_ATAN, jnp.where(near, square, 0) / (ahead * ahead)) / ahead
    rho = jnp.sqrt(jnp.where(off, square, 1))
    far = _angle(rho, jnp.where(off, point[2], 0)) / rho
    return materialize((jnp.where(near, few, far),))[0]


@angle_ratio.defjvp
def _angle_ratio_jvp(points, tangents):
    """Reuse the ratio s: ds = (z / r² − s) / ρ² · (x dx + y dy) − dz / r².

    XLA's CPU backend (jax 0.10.2) otherwise evaluates the arctangent for each use of a
    derivative.
    """
    ((x, y, z),), ((dx, dy, dz),) = points, tangents
    ratio = angle_ratio((x, y, z))
    square, near, ahead, off = _beside_axis((x, y, z))
    below = ahead * ahead
    few = polynomial(_ATAN_SLOPE, jnp.where(near, square, 0) / below) / (below * ahead)
    far = square + z * z
    inverse = 1 / jnp.where(near | off, far, 1)
    bend = (z * inverse - ratio) / jnp.where(off, square, 1)
    bend = jnp.where(near, 2 * few, jnp.where(off, bend, 0))
    bend, fall = materialize((bend, jnp.where(near | off, inverse, 0)))
    return ratio, bend * (x * dx + y * dy) - fall * dz


def _beside_axis(point: Point):
    """Return ρ², where the series holds, z there and 1 elsewhere, and where ρ > 0."""
    x, y, z = point
    square = x * x + y * y
    near = (z > 0) & (square < _SMALL * z * z)
    return square, near, jnp.where(near, z, 1), ~near & (square > 0)


def sine_ratio(square: Array) -> Array:
    """Return sin(t) / t of t², with all derivatives at 0."""
    small = square < _SMALL
    terms = (1.0, -1 / 6, 1 / 120, -1 / 5040, 1 / 362880, -1 / 39916800)
    t = jnp.sqrt(jnp.where(small, 1, square))
    return jnp.where(
        small, polynomial(terms, jnp.where(small, square, 0)), jnp.sin(t) / t
    )


def root(square: Array) -> Array:
    """Return the square root, with value and derivative 0 at 0."""
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)


def polynomial(coefficients, x: Array) -> Array:
    """Return Σ coefficients[k] xᵏ by Horner's rule."""
    value = coefficients[-1] + 0 * x
    for coefficient in coefficients[-2::-1]:
        value = coefficient + x * value
    return value
