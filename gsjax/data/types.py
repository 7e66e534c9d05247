"""A captured scene: what every reader of a dataset returns.

Host side, float64, OpenCV axes (x right, y down, z forward), world → camera.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.cameras.camera import LENS_RANGE, NEAR
from gsjax.errors import InputError

# Room for a photograph to be made smaller, and its focal length with it.
_LEAST, _MOST = LENS_RANGE[0] * 1e6, LENS_RANGE[1] / 1e6


def intrinsic_matrix(
    where: str, focals: tuple[float, float], centre: tuple[float, float]
) -> np.ndarray:
    """[3, 3] of focal lengths and a principal point in px, which ``where`` names.

    Raises:
      InputError: if nothing could be drawn with them; found here, before a training
        whose last photograph it is.
    """
    (fx, fy), (cx, cy) = focals, centre
    if not all(_LEAST < focal < _MOST for focal in focals):
        raise InputError(
            f"{where}: focal lengths {fx:g}, {fy:g} px; above {_LEAST:g} and below "
            f"{_MOST:g} is wanted: estimate the camera again"
        )
    if not all(abs(value) < _MOST for value in centre):
        raise InputError(
            f"{where}: principal point {cx:g}, {cy:g} px; within {_MOST:g} is wanted: "
            "estimate the camera again"
        )
    return np.asarray([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


class Distortion(NamedTuple):
    """Distortion of a photograph, in OpenCV's terms.

    Attributes:
      model: "radial_tangential" (`cv2.undistort`: k1 k2 p1 p2 [k3 [k4 k5 k6]]) or
        "fisheye" (`cv2.fisheye`: k1 k2 k3 k4, Kannala–Brandt).
      coefficients: as many as the model takes, in OpenCV's order.
    """

    model: str
    coefficients: tuple[float, ...]


@dataclass(frozen=True)
class View:
    """One photograph and the camera that took it.

    Attributes:
      name: what the dataset calls it: a path relative to its images, with suffix.
      image: the file.
      viewmat: [4, 4] world → camera, in the scene's coordinates.
      K: [3, 3] intrinsics in px of an image of ``width`` × ``height``; where the
        file is larger or smaller (``images_4/``), they are scaled on load.
      width, height: size in px that ``K`` refers to.
      lens: None for an ideal pinhole.
      mask: file of a grey image of the same size, 0 where a pixel is to be left
        out; or None.
      split: "train" or "test" where the dataset itself says so, else None.
      near: what is nearer than that, in units of the scene, is not drawn.
    """

    name: str
    image: Path
    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int
    lens: Distortion | None = None
    mask: Path | None = None
    split: str | None = None
    near: float = NEAR

    @property
    def centre(self) -> np.ndarray:
        """[3] where the camera stands."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


@dataclass(frozen=True)
class Dataset:
    """Photographs, their cameras, and the points that are known of the scene.

    Coordinates are those of the files minus ``origin``, which is zero unless the
    scene lies so far out that float32 would be too coarse for it.

    Attributes:
      source: folder or file that was read, and ``format``, what it was.
      views: sorted by name, names unique.
      points: [M, 3] float64; M may be 0.
      colors: [M, 3] uint8.
      origin: [3] float64, to be added to coordinates on the way out.
    """

    source: Path
    format: str
    views: tuple[View, ...]
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    colors: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))


class Photo(NamedTuple):
    """A photograph as loaded: undistorted and scaled, with what it then shows.

    Attributes:
      pixels: [H, W, 3] uint8 RGB.
      alpha: [H, W] uint8 opacity of the file, or None where nothing is transparent.
      valid: [H, W] bool, False where masked or where undistortion had nothing; or
        None where all is valid.
      K: [3, 3] float64, for this size and an ideal pinhole.
    """

    pixels: np.ndarray
    alpha: np.ndarray | None
    valid: np.ndarray | None
    K: np.ndarray

    def require(self, name: str) -> None:
        """See that the arrays are as above: others would be learnt as noise.

        Raises:
          InputError: if one is not; ``name`` says of which view.
        """
        size = np.shape(self.pixels)[:2]
        wanted = {
            "pixels": (*size, 3) if len(size) == 2 else ("H", "W", 3),
            "alpha": size,
            "valid": size,
            "K": (3, 3),
        }
        kinds = {"pixels": np.uint8, "alpha": np.uint8, "valid": np.bool_}
        for part, shape in wanted.items():
            value, kind = getattr(self, part), kinds.get(part)
            if value is None and part in ("alpha", "valid"):
                continue
            array = np.asarray(value)
            wrong = array.shape != shape or array.size == 0
            if wrong or (kind is not None and array.dtype != kind):
                told = f" of {np.dtype(kind).name}" if kind else ""
                raise InputError(
                    f"{name}: {part} of the photo has shape {array.shape} of "
                    f"{array.dtype}; {shape}{told} is wanted"
                )
