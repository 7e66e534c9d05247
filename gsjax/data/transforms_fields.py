"""The JSON of a `transforms.json`: its frames, poses and focal lengths, checked.

Poses are camera → world in OpenGL axes (x right, y up, z backward): columns 1 and 2
are flipped, then the matrix is inverted, which gives our world → camera in OpenCV
axes.
"""

import math
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsjax.data.colmap_model import MAX_COORDINATE, MAX_SIDE
from gsjax.errors import InputError
from gsjax.runtime import files

_RIGID_TOLERANCE = 1e-3
_OTHER_LENSES = ("ftheta_", "latlong", "equirectangular")


class Frame(NamedTuple):
    """One frame; ``where`` names file and index, ``sources`` are frame and file."""

    where: str
    sources: tuple[dict[str, Any], dict[str, Any]]

    def get(self, key: str) -> Any:
        """The value of the frame, or else that of the file, or else None."""
        values = (source.get(key) for source in self.sources)
        return next((value for value in values if value is not None), None)


def shown(value) -> str:
    """A value as found, for a message."""
    return "missing" if value is None else files.shown(value)


def read_frames(path: Path) -> list[Frame]:
    """The frames of a file, at least one."""
    data = files.read_json(path, "a transforms.json")
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(
            f"{path}: 'frames' is {shown(frames)}; a list of at least one frame is "
            "wanted: is this a transforms.json?"
        )
    for index, content in enumerate(frames):
        if not isinstance(content, dict):
            raise InputError(
                f"{path}: frames[{index}] is {shown(content)}; an object is wanted"
            )
    return [Frame(f"{path}: frames[{i}]", (f, data)) for i, f in enumerate(frames)]


def _is_number(value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def number(frame: Frame, source: dict[str, Any], key: str) -> float | None:
    """A finite number, or None where the key is absent or null."""
    value = source.get(key)
    if value is None:
        return None
    try:
        if _is_number(value) and abs(value) < MAX_COORDINATE:
            return float(value)
    except OverflowError:  # an integer beyond float64
        pass
    raise InputError(f"{frame.where}: {key} is {shown(value)}; a number is wanted")


def first_number(frame: Frame, key: str) -> float | None:
    """The number of the frame, or else the one of the whole file."""
    values = (number(frame, source, key) for source in frame.sources)
    return next((value for value in values if value is not None), None)


def text_of(frame: Frame, key: str) -> str | None:
    """A text of the frame itself, or None where the key is absent or null."""
    value = frame.sources[0].get(key)
    if value is not None and not isinstance(value, str):
        raise InputError(f"{frame.where}: {key} is {shown(value)}; text is wanted")
    return value


def model_of(frame: Frame) -> str:
    """The camera model in upper case; "PINHOLE" where the file names none.

    Raises:
      InputError: on a lens of instant-ngp that is not among ours.
    """
    keys = {key for source in frame.sources for key in source}
    for key in sorted(keys):
        if key.startswith(_OTHER_LENSES) and frame.get(key) not in (None, False):
            raise InputError(
                f"{frame.where}: {key[:40]} is {shown(frame.get(key))}, of a lens that "
                "is not supported; undistort the photographs to a pinhole first"
            )
    if frame.get("is_fisheye") is True:  # instant-ngp
        return "OPENCV_FISHEYE"
    name = frame.get("camera_model") or "PINHOLE"
    return (name if isinstance(name, str) else shown(name)).upper()


def size_of(frame: Frame) -> tuple[int, int] | None:
    """Width and height that the intrinsics refer to, or None if the file has none."""
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
            f"{frame.where}: image size w {width:g}, h {height:g}; whole and ≥ 1, at "
            f"most {MAX_SIDE}, is wanted"
        )
    return int(width), int(height)


# --- pose ---


def pose_of(frame: Frame) -> tuple[np.ndarray, float]:
    """World → camera [4, 4], and the scale that was divided out (1 if none)."""
    matrix = _matrix(frame)
    with np.errstate(all="ignore"):
        rotation, scale = rigid(frame.where, matrix[:3, :3])
    # OpenGL → OpenCV: y and z of the camera point the other way.
    rotation = rotation * np.asarray([1.0, -1.0, -1.0])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation.T, -rotation.T @ matrix[:3, 3]
    return viewmat, scale


def warn_of_scaled(path: Path, scaled: list[tuple[int, float]]) -> None:
    """Warn, on behalf of who called the caller's caller, of scales divided out."""
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
        raise InputError(f"{where} is {shown(value)}; 4 rows of 4 numbers are wanted")
    matrix = np.full((len(rows), 4), np.nan)
    try:
        if all(_is_number(v) for row in rows for v in row):
            matrix = np.asarray(rows, np.float64)
    except OverflowError:  # an integer beyond float64
        pass
    if not (np.abs(matrix) < MAX_COORDINATE).all():
        raise InputError(
            f"{where} has values that are no finite numbers: {shown(rows)}; remove the "
            "frame"
        )
    if len(matrix) == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise InputError(
            f"{where}: the last row is {matrix[3].tolist()}, 0 0 0 1 is wanted; "
            "is it transposed?"
        )
    return matrix


def rigid(where: str, block: np.ndarray) -> tuple[np.ndarray, float]:
    """Nearest rotation to ``block`` [3, 3], and its scale if that is not 1."""
    gram = block.T @ block
    square = float(np.trace(gram)) / 3
    scale = 1.0
    if not np.abs(gram - np.eye(3)).max() <= _RIGID_TOLERANCE:
        scale = math.sqrt(square)
        deviation = np.abs(gram / square - np.eye(3)).max()
        if not deviation <= _RIGID_TOLERANCE:
            raise InputError(
                f"{where}: the 3 × 3 part of transform_matrix is no rotation (nor a "
                f"scaled one): RᵀR is off by {deviation:.3g}, {_RIGID_TOLERANCE} is "
                "allowed; export rigid camera poses"
            )
    left, _, right = np.linalg.svd(block / scale)
    rotation = left @ right
    if np.linalg.det(rotation) < 0:
        raise InputError(
            f"{where}: the 3 × 3 part of transform_matrix mirrors (determinant -1); "
            "a rotation is wanted: flip one axis"
        )
    return rotation, scale


# --- focal lengths ---


def focal_lengths(
    frame: Frame, width: int, height: int, model: str
) -> tuple[float, float]:
    """Focal lengths in pixels; those of the frame go before those of the file.

    One alone is that of both axes.

    Raises:
      InputError: if there is none, or one is out of its range.
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
        raise InputError(f"{frame.where}: no focal length; fl_x{angles} is wanted")
    if fx <= 0 or fy <= 0:
        raise InputError(
            f"{frame.where}: focal lengths {fx:g}, {fy:g}; above 0 is wanted"
        )
    return fx, fy


def _focal(
    frame: Frame, source: dict[str, Any], axis: str, size: int, model: str
) -> float | None:
    """In pixels or, of a pinhole, by the angle of view: in radians or, as instant-ngp
    has it besides, in degrees."""
    focal = number(frame, source, f"fl_{axis}")
    if focal is not None or model != "pinhole":
        return focal
    for key, wanted, unit in (
        (f"camera_angle_{axis}", "radians between 0 and π", 1.0),
        (f"{axis}_fov", "degrees between 0 and 180", math.pi / 180),
    ):
        angle = number(frame, source, key)
        if angle is None:
            continue
        if not 1e-6 < unit * angle < math.pi:
            raise InputError(f"{frame.where}: {key} is {angle:g}; {wanted} are wanted")
        return 0.5 * size / math.tan(0.5 * unit * angle)
    return None
