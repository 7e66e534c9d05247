"""Shutters: the pose from which each point is seen.

A global shutter exposes the whole image at one pose. A rolling shutter exposes rows or
columns one after another while the camera moves. The time at which a point is exposed
then depends on where it falls, and that on the time: `expose` solves for both.

The motion is `Camera.twist`, a rotation vector ω and a translation τ: at time t of the
exposure, in 0 … 1, the rotation of the view matrix is exp(t ω) R and its translation is
T + t τ. That is the interpolation of world → camera poses by slerp and lerp.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.cameras.lens import polynomial, sine_ratio
from gsjax.errors import InputError
from gsjax.math.numerics import materialize

Array = Any
Camera = Any  # `gsjax.cameras.camera.Camera`, which imports this module
Point = tuple[Array, ...]  # x, y, z

_FASTEST = 0.9  # speed of an image that is followed; that of the shutter is 1
# Of sin(√x) / √x and (1 − cos √x) / x; the rest is below 1e-17 up to x = 1.
_SINE = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(10))
_COSINE = tuple((-1.0) ** k / math.factorial(2 * k + 2) for k in range(10))
_SMALL_TURN = 1 / 1.5**2  # squared, in rad: x is then at most 1
_TIMES = (-0.5, 1.5)  # what lies farther outside the image is not followed


class Shutter(NamedTuple):
    """When a point of the image is exposed, as a linear function of its place.

    The time is start + along_u · u / width + along_v · v / height, from 0 to 1 over the
    image. All three are 0 for a global shutter.

    Attributes:
      name: the name in files and messages.
      start, along_u, along_v: the coefficients of the time.
    """

    name: str
    start: float = 0.0
    along_u: float = 0.0
    along_v: float = 0.0

    @property
    def rolling(self) -> bool:
        """Return whether places of the image are exposed at different times."""
        return bool(self.along_u or self.along_v)


GLOBAL = Shutter("global")
SHUTTERS = {
    shutter.name: shutter
    for shutter in (
        GLOBAL,
        Shutter("top_to_bottom", 0.0, 0.0, 1.0),
        Shutter("bottom_to_top", 1.0, 0.0, -1.0),
        Shutter("left_to_right", 0.0, 1.0, 0.0),
        Shutter("right_to_left", 1.0, -1.0, 0.0),
    )
}


def find_shutter(shutter: str | Shutter) -> Shutter:
    """Return the shutter of a name; a `Shutter` is returned unchanged.

    Raises:
      InputError: if the name is unknown, or ``shutter`` is of another type.
    """
    if isinstance(shutter, Shutter):
        return shutter
    if isinstance(shutter, str) and shutter in SHUTTERS:
        return SHUTTERS[shutter]
    raise InputError(
        f"shutter: expected a gsjax.cameras.shutter.Shutter or one of "
        f"{sorted(SHUTTERS)}, got {shutter!r}"
    )


class Moment(NamedTuple):
    """The turn of a camera at a time t of its exposure, by Rodrigues.

    A vector v is turned to v + a ω × v + b ω × (ω × v), with θ = |ω|.

    Attributes:
      time: t.
      a: sin(t θ) / θ.
      slope: cos(t θ), the derivative of ``a``.
      b: (1 − cos(t θ)) / θ², of derivative ``a``.
    """

    time: Array
    a: Array
    slope: Array
    b: Array


class Exposure(NamedTuple):
    """Points as a camera saw them.

    Attributes:
      point: (x, y, z) in camera coordinates.
      viewmat: [4, 4] world → camera; a rolling shutter has rows of entries of the
        shape of the components.
      velocity: change of ``point`` over the exposure, or None.
      moment: when each point is exposed, or None.
    """

    point: Point
    viewmat: Array
    velocity: Point | None = None
    moment: Moment | None = None


def entry(viewmat: Array, i: int, j: int) -> Array:
    """Return an entry of `Exposure.viewmat`."""
    return viewmat[i][j] if isinstance(viewmat, tuple) else viewmat[i, j]


def centre(exposure: Exposure) -> Point:
    """Return the position of the camera in world coordinates."""
    view = exposure.viewmat
    return tuple(
        -sum(entry(view, i, j) * entry(view, i, 3) for i in range(3)) for j in range(3)
    )


def transform_point(viewmat: Array, point: Point) -> Point:
    """Return camera coordinates of a world point, as components; viewmat is [4, 4]."""
    return tuple(
        sum(viewmat[i, j] * point[j] for j in range(3)) + viewmat[i, 3]
        for i in range(3)
    )


def expose(camera: Camera, point: Point) -> Exposure:
    """Return world points in camera coordinates at the time of their exposure.

    Args:
      camera: a single camera.
      point: (x, y, z) in world coordinates.
    """
    if not camera.shutter.rolling or camera.twist is None:
        return Exposure(transform_point(camera.viewmat, point), camera.viewmat)
    path = _Path(*(materialize(part) for part in _path_of(camera, point)))
    (t,) = materialize((_time(camera, path),))
    moment = Moment(*materialize(moment_at(camera, t)))
    seen, velocity = _moving(camera, path, moment)
    view = _viewmat(camera, moment)
    return Exposure(materialize(seen), view, materialize(velocity), moment)


def moment_at(camera: Camera, time: Array) -> Moment:
    """Return the turn of a single camera at a time, of magnitude 1.5 at most."""
    square = sum(camera.twist[i] * camera.twist[i] for i in range(3))
    x = time * time * square
    sine, cosine = lax.cond(square < _SMALL_TURN, _series, _closed, x)
    return Moment(time, time * sine, 1 - x * cosine, time * time * cosine)


def _series(x: Array) -> tuple[Array, Array]:
    return polynomial(_SINE, x), polynomial(_COSINE, x)


def _closed(x: Array) -> tuple[Array, Array]:
    half = sine_ratio(0.25 * x)
    return sine_ratio(x), 0.5 * half * half


def exposed_at(camera: Camera, point: Point, moment: Moment) -> Point:
    """Return world points in camera coordinates at a moment of the exposure."""
    return _moving(camera, _path_of(camera, point), moment)[0]


class _Path(NamedTuple):
    """Camera coordinates of points: start + a turn + b back + t τ, see `Moment`."""

    start: Point
    turn: Point
    back: Point


def _turns(twist: Array, columns) -> tuple[list[Array], list[Array]]:
    """Return ω × v and ω × (ω × v) of vectors v = (x, y, z)."""
    once = _cross(twist, columns)
    return once, _cross(twist, once)


def _cross(a, b) -> list[Array]:
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def _path_of(camera: Camera, point: Point) -> _Path:
    view = camera.viewmat
    turned = [sum(view[i, j] * point[j] for j in range(3)) for i in range(3)]
    once, twice = _turns(camera.twist, turned)
    start = tuple(p + view[i, 3] for i, p in enumerate(turned))
    return _Path(start, tuple(once), tuple(twice))  # pyright: ignore


@jax.custom_jvp
def _time(camera: Camera, path: _Path) -> Array:
    """Return when points are exposed, by Newton's method."""
    low, high = _TIMES

    def step(_, t: Array) -> Array:
        wanted, speed, good = _exposed_later(camera, path, t)
        off = wanted - t
        # A point that overtakes the shutter has no time of exposure, or several.
        far = jnp.sign(off) * (high - low)
        change = jnp.where(speed < _FASTEST, off / _ahead(speed), far)
        t = t + jnp.where(good, change, 0)
        return jnp.where(t > low, jnp.where(t < high, t, high), low)

    t = jnp.full_like(path.start[0], 0.5)
    # Each step squares the error: three are enough for float32.
    return lax.fori_loop(0, 4 if t.dtype == jnp.float64 else 3, step, t)


@_time.defjvp
def _time_jvp(primals, tangents):
    """Differentiate t = τ(t) implicitly: dt = dτ / (1 − dτ/dt), with τ of the image."""
    camera, path = primals
    t = _time(camera, path)

    def wanted(camera: Camera, path: _Path):
        time, *rest = _exposed_later(camera, path, t)
        return time, rest

    _, change, (speed, good) = jax.jvp(wanted, primals, tangents, has_aux=True)
    low, high = _TIMES
    good &= (speed < _FASTEST) & (t > low) & (t < high)
    return t, jnp.where(good, change / _ahead(speed), 0)


def _exposed_later(camera: Camera, path: _Path, t: Array):
    """Return when the shutter is where points are seen at ``t``, its change, and where.

    Returns:
      the time, its derivative by ``t``, and a mask, False for points not before the
      camera.
    """
    seen, velocity = _moving(camera, path, moment_at(camera, t))
    good = camera.lens.depth(seen) > 0.5 * camera.near
    seen = tuple(jnp.where(good, p, e) for p, e in zip(seen, (0, 0, 1)))
    velocity = tuple(jnp.where(good, v, 0) for v in velocity)
    (u, v), (du, dv) = jax.jvp(lambda *p: camera.project(p), seen, velocity)
    width, height = camera.visible
    shutter = camera.shutter
    time = shutter.start + shutter.along_u * u / width + shutter.along_v * v / height
    return time, shutter.along_u * du / width + shutter.along_v * dv / height, good


def _ahead(speed: Array) -> Array:
    """Return how much faster the shutter is than a point of the image, above 0."""
    return 1 - jnp.where(speed < _FASTEST, speed, _FASTEST)


def _moving(camera: Camera, path: _Path, at: Moment) -> tuple[Point, Point]:
    """Return camera coordinates at a moment, and their change by the time."""
    shift = [camera.twist[3 + i] for i in range(3)]
    rows = list(zip(path.start, path.turn, path.back, shift))
    return (
        tuple(p + at.a * q + at.b * r + at.time * s for p, q, r, s in rows),
        tuple(at.slope * q + at.a * r + s for _, q, r, s in rows),
    )


def _viewmat(camera: Camera, at: Moment):
    """Return the entries of the view matrix at a moment, as rows of components."""
    view, twist = camera.viewmat, camera.twist
    once, twice = _turns(twist, [view[i, :3] for i in range(3)])
    return tuple(
        (
            *(view[i, j] + at.a * once[i][j] + at.b * twice[i][j] for j in range(3)),
            view[i, 3] + at.time * twist[3 + i],
        )
        for i in range(3)
    )


def image_rows(camera: Camera, exposure: Exposure, jacobian) -> Any:
    """Return the rows d(u, v) / d world of the image of a point, [3] each.

    Under a rolling shutter a moved point is exposed at another time:
    dt/dp = ∇τ J W / (1 − ∇τ · du/dt), and its image moves by du/dt · dt/dp.

    Args:
      camera: a single camera.
      exposure: from `expose`.
      jacobian: rows (du/d·, dv/d·) of the lens at the point.
    """
    rows: Any = [
        [
            sum(row[i] * entry(exposure.viewmat, i, j) for i in range(3))
            for j in range(3)
        ]
        for row in jacobian
    ]
    if exposure.velocity is None:
        return rows
    rows = [materialize(tuple(row)) for row in rows]
    width, height = camera.visible
    slopes = camera.shutter.along_u / width, camera.shutter.along_v / height
    speeds = [sum(j * v for j, v in zip(row, exposure.velocity)) for row in jacobian]
    below = _ahead(sum(s * v for s, v in zip(slopes, speeds)))
    by_time = materialize(
        tuple((slopes[0] * p + slopes[1] * q) / below for p, q in zip(*rows))
    )
    return [
        [r + speed * t for r, t in zip(row, by_time)]
        for row, speed in zip(rows, speeds)
    ]


def twist_between(start, end) -> np.ndarray:
    """Return the twist [..., 6] that takes one view matrix [..., 4, 4] to another.

    On the host. The rotation takes the shorter way.
    """
    from scipy.spatial.transform import Rotation

    start, end = (np.asarray(m, np.float64) for m in (start, end))
    turn = end[..., :3, :3] @ np.swapaxes(start[..., :3, :3], -1, -2)
    vector = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec()
    shift = end[..., :3, 3] - start[..., :3, 3]
    return np.concatenate([vector.reshape(shift.shape), shift], -1)
