"""Writer of cameras as a `transforms.json`, see `gsjax.data.transforms`."""

import json
from collections.abc import Sequence

import numpy as np

from gsjax.data.transforms import CameraEntry
from gsjax.errors import InputError


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
        raise InputError(
            f"camera {entry.name!r}: expected a single camera, got a batch; pass them "
            "one by one"
        )
    viewmat = np.asarray(camera.viewmat, np.float64)
    matrix = np.eye(4)
    matrix[:3, :3] = viewmat[:3, :3].T
    matrix[:3, 3] = -viewmat[:3, :3].T @ viewmat[:3, 3]
    matrix[:3, 1:3] *= -1  # OpenCV axes to OpenGL axes
    K = np.asarray(camera.K, np.float64)
    return {
        "camera_model": camera.lens.name.upper(),
        "w": camera.width,
        "h": camera.height,
        "fl_x": K[0, 0],
        "fl_y": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "file_path": f"{entry.name}.png",
        "transform_matrix": matrix.tolist(),
    }
