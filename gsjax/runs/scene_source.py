"""What the commands are given as a scene: a file, or the folder of a run."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.gaussians import Gaussians
from gsjax.raster.types import RasterConfig
from gsjax.runs.folder import (
    background_of,
    load_scene,
    load_settings,
    saved_splat,
)

PRESETS = {
    "compat": RasterConfig.compat,
    "accurate": RasterConfig.accurate,
    "fast": RasterConfig.fast,
}


class SceneSource(NamedTuple):
    """A scene to be rendered, and how it wants to be.

    Attributes:
      load: reads the Gaussians; called when all else is found to be well.
      config: how to render.
      background: RGB behind the scene.
      budget: largest error of rgb for which to choose the settings anew, or None.
    """

    load: Callable[[], Gaussians]
    config: RasterConfig
    background: tuple[float, ...]
    budget: float | None = None


def from_anywhere(trained: RasterConfig) -> RasterConfig:
    """The settings of a training, for views that are not of its photographs.

    Such a view may be filled by what stands right before the camera, and what is behind
    it is looked for; training does not, see `TrainConfig`.
    """
    return trained.replace(occlusion=RasterConfig.occlusion)


def is_run(path: Path) -> bool:
    """Whether a name means a run: a folder, or nothing that is there with a suffix."""
    return path.is_dir() or not (path.exists() or path.suffix)


def splat_file(path: Path) -> Path:
    """The Gaussians of a scene: the file itself, or that of the run.

    Raises:
      InputError: if it is a run that is none, or that has no Gaussians yet.
    """
    if not is_run(path):
        return path
    load_settings(path)
    return saved_splat(path)


def open_scene_source(
    path: Path,
    *,
    origin: np.ndarray | None = None,
    preset: str | None = None,
    background: tuple[float, ...] | None = None,
) -> SceneSource:
    """A scene by its file or run.

    Args:
      path: a .ply or .spz file, or the folder of a run.
      origin: [3] what is subtracted from the file's coordinates, as it is from those
        of the cameras that `load_dataset` or `load_near_transforms` gives.
      preset: name of the constants to render with; None takes those of the run, with
        the search for what is hidden that training leaves out, for a file "compat".
      background: RGB; None takes that of the run, for a file black.

    Raises:
      InputError: as `splat_file`.
    """
    config, behind = RasterConfig.compat(), (0.0, 0.0, 0.0)
    if is_run(path):
        trained = load_settings(path).config
        config, behind = from_anywhere(trained.raster), background_of(trained)
    if preset is not None:
        # Opacities were learnt with or without it: no matter of taste.
        config = PRESETS[preset](antialias=config.antialias)
    splat = splat_file(path)
    reader = partial(load_scene, splat, np.zeros(3) if origin is None else origin)
    return SceneSource(reader, config, behind if background is None else background)
