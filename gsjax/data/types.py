"""Data types that every dataset reader returns.

Host side, float64, OpenCV axes (x right, y down, z forward), world → camera.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.cameras.camera import LENS_RANGE, NEAR
from gsjax.cameras.distortion import Distortion
from gsjax.errors import InputError

# Leaves a margin for the photograph, and its focal length with it, to be scaled.
_MIN_LENGTH, _MAX_LENGTH = LENS_RANGE[0] * 1e6, LENS_RANGE[1] / 1e6


def unexpected(
    where: object,
    expected: str,
    got: object,
    remedy: str = "the file may be damaged: export or copy it again",
) -> InputError:
    """Return the error "where: expected …, got …; remedy"."""
    return InputError(f"{where}: expected {expected}, got {got}; {remedy}")


def intrinsic_matrix(
    where: str, focals: tuple[float, float], centre: tuple[float, float]
) -> np.ndarray:
    """Return the [3, 3] intrinsics of focal lengths (fx, fy) and a centre (cx, cy), px.

    Raises:
      InputError: beginning with ``where``, if a value cannot be rendered.
    """
    (fx, fy), (cx, cy), remedy = focals, centre, "estimate the camera again"
    if not all(_MIN_LENGTH < focal < _MAX_LENGTH for focal in focals):
        expected = f"focal lengths above {_MIN_LENGTH:g} and below {_MAX_LENGTH:g} px"
        raise unexpected(where, expected, f"{fx:g}, {fy:g}", remedy)
    if not all(abs(value) < _MAX_LENGTH for value in centre):
        expected = f"a principal point within {_MAX_LENGTH:g} px"
        raise unexpected(where, expected, f"{cx:g}, {cy:g}", remedy)
    return np.asarray([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


def inverted(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the [4, 4] inverse of a pose: a rotation [3, 3] and a position [3]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation.T, -rotation.T @ position
    return matrix


@dataclass(frozen=True)
class View:
    """A photograph and the camera that took it.

    Attributes:
      name: path of the photograph relative to the dataset's images, with suffix.
      image: the image file.
      viewmat: [4, 4] world → camera, in the dataset's coordinates.
      K: [3, 3] intrinsics in px of an image of ``width`` × ``height``. If the file has
        another size (``images_4/``), K is scaled on load.
      width, height: image size in px that ``K`` refers to.
      lens: lens of the photograph; None for an ideal pinhole.
      mask: file of a grey image of the same size, 0 where a pixel is excluded; or None.
      split: "train" or "test" if the dataset says so, else None.
      near: near plane: depth below which nothing is drawn, in world units.
      time: time of the exposure, for scenes that move; None if it is unknown. In
        datasets of `load_dataset`, 0 to 1.
      twist: [6] motion during the exposure of a rolling shutter, see
        `gsjax.cameras.shutter`; None if it is unknown or there is none.
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
    time: float | None = None
    twist: np.ndarray | None = None

    @property
    def centre(self) -> np.ndarray:
        """Position [3] of the camera."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


@dataclass(frozen=True)
class Dataset:
    """Photographs, their cameras, and the known points of the scene.

    Coordinates are those of the files minus ``origin``. The origin is zero unless the
    coordinates are too large for float32, see `gsjax.data.rebase`.

    Attributes:
      source: folder or file that was read.
      format: name of its format.
      views: views sorted by name; names are unique.
      points: [M, 3] float64; M may be 0.
      colors: [M, 3] uint8.
      origin: [3] float64, added to coordinates on export.
      duration: seconds from time 0 to time 1 of the views; None if it is unknown.
    """

    source: Path
    format: str
    views: tuple[View, ...]
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    colors: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    duration: float | None = None


class ReadOptions(NamedTuple):
    """Options of `load_dataset`, which documents them, for every reader."""

    images: str | PathLike[str] | None = None
    factor: int | None = None
    skip_missing: bool = False
    poses_only: bool = False


class Reader(NamedTuple):
    """A named dataset format, as a pair of functions.

    Attributes:
      detect: returns whether an existing path is a dataset of this format. It looks at
        file names only and does not raise on damaged files.
      load: reads the cameras and points of that path. `load_dataset` then sorts the
        views, checks their poses and chooses near planes and origin.
    """

    name: str
    detect: Callable[[Path], bool]
    load: Callable[[Path, ReadOptions], Dataset]


class Photo(NamedTuple):
    """A scaled photograph with its camera.

    Attributes:
      pixels: [H, W, 3] uint8 RGB.
      alpha: [H, W] uint8 opacity, or None if every pixel is opaque.
      valid: [H, W] bool, False where masked or outside of the undistorted image; None
        if all pixels are valid.
      K: [3, 3] float64 intrinsics of this size, px.
      lens: lens of the pixels; None for an ideal pinhole.
    """

    pixels: np.ndarray
    alpha: np.ndarray | None
    valid: np.ndarray | None
    K: np.ndarray
    lens: Distortion | None = None

    def over(self, background) -> np.ndarray:
        """Return the photograph [H, W, 3] float32 in [0, 1] over an RGB background."""
        truth = self.pixels.astype(np.float32) / 255
        if self.alpha is None:
            return truth
        alpha = self.alpha[..., None].astype(np.float32) / 255
        return truth * alpha + np.asarray(background, np.float32) * (1 - alpha)

    def require(self, name: str) -> None:
        """Raise `InputError`, for view ``name``, if an array is not as above."""
        size = np.shape(self.pixels)[:2]
        arrays = {
            "pixels": ((*size, 3), np.dtype(np.uint8)),
            "alpha": (size, np.dtype(np.uint8)),
            "valid": (size, np.dtype(bool)),
            "K": ((3, 3), None),
        }
        for part, (shape, dtype) in arrays.items():
            value = getattr(self, part)
            if value is None and part in ("alpha", "valid"):
                continue
            array = np.asarray(value)
            fits = array.shape == shape and dtype in (None, array.dtype)
            if not fits or array.size == 0:
                expected = f"{dtype or 'numbers'} of shape {shape}"
                got = f"{array.dtype} of shape {array.shape}"
                remedy = "use `load_photo` or `make_dataset`"
                raise unexpected(f"{name}: {part} of the photo", expected, got, remedy)
