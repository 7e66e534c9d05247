"""Cameras from and to the `transforms.json` of NeRF, instant-ngp or nerfstudio.

The files have camera → world matrices in OpenGL axes (x right, y up, z backward): flip
columns 1 and 2 and invert for world → camera in OpenCV axes. Everything is float64 on
the host until `make_camera`.
"""

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from gsjax.cameras.camera import Camera, make_camera
from gsjax.cameras.distortion import single_lens_fields
from gsjax.data.extent import near_plane
from gsjax.data.rebase import far_origin, shifted
from gsjax.data.transforms_fields import (
    Frame,
    no_size,
    read_frames,
    warn_of_scaled,
)
from gsjax.data.transforms_lens import intrinsics_of_frame, lens_keys, lens_of_frame
from gsjax.data.types import inverted, unexpected
from gsjax.errors import InputError

_MAX_NAME_BYTES = 180


@dataclass(frozen=True)
class CameraEntry:
    """A camera with its name and time; unpacks as (name, camera).

    Attributes:
      name: unique, safe as a file name, without suffix.
      camera: a single camera.
      time: of the exposure; None if it is unknown.
    """

    name: str
    camera: Camera
    time: float | None = None

    def __iter__(self) -> Iterator[Any]:
        return iter((self.name, self.camera))

    def replace(self, **changes) -> "CameraEntry":
        """Return a copy with some attributes changed."""
        return replace(self, **changes)


def load_transforms(
    path: str | PathLike[str], *, size: tuple[int, int] | None = None
) -> list[CameraEntry]:
    """Return the cameras of a `transforms.json`, in the order of the file.

    Intrinsics are read from the frame or, for all frames, from the top level: fl_x,
    fl_y, cx, cy, w, h in px, or camera_angle_x and camera_angle_y in radians, or x_fov
    and y_fov in degrees. A single one holds for both axes; cx and cy default to the
    image centre.

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
    poses = [frame.pose() for frame in frames]
    centres = np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose, _ in poses])
    origin = far_origin(centres, np.zeros((0, 3))) if near_origin else np.zeros(3)
    near = near_plane(centres)
    entries: list[CameraEntry] = []
    used: dict[str, int] = {}
    for index, (frame, (viewmat, _)) in enumerate(zip(frames, poses)):
        camera = _camera(frame, shifted(viewmat, origin), size, near)
        name = _unique_name(frame, index, used)
        entries.append(CameraEntry(name, camera, frame.number("time")))
    factors = enumerate(factor for _, factor in poses)
    warn_of_scaled(path, [(index, factor) for index, factor in factors if factor != 1])
    return entries, origin


def _camera(
    frame: Frame, viewmat: np.ndarray, size: tuple[int, int] | None, near: float
) -> Camera:
    orthographic = frame.model() == "ORTHOGRAPHIC"
    lens = None if orthographic else lens_of_frame(frame)
    found = frame.size() or size
    if found is None:
        raise no_size(frame.where)
    width, height = found
    if orthographic:
        fx, fy, cx, cy = frame.intrinsics(width, height, "orthographic")
        K = np.asarray([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        fields: dict[str, Any] = {"lens": "orthographic"}
    else:
        K = intrinsics_of_frame(frame, (width, height), lens)
        fields = single_lens_fields(lens)
    out_width, out_height = (width, height) if size is None else size
    K = K * [[out_width / width], [out_height / height], [1]]
    try:
        with np.errstate(over="ignore"):
            pixels = {"width": int(out_width), "height": int(out_height)}
            return make_camera(viewmat=viewmat, K=K, **pixels, near=near, **fields)
    except InputError as error:
        raise InputError(f"{frame.where}: {error}") from error


def _unique_name(frame: Frame, index: int, used: dict[str, int]) -> str:
    """Return a file name without suffix, unique even if case is ignored."""
    path = (frame.text("file_path") or "").replace("\\", "/")
    base = Path(path.rpartition("/")[2]).stem
    base = re.sub(r"[^\w.\- ]", "_", base).strip(". ")
    base = base.encode()[:_MAX_NAME_BYTES].decode(errors="ignore").strip(". ")
    base = base or f"frame_{index:05d}"
    name, key = base, base.casefold()
    while name.casefold() in used:
        used[key] += 1
        name = f"{base}_{used[key]}"
    used[name.casefold()] = 0
    return name


def transforms_json(
    entries: Sequence[CameraEntry], *, ply_file_path: str | None = None
) -> str:
    """Return the text of a `transforms.json` with one frame per camera.

    Values that all cameras share (intrinsics, size, lens) are at the top level, the
    others in the frames. The format has no near and far planes.

    Args:
      entries: names and single (unbatched) cameras.
      ply_file_path: name of a point cloud beside the file, for nerfstudio.

    Raises:
      InputError: if a camera is a batch, or its lens is not one of the format.
    """
    frames = [_frame_of(entry) for entry in entries]
    shared = {
        key: value
        for key, value in (frames[0].items() if frames else ())
        if key not in ("file_path", "transform_matrix", "time")
        and all(frame.get(key) == value for frame in frames)
    }
    frames = [{k: v for k, v in f.items() if k not in shared} for f in frames]
    if ply_file_path is not None:
        shared["ply_file_path"] = ply_file_path
    return json.dumps({**shared, "frames": frames}, indent=1, allow_nan=False) + "\n"


def _frame_of(entry: CameraEntry) -> dict:
    camera = entry.camera
    if camera.batched:
        where, remedy = f"camera {entry.name!r}", "pass them one by one"
        raise unexpected(where, "a single camera", "a batch", remedy)
    viewmat = np.asarray(camera.viewmat, np.float64)
    matrix = inverted(viewmat[:3, :3], viewmat[:3, 3])
    matrix[:3, 1:3] *= -1  # OpenCV axes to OpenGL axes
    K = np.asarray(camera.K, np.float64)
    time = {} if entry.time is None else {"time": entry.time}
    return {
        **lens_keys(camera),
        "w": camera.width,
        "h": camera.height,
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "file_path": f"{entry.name}.png",
        **time,
        "transform_matrix": matrix.tolist(),
    }
