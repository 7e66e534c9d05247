"""Cameras to the `transforms.json` form that `gsjax.data.transforms` reads."""

import json
from collections.abc import Sequence

import numpy as np

from gsjax.data.transforms import CameraEntry
from gsjax.errors import InputError


def transforms_json(
    entries: Sequence[CameraEntry], *, ply_file_path: str | None = None
) -> str:
    """Text of a `transforms.json` with one frame per camera.

    What all cameras share (intrinsics, size, lens) stands at the top, the rest in the
    frames. Near and far have no place in the format and are lost.

    Args:
      entries: names and single (unbatched) cameras.
      ply_file_path: name of a point cloud beside the file, as nerfstudio has it.

    Raises:
      InputError: if a camera is a batch.
    """
    frames = [_frame(entry) for entry in entries]
    shared = {
        key: value
        for key, value in (frames[0].items() if frames else ())
        if key not in ("file_path", "transform_matrix")
        and all(frame[key] == value for frame in frames)
    }
    frames = [{k: v for k, v in f.items() if k not in shared} for f in frames]
    if ply_file_path is not None:
        shared["ply_file_path"] = ply_file_path
    return json.dumps({**shared, "frames": frames}, indent=1, allow_nan=False) + "\n"


def _frame(entry: CameraEntry) -> dict:
    camera = entry.camera
    if camera.batched:
        raise InputError(f"camera {entry.name!r} is a batch; pass single cameras")
    viewmat = np.asarray(camera.viewmat, np.float64)
    matrix = np.eye(4)
    matrix[:3, :3] = viewmat[:3, :3].T
    matrix[:3, 3] = -viewmat[:3, :3].T @ viewmat[:3, 3]
    matrix[:3, 1:3] *= -1  # OpenCV axes to OpenGL axes
    K = np.asarray(camera.K, np.float64)
    return {
        "camera_model": camera.model.name.upper(),
        "w": camera.width,
        "h": camera.height,
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "file_path": f"{entry.name}.png",
        "transform_matrix": matrix.tolist(),
    }
