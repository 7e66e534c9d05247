"""Small datasets made by code, for the tests of their readers."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from gsjax.cameras.camera import look_at
from gsjax.data.types import Dataset, View

SIZE = (32, 24)


def save_photo(path: Path, pixels: np.ndarray | None = None) -> Path:
    """Write RGB(A) or grey pixels, by default a small ramp, and make the folders."""
    if pixels is None:
        ramp = np.arange(SIZE[0] * SIZE[1] * 3) % 251
        pixels = ramp.reshape(SIZE[1], SIZE[0], 3).astype(np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    if pixels.ndim == 3:
        order = [2, 1, 0, 3][: pixels.shape[2]]
        pixels = pixels[..., order]
    done, data = cv2.imencode(path.suffix, np.ascontiguousarray(pixels))
    assert done
    path.write_bytes(data.tobytes())
    return path


def scene_of_views(count: int = 5, points: int = 40, seed: int = 0, at=(0, 0, 0)):
    """A scene of general poses around ``at``, two cameras, no files."""
    rng = np.random.default_rng(seed)
    views = []
    for index in range(count):
        eye, target = rng.normal(size=3) * 3 + at, 0.2 * rng.normal(size=3) + at
        focal = 40.0 + index % 2
        K = np.asarray([[focal, 0, 15.5], [0, focal + 2, 12.25], [0, 0, 1]])
        name = f"view_{index:02d}.png"
        views.append(View(name, Path(name), look_at(eye, target), K, *SIZE))
    xyz = rng.normal(size=(points, 3)) + at
    colors = rng.integers(0, 256, (points, 3)).astype(np.uint8)
    return Dataset(Path("made"), "made", tuple(views), xyz, colors)


def to_opengl(viewmat: np.ndarray) -> np.ndarray:
    """Camera → world in OpenGL axes of an OpenCV world → camera matrix."""
    return np.linalg.inv(viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])


def synthetic_model(folder: Path) -> Path:
    """A model by pycolmap in ``bin`` and ``txt``, with tracks and 2D points."""
    # After cv2: loaded before, its zlib breaks the PNG encoder of OpenCV.
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 2, 2
    options.num_frames_per_rig, options.num_points3D = 3, 15
    options.num_points2D_without_point3D = 3
    pycolmap.set_random_seed(1)
    model = pycolmap.synthesize_dataset(options)
    for form in ("bin", "txt"):
        (folder / form).mkdir()
    model.write_binary(folder / "bin")
    model.write_text(folder / "txt")
    return folder
