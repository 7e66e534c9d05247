"""A small good file of every format, and the function that reads it."""

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from captures import dataset_of_views, save_photo, to_opengl
from ksplat_files import ksplat_fields, ksplat_file

import gsjax
from gsjax.data import colmap_binary
from gsjax.data.colmap import read_colmap
from gsjax.data.colmap_writer import write_colmap
from gsjax.data.llff import load_llff
from gsjax.data.nerf import load_nerf
from gsjax.data.photos import load_photo
from gsjax.data.transforms import load_transforms
from gsjax.data.types import View
from gsjax.io.point_cloud import read_point_cloud
from gsjax.io.spz import write_spz
from gsjax.runs.checkpoint import load_checkpoint, save_checkpoint
from gsjax.runs.folder import RunSettings, load_settings, save_settings
from gsjax.runs.info import describe_run
from gsjax.runs.refined_cameras import load_cameras, save_cameras

SCENE = dataset_of_views(count=2, points=4)
MODEL = ("cameras", "images", "points3D")
STEP, META = "checkpoints/step_000000007.npz", "meta.json.npy"


def photo(path: Path, mask: Path | None = None):
    return load_photo(View("a", path, np.eye(4), np.eye(3), 8, 6, mask=mask))


def nerf(path: Path):
    load_transforms(path, size=(8, 6))
    return load_nerf(path)


READ: dict[str, Callable[[Path], object]] = {
    "scene.ply": gsjax.load,
    "ascii.ply": gsjax.load,
    "cloud.ply": read_point_cloud,
    "scene.compressed.ply": gsjax.load,
    "scene.spz": gsjax.load,
    "older.spz": gsjax.load,
    "scene.splat": gsjax.load,
    "scene.ksplat": gsjax.load,
    "scene.sog": gsjax.load,
    "sog/meta.json": gsjax.load,
    "sog/quats.webp": lambda path: gsjax.load(path.parent),
    "scene.glb": gsjax.load,
    "sparse/0/cameras.bin": colmap_binary.read_cameras,
    "sparse/0/images.bin": colmap_binary.read_images,
    "sparse/0/points3D.bin": colmap_binary.read_points,
    **{f"text/{n}.txt": lambda path: read_colmap(path.parent) for n in MODEL},
    "transforms.json": nerf,
    "poses_bounds.npy": load_llff,
    **{f"photo{s}": photo for s in (".png", ".jpg", ".webp", ".tiff", ".bmp")},
    "mask.png": lambda path: photo(path.with_name("photo.png"), path),
    STEP: load_checkpoint,
    "config.json": lambda path: load_settings(path.parent),
    "eval.json": lambda path: describe_run(path.parent),
    "cameras.json": lambda path: load_cameras(SCENE, path),
}
# A prefix of whole rows is a valid shorter file: bytes of a row.
WHOLE_ROWS = {"scene.splat": 32}
# A prefix of text may be a valid shorter file, which gives a warning if it is detected.
TEXT = ("ascii.ply", "cloud.ply", *(f"text/{name}.txt" for name in MODEL))


def write_good_files(folder: Path) -> None:
    """A small good file of every format."""
    with jax.enable_x64(False):
        gaussians = gsjax.init_gaussians(SCENE, sh_degree=0)
    gsjax.save(folder / "scene.ply", gaussians)
    for suffix in (".spz", ".splat", ".compressed.ply"):
        gsjax.save(folder / f"scene{suffix}", gaussians)
    write_spz(folder / "older.spz", gaussians, version=3)
    (folder / "sog").mkdir()
    harmonic = gsjax.with_sh_degree(gaussians, 1)
    for name in ("scene.sog", "sog/meta.json", "scene.glb"):
        gsjax.save(folder / name, harmonic)
    (folder / "scene.ksplat").write_bytes(ksplat_file(1, ksplat_fields(4)))
    (folder / "ascii.ply").write_bytes(as_ascii((folder / "scene.ply").read_bytes()))
    cloud = "ply\nformat ascii 1.0\nelement vertex 2\n"
    names = [*(f"float {axis}" for axis in "xyz"), "uchar red", "uchar green"]
    cloud += "".join(f"property {name}\n" for name in [*names, "uchar blue"])
    cloud += "end_header\n0 0.5 1 9 8 7\n1 2 3 4 5 6\n"
    (folder / "cloud.ply").write_text(cloud)
    write_colmap(folder / "sparse/0", SCENE)
    (folder / "text").mkdir()
    for name, text in COLMAP_TEXT.items():
        (folder / "text" / f"{name}.txt").write_text(text)
    for view in SCENE.views:
        save_photo(folder / "images" / view.name)
    (folder / "transforms.json").write_text(json.dumps(TRANSFORMS))
    np.save(folder / "poses_bounds.npy", POSES)
    pixels = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)
    for suffix in (".png", ".jpg", ".webp", ".tiff", ".bmp"):
        save_photo(folder / f"photo{suffix}", pixels)
    save_photo(folder / "mask.png", pixels[..., 0] // 128 * np.uint8(255))
    state = gsjax.init_state(gaussians, gsjax.TrainConfig(sh_degree=0), 1.0, 2)
    state = state.replace(step=state.step + 7)
    content = {"pair_capacity": 64, "seconds": 0.0}
    assert save_checkpoint(folder / "checkpoints", state, content) == folder / STEP
    save_settings(folder, RunSettings(dataset=folder))
    scores = {"which": "test", "views": 2, "psnr": 30.5, "ssim": 0.9}
    (folder / "eval.json").write_text(json.dumps(scores))
    save_cameras(folder / "cameras.json", SCENE)


def npy(array) -> bytes:
    """Return an array as the bytes of a .npy file."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def entries(
    edit: Callable[[dict[str, bytes]], object], method: int = zipfile.ZIP_STORED
) -> Callable[[bytes], bytes]:
    """Return a change that edits the entries of a ZIP archive, with valid checksums."""

    def change(data: bytes) -> bytes:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            found = {name: archive.read(name) for name in archive.namelist()}
        edit(found)
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", method) as archive:
            for name, content in found.items():
                archive.writestr(name, content)
        return buffer.getvalue()

    return change


def as_ascii(data: bytes) -> bytes:
    """Return the same PLY as text."""
    head, body = data.split(b"end_header\n")
    rows = np.frombuffer(body, "<f4").reshape(len(SCENE.points), 17)
    head = head.replace(b"binary_little_endian", b"ascii") + b"end_header\n"
    lines = [" ".join(f"{value:.3g}" for value in row) for row in rows]
    return head + "\n".join([*lines, ""]).encode()


COLMAP_TEXT = {
    "cameras": "# Camera list\n# Number of cameras: 2\n"
    "1 PINHOLE 32 24 40 42 15.5 12.25\n2 SIMPLE_RADIAL 32 24 40 15.5 12.25 0.1\n",
    "images": "# Image list\n# Number of images: 2, mean observations per image: 1\n"
    "1 1 0 0 0 0 0 3 1 view_00.png\n1.5 2 1\n"
    "2 0.5 0.5 0.5 0.5 0 1 3 2 view_01.png\n3 4 -1 7 8 1\n",
    "points3D": "# 3D point list\n# Number of points: 2, mean track length: 1\n"
    "1 0.5 1 -2 255 0 9 0.25 1 0 2 1\n2 3 4 5 1 2 3 0.5 1 0\n",
}
TRANSFORMS = {
    **{"w": 32, "h": 24, "fl_x": 40, "fl_y": 42, "cx": 15.5, "cy": 12.25},
    "frames": [
        {
            "file_path": f"images/{view.name}",
            "transform_matrix": np.round(to_opengl(view.viewmat), 5).tolist(),
        }
        for view in SCENE.views
    ],
}
# Down, right, back; position; height, width, focal length; near and far.
POSES = np.asarray([[0, 1, 0, 1, 24, 1, 0, 0, 2, 32, 0, 0, -1, 3, 40, 1, 9]] * 2, float)
