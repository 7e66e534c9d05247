"""Compression of a run, or of a file of Gaussians, measured on held-out views."""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera, make_camera
from gsjax.cameras.distortion import lens_fields
from gsjax.compression.compress import compress
from gsjax.compression.finetune import Finetuning
from gsjax.compression.parts import part_path
from gsjax.compression.types import CompressedScene, Goal, HeldOut
from gsjax.data.photos import load_photos
from gsjax.data.transforms import load_near_transforms
from gsjax.data.types import Photo, View
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.io.common import warn
from gsjax.io.formats import DEFAULT_MODE
from gsjax.planning.types import Reason
from gsjax.raster.types import RasterConfig
from gsjax.runs import folder as run_folder
from gsjax.runs.export import scene_mode
from gsjax.runs.mesh import sphere_cameras
from gsjax.runs.refined_cameras import refine_photos
from gsjax.runs.scene_source import (
    is_run,
    note_moment,
    open_scene_source,
    splat_file,
)
from gsjax.runs.trajectories import view_entries
from gsjax.runtime.console import note
from gsjax.runtime.files import make_folder, reject_existing
from gsjax.train.config import TrainConfig, render_mode_of
from gsjax.train.frames import with_shutter_of
from gsjax.train.loop import subset

_ON_SPHERE, _HELD_OUT = 24, 7  # views of a file without cameras
_OUTSIDE = 0.02  # share of the Gaussians beyond each side of the box about them


class CompressionInputs(NamedTuple):
    """A scene, and the views by which it is compressed.

    Attributes:
      gaussians: the scene, relative to ``origin``.
      cameras: views that matter to the scene.
      held_out: pictures on which the loss is measured.
      config, background: how it is drawn.
      origin: [3] of the coordinates, in those of the dataset.
    """

    gaussians: Gaussians
    cameras: list[Camera]
    held_out: HeldOut
    config: RasterConfig
    background: tuple[float, ...]
    origin: np.ndarray


def compress_scene(
    source: Path,
    out: Path,
    goal: Goal,
    *,
    cameras: Path | None = None,
    finetune_steps: int = 0,
    overwrite: bool = False,
) -> CompressedScene:
    """Write a scene as small files, and return it as read back.

    Args:
      source: folder of a run, whose held-out views measure the loss; or a file of
        Gaussians.
      out: the file; its suffix selects the format. Its folder is created if missing.
      goal: what must be met, and the number of files, see `CompressedScene.save`.
      cameras: cameras of a file (transforms.json); None for a sphere about it.
      finetune_steps: number of steps for which the scene of a run is trained further in
        each trial; 0 for none.
      overwrite: replace an existing file.

    Raises:
      InputError: if there is no scene, the file exists without ``overwrite``, or as
        `compress`.
      CapacityError: as `compress`.
    """
    paths = [part_path(out, k + 1, goal.parts) for k in range(max(goal.parts, 1))]
    reject_existing(paths, overwrite)
    if finetune_steps and not is_run(source):
        remedy = "pass the folder of a run, which has photographs"
        raise InputError(f"{source}: expected a run for fine-tuning; {remedy}")
    inputs = compression_inputs(source, cameras)
    finetuning = run_finetuning(source, finetune_steps) if finetune_steps else None
    mode = scene_mode(source)
    if mode not in (render_mode_of(inputs.config), DEFAULT_MODE):
        warn(f"{source}: its render mode {mode!r} is not known, and not recorded")
    result = compress(
        inputs.gaussians,
        inputs.cameras,
        goal=goal,
        suffix=file_suffix(out),
        config=inputs.config,
        background=inputs.background,
        held_out=inputs.held_out,
        finetuning=finetuning,
    )
    if np.any(inputs.origin):
        place = ", ".join(f"{x:g}" for x in inputs.origin)
        why = f"coordinates are relative to ({place}), where the numbers are exact"
        result = result._replace(reasons=(*result.reasons, Reason("origin", why)))
    if len(result.files) < goal.parts:  # a small scene, whose files have other names
        count = len(result.files)
        reject_existing([part_path(out, k + 1, count) for k in range(count)], overwrite)
    make_folder(out.parent)
    result.save(out)
    return result


def file_suffix(path: Path) -> str:
    """Return the suffix of a file name, with both parts of ".compressed.ply"."""
    name = path.name.lower()
    return (
        ".compressed.ply" if name.endswith(".compressed.ply") else path.suffix.lower()
    )


def compression_inputs(source: Path, cameras: Path | None = None) -> CompressionInputs:
    """Return the scene of a run with its training and held-out views, or of a file.

    Args:
      source, cameras: as `compress_scene`.

    Raises:
      InputError: as `load_split`, if the run has no scene yet, or if the file cannot be
        read.
    """
    if not is_run(source):
        return _of_file(source, cameras)
    if run_folder.load_settings(source).config.motion == "none":
        return _of_run(source)
    # Photographs of other times do not show the moment that is compressed.
    note_moment(source)
    return _of_file(splat_file(source), cameras)


def _of_run(path: Path) -> CompressionInputs:
    settings = run_folder.load_settings(path)
    files, config = run_folder.run_files(path), settings.config
    given = run_folder.load_split(settings)
    split = run_folder.with_refined_cameras(given, files)
    gaussians = run_folder.load_scene(splat_file(path), split.dataset.origin)
    entries = view_entries(
        split.views("train"),
        max_size=config.max_size,
        undistort=config.undistort and not files.cameras.exists(),
        shutter=config.shutter,
    )
    which = "test" if split.test else "train"
    if which == "train":
        note("warning: the run holds out no views; the loss is that of training views")
    before, views = given.views(which), split.views(which)
    photos = load_photos(before, config.max_size, undistort=config.undistort)
    photos = refine_photos(photos, before, views)
    background = run_folder.background_color(config)
    return CompressionInputs(
        gaussians=gaussians,
        cameras=[entry.camera for entry in entries],
        held_out=_held_out(views, photos, config, background),
        config=config.raster,
        background=background,
        origin=split.dataset.origin,
    )


def run_finetuning(path: Path, steps: int) -> Finetuning:
    """Return the training views of a run, as refined, with their photographs.

    Raises:
      InputError: if the scene of the run moves.
    """
    settings = run_folder.load_settings(path)
    files, config = run_folder.run_files(path), settings.config
    if config.motion != "none":
        raise InputError(
            f"{path}: the scene moves, and its photographs show other times than the "
            "moment that is compressed; leave out --finetune"
        )
    given = run_folder.load_split(settings)
    split = run_folder.with_refined_cameras(given, files)
    before, dataset = given.views("train"), subset(split.dataset, split.train)
    photos = load_photos(before, config.max_size, undistort=config.undistort)
    return Finetuning(
        dataset, refine_photos(photos, before, dataset.views), config, steps
    )


def _held_out(
    views: list[View], photos: list[Photo], config: TrainConfig, background
) -> HeldOut:
    """Return views with their photographs over the background."""
    cameras, truths, valid = [], [], []
    for view, photo in zip(views, photos):
        height, width = photo.pixels.shape[:2]
        batch = make_camera(
            viewmat=view.viewmat[None],
            K=photo.K[None],
            width=width,
            height=height,
            near=np.asarray([view.near]),
            **lens_fields([photo.lens]),
        )
        batch = with_shutter_of([view], config.shutter, batch)
        cameras.append(jax.tree.map(lambda a: a[0], batch))
        truths.append(photo.over(background))
        valid.append(photo.valid)
    return HeldOut(cameras, truths, valid)


def _of_file(path: Path, cameras: Path | None) -> CompressionInputs:
    origin = np.zeros(3)
    given: list[Camera] = []
    if cameras is not None:
        entries, origin = load_near_transforms(cameras)
        given = [entry.camera for entry in entries]
    source = open_scene_source(path, origin=origin)
    gaussians = source.load()
    if cameras is None:
        low, high = _box(gaussians)
        note(f"no cameras: {_ON_SPHERE} views from a sphere about the scene")
        given = sphere_cameras(low, high, _ON_SPHERE)
        held_out = HeldOut(sphere_cameras(low, high, _HELD_OUT))
    else:
        held_out = HeldOut(given[::8])
        given = [one for place, one in enumerate(given) if place % 8] or given
    if not given:
        raise InputError(f"{cameras}: expected at least one camera, got none")
    params = gaussians.params
    gaussians = gaussians.replace(  # pyright: ignore
        params=jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), params)
    )
    return CompressionInputs(
        gaussians, given, held_out, source.config, source.background, origin
    )


def _box(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a box about the more opaque half of a scene."""
    active = np.asarray(gaussians.active)
    logits = np.asarray(gaussians.params.logit_opacities)[active]
    if not len(logits):
        raise InputError("scene: expected at least one Gaussian, got none")
    solid = logits >= np.median(logits)
    means = np.asarray(gaussians.params.means, np.float64)[active][solid]
    low, high = np.quantile(means, [_OUTSIDE, 1 - _OUTSIDE], axis=0)
    margin = 0.05 * float((high - low).max()) or 1.0
    return low - margin, high + margin
