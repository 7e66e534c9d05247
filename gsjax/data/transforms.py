"""Camera lists in the `transforms.json` form of NeRF, instant-ngp and nerfstudio.

Their matrices are camera → world in OpenGL axes (x right, y up, z backward): columns
1 and 2 are flipped, then the matrix is inverted, which gives our world → camera in
OpenCV axes. Everything here is float64 on the host until `make_camera`.
"""

import re
import warnings
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.cameras.camera import Camera, make_camera
from gsjax.data.extent import near_plane
from gsjax.data.rebase import far_origin, shifted
from gsjax.data.transforms_fields import (
    Frame,
    first_number,
    focal_lengths,
    model_of,
    pose_of,
    read_frames,
    shown,
    size_of,
    text_of,
    warn_of_scaled,
)
from gsjax.errors import InputError

# `camera_model` of the file → ours. Lens distortion is not rendered.
_MODELS = {
    **dict.fromkeys(("OPENCV", "PINHOLE", "SIMPLE_PINHOLE"), "pinhole"),
    **dict.fromkeys(("RADIAL", "SIMPLE_RADIAL"), "pinhole"),
    "ORTHOGRAPHIC": "orthographic",
}
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_MAX_NAME_BYTES = 180


class CameraEntry(NamedTuple):
    """A camera and the name of its output: unique, safe as a file name, no suffix."""

    name: str
    camera: Camera


def load_transforms(
    path: str | PathLike[str], *, size: tuple[int, int] | None = None
) -> list[CameraEntry]:
    """Cameras of a `transforms.json`, in the order of the file.

    Intrinsics stand in the frame or, for all frames, at the top: fl_x, fl_y, cx, cy,
    w, h in pixels, or camera_angle_x and camera_angle_y in radians, or x_fov and y_fov
    in degrees. One alone is that of both axes; a missing cx, cy is the image centre.
    Lens distortion is not rendered: a warning says so.

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
    entries, _ = _load(Path(path), size, near_origin=False)
    return entries


def load_near_transforms(
    path: str | PathLike[str], *, size: tuple[int, int] | None = None
) -> tuple[list[CameraEntry], np.ndarray]:
    """As `load_transforms`, brought near the origin where float32 would be too coarse.

    Returns:
      The cameras, and what was subtracted from their world's coordinates [3] in
      float64, and is to be from those of the scene; see `gsjax.data.rebase`.
    """
    return _load(Path(path), size, near_origin=True)


def _load(
    path: Path, size: tuple[int, int] | None, near_origin: bool
) -> tuple[list[CameraEntry], np.ndarray]:
    if size is not None and not (
        len(size) == 2 and all(isinstance(v, int | np.integer) and v >= 1 for v in size)
    ):
        raise InputError(f"size {size}: (width, height), whole and ≥ 1, is wanted")
    frames = read_frames(path)
    poses = [pose_of(frame) for frame in frames]
    centres = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose, _ in poses])
    origin = far_origin(centres, np.zeros((0, 3))) if near_origin else np.zeros(3)
    near = near_plane(centres)
    entries: list[CameraEntry] = []
    used: dict[str, int] = {}
    distorted = set()
    for index, (frame, (viewmat, _)) in enumerate(zip(frames, poses)):
        distorted.update(_distortion(frame))
        camera = _camera(frame, shifted(viewmat, origin), size, near)
        entries.append(CameraEntry(_unique_name(frame, index, used), camera))
    factors = enumerate(factor for _, factor in poses)
    warn_of_scaled(path, [(index, factor) for index, factor in factors if factor != 1])
    if distorted:
        warnings.warn(
            f"{path}: lens distortion ({', '.join(sorted(distorted))}) is ignored; "
            "images are rendered as an ideal, undistorted lens",
            UserWarning,
            stacklevel=3,
        )
    return entries, origin


# --- intrinsics ---


def _camera(
    frame: Frame, viewmat: np.ndarray, size: tuple[int, int] | None, near: float
) -> Camera:
    model = _model(frame)
    width, height = _size(frame, size)
    fx, fy = focal_lengths(frame, width, height, model)
    cx, cy = first_number(frame, "cx"), first_number(frame, "cy")
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
                near=near,
                model=model,
            )
    except InputError as error:
        raise InputError(f"{frame.where}: {error}") from error


def _model(frame: Frame) -> str:
    name = model_of(frame)
    model = _MODELS.get(name)
    if model is None:
        raise InputError(
            f"{frame.where}: camera_model {shown(name)} is not rendered; supported: "
            f"{', '.join(_MODELS)}. Undistort the images to a pinhole first"
        )
    return model


def _size(frame: Frame, size: tuple[int, int] | None) -> tuple[int, int]:
    """Width and height that the intrinsics of the file refer to."""
    found = size_of(frame) or size
    if found is None:
        raise InputError(
            f"{frame.where}: no image size: w is missing, h is missing; give both in "
            "the file, or pass size=(width, height), on the command line --size WxH"
        )
    return found


def _distortion(frame: Frame) -> list[str]:
    """Keys of the distortion coefficients that are not zero."""
    found = [key for key in _DISTORTION if first_number(frame, key)]
    coefficients = frame.get("distortion_params")  # nerfstudio, per frame
    if isinstance(coefficients, list) and any(coefficients):
        found.append("distortion_params")
    return found


# --- names ---


def _unique_name(frame: Frame, index: int, used: dict[str, int]) -> str:
    """A file name without suffix that no entry before has, in any case of letters."""
    base = Path(
        (text_of(frame, "file_path") or "").replace("\\", "/").rpartition("/")[2]
    ).stem
    base = re.sub(r"[^\w.\- ]", "_", base).strip(". ")
    base = base.encode()[:_MAX_NAME_BYTES].decode(errors="ignore").strip(". ")
    base = base or f"frame_{index:05d}"
    name, key = base, base.casefold()
    while name.casefold() in used:
        used[key] += 1
        name = f"{base}_{used[key]}"
    used[name.casefold()] = 0
    return name
