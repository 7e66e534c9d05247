"""Viewer content from a file, a run, or a training that starts."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from gsjax.data.photos import load_photos
from gsjax.data.types import Dataset, Photo, View
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.mesh.surface import read_mesh
from gsjax.raster.types import RasterConfig
from gsjax.runs import folder
from gsjax.runs.info import describe_run
from gsjax.runs.mesh import find_mesh
from gsjax.runs.scene_source import free_view_config, is_run, open_scene_source
from gsjax.runtime.console import note, one_line
from gsjax.train.config import TrainConfig
from gsjax.viewer import cameras
from gsjax.viewer.exact import ExactRenderer
from gsjax.viewer.session import ViewerContent


class LoadedContent(NamedTuple):
    """Content, and the views whose photographs are not loaded yet."""

    content: ViewerContent
    views: tuple[View, ...] = ()


def load_content(
    path: Path,
    *,
    up: str | None = None,
    raster: RasterConfig | None = None,
    min_opacity: float = 0.0,
    max_gaussians: int | None = None,
    with_mesh: bool = False,
) -> LoadedContent:
    """Load a scene by its file or run; a run brings the cameras of its dataset.

    If the dataset is missing, the cameras are left out with a warning.

    Args:
      path: a file of Gaussians, or the folder of a run.
      up: up direction of the world, a key of `UPS`; None takes it from the cameras, or
        −y without cameras, as in most scenes from COLMAP.
      raster: as `open_scene_source`.
      min_opacity, max_gaussians: see `ViewerContent`.
      with_mesh: also load the mesh that `gsjax mesh` has written for the scene.

    Raises:
      InputError: as `open_scene_source`, or if a file is missing or cannot be read.
      MissingExtraError: if there is a mesh, and trimesh is not installed.
    """
    mesh = read_mesh(find_mesh(path)) if with_mesh else None
    dataset, status = None, ""
    if is_run(path):
        settings, run = folder.load_settings(path), describe_run(path)
        status = f"step {run['steps_done']:,} of {run['steps']:,}"
        try:
            split, files = folder.load_split(settings), folder.run_files(path)
            dataset = folder.with_refined_cameras(split, files).dataset
        except InputError as error:
            note(f"warning: without cameras: {one_line(error)}")
    origin, views = (dataset.origin, dataset.views) if dataset else (None, ())
    source = open_scene_source(path, origin=origin, raster=raster)
    gaussians = source.load()
    renderer = ExactRenderer(source.config, source.background)
    content = make_content(gaussians, renderer, cameras.frusta_of(views), up)
    content.status = status
    if source.moving is not None:
        content.moving = source.moving()
    if mesh is not None:
        offset = 0 if origin is None else origin
        content.mesh = mesh._replace(vertices=mesh.vertices - offset)
    content.min_opacity, content.max_gaussians = min_opacity, max_gaussians
    return LoadedContent(content, views)


def frusta_with_photos(
    views: Sequence[View], size: int = cameras.THUMBNAIL
) -> list[cameras.Frustum]:
    """Return cameras with photographs; without and with a warning if one is missing."""
    drawn = {frustum.name for frustum in cameras.frusta_of(views)}
    few = [view for view in views if view.name in drawn]
    try:
        return cameras.frusta_of(few, load_photos(few, size))
    except InputError as error:
        note(f"warning: without photographs: {one_line(error)}")
        return cameras.frusta_of(few)


def training_content(
    gaussians: Gaussians, dataset: Dataset, photos: Sequence[Photo], config: TrainConfig
) -> ViewerContent:
    """Return the content for the start of a training.

    Exact images are rendered on one device, and ``gaussians`` must be on one: the step
    runs on all devices at the same time, and two programs that wait for each other's
    devices would deadlock.
    """
    raster = free_view_config(config.raster).replace(devices=1)
    renderer = ExactRenderer(raster, folder.background_color(config))
    return make_content(gaussians, renderer, cameras.frusta_of(dataset.views, photos))


def make_content(
    gaussians: Gaussians,
    renderer: ExactRenderer,
    frusta: list[cameras.Frustum],
    up: str | None = None,
) -> ViewerContent:
    """Return content with a viewpoint for it; ``up`` as in `load_content`."""
    if frusta:
        viewpoint = cameras.viewpoint_of_cameras(frusta)
        viewpoint = viewpoint if up is None else viewpoint._replace(up=cameras.UPS[up])
    else:
        viewpoint = cameras.viewpoint_of_gaussians(gaussians, cameras.UPS[up or "-y"])
    return ViewerContent(gaussians, renderer, viewpoint, frusta)
