"""Lenses that see (almost) every direction: panorama, unified camera and lidar."""

from collections.abc import Callable
from functools import cache, partial

import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.cameras.lens import (
    Array,
    Length,
    Lens,
    Pixel,
    Point,
    edge_radius,
    from_pixel,
    range_depth,
    root,
    to_pixel,
)


def _angles(point: Point) -> Pixel:
    """Return azimuth to the right and elevation downwards; 0 azimuth on the poles."""
    x, y, z = point
    square = x * x + z * z
    off = square > 0
    azimuth = jnp.arctan2(jnp.where(off, x, 0), jnp.where(off, z, 1))
    flat = root(square)
    there = off | (y != 0)
    return azimuth, jnp.arctan2(jnp.where(there, y, 0), jnp.where(there, flat, 1))


def _direction(azimuth: Array, elevation: Array) -> Point:
    flat = jnp.cos(elevation)
    return jnp.sin(azimuth) * flat, jnp.sin(elevation), jnp.cos(azimuth) * flat


def _off_the_centre(K: Array, c: Array, point: Point) -> Array:
    del K, c
    return range_depth(point) > 0


def _limit_latitude(
    K: Array, c: Array, size: tuple[Length, Length], point: Point
) -> Point:
    """Keep ``point`` one row from the poles, where the Jacobian has no bound."""
    del c, size
    return _off_the_poles(1 / K[1, 1], point)


def _off_the_poles(margin: Array, point: Point) -> Point:
    """Keep ``point`` at an angle of ``margin`` or half a radian from the poles."""
    x, y, z = point
    margin = jnp.minimum(margin, 0.5)
    limit = lax.stop_gradient(jnp.tan(0.5 * np.pi - margin))
    square = x * x + z * z
    steep = (square > 0) & (y * y > limit * limit * square)
    far = jnp.where(steep, range_depth(point), 1)
    flat = jnp.where(steep, far / jnp.sqrt(1 + limit * limit), 1)
    turn = jnp.where(steep, flat / jnp.sqrt(jnp.where(steep, square, 1)), 1)
    return x * turn, jnp.where(steep, jnp.sign(y) * limit * flat, y), z * turn


# 360° × 180°: fx is the width over 2π, fy the height over π.
EQUIRECTANGULAR = Lens(
    name="equirectangular",
    counts=(0,),
    project=lambda K, _, point: to_pixel(K, *_angles(point)),
    unproject=lambda K, _, pixel: _direction(*from_pixel(K, pixel)),
    valid=_off_the_centre,
    depth=range_depth,
    linearise=_limit_latitude,
    period=lambda K, _: 2 * np.pi * K[0, 0],
)


def panorama_intrinsics(width: int, height: int) -> np.ndarray:
    """Return K [3, 3] of an equirectangular image of the whole sphere."""
    fx, fy = width / (2 * np.pi), height / np.pi
    return np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1.0]])


# The enhanced unified camera model of Khomutenko et al. (2016): α β.


def _eucm_parts(c: Array, point: Point) -> tuple[Array, Array]:
    """Return d = √(β ρ² + z²) and the denominator."""
    x, y, z = point
    d = root(c[1] * (x * x + y * y) + z * z)
    return d, c[0] * d + (1 - c[0]) * z


def _eucm_project(K: Array, c: Array, point: Point) -> Pixel:
    _, below = _eucm_parts(c, point)
    below = jnp.where(below > 0, below, 1)
    return to_pixel(K, point[0] / below, point[1] / below)


def _eucm_unproject(K: Array, c: Array, pixel: Pixel) -> Point:
    a, b = from_pixel(K, pixel)
    return a, b, _eucm_depth(c, a * a + b * b)


def _eucm_depth(c: Array, square: Array) -> Array:
    alpha, beta = c[0], c[1]
    under = root(1 - (2 * alpha - 1) * beta * square)
    return (1 - beta * alpha * alpha * square) / (alpha * under + 1 - alpha)


def _eucm_valid(K: Array, c: Array, point: Point) -> Array:
    del K
    d, below = _eucm_parts(c, point)
    low = c[0] <= 0.5
    ratio = jnp.where(low, c[0], 1 - c[0]) / jnp.where(low, 1 - c[0], c[0])
    return (below > 0) & (point[2] > -ratio * d)


def _eucm_linearise(
    K: Array, c: Array, size: tuple[Length, Length], point: Point
) -> Point:
    """Move ``point`` to where the image of its direction ends."""
    limit = edge_radius(K, size)
    # Past this radius no direction is imaged.
    bend = (2 * c[0] - 1) * c[1]
    most = jnp.where(bend > 0, 0.999 / jnp.sqrt(jnp.where(bend > 0, bend, 1)), limit)
    limit = lax.stop_gradient(jnp.minimum(limit, most))
    x, y, z = point
    _, below = _eucm_parts(c, point)
    square = x * x + y * y
    out = (square > 0) & (square > (limit * jnp.maximum(below, 0)) ** 2)
    ahead = _eucm_depth(lax.stop_gradient(c), limit * limit)
    norm = range_depth(point) / jnp.sqrt(limit * limit + ahead * ahead)
    turn = jnp.where(out, limit * norm / jnp.sqrt(jnp.where(out, square, 1)), 1)
    return x * turn, y * turn, jnp.where(out, ahead * norm, z)


def _eucm_fault(c: np.ndarray) -> str | None:
    alpha, beta = c[..., 0], c[..., 1]
    if ((alpha >= 0) & (alpha <= 1) & (beta > 0)).all():
        return None
    return f"expected alpha in [0, 1] and beta above 0, got {c}; check their order"


EUCM = Lens(
    name="eucm",
    counts=(2,),
    project=_eucm_project,
    unproject=_eucm_unproject,
    valid=_eucm_valid,
    depth=range_depth,
    linearise=_eucm_linearise,
    fault=_eucm_fault,
)


# A spinning lidar: rows of given elevation, columns of given azimuth.


def lidar_coefficients(elevations, azimuths, offsets=None) -> np.ndarray:
    """Return the coefficients of a lidar from its tables, in radians.

    Args:
      elevations: [rows] above the horizon, falling.
      azimuths: [columns] from forward to the left, in firing order; wrapped or not.
      offsets: [rows] added to the azimuths of a row; default 0.
    """
    elevations = np.asarray(elevations, np.float64)
    azimuths = np.unwrap(np.asarray(azimuths, np.float64))
    if offsets is None:
        offsets = np.zeros_like(elevations)
    return np.concatenate([elevations, azimuths, np.asarray(offsets, np.float64)])


def _at(table: Array, place: Array) -> Array:
    """Interpolate a table [n] at places in 0 … n − 1, and extend it linearly."""
    low = jnp.clip(jnp.floor(lax.stop_gradient(place)), 0, table.shape[0] - 2)
    low = low.astype(jnp.int32)
    first = table[low]
    return first + (table[low + 1] - first) * (place - low)


def _place(table: Array, value: Array) -> Array:
    """Return where a monotone table [n] has a value; the inverse of `_at`."""
    rising = table[-1] > table[0]
    sign = jnp.where(rising, 1, -1)
    after = jnp.searchsorted(sign * table, sign * lax.stop_gradient(value))
    low = jnp.clip(after - 1, 0, table.shape[0] - 2)
    first, span = table[low], table[low + 1] - table[low]
    return low + (value - first) / jnp.where(span == 0, 1, span)


def _nearest(elevations: Array, elevation: Array) -> Array:
    place = _place(elevations, lax.stop_gradient(elevation))
    low = jnp.clip(jnp.floor(place), 0, elevations.shape[0] - 2).astype(jnp.int32)
    above = jnp.abs(elevations[low] - elevation)
    return jnp.where(above <= jnp.abs(elevations[low + 1] - elevation), low, low + 1)


def _lidar_project(split: Callable, K: Array, c: Array, point: Point) -> Pixel:
    elevations, azimuths, offsets = split(c)
    right, down = _angles(point)
    elevation = -down
    row = _place(elevations, elevation)
    # The turn nearest to the middle of the table.
    azimuth = -right - offsets[_nearest(elevations, elevation)]
    turns = jnp.round((0.5 * (azimuths[0] + azimuths[-1]) - azimuth) / (2 * np.pi))
    column = _place(azimuths, azimuth + 2 * np.pi * lax.stop_gradient(turns))
    return to_pixel(K, column, row)


def _lidar_unproject(split: Callable, K: Array, c: Array, pixel: Pixel) -> Point:
    elevations, azimuths, offsets = split(c)
    column, row = from_pixel(K, pixel)
    elevation = _at(elevations, row)
    nearest = jnp.clip(jnp.round(row), 0, elevations.shape[0] - 1).astype(jnp.int32)
    azimuth = _at(azimuths, column) + offsets[nearest]
    return _direction(-azimuth, -elevation)


def _lidar_period(split: Callable, K: Array, c: Array) -> Array:
    """Return the columns of one turn, by the mean step of the table."""
    _, azimuths, _ = split(c)
    step = jnp.abs(azimuths[-1] - azimuths[0]) / (azimuths.shape[0] - 1)
    # A camera that is not drawn must not spoil derivatives: 0 · ∞ is NaN.
    focal = jnp.where(jnp.abs(K[0, 0]) < 1e15, K[0, 0], 1)
    return focal * 2 * np.pi / jnp.where(step > 1e-6, step, 1)


def _lidar_linearise(
    split: Callable, K: Array, c: Array, size: tuple[Length, Length], point: Point
) -> Point:
    """Keep ``point`` the mean step between rows from the poles."""
    del K, size
    elevations, _, _ = split(c)
    step = jnp.abs(elevations[-1] - elevations[0]) / (elevations.shape[0] - 1)
    return _off_the_poles(jnp.where(step > 0, step, 0.5), point)


@cache
def lidar_lens(rows: int, columns: int) -> Lens:
    """Return the lens of a spinning lidar with ``rows`` × ``columns`` beams.

    A pixel is a beam: column and row of the tables at the pixel's centre, with
    K = [[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]. The coefficients are those of
    `lidar_coefficients`. The lidar's forward, left and up are the camera's z, −x and
    −y. A Gaussian is drawn in all rows with the offset of the row nearest to its mean,
    so where rows differ, it is displaced in them by the difference of their offsets.
    """

    def split(c: Array) -> tuple[Array, Array, Array]:
        return c[:rows], c[rows : rows + columns], c[rows + columns :]

    return Lens(
        name="lidar",
        counts=(2 * rows + columns,),
        project=partial(_lidar_project, split),
        unproject=partial(_lidar_unproject, split),
        valid=_off_the_centre,
        depth=range_depth,
        linearise=partial(_lidar_linearise, split),
        period=partial(_lidar_period, split),
    )
