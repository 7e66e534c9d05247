"""Lenses that distort a plane of directions around their axis.

The plane is (x, y) / z for perspective lenses and θ (x, y) / ρ for wide ones, with
ρ = hypot(x, y) and θ the angle from the axis. A lens is then a function of that plane,
and its part along the radius, which decides where the image folds.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.cameras import solvers
from gsjax.cameras.lens import (
    Array,
    Length,
    Lens,
    Pixel,
    Point,
    angle_ratio,
    atan_ratio,
    edge_radius,
    from_pixel,
    polynomial,
    range_depth,
    root,
    sine_ratio,
    to_pixel,
    z_depth,
)

# Perspective lenses end at 89.994°, so that powers of the radius stay finite.
_FARTHEST = 1e4


class Model(NamedTuple):
    """A distortion of the plane of directions.

    Attributes:
      wide: whether the plane is θ (x, y) / ρ instead of (x, y) / z.
      plane: (c, a, b) → distorted (a, b).
      radius: (c, r) → distorted radius, without terms that depend on the direction;
        NaN beyond a pole or the end of the model.
      tangential: whether ``plane`` has terms that depend on the direction.
      limit: c → the largest radius of the model, or None.
    """

    wide: bool
    plane: Callable[[Array, Array, Array], Pixel]
    radius: Callable[[Array, Array], Array]
    tangential: bool = False
    limit: Callable[[Array], Array] | None = None


def _base(model: Model, point: Point) -> Pixel:
    x, y, z = point
    scale = angle_ratio(point) if model.wide else 1 / z
    return (x * scale, y * scale) if model.wide else (x / z, y / z)


def _grid(model: Model, dtype) -> Array:
    """Return radii from 0 to the largest: π, or the tangent of almost 90°."""
    angles = np.linspace(0, 1, solvers.SAMPLES + 1)
    if model.wide:
        return jnp.asarray(np.pi * angles, dtype)
    return jnp.asarray(np.tan(0.5 * np.pi * angles[:-1]), dtype)


def _first_radius(model: Model, c: Array, target: Array | float) -> Array:
    """Return the first radius that folds or reaches ``target``, or infinity."""
    c = lax.stop_gradient(c)

    def stops(r: Array) -> Array:
        value, slope = jax.jvp(partial(model.radius, c), (r,), (jnp.ones_like(r),))
        return ~((slope > 0) & (value < target))

    return solvers.first_true(stops, _grid(model, c.dtype))


def fold_radius(model: Model, c: Array) -> Array:
    """Return the radius (or angle) at which the distorted radius stops growing.

    Infinite if there is none. At most the limit of the model.
    """
    fold = _first_radius(model, c, np.inf)
    return fold if model.limit is None else jnp.minimum(fold, model.limit(c))


def _edge(model: Model, c: Array, target: Array) -> Array:
    """Return the radius whose image is ``target``, or the fold; differentiable."""
    found = _first_radius(model, c, lax.stop_gradient(target))
    start = jnp.where(found < jnp.inf, found, 0)

    def step(r: Array) -> Array:
        value, slope = jax.jvp(partial(model.radius, c), (r,), (jnp.ones_like(r),))
        reached = (start > 0) & (slope > 1e-3) & (jnp.abs(value - target) < 1e-3)
        change = (value - target) / jnp.where(reached, slope, 1)
        return r - jnp.where(reached, change, 0)

    return jnp.where(found < jnp.inf, step(step(start)), jnp.inf)


def _project(model: Model, K: Array, c: Array, point: Point) -> Pixel:
    return to_pixel(K, *model.plane(c, *_base(model, point)))


def _valid(model: Model, K: Array, c: Array, point: Point) -> Array:
    del K
    x, y, z = point
    fold = fold_radius(model, c)
    if not model.wide:
        fold = jnp.minimum(fold, _FARTHEST)
    a, b = _base(model, point)
    # The axis behind a wide lens has no direction on the image.
    good = (z > 0) | (model.wide & (x * x + y * y > 0))
    good &= a * a + b * b < fold * fold
    if model.tangential:
        one, zero = jnp.ones_like(a), jnp.zeros_like(a)
        plane = partial(model.plane, c)
        _, by_a = jax.jvp(plane, (a, b), (one, zero))
        _, by_b = jax.jvp(plane, (a, b), (zero, one))
        good &= by_a[0] * by_b[1] - by_a[1] * by_b[0] > 0
    return good


def _unproject(model: Model, K: Array, c: Array, pixel: Pixel) -> Point:
    target = from_pixel(K, pixel)
    far = root(target[0] * target[0] + target[1] * target[1])
    high = jnp.minimum(fold_radius(model, c), np.pi if model.wide else _FARTHEST)
    r = solvers.invert_rising(model.radius, c, lax.stop_gradient(far), high)
    scale = lax.stop_gradient(jnp.where(far > 0, r / jnp.where(far > 0, far, 1), 1))
    start = target[0] * scale, target[1] * scale
    a, b = solvers.invert_plane(model.plane, c, target, start)
    if not model.wide:
        return a, b, 1 + 0 * a
    square = a * a + b * b
    sine = sine_ratio(square)
    return a * sine, b * sine, jnp.cos(root(square))


def _linearise(
    model: Model, K: Array, c: Array, size: tuple[Length, Length], point: Point
) -> Point:
    """Move ``point`` towards the axis, to where the image of its radius ends."""
    limit = _edge(model, c, edge_radius(K, size))
    x, y, z = point
    if not model.wide:
        # Infinite if no direction is imaged so far out: 0 · ∞ in a derivative is NaN.
        bounded = limit < jnp.inf
        limit = jnp.where(bounded, limit, 1)
        square = x * x + y * y
        out = bounded & (square > limit * limit * z * z)
        scale = jnp.where(out, limit * z / jnp.sqrt(jnp.where(out, square, 1)), 1)
        return x * scale, y * scale, z
    limit = jnp.minimum(limit, np.pi)
    ratio = angle_ratio(point)
    square = x * x + y * y
    out = (square > 0) & (ratio * ratio * square > limit * limit)
    rho = jnp.sqrt(jnp.where(out, square, 1))
    far = jnp.where(out, range_depth(point), 1)
    scale = jnp.where(out, far * jnp.sin(limit) / rho, 1)
    return x * scale, y * scale, jnp.where(out, far * jnp.cos(limit), z)


def radial_lens(name: str, counts: tuple[int, ...], model: Model, fault=None) -> Lens:
    """Return the lens of a distortion model; ``fault`` as in `Lens`."""
    return Lens(
        name=name,
        counts=counts,
        project=partial(_project, model),
        unproject=partial(_unproject, model),
        valid=partial(_valid, model),
        depth=range_depth if model.wide else z_depth,
        linearise=partial(_linearise, model),
        fault=fault,
    )


def _columns(c: Array, count: int) -> list[Array]:
    """Return ``count`` coefficients; those not given are 0."""
    return [c[i] if i < c.shape[-1] else 0.0 for i in range(count)]


def _tangential(p1, p2, a: Array, b: Array, square: Array) -> Pixel:
    cross = 2 * a * b
    return (
        p1 * cross + p2 * (square + 2 * a * a),
        p2 * cross + p1 * (square + 2 * b * b),
    )


# OpenCV's model: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]].


def _opencv_scale(c: Array, square: Array) -> tuple[Array, Array]:
    """Return distorted over undistorted radius, and where it has no pole."""
    k1, k2, _, _, k3, k4, k5, k6 = _columns(c, 8)
    above = polynomial((1.0, k1, k2, k3), square)
    if c.shape[-1] < 8:
        return above, square == square
    below = polynomial((1.0, k4, k5, k6), square)
    good = below > 0
    return above / jnp.where(good, below, 1), good


def _opencv_radius(c: Array, r: Array) -> Array:
    scale, good = _opencv_scale(c, r * r)
    return jnp.where(good, r * scale, np.nan)


def _opencv_plane(c: Array, a: Array, b: Array) -> Pixel:
    _, _, p1, p2, *_ = _columns(c, 4)
    square = a * a + b * b
    scale, _ = _opencv_scale(c, square)
    da, db = _tangential(p1, p2, a, b, square)
    if c.shape[-1] > 8:
        s1, s2, s3, s4 = _columns(c, 12)[8:]
        da = da + square * (s1 + s2 * square)
        db = db + square * (s3 + s4 * square)
    return a * scale + da, b * scale + db


# The fisheye models: powers of θ², with COLMAP's further terms.


def _odd_radius(which: tuple[int, ...], c: Array, angle: Array) -> Array:
    terms = (1.0, *(c[i] for i in which))
    return angle * polynomial(terms, angle * angle)


def _fisheye_plane(c: Array, a: Array, b: Array) -> Pixel:
    scale = polynomial((1.0, *_columns(c, 4)), a * a + b * b)
    return a * scale, b * scale


def _thin_prism_plane(c: Array, a: Array, b: Array) -> Pixel:
    k1, k2, p1, p2, k3, k4, s1, s2 = _columns(c, 8)
    square = a * a + b * b
    scale = polynomial((1.0, k1, k2, k3, k4), square)
    da, db = _tangential(p1, p2, a, b, square)
    return a * scale + da + s1 * square, b * scale + db + s2 * square


def _rad_tan_thin_prism_plane(c: Array, a: Array, b: Array) -> Pixel:
    *k, p0, p1, s0, s1, s2, s3 = _columns(c, 12)
    scale = polynomial((1.0, *k), a * a + b * b)
    a, b = a * scale, b * scale
    square = a * a + b * b
    along = 2 * (p0 * a + p1 * b)
    return (
        a + a * along + square * (p0 + s0 + s1 * square),
        b + b * along + square * (p1 + s2 + s3 * square),
    )


# The field-of-view model of Devernay and Faugeras (2001): ω.


def _fov_scale(c: Array, square: Array) -> Array:
    half = 0.5 * c[0]
    tangent = half * _tan_ratio(half)
    return _tan_ratio(half) * atan_ratio(4 * square * tangent * tangent)


def _tan_ratio(x: Array) -> Array:
    """Return tan(x) / x, with all derivatives at 0."""
    return sine_ratio(x * x) / jnp.cos(x)


def _fov_fault(c: np.ndarray) -> str | None:
    if (np.abs(c) < np.pi).all():
        return None
    return f"expected an angle below π, got {c}; convert degrees to radians"


def _fov_plane(c: Array, a: Array, b: Array) -> Pixel:
    scale = _fov_scale(c, a * a + b * b)
    return a * scale, b * scale


# The division model of Fitzgibbon (2001): k.


def _division_scale(c: Array, square: Array) -> Array:
    inside = 1 - 4 * c[0] * square
    return 2 / (1 + root(inside))


def _division_plane(c: Array, a: Array, b: Array) -> Pixel:
    scale = _division_scale(c, a * a + b * b)
    return a * scale, b * scale


def _division_radius(c: Array, r: Array) -> Array:
    return jnp.where(4 * c[0] * r * r <= 1, r * _division_scale(c, r * r), np.nan)


def _division_limit(c: Array) -> Array:
    """Return the radius at which the root of the model ends."""
    bent = c[0] > 0
    return jnp.where(bent, 0.5 / jnp.sqrt(jnp.where(bent, c[0], 1)), np.inf)


# f-theta: k0 … k5 of a polynomial, the affine c d e, and the largest angle.


def _affine(c: Array, ratio: Array, a: Array, b: Array) -> Pixel:
    p, q = a * ratio, b * ratio
    return c[6] * p + c[7] * q, c[8] * p + q


def _ftheta_radius(c: Array, angle: Array) -> Array:
    return polynomial([c[i] for i in range(6)], angle)


def _ftheta_plane(c: Array, a: Array, b: Array) -> Pixel:
    angle = root(a * a + b * b)
    return _affine(c, polynomial([c[i] for i in range(1, 6)], angle), a, b)


def _ftheta_inverse_radius(c: Array, angle: Array) -> Array:
    # The polynomial may fold beyond the largest angle: stop there.
    slope, end = lax.stop_gradient((c[1], c[9]))
    high = 4 * jnp.maximum(end, 1e-3) / slope
    part = jnp.asarray(np.linspace(0, 1, solvers.SAMPLES + 1), c.dtype)

    def stops(pixels: Array) -> Array:
        value, rise = jax.jvp(
            partial(_ftheta_radius, lax.stop_gradient(c)),
            (pixels,),
            (jnp.ones_like(pixels),),
        )
        return ~((rise > 0) & (value < 1.5 * end))

    last = jnp.minimum(solvers.first_true(stops, high * part), high)
    return solvers.invert_rising(_ftheta_radius, c, angle, last)


def _ftheta_inverse_plane(c: Array, a: Array, b: Array) -> Pixel:
    pixels = _ftheta_inverse_radius(c, root(a * a + b * b))
    return _affine(c, 1 / polynomial([c[i] for i in range(1, 6)], pixels), a, b)


def _ftheta_fault(c: np.ndarray) -> str | None:
    slope, end = c[..., 1], c[..., 9]
    if ((slope > 0) & (end > 0)).all():
        return None
    return (
        f"expected a slope k1 and a largest angle above 0, got {slope} and {end}; give "
        "k0 … k5, c, d, e and the largest angle, in this order"
    )


def _largest_angle(c: Array) -> Array:
    return c[9]


OPENCV = radial_lens(
    "opencv", (4, 5, 8, 12), Model(False, _opencv_plane, _opencv_radius, True)
)
FISHEYE = radial_lens(
    "fisheye", (4,), Model(True, _fisheye_plane, partial(_odd_radius, (0, 1, 2, 3)))
)
THIN_PRISM_FISHEYE = radial_lens(
    "thin_prism_fisheye",
    (8,),
    Model(True, _thin_prism_plane, partial(_odd_radius, (0, 1, 4, 5)), True),
)
RAD_TAN_THIN_PRISM_FISHEYE = radial_lens(
    "rad_tan_thin_prism_fisheye",
    (12,),
    Model(True, _rad_tan_thin_prism_plane, partial(_odd_radius, tuple(range(6))), True),
)
FOV = radial_lens(
    "fov",
    (1,),
    Model(False, _fov_plane, lambda c, r: r * _fov_scale(c, r * r)),
    _fov_fault,
)
DIVISION = radial_lens(
    "division",
    (1,),
    Model(False, _division_plane, _division_radius, limit=_division_limit),
)
FTHETA = radial_lens(
    "ftheta",
    (10,),
    Model(True, _ftheta_plane, _ftheta_radius, limit=_largest_angle),
    _ftheta_fault,
)
FTHETA_INVERSE = radial_lens(
    "ftheta_inverse",
    (10,),
    Model(True, _ftheta_inverse_plane, _ftheta_inverse_radius, limit=_largest_angle),
    _ftheta_fault,
)
