"""Distortion of photographs, and the maps that resample them to an ideal pinhole.

Pixel centres are at + 0.5. The lens functions are those of the renderer.
"""

from typing import NamedTuple

import numpy as np

from gsjax.cameras.lenses import LENSES, Lens
from gsjax.errors import InputError

_BAND = 256  # rows processed at a time; float64 maps of a whole photograph are large
_REACH = 1 / 64  # px beyond the border that count as rounding


class Distortion(NamedTuple):
    """The distortion of a photograph.

    Attributes:
      model: name of a lens with coefficients: "opencv" (k1 k2 p1 p2 [k3 [k4 k5 k6]]) or
        "fisheye" (k1 k2 k3 k4).
      coefficients: as many as the lens accepts, in OpenCV's order.
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
        if lens is None or count not in lens.counts or count == 0:
            choices = {each.name: each.counts for each in LENSES.values()}
            known = ", ".join(f"{k} with {v}" for k, v in choices.items() if any(v))
            raise InputError(
                f"lens: expected {known} coefficients, got {self.model!r} with {count}"
            )
        return lens


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
    lens, c = distortion.lens, np.asarray(distortion.coefficients, np.float64)
    point = (x, y, np.ones_like(x))
    xd, yd = lens.project(np.eye(3), c, point)
    valid = lens.valid(np.eye(3), c, point)
    return np.where(valid, xd, np.nan), np.where(valid, yd, np.nan)


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
