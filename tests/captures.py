"""Small datasets made by code, for the tests of their readers."""

import json
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsjax.cameras.camera import look_at
from gsjax.data.colmap_writer import write_colmap
from gsjax.data.types import Dataset, View
from gsjax.errors import InputError

SIZE = (32, 24)
PIXELS = {"fl_x": 40.0, "fl_y": 42.0, "cx": 15.5, "cy": 12.25, "w": 32, "h": 24}


def rejects(expected: str, call, *args, **options) -> None:
    """Check that a call raises an InputError with this message."""
    with pytest.raises(InputError, match=expected):
        call(*args, **options)


def warned(expected: str, call, *args, **options):
    """Return the result of a call that gives a warning with this message."""
    with pytest.warns(UserWarning, match=expected):
        return call(*args, **options)


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


def dataset_of_views(count: int = 5, points: int = 40, seed: int = 0, at=(0, 0, 0)):
    """A dataset of general poses around ``at``, two cameras, no files."""
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


def with_names(dataset: Dataset, names) -> Dataset:
    """The same dataset with other names of its views."""
    views = [replace(view, name=name) for view, name in zip(dataset.views, names)]
    return replace(dataset, views=tuple(views))


def colmap_dataset(folder: Path, dataset: Dataset | None = None, place="sparse/0"):
    """Write a dataset as a COLMAP model with photographs."""
    dataset = dataset_of_views() if dataset is None else dataset
    write_colmap(folder / place, dataset)
    for view in dataset.views:
        save_photo(folder / "images" / view.name)
    return dataset


def to_opengl(viewmat: np.ndarray) -> np.ndarray:
    """Camera → world in OpenGL axes of an OpenCV world → camera matrix."""
    return np.linalg.inv(viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])


def frames_of(dataset: Dataset, form="images/{}.png", **more) -> list[dict]:
    """Frames of a transforms.json whose file_path is ``form`` of the view's index."""
    matrices = [to_opengl(view.viewmat).tolist() for view in dataset.views]
    names = [form.format(index) for index in range(len(matrices))]
    rows = zip(names, matrices)
    return [{"file_path": n, "transform_matrix": m, **more} for n, m in rows]


def write_transforms(folder: Path, frames, name="transforms.json", **content) -> Path:
    """Write a transforms.json."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(json.dumps({**content, "frames": frames}))
    return path


def nerfstudio_dataset(folder: Path, count=4, **content) -> Dataset:
    """Write a dataset as ns-process-data does, with photographs."""
    dataset = dataset_of_views(count)
    frames = content.pop("frames", frames_of(dataset, "images/frame_{}.png"))
    for frame in frames:
        save_photo(folder / frame["file_path"])
    write_transforms(folder, frames, **{**PIXELS, "camera_model": "OPENCV", **content})
    return dataset


def llff_dataset(folder: Path, count=4) -> Dataset:
    """Write a dataset of LLFF, by the definition of the format, with photographs."""
    dataset = dataset_of_views(count)
    rows = []
    for view in dataset.views:
        right, down, forward = view.viewmat[:3, :3]
        intrinsics = (SIZE[1], SIZE[0], 40.0)
        matrix = np.stack([down, right, -forward, view.centre, intrinsics], -1)
        rows.append([*matrix.ravel(), 1.5, 20.0])
    np.save(folder / "poses_bounds.npy", rows)
    for index in range(count):
        save_photo(folder / "images" / f"IMG_{9 - index}.JPG")
    return dataset


def png_chunk(kind: bytes, body: bytes) -> bytes:
    """Return a chunk of a PNG."""
    crc = struct.pack(">I", zlib.crc32(kind + body))
    return struct.pack(">I", len(body)) + kind + body + crc


def exif_turn(orientation: int) -> bytes:
    """Return EXIF data of nothing but an orientation."""
    entry = struct.pack("<IHHHII", 8, 1, 0x112, 3, 1, orientation)
    return b"II*\0" + entry + bytes(4)


def ply_file(
    table: dict[str, np.ndarray],
    *,
    kind: str = "binary_little_endian",
    types: dict[str, str] | None = None,
    eol: str = "\n",
    before: tuple[str, bytes] = ("", b""),
    after: tuple[str, bytes] = ("", b""),
) -> bytes:
    """A PLY file; ``before`` and ``after`` are header lines and body of elements."""
    count = len(next(iter(table.values())))
    codes = {"float": "f4", "double": "f8", "uchar": "u1", "ushort": "u2", "int": "i4"}
    types = dict.fromkeys(table, "float") | (types or {})
    lines = ["ply", f"format {kind} 1.0", "comment made by a test"]
    lines += before[0].splitlines() + [f"element vertex {count}"]
    lines += [f"property {types[name]} {name}" for name in table]
    lines += after[0].splitlines() + ["end_header", ""]
    header = eol.join(lines).encode()
    if kind == "ascii":
        rows = zip(*(table[name] for name in table))
        text = "".join(" ".join(repr(float(v)) for v in row) + eol for row in rows)
        return header + before[1] + text.encode() + after[1]
    order = "<" if kind == "binary_little_endian" else ">"
    dtype = [(name, order + codes[types[name]]) for name in table]
    body = np.zeros(count, dtype)
    for name, column in table.items():
        body[name] = column
    return header + before[1] + body.tobytes() + after[1]
