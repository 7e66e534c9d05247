"""What is to be shown: a file, a run, or a training that is about to begin."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from gsjax.data.photos import load_photos
from gsjax.data.types import Dataset, Photo, View
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.runs.folder import (
    background_of,
    load_data,
    load_settings,
    refined_data,
    run_files,
)
from gsjax.runs.run_info import describe_run
from gsjax.runs.scene_source import from_anywhere, is_run, open_scene_source
from gsjax.runtime.console import note, one_line
from gsjax.train.config import TrainConfig
from gsjax.viewer.exact import ExactRenderer
from gsjax.viewer.session import Exhibit
from gsjax.viewer.stage import (
    THUMBNAIL,
    UPS,
    Frustum,
    eye_of_cameras,
    eye_of_gaussians,
    frusta_of,
)


class Shown(NamedTuple):
    """An exhibit, and the views whose photographs are still to be loaded."""

    exhibit: Exhibit
    views: tuple[View, ...] = ()


def open_exhibit(
    path: Path,
    *,
    up: str | None = None,
    preset: str | None = None,
    min_opacity: float = 0.0,
    max_gaussians: int | None = None,
) -> Shown:
    """A scene by its file or run; of a run with the cameras of its dataset.

    A dataset that is not there any more costs the cameras, and a warning.

    Args:
      path: a .ply or .spz file, or the folder of a run.
      up: of the world, of `UPS`; None takes it from the cameras, or else −y, which is
        up in most scenes from COLMAP.
      preset: as `open_scene_source`.
      min_opacity, max_gaussians: see `Exhibit`.

    Raises:
      InputError: as `open_scene_source`, or if the file cannot be read.
    """
    scene, status = None, ""
    if is_run(path):
        settings = load_settings(path)
        run = describe_run(path)
        status = f"step {run['steps_done']:,} of {run['steps']:,}"
        try:
            scene = refined_data(load_data(settings), run_files(path)).scene
        except InputError as error:
            note(f"warning: without cameras: {one_line(error)}")
    origin = None if scene is None else scene.origin
    subject = open_scene_source(path, origin=origin, preset=preset)
    gaussians = subject.load()
    frusta = [] if scene is None else frusta_of(scene.views)
    renderer = ExactRenderer(subject.config, subject.background)
    exhibit = _exhibit(gaussians, renderer, frusta, up)
    exhibit.status = status
    exhibit.min_opacity, exhibit.max_gaussians = min_opacity, max_gaussians
    return Shown(exhibit, () if scene is None else scene.views)


def photographed(views: Sequence[View], size: int = THUMBNAIL) -> list[Frustum]:
    """Cameras with their photographs; without, and a warning, where one is missing."""
    drawn = {frustum.name for frustum in frusta_of(views)}
    few = [view for view in views if view.name in drawn]
    try:
        return frusta_of(few, load_photos(few, size))
    except InputError as error:
        note(f"warning: without photographs: {one_line(error)}")
        return frusta_of(few)


def exhibit_of_training(
    gaussians: Gaussians, scene: Dataset, photos: Sequence[Photo], config: TrainConfig
) -> Exhibit:
    """What a training begins with.

    Its exact pictures are rendered by one device: the step runs on all of them at the
    same time, and two programs that wait for one another's devices would for ever. So
    ``gaussians``, and what is shown in their place, must be on one.
    """
    raster = from_anywhere(config.raster).replace(devices=1)
    renderer = ExactRenderer(raster, background_of(config))
    return _exhibit(gaussians, renderer, frusta_of(scene.views, photos), None)


def _exhibit(
    gaussians: Gaussians,
    renderer: ExactRenderer,
    frusta: list[Frustum],
    up: str | None,
) -> Exhibit:
    if frusta:
        eye = eye_of_cameras(frusta)
        eye = eye if up is None else eye._replace(up=UPS[up])
    else:
        eye = eye_of_gaussians(gaussians, UPS[up or "-y"])
    return Exhibit(gaussians, renderer, eye, frusta)
