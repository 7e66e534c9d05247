"""Lenses and rolling shutters of the ray caster, independent of the renderer's.

Lenses are inverted by OpenCV, and poses are interpolated by SciPy.

Axis legend: R rays.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from gsjax.errors import InputError
from gsjax.io import images

_ITERATIONS, _TOLERANCE = 200, 1e-12
_OFF = 1e-3  # px between a pixel and the image of its ray, at most
# (start, along u, along v) of the time of exposure, from 0 to 1.
_TIMES = {
    "top_to_bottom": (0, 0, 1),
    "bottom_to_top": (1, 0, -1),
    "left_to_right": (0, 1, 0),
    "right_to_left": (1, -1, 0),
}


class Optics(NamedTuple):
    """The lens and the shutter of ray-cast photographs.

    Attributes:
      lens: "pinhole", "opencv" or "fisheye", of less than 180°.
      coefficients: distortion in the order of OpenCV.
      shutter: "global", or the name of a rolling shutter of `gsjax.cameras.shutter`.
      twist: [6] rotation vector ω and translation τ of the view matrix over the
        exposure: at time t, from 0 to 1, it is (exp(t ω) R, T + t τ).
    """

    lens: str = "pinhole"
    coefficients: Sequence[float] = ()
    shutter: str = "global"
    twist: Sequence[float] | np.ndarray | None = None


PINHOLE = Optics()


def local_rays(optics: Optics, K, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return directions [3, R] of pixels [R] in camera coordinates, with z = 1.

    Raises:
      InputError: if the lens is unknown, or no direction is imaged to a pixel.
    """
    K = np.asarray(K, np.float64)
    if optics.lens == "pinhole":
        x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
        return np.stack([x, y, np.ones_like(x)])
    cv2, c = images.opencv(), np.asarray(optics.coefficients, np.float64)
    pixels = np.ascontiguousarray(np.stack([u, v], -1)[:, None], np.float64)
    still = np.zeros(3)
    kind = cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS
    stop = kind, _ITERATIONS, _TOLERANCE
    if optics.lens == "opencv":
        if hasattr(cv2, "undistortPointsIter"):  # before OpenCV 5
            plane = cv2.undistortPointsIter(pixels, K, c, None, None, stop)
        else:
            plane = cv2.undistortPoints(pixels, K, c, criteria=stop)
        again, _ = cv2.projectPoints(_homogeneous(plane), still, still, K, c)
    elif optics.lens == "fisheye":
        plane = cv2.fisheye.undistortPoints(pixels, K, c, criteria=stop)
        again, _ = cv2.fisheye.projectPoints(_homogeneous(plane), still, still, K, c)
    else:
        raise InputError(
            f"lens: expected pinhole, opencv or fisheye, got {optics.lens!r}"
        )
    if not np.abs(again - pixels).max(initial=0) < _OFF:
        raise InputError(
            f"coefficients: expected a direction for each pixel, got {optics}; the "
            "image reaches beyond the fold of the lens, or 180°"
        )
    return np.ascontiguousarray(_homogeneous(plane)[:, 0].T)


def _homogeneous(plane: np.ndarray) -> np.ndarray:
    """Return points [R, 1, 3] of the plane z = 1."""
    return np.concatenate([plane, np.ones_like(plane[..., :1])], -1)


def exposures(
    optics: Optics, viewmat, size: tuple[int, int], u: np.ndarray, v: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray | slice]]:
    """Yield view matrices [4, 4] and the indices of the rays that they expose.

    Args:
      optics: the shutter and its twist.
      viewmat: [4, 4] world → camera, at the start of the exposure.
      size: width and height of the image, px.
      u, v: [R] pixels.

    Raises:
      InputError: if the shutter is unknown.
    """
    viewmat = np.asarray(viewmat, np.float64)
    if optics.shutter == "global":
        yield viewmat, slice(None)
        return
    if optics.shutter not in _TIMES or optics.twist is None:
        raise InputError(
            f"shutter: expected global, or one of {sorted(_TIMES)} with a twist, got "
            f"{optics}"
        )
    from scipy.spatial.transform import Rotation

    start, along_u, along_v = _TIMES[optics.shutter]
    twist = np.asarray(optics.twist, np.float64)
    lines, line_of = np.unique(u if along_u else v, return_inverse=True)
    length = size[0] if along_u else size[1]
    order = np.argsort(line_of, kind="stable")
    ends = np.cumsum(np.bincount(line_of))
    for line, rays in zip(lines, np.split(order, ends[:-1])):
        time = start + (along_u + along_v) * line / length
        pose = viewmat.copy()
        pose[:3, :3] = Rotation.from_rotvec(time * twist[:3]).as_matrix()
        pose[:3, :3] = pose[:3, :3] @ viewmat[:3, :3]
        pose[:3, 3] += time * twist[3:]
        yield pose, rays
