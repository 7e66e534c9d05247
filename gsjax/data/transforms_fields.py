"""Checked access to the frames, poses and focal lengths of a `transforms.json`."""

import math
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsjax.data.colmap_model import MAX_COORDINATE, MAX_SIDE
from gsjax.data.types import unexpected
from gsjax.errors import InputError
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


def shown(value) -> str:
    """Return a found value as text for a message."""
    return "missing" if value is None else files.shown(value)


def read_frames(path: Path) -> list[Frame]:
    """Return the frames of a file, at least one."""
    data = files.read_json(path, "a transforms.json")
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(
            f"{path}: 'frames': expected a list of at least one frame, got "
            f"{shown(frames)}; pass a transforms.json"
        )
    for index, content in enumerate(frames):
        if not isinstance(content, dict):
            raise unexpected(f"{path}: frames[{index}]", "an object", shown(content))
    return [Frame(f"{path}: frames[{i}]", (f, data)) for i, f in enumerate(frames)]


def _is_number(value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def number(frame: Frame, source: dict[str, Any], key: str) -> float | None:
    """Return a finite number, or None if the key is absent or null."""
    value = source.get(key)
    if value is None:
        return None
    try:
        if _is_number(value) and abs(value) < MAX_COORDINATE:
            return float(value)
    except OverflowError:  # an integer beyond float64
        pass
    raise _unexpected(frame, key, "a number", value)


def first_number(frame: Frame, key: str) -> float | None:
    """Return the number of the frame, else of the top level, else None."""
    values = (number(frame, source, key) for source in frame.sources)
    return next((value for value in values if value is not None), None)


def text_of(frame: Frame, key: str) -> str | None:
    """Return a text of the frame itself, or None if the key is absent or null."""
    value = frame.sources[0].get(key)
    if value is not None and not isinstance(value, str):
        raise _unexpected(frame, key, "text", value)
    return value


def _unexpected(frame: Frame, key: str, expected: str, value) -> InputError:
    return unexpected(f"{frame.where}: {key}", expected, shown(value))


def model_of(frame: Frame) -> str:
    """Return the camera model in upper case; "PINHOLE" if the file names none.

    Raises:
      InputError: if the file describes an unsupported lens of instant-ngp.
    """
    keys = {key for source in frame.sources for key in source}
    for key in sorted(keys):
        if key.startswith(_OTHER_LENSES) and frame.get(key) not in (None, False):
            raise InputError(
                f"{frame.where}: {key[:40]} {shown(frame.get(key))}: this lens is not "
                "supported; undistort the photographs to a pinhole first"
            )
    if frame.get("is_fisheye") is True:  # instant-ngp
        return "OPENCV_FISHEYE"
    name = frame.get("camera_model") or "PINHOLE"
    return (name if isinstance(name, str) else shown(name)).upper()


def size_of(frame: Frame) -> tuple[int, int] | None:
    """Return the width and height that the intrinsics refer to, or None."""
    width, height = first_number(frame, "w"), first_number(frame, "h")
    if width is None and height is None:
        return None
    if width is None or height is None:
        raise InputError(
            f"{frame.where}: no image size: w is {shown(width)}, h is "
            f"{shown(height)}; give both in the file, or pass size=(width, height), "
            "on the command line --size WxH"
        )
    if not all(1 <= side <= MAX_SIDE and side % 1 == 0 for side in (width, height)):
        raise InputError(
            f"{frame.where}: expected a whole image size from 1 to {MAX_SIDE}, got w "
            f"{width:g}, h {height:g}; export the file again"
        )
    return int(width), int(height)


# --- pose ---


def pose_of(frame: Frame) -> tuple[np.ndarray, float]:
    """Return world → camera [4, 4], and the scale that was divided out (1 if none)."""
    matrix = _matrix(frame)
    with np.errstate(all="ignore"):
        rotation, scale = rigid(f"{frame.where}: transform_matrix", matrix[:3, :3])
    # OpenGL → OpenCV: flip y and z of the camera.
    rotation = rotation * np.asarray([1.0, -1.0, -1.0])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation.T, -rotation.T @ matrix[:3, 3]
    return viewmat, scale


def warn_of_scaled(path: Path, scaled: list[tuple[int, float]]) -> None:
    """Warn of scales that were divided out, if any."""
    if scaled:
        first = ", ".join(f"{index} (× {scale:.6g})" for index, scale in scaled[:5])
        warnings.warn(
            f"{path}: the rotations of {len(scaled)} frames are scaled, the first: "
            f"{first}; the scale is divided out",
            UserWarning,
            stacklevel=4,
        )


def _matrix(frame: Frame) -> np.ndarray:
    value = frame.sources[0].get("transform_matrix")
    where = f"{frame.where}: transform_matrix"
    rows = value if isinstance(value, list) else []
    shape = [len(row) for row in rows if isinstance(row, list)]
    if len(shape) != len(rows) or shape not in ([4] * 4, [4] * 3):
        raise unexpected(where, "4 rows of 4 numbers", shown(value))
    matrix = np.full((len(rows), 4), np.nan)
    try:
        if all(_is_number(v) for row in rows for v in row):
            matrix = np.asarray(rows, np.float64)
    except OverflowError:  # an integer beyond float64
        pass
    if not (np.abs(matrix) < MAX_COORDINATE).all():
        raise unexpected(where, "finite numbers", shown(rows), "remove the frame")
    if len(matrix) == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise unexpected(
            where, "the last row 0 0 0 1", matrix[3].tolist(), "transpose the matrix"
        )
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
            raise InputError(
                f"{where}: expected a rotation, or a scaled one, as the 3 × 3 part: "
                f"RᵀR is off by {deviation:.3g}, more than {_RIGID_TOLERANCE}; export "
                "rigid camera poses"
            )
    left, _, right = np.linalg.svd(block / scale)
    rotation = left @ right
    if np.linalg.det(rotation) < 0:
        raise InputError(
            f"{where}: expected a rotation as the 3 × 3 part, got a reflection "
            "(determinant -1); flip one axis"
        )
    return rotation, scale


# --- intrinsics ---


def intrinsics_of(
    frame: Frame, width: int, height: int, model: str
) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy in px; those of the frame precede the top level's.

    A single focal length holds for both axes; cx and cy default to the image centre.

    Raises:
      InputError: if there is no focal length, or one is out of range.
    """
    fx = fy = None
    for source in frame.sources:
        fx = _focal(frame, source, "x", width, model) if fx is None else fx
        fy = _focal(frame, source, "y", height, model) if fy is None else fy
        if fx is not None:
            break
    fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
    if fx is None or fy is None:
        angles = "" if model != "pinhole" else ", camera_angle_x or x_fov"
        raise unexpected(frame.where, f"a focal length, fl_x{angles}", "none")
    if fx <= 0 or fy <= 0:
        raise unexpected(frame.where, "focal lengths above 0", f"{fx:g}, {fy:g}")
    cx, cy = first_number(frame, "cx"), first_number(frame, "cy")
    return fx, fy, width / 2 if cx is None else cx, height / 2 if cy is None else cy


def _focal(
    frame: Frame, source: dict[str, Any], axis: str, size: int, model: str
) -> float | None:
    """Return a focal length in px, of a pinhole also from its angle of view.

    The angle is in radians or, for instant-ngp, in degrees.
    """
    focal = number(frame, source, f"fl_{axis}")
    if focal is not None or model != "pinhole":
        return focal
    for key, expected, unit in (
        (f"camera_angle_{axis}", "radians between 0 and π", 1.0),
        (f"{axis}_fov", "degrees between 0 and 180", math.pi / 180),
    ):
        angle = number(frame, source, key)
        if angle is None:
            continue
        if not 1e-6 < unit * angle < math.pi:
            raise _unexpected(frame, key, expected, angle)
        return 0.5 * size / math.tan(0.5 * unit * angle)
    return None
