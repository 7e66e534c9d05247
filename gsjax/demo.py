"""The built-in demonstration: a scene from nothing, pictures of it, and its files.

Renders a made-up scene; it writes what training would (a scene as PLY, its cameras),
so that the other commands can be tried on it.
"""

from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from gsjax import images
from gsjax.console import note, progress
from gsjax.io import save
from gsjax.movies import encode_animation
from gsjax.raster.render import render_exact
from gsjax.raster.types import RasterConfig, Render
from gsjax.scene.synthetic import SyntheticScene, torus_knot_scene
from gsjax.scene.transforms import CameraEntry
from gsjax.scene.transforms_writer import transforms_json

_TURN_SECONDS = 4.0


class DemoFiles(NamedTuple):
    """Where the demonstration writes."""

    scene: Path
    cameras: Path
    still: Path
    depth: Path
    turntable: Path


class DemoSettings(NamedTuple):
    """How much there is to see."""

    gaussians: int = 20_000
    frames: int = 48
    width: int = 640
    height: int = 480


def demo_files(folder: Path) -> DemoFiles:
    """Names inside ``folder``."""
    return DemoFiles(
        scene=folder / "scene.ply",
        cameras=folder / "cameras.json",
        still=folder / "still.png",
        depth=folder / "depth.png",
        turntable=folder / "turntable.webp",
    )


def run_demo(folder: Path, settings: DemoSettings, *, overwrite: bool) -> DemoFiles:
    """Make the scene, render it and write all files.

    Raises:
      InputError: if a file exists and ``overwrite`` is not set, or cannot be written.
      MissingExtraError: if OpenCV is absent.
    """
    files = demo_files(folder)
    images.refuse_existing(files, overwrite)
    images.opencv()
    images.make_folder(folder)
    scene = torus_knot_scene(*settings)
    _write_scene(files, scene, overwrite)
    note(f"rendering {scene.gaussians.capacity:,} Gaussians (the first view compiles)")
    first, frames = _turn(scene)
    images.write_file(files.still, _png(first.rgb))
    depth = images.depth_picture(np.asarray(first.depth))
    # Near is bright, as pictures of depth mostly are; 0 stays "nothing".
    shown = np.where(depth.pixels > 0, 65536 - depth.pixels.astype(np.int32), 0)
    images.write_file(files.depth, images.encode_png(shown.astype(np.uint16)))
    fps = len(frames) / _TURN_SECONDS
    images.write_file(files.turntable, encode_animation(".webp", frames, fps))
    return files


def _write_scene(files: DemoFiles, scene: SyntheticScene, overwrite: bool) -> None:
    save(files.scene, scene.gaussians, overwrite=overwrite)
    entries = [
        CameraEntry(f"orbit_{index:03d}", camera)
        for index, camera in enumerate(scene.cameras)
    ]
    images.write_file(files.cameras, transforms_json(entries).encode())


def _turn(scene: SyntheticScene) -> tuple[Render, list[np.ndarray]]:
    """The first view, and pictures of all views at half the size."""
    # All views are alike, so one size of the work is enough: it compiles faster.
    config = RasterConfig(outputs=("rgb", "depth"), rungs=1)
    background = jnp.asarray(scene.background)
    first, frames = None, []
    for camera in progress(scene.cameras, "turntable"):
        view = render_exact(scene.gaussians, camera, config, background)
        first = view if first is None else first
        frames.append(images.to_8_bit(_halved(np.asarray(view.rgb))))
    assert first is not None, "an orbit has a camera"
    return first, frames


def _halved(image: np.ndarray) -> np.ndarray:
    """Means over 2 × 2 pixels; an odd last row or column is cut off."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    blocks = image[: 2 * height, : 2 * width].reshape(height, 2, width, 2, -1)
    return blocks.mean(axis=(1, 3))


def _png(rgb) -> bytes:
    return images.encode_png(images.to_8_bit(np.asarray(rgb)))
