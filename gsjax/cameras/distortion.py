"""Where the pixels of an ideal pinhole lie in a photograph taken through a lens.

Coordinates are those of the package, pixel centres at + 0.5.
"""

import numpy as np

from gsjax.data.types import Distortion
from gsjax.errors import InputError

_SAMPLES = 4096
_BAND = 256


def distort(
    lens: Distortion, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distorted image coordinates at unit focal length of undistorted ones.

    Brown–Conrady with a rational radial part, or Kannala–Brandt, both as OpenCV
    documents them. Past the fold, where the model turns back inwards and would show
    the same pixels once more, the result is NaN.

    Args:
      lens: the lens.
      x, y: of any one shape.
    """
    radius = np.hypot(x, y)
    limit = _fold(lens, float(radius.max(initial=0.0)))
    if lens.model == "fisheye":
        scale = _radial(lens, radius)
        xd, yd = x * scale, y * scale
    else:
        _, _, p1, p2, *_ = _coefficients(lens)
        scale, square = _radial(lens, radius), radius * radius
        xd = x * scale + 2 * p1 * x * y + p2 * (square + 2 * x * x)
        yd = y * scale + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    beyond = radius > limit
    if beyond.any():
        xd[beyond] = yd[beyond] = np.nan
    return xd, yd


def _coefficients(lens: Distortion) -> list[float]:
    """All coefficients of the kind, those that are not given as 0."""
    counts = {"radial_tangential": ((4, 5, 8), 8), "fisheye": ((4,), 4)}
    given, full = counts.get(lens.model, ((), 0))
    if len(lens.coefficients) not in given:
        raise InputError(
            f"lens {lens.model!r} with {len(lens.coefficients)} coefficients; wanted: "
            "radial_tangential with 4, 5 or 8, or fisheye with 4"
        )
    return [*lens.coefficients, *[0.0] * (full - len(lens.coefficients))]


def _radial(lens: Distortion, radius: np.ndarray) -> np.ndarray:
    """Distorted over undistorted radius."""
    if lens.model == "fisheye":
        k1, k2, k3, k4 = _coefficients(lens)
        angle = np.arctan(radius)
        t = angle * angle
        scale = 1 + t * (k1 + t * (k2 + t * (k3 + t * k4)))
        small = radius < 1e-8
        return scale * np.where(small, 1.0, angle / np.where(small, 1.0, radius))
    k1, k2, _, _, k3, k4, k5, k6 = _coefficients(lens)
    s = radius * radius
    above = 1 + s * (k1 + s * (k2 + s * k3))
    below = 1 + s * (k4 + s * (k5 + s * k6))
    return above / np.where(below > 0, below, np.nan)


def _fold(lens: Distortion, largest: float) -> float:
    """Radius up to which the distorted radius grows, searched for up to ``largest``."""
    radii = np.linspace(0, largest * (1 + 1 / _SAMPLES), _SAMPLES)
    distorted = radii * _radial(lens, radii)
    falls = np.flatnonzero(~(np.diff(distorted) > 0))
    return float(radii[falls[0]]) if len(falls) and largest > 0 else np.inf


def undistortion_maps(
    lens: Distortion, K: np.ndarray, width: int, height: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sources of the pixels of an ideal pinhole of the same K and size.

    Returns:
      Two [H, W] float32 arrays for `cv2.remap` (pixel centres at whole numbers), and
      [H, W] bool: where the source lies in the photograph.
    """
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    map_x = np.empty((height, width), np.float32)
    map_y = np.empty((height, width), np.float32)
    x = (np.arange(width) + 0.5 - cx) / fx
    y = (np.arange(height) + 0.5 - cy) / fy
    for top in range(0, height, _BAND):  # in bands: float64 is large
        rows = slice(top, top + _BAND)
        xd, yd = distort(lens, *np.broadcast_arrays(x, y[rows, None]))
        map_x[rows], map_y[rows] = xd * fx + (cx - 0.5), yd * fy + (cy - 0.5)
    # Bilinear interpolation needs a neighbour on either side; 1/64 px is rounding.
    slack = 1 / 64
    valid = (map_x >= -slack) & (map_x <= width - 1 + slack)
    valid &= (map_y >= -slack) & (map_y <= height - 1 + slack)
    map_x[~valid] = map_y[~valid] = -2
    return map_x, map_y, valid
