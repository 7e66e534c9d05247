"""Lenses: how points in camera coordinates fall onto the image.

A lens is a set of pure functions over components of any one shape. The renderer, the
undistortion of photographs and the projection on the host use the same functions, on
JAX or NumPy arrays. The EWA Jacobian is the derivative of `Lens.project`, so a new lens
needs no other code.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.errors import InputError

Array = Any  # jax.Array or numpy.ndarray
Point = tuple[Array, Array, Array]
Length = int | jax.Array  # px

_NEWTON_STEPS = 12
_FOLD_SAMPLES = 4096


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
    """

    name: str
    counts: tuple[int, ...]
    project: Callable[[Array, Array, Point], tuple[Array, Array]]
    unproject: Callable[[Array, Array, tuple[Array, Array]], Point]
    valid: Callable[[Array, Array, Point], Array]
    depth: Callable[[Point], Array]
    linearise: Callable[[Array, Array, tuple[Length, Length], Point], Point]


def z_depth(point: Point) -> Array:
    """Return camera z, the ordering depth of lenses of less than 180°."""
    return point[2]


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


def _pinhole_project(K: Array, c: Array, point: Point) -> tuple[Array, Array]:
    del c
    x, y, z = point
    return K[0, 0] * (x / z) + K[0, 2], K[1, 1] * (y / z) + K[1, 2]


def _pinhole_unproject(K: Array, c: Array, pixel: tuple[Array, Array]) -> Point:
    del c
    x, y = (pixel[0] - K[0, 2]) / K[0, 0], (pixel[1] - K[1, 2]) / K[1, 1]
    return x, y, 1 + 0 * x


def _orthographic_project(K: Array, c: Array, point: Point) -> tuple[Array, Array]:
    del c
    x, y, _ = point
    return K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]


PINHOLE = Lens(
    name="pinhole",
    counts=(0,),
    project=_pinhole_project,
    unproject=_pinhole_unproject,
    valid=everywhere,
    depth=z_depth,
    linearise=limit_to_image,
)
ORTHOGRAPHIC = PINHOLE._replace(
    name="orthographic", project=_orthographic_project, linearise=linearise_in_place
)


def _namespace(*values: Array):
    """Return `numpy` for NumPy arrays, else `jax.numpy`."""
    host = all(isinstance(v, (np.ndarray, np.generic, float, int)) for v in values)
    return np if host else jnp


def _columns(c: Array, count: int) -> list[Array]:
    """Return ``count`` coefficients; those not given are 0."""
    return [c[i] if i < c.shape[-1] else 0.0 for i in range(count)]


def _opencv_radial(c: Array, s: Array) -> Array:
    """Distorted over undistorted radius, from its square; NaN beyond a pole."""
    k1, k2, _, _, k3, k4, k5, k6 = _columns(c, 8)
    above = 1 + s * (k1 + s * (k2 + s * k3))
    below = 1 + s * (k4 + s * (k5 + s * k6))
    return above / _namespace(s).where(below > 0, below, np.nan)


def _opencv_plane(c: Array, x: Array, y: Array) -> tuple[Array, Array]:
    _, _, p1, p2, *_ = _columns(c, 8)
    square = x * x + y * y
    scale = _opencv_radial(c, square)
    return (
        x * scale + 2 * p1 * x * y + p2 * (square + 2 * x * x),
        y * scale + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
    )


def _fisheye_radial(c: Array, r: Array) -> Array:
    k1, k2, k3, k4 = _columns(c, 4)
    xp = _namespace(r)
    angle = xp.arctan(r)
    t = angle * angle
    scale = 1 + t * (k1 + t * (k2 + t * (k3 + t * k4)))
    small = r < 1e-8
    return scale * xp.where(small, 1.0, angle / xp.where(small, 1.0, r))


def _fisheye_plane(c: Array, x: Array, y: Array) -> tuple[Array, Array]:
    square = x * x + y * y
    xp = _namespace(x)
    safe = xp.where(square > 0, square, 1.0)  # the root has no slope at 0
    scale = _fisheye_radial(c, xp.where(square > 0, xp.sqrt(safe), 0.0))
    return x * scale, y * scale


def _project_plane(plane: Callable, K: Array, c: Array, point: Point):
    x, y, z = point
    xd, yd = plane(c, x / z, y / z)
    return K[0, 0] * xd + K[0, 2], K[1, 1] * yd + K[1, 2]


def _unproject_plane(plane: Callable, K: Array, c: Array, pixel) -> Point:
    """Invert ``plane`` by Newton's method, from the distorted point on."""
    target = _pinhole_unproject(K, c, pixel)[:2]
    x, y = target
    for _ in range(_NEWTON_STEPS):
        (xd, yd), (a, b), (d, e) = _plane_and_slopes(plane, c, x, y)
        det = a * e - b * d
        det = _namespace(det).where(det == 0, 1.0, det)
        dx, dy = xd - target[0], yd - target[1]
        x, y = x - (e * dx - b * dy) / det, y - (a * dy - d * dx) / det
    return x, y, 1 + 0 * x


def _plane_and_slopes(plane: Callable, c: Array, x: Array, y: Array):
    """Value of ``plane`` and its rows of slopes by x and y."""
    at, one, zero = partial(plane, c), jnp.ones_like(x), jnp.zeros_like(x)
    value, by_x = jax.jvp(at, (x, y), (one, zero))
    _, by_y = jax.jvp(at, (x, y), (zero, one))
    return value, (by_x[0], by_y[0]), (by_x[1], by_y[1])


def fold_radius(radial: Callable, c: Array) -> Array:
    """Return the radius up to which the distorted radius grows, or inf.

    Args:
      radial: (c, radius) → distorted over undistorted radius.
      c: [M] coefficients.
    """
    xp = _namespace(c)
    r = np.tan(np.linspace(0, np.pi / 2, _FOLD_SAMPLES, endpoint=False))
    r = r if xp is np else jnp.asarray(r, c.dtype)
    falls = ~(xp.diff(r * radial(c, r)) > 0)
    return xp.where(falls.any(), r[xp.argmax(falls)], np.inf)


def _before_fold(radial: Callable, K: Array, c: Array, point: Point) -> Array:
    del K
    x, y, z = point
    limit = fold_radius(radial, c)
    return (z > 0) & (x * x + y * y <= (limit * z) ** 2)


def _distorting(name: str, counts, plane: Callable, radial: Callable) -> Lens:
    return Lens(
        name=name,
        counts=counts,
        project=partial(_project_plane, plane),
        unproject=partial(_unproject_plane, plane),
        valid=partial(_before_fold, radial),
        depth=z_depth,
        linearise=limit_to_image,
    )


# OpenCV's radial-tangential model: k1 k2 p1 p2 [k3 [k4 k5 k6]].
OPENCV = _distorting(
    "opencv", (4, 5, 8), _opencv_plane, lambda c, r: _opencv_radial(c, r * r)
)
# OpenCV's fisheye model of Kannala and Brandt (2006): k1 k2 k3 k4.
FISHEYE = _distorting("fisheye", (4,), _fisheye_plane, _fisheye_radial)

LENSES = {lens.name: lens for lens in (PINHOLE, ORTHOGRAPHIC, OPENCV, FISHEYE)}


def find_lens(lens: str | Lens) -> Lens:
    """Return the lens of a name; a `Lens` is returned unchanged.

    Raises:
      InputError: if the name is unknown, or ``lens`` is of another type.
    """
    if isinstance(lens, Lens):
        return lens
    if isinstance(lens, str) and lens in LENSES:
        return LENSES[lens]
    raise InputError(
        f"lens: expected a gsjax.cameras.lenses.Lens or one of {sorted(LENSES)}, got "
        f"{lens!r}"
    )
