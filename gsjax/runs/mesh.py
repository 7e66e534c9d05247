"""The mesh of a run: depth of its views → distance field → triangles → file.

Axis legend: N Gaussians.
"""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, activate
from gsjax.mesh.fusion import DepthImage, Grid, fuse, make_grid
from gsjax.mesh.surface import (
    Mesh,
    components,
    is_watertight,
    largest,
    surface_of,
    write_mesh,
)
from gsjax.raster.types import RasterConfig
from gsjax.runs import folder as run_folder
from gsjax.runs.scene_source import open_scene_source
from gsjax.runs.trajectories import view_entries
from gsjax.runs.views import prepare_render, render_cameras
from gsjax.runtime.console import note, progress
from gsjax.runtime.files import make_folder, reject_existing

_SOLID = 0.5  # opacity from which a pixel shows a surface, and a Gaussian counts
_SHARE = 0.02  # of the Gaussians beyond each side of the box
_MARGIN = 0.05  # of the box, added on each side


class MeshSettings(NamedTuple):
    """Settings of a mesh.

    Attributes:
      resolution: voxels along the longest side of the box.
      box: corners (low, high) in the coordinates of the dataset; None for a box that
        holds the opaque Gaussians but for 2 % on each side.
      depth: "median" or "expected".
      parts: number of connected parts that are kept, the largest; 0 for all.
      closed: take what no view has seen as outside, so that the mesh is watertight.
    """

    resolution: int = 256
    box: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    depth: str = "median"
    parts: int = 1
    closed: bool = False


class MeshReport(NamedTuple):
    """A mesh, and how it was made.

    Attributes:
      mesh: the mesh, in the coordinates of the dataset's files.
      voxel: side of a voxel, world units.
      parts: number of connected parts before the small ones were left out.
      watertight: whether each edge belongs to two triangles.
      seconds: time taken.
    """

    mesh: Mesh
    voxel: float
    parts: int
    watertight: bool
    seconds: float


def mesh_of_run(
    folder: Path, out: Path, settings: MeshSettings, *, overwrite: bool = False
) -> MeshReport:
    """Write the mesh of a run.

    Args:
      folder: of the run.
      out: .ply, .glb, .obj or .stl; its folder is created if missing.
      settings: how it is made.
      overwrite: replace an existing file.

    Raises:
      InputError: if the run has no scene, the file exists without ``overwrite``, or
        there is no surface in the box.
      CapacityError: if the voxels do not fit in memory.
      MissingExtraError: if a package for meshes is not installed.
    """
    begun = time.perf_counter()
    reject_existing([out], overwrite)
    run = run_folder.load_settings(folder)
    files = run_folder.run_files(folder)
    split = run_folder.with_refined_cameras(run_folder.load_split(run), files)
    origin = split.dataset.origin
    source = open_scene_source(folder, origin=origin)
    entries = view_entries(
        split.views("train"),
        max_size=run.config.max_size,
        undistort=run.config.undistort and not files.cameras.exists(),
        shutter=run.config.shutter,
    )
    cameras = [entry.camera for entry in entries]
    kind = "depth" if settings.depth == "expected" else "median_depth"
    gaussians, config = prepare_render(source, cameras, ("rgb", "alpha", kind))
    config = config.replace(ray_depth=not config.draws_surfels)
    grid = _grid(gaussians, settings, origin)
    shape = " × ".join(map(str, grid.shape))
    note(f"voxels: {shape}, {grid.voxel:.4g} wide; {len(cameras)} views")
    field = fuse(_depth_images(gaussians, cameras, config, kind), grid)
    mesh = surface_of(field, closed=settings.closed)
    parts = int(components(mesh).max()) + 1
    if settings.parts:
        mesh = largest(mesh, settings.parts)
    mesh = mesh._replace(vertices=mesh.vertices + origin)
    make_folder(out.parent)
    write_mesh(out, mesh, overwrite=overwrite)
    seconds = time.perf_counter() - begun
    return MeshReport(mesh, grid.voxel, parts, is_watertight(mesh), seconds)


def _grid(gaussians: Gaussians, settings: MeshSettings, origin: np.ndarray) -> Grid:
    """Return the voxels, in the coordinates of training."""
    if settings.box is not None:
        low, high = (np.asarray(corner) - origin for corner in settings.box)
        return make_grid(low, high, settings.resolution)
    solid = np.asarray(gaussians.active) & (
        np.asarray(activate(gaussians.params)["opacities"]) > _SOLID
    )
    if solid.sum() < 8:
        raise InputError(
            f"scene: expected Gaussians with an opacity above {_SOLID}, got "
            f"{solid.sum()}; train longer, or pass a box (--box)"
        )
    means = np.asarray(gaussians.params.means, np.float64)[solid]
    low, high = np.quantile(means, [_SHARE, 1 - _SHARE], axis=0)
    margin = _MARGIN * (high - low).max()
    return make_grid(low - margin, high + margin, settings.resolution)


def _depth_images(
    gaussians: Gaussians, cameras: list, config: RasterConfig, kind: str
) -> Iterator[DepthImage]:
    """Yield the depth of each view, 0 where it shows no surface."""
    views = render_cameras(gaussians, cameras, config, (0.0, 0.0, 0.0))
    for camera, view in zip(progress(cameras, "views"), views):
        depth = getattr(view, kind)
        solid = jnp.asarray(view.alpha) > _SOLID
        yield DepthImage(camera, jnp.where(solid, depth, 0), view.rgb)
