"""Checked access to the frames, poses and focal lengths of a `transforms.json`."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsjax.data.colmap_model import MAX_COORDINATE, MAX_SIDE
from gsjax.data.types import inverted, unexpected
from gsjax.errors import InputError
from gsjax.io.common import warn
from gsjax.runtime import files

_RIGID_TOLERANCE = 1e-3
_OTHER_LENSES = ("ftheta_", "latlong", "equirectangular")


class Frame(NamedTuple):
    """A frame; ``where`` names file and index, ``sources`` are frame and top level."""

    where: str
    sources: tuple[dict[str, Any], dict[str, Any]]

    def get(self, key: str) -> Any:
        """Return the value of the frame, else of the top level, else None."""
        values = (source.get(key) for source in self.sources)
        return next((value for value in values if value is not None), None)

    def text(self, key: str) -> str | None:
        """Return a text of the frame itself, or None if the key is absent or null."""
        value = self.sources[0].get(key)
        if value is not None and not isinstance(value, str):
            raise self.unexpected(key, "text", value)
        return value

    def number(self, key: str) -> float | None:
        """Return the finite number of the frame, else of the top level, else None."""
        values = (self.number_of(source, key) for source in self.sources)
        return next((value for value in values if value is not None), None)

    def number_of(self, source: dict[str, Any], key: str) -> float | None:
        """Return a finite number of one source, or None if it is absent or null."""
        value = source.get(key)
        number = None if value is None else _finite(value)
        if number is not None and math.isnan(number):
            raise self.unexpected(key, "a number", value)
        return number

    def unexpected(self, key: str, expected: str, value) -> InputError:
        """Return the error for the value of a key."""
        return unexpected(f"{self.where}: {key}", expected, shown(value))

    def model(self) -> str:
        """Return the camera model in upper case; "PINHOLE" if the file names none.

        Raises:
          InputError: if the file describes an unsupported lens of instant-ngp.
        """
        for key in sorted({key for source in self.sources for key in source}):
            if key.startswith(_OTHER_LENSES) and self.get(key) not in (None, False):
                raise InputError(
                    f"{self.where}: {key[:40]} {shown(self.get(key))}: this lens is "
                    "not supported; undistort the photographs to a pinhole first"
                )
        if self.get("is_fisheye") is True:  # instant-ngp
            return "OPENCV_FISHEYE"
        name = self.get("camera_model") or "PINHOLE"
        return (name if isinstance(name, str) else shown(name)).upper()

    def size(self) -> tuple[int, int] | None:
        """Return the width and height that the intrinsics refer to, or None."""
        width, height = self.number("w"), self.number("h")
        if width is None and height is None:
            return None
        if width is None or height is None:
            raise no_size(self.where, width, height)
        if not all(1 <= side <= MAX_SIDE and side % 1 == 0 for side in (width, height)):
            expected = f"a whole image size from 1 to {MAX_SIDE}"
            raise unexpected(self.where, expected, f"w {width:g}, h {height:g}")
        return int(width), int(height)

    def pose(self) -> tuple[np.ndarray, float]:
        """Return world → camera [4, 4], and the scale that was divided out, else 1."""
        matrix = _matrix(f"{self.where}: transform_matrix", self.sources[0])
        with np.errstate(all="ignore"):
            rotation, scale = rigid(f"{self.where}: transform_matrix", matrix[:3, :3])
        # OpenGL → OpenCV: flip y and z of the camera.
        rotation = rotation * np.asarray([1.0, -1.0, -1.0])
        return inverted(rotation, matrix[:3, 3]), scale

    def intrinsics(
        self, width: int, height: int, model: str
    ) -> tuple[float, float, float, float]:
        """Return fx, fy, cx, cy in px; those of the frame precede the top level's.

        A single focal length holds for both axes; cx and cy default to the image
        centre.

        Raises:
          InputError: if there is no focal length, or one is out of range.
        """
        fx = fy = None
        for source in self.sources:
            fx = self._focal(source, "x", width, model) if fx is None else fx
            fy = self._focal(source, "y", height, model) if fy is None else fy
            if fx is not None:
                break
        fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
        if fx is None or fy is None:
            angles = "" if model != "pinhole" else ", camera_angle_x or x_fov"
            raise unexpected(self.where, f"a focal length, fl_x{angles}", "none")
        if fx <= 0 or fy <= 0:
            raise unexpected(self.where, "focal lengths above 0", f"{fx:g}, {fy:g}")
        cx, cy = self.number("cx"), self.number("cy")
        return fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy

    def _focal(
        self, source: dict[str, Any], axis: str, size: int, model: str
    ) -> float | None:
        """Return a focal length in px, of a pinhole also from its angle of view."""
        focal = self.number_of(source, f"fl_{axis}")
        if focal is not None or model != "pinhole":
            return focal
        for key, expected, unit in (
            (f"camera_angle_{axis}", "radians between 0 and π", 1.0),
            (f"{axis}_fov", "degrees between 0 and 180", math.pi / 180),  # instant-ngp
        ):
            angle = self.number_of(source, key)
            if angle is None:
                continue
            if not 1e-6 < unit * angle < math.pi:
                raise self.unexpected(key, expected, angle)
            return 0.5 * size / math.tan(0.5 * unit * angle)
        return None


def shown(value) -> str:
    """Return a found value as text for a message."""
    return "missing" if value is None else files.shown(value)


def no_size(where: str, width=None, height=None) -> InputError:
    """Return the error for an image size that a file gives in part, or not at all."""
    return InputError(
        f"{where}: no image size: w is {shown(width)}, h is {shown(height)}; give both "
        "in the file, or pass size=(width, height), on the command line --size WxH"
    )


def read_frames(path: Path) -> list[Frame]:
    """Return the frames of a file, at least one."""
    data = files.read_json(path, "a transforms.json")
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        expected, remedy = "a list of at least one frame", "pass a transforms.json"
        raise unexpected(f"{path}: 'frames'", expected, shown(frames), remedy)
    for index, content in enumerate(frames):
        if not isinstance(content, dict):
            raise unexpected(f"{path}: frames[{index}]", "an object", shown(content))
    return [Frame(f"{path}: frames[{i}]", (f, data)) for i, f in enumerate(frames)]


def _finite(value) -> float:
    """Return a number as float, or NaN for any other value."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if is_number and abs(value) < MAX_COORDINATE else math.nan


def warn_of_scaled(path: Path, scaled: list[tuple[int, float]]) -> None:
    """Warn of scales that were divided out, if any."""
    if scaled:
        first = ", ".join(f"{index} (× {scale:.6g})" for index, scale in scaled[:5])
        warn(
            f"{path}: the rotations of {len(scaled)} frames are scaled, the first: "
            f"{first}; the scale is divided out"
        )


def _matrix(where: str, frame: dict[str, Any]) -> np.ndarray:
    value = frame.get("transform_matrix")
    rows = value if isinstance(value, list) else []
    shape = [len(row) for row in rows if isinstance(row, list)]
    if len(shape) != len(rows) or shape not in ([4] * 4, [4] * 3):
        raise unexpected(where, "4 rows of 4 numbers", shown(value))
    matrix = np.asarray([[_finite(value) for value in row] for row in rows])
    if not np.isfinite(matrix).all():
        raise unexpected(where, "finite numbers", shown(rows), "remove the frame")
    if len(matrix) == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        remedy = "transpose the matrix"
        raise unexpected(where, "the last row 0 0 0 1", matrix[3].tolist(), remedy)
    return matrix


def rigid(where: str, block: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the nearest rotation to ``block`` [3, 3], and its scale (1 if none)."""
    gram = block.T @ block
    square = float(np.trace(gram)) / 3
    scale = 1.0
    if not np.abs(gram - np.eye(3)).max() <= _RIGID_TOLERANCE:
        scale = math.sqrt(square)
        deviation = np.abs(gram / square - np.eye(3)).max()
        if not deviation <= _RIGID_TOLERANCE:
            off = f"RᵀR is off by {deviation:.3g}, more than {_RIGID_TOLERANCE}"
            what = "expected a rotation, or a scaled one, as the 3 × 3 part"
            raise InputError(f"{where}: {what}: {off}; export rigid camera poses")
    left, _, right = np.linalg.svd(block / scale)
    rotation = left @ right
    if np.linalg.det(rotation) < 0:
        expected, got = "a rotation as the 3 × 3 part", "a reflection (determinant -1)"
        raise unexpected(where, expected, got, "flip one axis")
    return rotation, scale
