"""Cameras to render, from the `transforms.json` of NeRF, instant-ngp or nerfstudio.

The files have camera → world matrices in OpenGL axes (x right, y up, z backward): flip
columns 1 and 2 and invert for world → camera in OpenCV axes. Everything is float64 on
the host until `make_camera`.
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
    intrinsics_of,
    model_of,
    pose_of,
    read_frames,
    shown,
    size_of,
    text_of,
    warn_of_scaled,
)
from gsjax.data.types import unexpected
from gsjax.errors import InputError

# `camera_model` of the file → lens of `make_camera`; distortion is not rendered.
_MODELS = {
    **dict.fromkeys(("OPENCV", "PINHOLE", "SIMPLE_PINHOLE"), "pinhole"),
    **dict.fromkeys(("RADIAL", "SIMPLE_RADIAL"), "pinhole"),
    "ORTHOGRAPHIC": "orthographic",
}
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_MAX_NAME_BYTES = 180


class CameraEntry(NamedTuple):
    """A camera and a unique name, safe as a file name, without suffix."""

    name: str
    camera: Camera


def load_transforms(
    path: str | PathLike[str], *, size: tuple[int, int] | None = None
) -> list[CameraEntry]:
    """Return the cameras of a `transforms.json`, in the order of the file.

    Intrinsics are read from the frame or, for all frames, from the top level: fl_x,
    fl_y, cx, cy, w, h in px, or camera_angle_x and camera_angle_y in radians, or x_fov
    and y_fov in degrees. A single one holds for both axes; cx and cy default to the
    image centre. Lens distortion is ignored, with a warning.

    Args:
      path: the JSON file.
      size: (width, height) in px of the images to render. Intrinsics are scaled from
        the size in the file (another aspect ratio stretches the image); if the file
        has none, as NeRF's synthetic scenes, they refer to this size.

    Returns:
      The cameras, named by the stem of file_path or else ``frame_00012``.

    Raises:
      InputError: if the file cannot be read or is not such a JSON file, or a frame has
        no rigid transform_matrix, no usable intrinsics, no size or an unknown lens.
    """
    entries, _ = _load(Path(path), size, near_origin=False)
    return entries


def load_near_transforms(
    path: str | PathLike[str], *, size: tuple[int, int] | None = None
) -> tuple[list[CameraEntry], np.ndarray]:
    """Return the cameras of `load_transforms`, translated if float32 is too coarse.

    Returns:
      The cameras, and the [3] float64 offset that was subtracted from their coordinates
      and must be subtracted from those of the scene; see `gsjax.data.rebase`.
    """
    return _load(Path(path), size, near_origin=True)


def _load(
    path: Path, size: tuple[int, int] | None, near_origin: bool
) -> tuple[list[CameraEntry], np.ndarray]:
    if size is not None and not (
        len(size) == 2 and all(isinstance(v, int | np.integer) and v >= 1 for v in size)
    ):
        raise unexpected("size", "whole (width, height) ≥ 1", size, "pass (800, 600)")
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
            "images are rendered without it",
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
    fx, fy, cx, cy = intrinsics_of(frame, width, height, model)
    out_width, out_height = (width, height) if size is None else size
    sx, sy = out_width / width, out_height / height
    K = np.asarray([[sx * fx, 0, sx * cx], [0, sy * fy, sy * cy], [0, 0, 1]])
    try:
        with np.errstate(over="ignore"):
            return make_camera(
                viewmat=viewmat,
                K=K,
                width=int(out_width),
                height=int(out_height),
                near=near,
                lens=model,
            )
    except InputError as error:
        raise InputError(f"{frame.where}: {error}") from error


def _model(frame: Frame) -> str:
    name = model_of(frame)
    model = _MODELS.get(name)
    if model is None:
        raise InputError(
            f"{frame.where}: camera_model {shown(name)} cannot be rendered; supported: "
            f"{', '.join(_MODELS)}; undistort the images to a pinhole first"
        )
    return model


def _size(frame: Frame, size: tuple[int, int] | None) -> tuple[int, int]:
    """Return the width and height that the intrinsics of the file refer to."""
    found = size_of(frame) or size
    if found is None:
        raise InputError(
            f"{frame.where}: no image size: w is missing, h is missing; give both in "
            "the file, or pass size=(width, height), on the command line --size WxH"
        )
    return found


def _distortion(frame: Frame) -> list[str]:
    """Return the keys of nonzero distortion coefficients."""
    found = [key for key in _DISTORTION if first_number(frame, key)]
    coefficients = frame.get("distortion_params")  # nerfstudio, per frame
    if isinstance(coefficients, list) and any(coefficients):
        found.append("distortion_params")
    return found


# --- names ---


def _unique_name(frame: Frame, index: int, used: dict[str, int]) -> str:
    """Return a file name without suffix, unique even if case is ignored."""
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
