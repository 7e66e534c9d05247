"""Lenses of photographs, and the maps that resample them to an ideal pinhole.

Pixel centres are at + 0.5. The lens functions are those of the renderer.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.cameras.lenses import LENSES, OPENCV, PINHOLE, Lens
from gsjax.errors import InputError

_BAND = 256  # rows processed at a time; float64 maps of a whole photograph are large
_REACH = 1 / 64  # px beyond the border that count as rounding


class Distortion(NamedTuple):
    """The lens of a photograph that is no ideal pinhole.

    Attributes:
      model: name of a lens of `gsjax.cameras.lenses.LENSES`.
      coefficients: as many as the lens accepts.
    """

    model: str
    coefficients: tuple[float, ...]

    @property
    def lens(self) -> Lens:
        """The lens functions.

        Raises:
          InputError: if there is no such model, or it takes another number of
            coefficients.
        """
        lens, count = LENSES.get(self.model), len(self.coefficients)
        if lens is None or count not in lens.counts:
            choices = {each.name: each.counts for each in LENSES.values()}
            known = ", ".join(f"{k} with {v}" for k, v in choices.items())
            raise InputError(
                f"lens: expected {known} coefficients, got {self.model!r} with {count}"
            )
        return lens


def distortion_of(camera: Camera) -> Distortion | None:
    """Return the lens of a single camera by name; None for a pinhole."""
    if camera.lens is PINHOLE:
        return None
    c = camera.coefficients
    values = () if c is None else tuple(np.asarray(c, np.float64).tolist())
    return Distortion(camera.lens.name, values)


def lens_fields(
    lenses: Sequence[Distortion | None], distorting: bool = False
) -> dict[str, Any]:
    """Return the lens of several cameras, as arguments of `make_camera`.

    Args:
      lenses: of V cameras; None is a pinhole.
      distorting: give pinholes the OpenCV lens of zero coefficients, to be optimised.

    Returns:
      ``lens`` and ``coefficients``, [V, M] or None. OpenCV lenses of different numbers
      of coefficients, and pinholes among them, get zeros.

    Raises:
      InputError: if the cameras have lenses of different kinds, or as `Distortion`.
    """
    found = {None if d is None else d.lens.name for d in lenses}
    if found == {None} and not distorting:
        return {"lens": PINHOLE, "coefficients": None}
    names = {"opencv" if name is None else name for name in found}
    if len(names) > 1:
        kinds = sorted("pinhole" if name is None else name for name in found)
        raise InputError(
            f"lenses: expected one kind for all photographs, got {', '.join(kinds)}; "
            "undistort them (undistort=True, --undistort), or use those of one lens"
        )
    given = [() if d is None else d.coefficients for d in lenses]
    lens = LENSES[names.pop()]
    count = max(len(values) for values in given)
    if lens is OPENCV:
        count = max(count, OPENCV.counts[0])
    rows = [(*values, *(0.0,) * (count - len(values))) for values in given]
    return {"lens": lens, "coefficients": np.array(rows) if count else None}


def single_lens_fields(lens: Distortion | None) -> dict[str, Any]:
    """Return `lens_fields` of one camera, for `make_camera` without a batch."""
    fields = lens_fields([lens])
    c = fields["coefficients"]
    return {**fields, "coefficients": None if c is None else c[0]}


def project_points(
    distortion: Distortion | None, K: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project camera points in float64 on the host.

    Args:
      distortion: None for a pinhole.
      K: [3, 3] intrinsics, px.
      points: [M, 3].

    Returns:
      Pixels [M, 2]; depths [M] by the lens; and [M] bool, True where a point has an
      image (inside of the photograph or not).
    """
    if distortion is None:
        depth = points[:, 2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            plane = points[:, :2] / depth[:, None]
            return plane * K[(0, 1), (0, 1)] + K[:2, 2], depth, depth > 0
    with jax.enable_x64(True):
        c = jnp.asarray(distortion.coefficients, jnp.float64)
        found = _project(distortion.lens, K, c, jnp.asarray(points, jnp.float64))
        return tuple(np.asarray(a) for a in found)  # pyright: ignore


@partial(jax.jit, static_argnums=0)
def _project(lens: Lens, K: jax.Array, c: jax.Array, points: jax.Array):
    at = tuple(points.T)
    depth = lens.depth(at)  # pyright: ignore
    seen = lens.valid(K, c, at) & (depth > 0)  # pyright: ignore
    return jnp.stack(lens.project(K, c, at), -1), depth, seen  # pyright: ignore


def distort(
    distortion: Distortion, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return distorted coordinates at unit focal length; NaN beyond the fold.

    Args:
      distortion: lens and coefficients.
      x, y: undistorted coordinates at unit focal length, of any one shape.

    Raises:
      InputError: if the lens is unknown or takes another number of coefficients.
    """
    with jax.enable_x64(True):
        coefficients = jnp.asarray(distortion.coefficients, jnp.float64)
        found = _distorted(distortion.lens, coefficients, x, y)
        return np.asarray(found[0]), np.asarray(found[1])


@partial(jax.jit, static_argnums=0)
def _distorted(lens: Lens, c: jax.Array, x: jax.Array, y: jax.Array):
    K, point = jnp.eye(3), (x, y, jnp.ones_like(x))
    valid = lens.valid(K, c, point)
    return tuple(jnp.where(valid, a, jnp.nan) for a in lens.project(K, c, point))


def imaged_pixels(
    distortion: Distortion, K: np.ndarray, width: int, height: int
) -> np.ndarray:
    """Return [H, W] bool: whether a direction is imaged to each pixel's centre.

    Beyond the fold of a lens, or the edge of a fisheye's circle, there is none.
    """
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    border = [
        (x, 0 * x + y[0]),
        (x, 0 * x + y[-1]),
        (0 * y + x[0], y),
        (0 * y + x[-1], y),
    ]
    few = np.meshgrid(x[:: max(1, width // 32)], y[:: max(1, height // 32)])
    some = [*border, tuple(a.ravel() for a in few)]
    if all(_imaged(distortion, K, *pixels).all() for pixels in some):
        return np.ones((height, width), bool)
    parts = []
    for top in range(0, height, _BAND):
        pixels = np.broadcast_arrays(x, y[top : top + _BAND, None])
        parts.append(_imaged(distortion, K, *pixels))
    return np.concatenate(parts)


def _imaged(distortion: Distortion, K: np.ndarray, u, v) -> np.ndarray:
    with jax.enable_x64(True):
        c = jnp.asarray(distortion.coefficients, jnp.float64)
        found = _round_trip(distortion.lens, jnp.asarray(K, jnp.float64), c, (u, v))
        return np.asarray(found)


@partial(jax.jit, static_argnums=0)
def _round_trip(lens: Lens, K: jax.Array, c: jax.Array, pixel):
    ray = lens.unproject(K, c, pixel)
    again = lens.project(K, c, ray)
    off = sum(jnp.abs(a - b) for a, b in zip(again, pixel))
    return lens.valid(K, c, ray) & (off < 0.1)


def undistortion_maps(
    distortion: Distortion, K: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the source of every pixel of an ideal pinhole with the same K and size.

    Returns:
      Two [H, W] float32 arrays for `cv2.remap` (pixel centres at whole numbers), and
      [H, W] bool, True if the source lies in the photograph.

    Raises:
      InputError: as `distort`.
    """
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    map_x = np.empty((height, width), np.float32)
    map_y = np.empty((height, width), np.float32)
    x = (np.arange(width) + 0.5 - cx) / fx
    y = (np.arange(height) + 0.5 - cy) / fy
    for top in range(0, height, _BAND):
        rows = slice(top, top + _BAND)
        xd, yd = distort(distortion, *np.broadcast_arrays(x, y[rows, None]))
        map_x[rows], map_y[rows] = xd * fx + (cx - 0.5), yd * fy + (cy - 0.5)
    # Bilinear interpolation needs a neighbour on either side.
    valid = (map_x >= -_REACH) & (map_x <= width - 1 + _REACH)
    valid &= (map_y >= -_REACH) & (map_y <= height - 1 + _REACH)
    map_x[~valid] = map_y[~valid] = -2
    return map_x, map_y, valid
