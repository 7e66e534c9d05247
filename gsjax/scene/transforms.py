"""Camera lists in the `transforms.json` form of NeRF, instant-ngp and nerfstudio.

Their matrices are camera → world in OpenGL axes (x right, y up, z backward): columns
1 and 2 are flipped, then the matrix is inverted, which gives our world → camera in
OpenCV axes. Everything here is float64 on the host until `make_camera`.
"""

import json
import math
import re
import warnings
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsjax.cameras import Camera, make_camera
from gsjax.errors import InputError

# `camera_model` of the file → ours. Lens distortion is not rendered.
_MODELS = {
    **dict.fromkeys(("OPENCV", "PINHOLE", "SIMPLE_PINHOLE"), "pinhole"),
    **dict.fromkeys(("RADIAL", "SIMPLE_RADIAL"), "pinhole"),
    "ORTHOGRAPHIC": "orthographic",
}
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_RIGID_TOLERANCE = 1e-3
_MAX_NAME_BYTES = 180


class CameraEntry(NamedTuple):
    """A camera and the name of its output: unique, safe as a file name, no suffix."""

    name: str
    camera: Camera


class _Frame(NamedTuple):
    """One frame; ``where`` names file and index, ``sources`` are frame and file."""

    where: str
    sources: tuple[dict[str, Any], dict[str, Any]]


def load_transforms(
    path: str | PathLike[str], *, size: tuple[int, int] | None = None
) -> list[CameraEntry]:
    """Cameras of a `transforms.json`, in the order of the file.

    Intrinsics stand in the frame or, for all frames, at the top: fl_x, fl_y, cx, cy,
    w, h in pixels, or camera_angle_x and camera_angle_y in radians. A missing fl_y is
    fl_x; a missing cx, cy is the image centre. Lens distortion is not rendered: a
    warning says so.

    Args:
      path: the JSON file.
      size: (width, height) in pixels of the images to render. Intrinsics are scaled
        from the size in the file (another aspect ratio stretches the image); where
        the file has none, as in the NeRF synthetic scenes, this is the size.

    Returns:
      Names, from the stem of file_path or else ``frame_00012``, and cameras.

    Raises:
      InputError: if the file cannot be read, is no such JSON, or a frame has no
        rigid transform_matrix, no usable intrinsics, no size or an unknown lens.
    """
    path = Path(path)
    if size is not None and not (
        len(size) == 2 and all(isinstance(v, int | np.integer) and v >= 1 for v in size)
    ):
        raise InputError(f"size {size}: (width, height), whole and ≥ 1, is wanted")
    data = _read_json(path)
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(
            f"{path}: 'frames' is {_shown(frames)}; a list of at least one frame is "
            "wanted: is this a transforms.json?"
        )
    entries: list[CameraEntry] = []
    used: dict[str, int] = {}
    scaled, distorted = [], set()
    for index, content in enumerate(frames):
        where = f"{path}: frames[{index}]"
        if not isinstance(content, dict):
            raise InputError(f"{where} is {_shown(content)}; an object is wanted")
        frame = _Frame(where, (content, data))
        viewmat, factor = _viewmat(frame)
        if factor != 1:
            scaled.append(f"{index} (× {factor:.6g})")
        distorted.update(_distortion(frame))
        camera = _camera(frame, viewmat, size)
        entries.append(CameraEntry(_unique_name(frame, index, used), camera))
    if scaled:
        _warn(
            f"{path}: the rotations of {len(scaled)} frames are scaled, the first: "
            f"{', '.join(scaled[:5])}; the scale is divided out"
        )
    if distorted:
        _warn(
            f"{path}: lens distortion ({', '.join(sorted(distorted))}) is ignored; "
            "images are rendered as an ideal, undistorted lens"
        )
    return entries


def _warn(message: str) -> None:
    warnings.warn(message, UserWarning, stacklevel=3)


def _shown(value) -> str:
    return "missing" if value is None else repr(value)[:80]


def _read_json(path: Path) -> dict[str, Any]:
    try:
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: not a regular file; pass a transforms.json")
        raw = path.read_bytes()
    except OSError as error:
        reason = error.strerror or error
        raise InputError(
            f"{path}: cannot be read: {reason}; check the path and its permissions"
        ) from error
    try:
        data = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: not JSON: {str(error)[:120]}; pass a transforms.json"
        ) from error
    if not isinstance(data, dict):
        raise InputError(
            f"{path}: the top is {_shown(data)}; an object with 'frames' is wanted"
        )
    return data


def _is_number(value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _number(frame: _Frame, source: dict[str, Any], key: str) -> float | None:
    """A finite number, or None where the key is absent or null."""
    value = source.get(key)
    if value is None:
        return None
    try:
        if _is_number(value) and math.isfinite(value):
            return float(value)
    except OverflowError:  # an integer beyond float64
        pass
    raise InputError(f"{frame.where}: {key} is {_shown(value)}; a number is wanted")


def _first(frame: _Frame, key: str) -> float | None:
    """The number of the frame, or else the one of the whole file."""
    values = (_number(frame, source, key) for source in frame.sources)
    return next((value for value in values if value is not None), None)


# --- pose ---


def _viewmat(frame: _Frame) -> tuple[np.ndarray, float]:
    """World → camera [4, 4], and the scale that was divided out (1 if none)."""
    matrix = _matrix(frame)
    with np.errstate(all="ignore"):
        rotation, scale = _rigid(frame.where, matrix[:3, :3])
    # OpenGL → OpenCV: y and z of the camera point the other way.
    rotation = rotation * np.asarray([1.0, -1.0, -1.0])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation.T, -rotation.T @ matrix[:3, 3]
    return viewmat, scale


def _matrix(frame: _Frame) -> np.ndarray:
    value = frame.sources[0].get("transform_matrix")
    where = f"{frame.where}: transform_matrix"
    rows = value if isinstance(value, list) else []
    shape = [len(row) for row in rows if isinstance(row, list)]
    if len(shape) != len(rows) or shape not in ([4] * 4, [4] * 3):
        raise InputError(f"{where} is {_shown(value)}; 4 rows of 4 numbers are wanted")
    matrix = np.full((len(rows), 4), np.nan)
    try:
        if all(_is_number(v) for row in rows for v in row):
            matrix = np.asarray(rows, np.float64)
    except OverflowError:  # an integer beyond float64
        pass
    # Bounded, so that products stay finite and float32 holds the result.
    if not (np.abs(matrix) < 1e30).all():
        raise InputError(
            f"{where} has values that are no finite numbers: {_shown(rows)}"
        )
    if len(matrix) == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise InputError(
            f"{where}: the last row is {matrix[3].tolist()}, 0 0 0 1 is wanted; "
            "is it transposed?"
        )
    return matrix


def _rigid(where: str, block: np.ndarray) -> tuple[np.ndarray, float]:
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


# --- intrinsics ---


def _camera(frame: _Frame, viewmat: np.ndarray, size: tuple[int, int] | None) -> Camera:
    model = _model(frame)
    width, height = _size(frame, size)
    fx, fy = _focals(frame, width, height, model)
    cx, cy = _first(frame, "cx"), _first(frame, "cy")
    out_width, out_height = (width, height) if size is None else size
    sx, sy = out_width / width, out_height / height
    K = np.eye(3)
    K[0, 0], K[0, 2] = sx * fx, sx * (width / 2 if cx is None else cx)
    K[1, 1], K[1, 2] = sy * fy, sy * (height / 2 if cy is None else cy)
    try:
        with np.errstate(over="ignore"):
            return make_camera(
                viewmat=viewmat,
                K=K,
                width=int(out_width),
                height=int(out_height),
                model=model,
            )
    except InputError as error:
        raise InputError(f"{frame.where}: {error}") from error


def _model(frame: _Frame) -> str:
    merged = frame.sources[1] | frame.sources[0]
    name = merged.get("camera_model") or "PINHOLE"
    if merged.get("is_fisheye") is True:  # instant-ngp
        name = "OPENCV_FISHEYE"
    model = _MODELS.get(str(name).upper())
    if model is None:
        raise InputError(
            f"{frame.where}: camera_model {_shown(name)} is not rendered; supported: "
            f"{', '.join(_MODELS)}. Undistort the images to a pinhole first"
        )
    return model


def _size(frame: _Frame, size: tuple[int, int] | None) -> tuple[int, int]:
    """Width and height that the intrinsics of the file refer to."""
    width, height = _first(frame, "w"), _first(frame, "h")
    if width is None and height is None and size is not None:
        return size
    if width is None or height is None:
        raise InputError(
            f"{frame.where}: no image size: w is {_shown(width)}, h is "
            f"{_shown(height)}; give both in the file, or pass size=(width, height), "
            "on the command line --size WxH"
        )
    if not (width >= 1 and height >= 1 and width % 1 == 0 and height % 1 == 0):
        raise InputError(
            f"{frame.where}: image size w {width:g}, h {height:g}; whole and ≥ 1 is "
            "wanted"
        )
    return int(width), int(height)


def _focals(frame: _Frame, width: int, height: int, model: str) -> tuple[float, float]:
    """Focal lengths in pixels; those of the frame go before those of the file."""
    fy = None
    for source in frame.sources:
        fx = _number(frame, source, "fl_x")
        fy = _number(frame, source, "fl_y") if fy is None else fy
        if fx is None and model == "pinhole":
            fx = _focal_of_angle(frame, source, "camera_angle_x", width)
        if fy is None and model == "pinhole":
            fy = _focal_of_angle(frame, source, "camera_angle_y", height)
        if fx is None:
            continue
        fy = fx if fy is None else fy
        if fx <= 0 or fy <= 0:
            raise InputError(
                f"{frame.where}: focal lengths {fx:g}, {fy:g}; above 0 is wanted"
            )
        return fx, fy
    wanted = "fl_x" if model == "orthographic" else "fl_x or camera_angle_x"
    raise InputError(f"{frame.where}: no focal length; {wanted} is wanted")


def _focal_of_angle(
    frame: _Frame, source: dict[str, Any], key: str, size: int
) -> float | None:
    angle = _number(frame, source, key)
    if angle is None:
        return None
    if not 1e-6 < angle < math.pi:
        raise InputError(
            f"{frame.where}: {key} is {angle:g}; radians between 0 and π are wanted"
        )
    return 0.5 * size / math.tan(0.5 * angle)


def _distortion(frame: _Frame) -> list[str]:
    """Keys of the distortion coefficients that are not zero."""
    found = [key for key in _DISTORTION if _first(frame, key)]
    merged = frame.sources[1] | frame.sources[0]
    coefficients = merged.get("distortion_params")  # nerfstudio, per frame
    if isinstance(coefficients, list) and any(coefficients):
        found.append("distortion_params")
    return found


# --- names ---


def _unique_name(frame: _Frame, index: int, used: dict[str, int]) -> str:
    """A file name without suffix that no entry before has, in any case of letters."""
    file_path = frame.sources[0].get("file_path")
    if file_path is not None and not isinstance(file_path, str):
        raise InputError(
            f"{frame.where}: file_path is {_shown(file_path)}; text is wanted"
        )
    base = Path((file_path or "").replace("\\", "/").rpartition("/")[2]).stem
    base = re.sub(r"[^\w.\- ]", "_", base).strip(". ")
    base = base.encode()[:_MAX_NAME_BYTES].decode(errors="ignore").strip(". ")
    base = base or f"frame_{index:05d}"
    name, key = base, base.casefold()
    while name.casefold() in used:
        used[key] += 1
        name = f"{base}_{used[key]}"
    used[name.casefold()] = 0
    return name
