"""A scene given by a file of Gaussians or the folder of a run."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.gaussians import Gaussians
from gsjax.io.formats import render_mode, scene_path
from gsjax.raster.types import RasterConfig
from gsjax.runs import folder as run_folder
from gsjax.runs.moving import load_moving
from gsjax.runtime.console import note
from gsjax.train.config import mip_raster
from gsjax.train.motion.scene import MovingScene

# Render settings by their names on the command line.
RASTER_PRESETS = {
    "compat": RasterConfig.compat,
    "accurate": RasterConfig.accurate,
    "fast": RasterConfig.fast,
}


class SceneSource(NamedTuple):
    """A scene to render, and how.

    Attributes:
      load: reads the Gaussians; called after all other checks.
      config: render settings.
      background: RGB background.
      budget: maximum error of rgb to choose settings for, or None to use ``config``.
      moving: reads the scene at all times, if it moves. What ``load`` reads is then
        that at time 0.
    """

    load: Callable[[], Gaussians]
    config: RasterConfig
    background: tuple[float, ...]
    budget: float | None = None
    moving: Callable[[], MovingScene] | None = None


def free_view_config(trained: RasterConfig) -> RasterConfig:
    """Return the render settings of a run with occlusion culling, off in training.

    A free view may be filled by Gaussians right before the camera, where it pays.
    """
    return trained.replace(occlusion=not trained.sorts_pixels)


def note_moment(path: Path) -> None:
    """Say that of a run that moves, one moment is used."""
    if is_run(path) and run_folder.load_settings(path).config.motion != "none":
        note(
            f"{path}: the scene moves; its moment at time 0 is used (for another: "
            "gsjax export --time)"
        )


def is_run(path: Path) -> bool:
    """Return whether a path denotes a run: a folder, or missing and without suffix.

    The folder of a SOG is not a run: it stands for the file in it.
    """
    path = scene_path(path)
    return path.is_dir() or not (path.exists() or path.suffix)


def splat_file(path: Path) -> Path:
    """Return the file of Gaussians of a scene: the path itself, or that of the run.

    For the folder of a SOG it is the meta.json.

    Raises:
      InputError: if it is a folder but not a run, or a run without Gaussians yet.
    """
    if not is_run(path):
        return scene_path(path)
    run_folder.load_settings(path)
    return run_folder.require_splat(path)


def file_raster(path: Path) -> RasterConfig:
    """Return the render settings of a file of Gaussians: `RasterConfig.compat`.

    They draw surfels, or have the filter of Mip-Splatting, if the file says so.

    Raises:
      InputError: if the file cannot be read.
    """
    config, mode = RasterConfig.compat(), render_mode(path)
    if mode == "2dgs":
        return config.replace(primitive="surfel")
    return mip_raster(config) if mode == "mip" else config


def open_scene_source(
    path: Path,
    *,
    origin: np.ndarray | None = None,
    raster: RasterConfig | None = None,
    background: tuple[float, ...] | None = None,
) -> SceneSource:
    """Open a scene by its file or run.

    Args:
      path: a file of Gaussians, or the folder of a run.
      origin: [3] to subtract from the file's coordinates, as `load_dataset` and
        `load_near_transforms` do from those of the cameras.
      raster: render settings, except ``dilation``, ``antialias`` and ``primitive``,
        which are those of the scene; None for `free_view_config` of the run, or
        "compat" for a file.
      background: RGB; None for that of the run, or black for a file.

    Raises:
      InputError: as `splat_file`.
    """
    config, behind, moving = RasterConfig.compat(), (0.0, 0.0, 0.0), None
    origin = np.zeros(3) if origin is None else origin
    if is_run(path):
        trained = run_folder.load_settings(path).config
        config, behind = trained.raster, run_folder.background_color(trained)
        config = free_view_config(config)
        if trained.motion != "none":
            file = run_folder.run_files(path).motion
            moving = partial(load_moving, file, trained, origin)
    else:
        config = file_raster(path)
    if raster is not None:  # a scene is learnt for one way of drawing
        names = "dilation", "antialias", "primitive"
        config = raster.replace(**{name: getattr(config, name) for name in names})
    splat = splat_file(path)
    reader = partial(run_folder.load_scene, splat, origin)
    behind = behind if background is None else background
    return SceneSource(reader, config, behind, moving=moving)
