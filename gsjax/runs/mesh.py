"""The mesh of a run: depth of its views → distance field → triangles → file.

Axis legend: N Gaussians.
"""

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera, look_at, make_camera
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, activate
from gsjax.mesh.fusion import DepthImage, fuse, make_grid, make_unbounded_grid
from gsjax.mesh.surface import (
    SUFFIXES,
    Mesh,
    components,
    filled,
    is_watertight,
    largest,
    simplified,
    surface_of,
    write_mesh,
)
from gsjax.raster.types import RasterConfig
from gsjax.runs import folder as run_folder
from gsjax.runs.scene_source import (
    SceneSource,
    is_run,
    note_moment,
    open_scene_source,
)
from gsjax.runs.trajectories import view_entries
from gsjax.runs.views import prepare_render, render_cameras
from gsjax.runtime.console import note, progress
from gsjax.runtime.files import make_folder, reject_existing

Corners = tuple[Sequence[float], Sequence[float]]

_SOLID = 0.5  # opacity from which a pixel shows a surface, and a Gaussian counts
_SHARE = 0.02  # of the Gaussians beyond each side of the box
_LEAST_PART = 0.01  # of the triangles
_MARGIN = 0.05  # of the box, added on each side
_FOV, _SIZE = np.radians(50.0), 640  # of the views of a sphere


class MeshSettings(NamedTuple):
    """Settings of a mesh.

    Attributes:
      resolution: voxels along the longest side of the box.
      box: corners (low, high) in the coordinates of the dataset; None for a box that
        holds the opaque Gaussians but for 2 % on each side.
      unbounded: mesh all of space; the box is only where voxels are finest.
      sphere: number of views from a sphere about the box; 0 takes the training views.
      depth: "median" or "expected"; None for the median in a box, else the expected.
      truncation: distance from the surface, in voxels, that an image counts behind it.
      parts: number of connected parts that are kept, the largest; 0 for all; None for
        those with at least 1 % of the triangles.
      closed: make a watertight solid, see `gsjax.mesh.surface_of`.
      fill_holes: close each hole by triangles about its middle.
      triangles: most triangles of the mesh, reached by edge collapses; None for all.
    """

    resolution: int = 256
    box: Corners | None = None
    unbounded: bool = False
    sphere: int = 0
    depth: str | None = None
    truncation: float = 4.0
    parts: int | None = None
    closed: bool = False
    fill_holes: bool = False
    triangles: int | None = None

    @property
    def output(self) -> str:
        """Return the name of the output of a render that is fused."""
        depth = self.depth or ("expected" if self.unbounded else "median")
        return {"median": "median_depth", "expected": "depth"}[depth]


class MeshReport(NamedTuple):
    """A mesh, and how it was made.

    Attributes:
      mesh: the mesh, in the coordinates of the dataset's files.
      voxel: side of a voxel, or of the finest one if unbounded, world units.
      parts: numbers of connected parts: of the mesh, and of the surface before the
        small ones were left out.
      watertight: see `gsjax.mesh.is_watertight`.
      seconds: time taken.
    """

    mesh: Mesh
    voxel: float
    parts: tuple[int, int]
    watertight: bool
    seconds: float


def mesh_of_run(
    path: Path, out: Path, settings: MeshSettings, *, overwrite: bool = False
) -> MeshReport:
    """Write the mesh of a run, or of a file of Gaussians.

    Args:
      path: folder of the run, or a file of Gaussians, which is seen from a sphere.
      out: .ply, .glb, .obj or .stl; its folder is created if missing.
      settings: how it is made.
      overwrite: replace an existing file.

    Raises:
      InputError: if there is no scene, the file exists without ``overwrite``, or there
        is no surface in the box.
      CapacityError: if the voxels do not fit in memory.
      MissingExtraError: if a package for meshes is not installed.
    """
    begun = time.perf_counter()
    reject_existing([out], overwrite)
    cameras, origin, source = _opened(path, with_views=not settings.sphere)
    if not (cameras or settings.sphere):
        raise InputError(
            f"{path}: a file has no cameras; pass a number of views from a sphere "
            "(--sphere 64)"
        )
    if settings.box is not None:
        low, high = (np.asarray(corner) - origin for corner in settings.box)
        settings = settings._replace(box=(low, high))
    gaussians, config = prepare_render(source, cameras, ("rgb", "alpha"))
    config = config.replace(ray_depth=not config.draws_surfels)
    report = mesh_of_scene(gaussians, cameras, config, settings)
    mesh = report.mesh._replace(vertices=report.mesh.vertices + origin)
    make_folder(out.parent)
    write_mesh(out, mesh, overwrite=overwrite)
    return report._replace(mesh=mesh, seconds=time.perf_counter() - begun)


def mesh_of_scene(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    config: RasterConfig,
    settings: MeshSettings | None = None,
) -> MeshReport:
    """Return the mesh of Gaussians, in their coordinates, and how it was made.

    Args:
      gaussians: N slots, concrete.
      cameras: of the depth images, unless the settings ask for a sphere of views.
      config: render settings but for the outputs; ``ray_depth`` gives ellipsoids a
        depth that varies within each.
      settings: how it is made; ``box`` in the coordinates of the Gaussians.

    Raises:
      InputError, CapacityError, MissingExtraError: as `mesh_of_run`.
    """
    begun, settings = time.perf_counter(), settings or MeshSettings()
    low, high = _box(gaussians, settings)
    if settings.unbounded:
        half = float((high - low).max()) / 2
        grid = make_unbounded_grid((low + high) / 2, half, settings.resolution)
        voxel = grid.voxel * half
    else:
        grid = make_grid(low, high, settings.resolution)
        voxel = grid.voxel
    if settings.sphere:
        cameras = sphere_cameras(low, high, settings.sphere)
    config = config.replace(outputs=("rgb", "alpha", settings.output))
    shape = " × ".join(map(str, grid.shape))
    note(f"voxels: {shape}, {voxel:.4g} wide; {len(cameras)} views")
    images = _depth_images(gaussians, cameras, config, settings.output)
    field = fuse(images, grid, truncation=settings.truncation)
    mesh = surface_of(field, closed=settings.closed)
    sizes = np.bincount(components(mesh))
    kept = settings.parts
    if kept is None:
        kept = int(np.sum(sizes >= _LEAST_PART * len(mesh.faces)))
    parts = min(kept, len(sizes)) or len(sizes), len(sizes)
    mesh = largest(mesh, parts[0])
    if settings.fill_holes:
        mesh = filled(mesh)
    if settings.triangles is not None:
        mesh = simplified(mesh, settings.triangles)
    seconds = time.perf_counter() - begun
    return MeshReport(mesh, voxel, parts, is_watertight(mesh), seconds)


def find_mesh(path: Path) -> Path:
    """Return the mesh that `gsjax mesh` wrote for a scene by default.

    Raises:
      InputError: if there is none.
    """
    usual = default_mesh(path)
    found = [usual.with_name(f"{usual.stem}{suffix}") for suffix in SUFFIXES]
    for file in found:
        if file.exists():
            return file
    raise InputError(f"{found[0]}: no mesh; make it with gsjax mesh {path}")


def default_mesh(path: Path) -> Path:
    """Return the path of the mesh of a run, or of a file of Gaussians."""
    return (
        path / "mesh.ply" if is_run(path) else path.with_name(f"{path.stem}.mesh.ply")
    )


def sphere_cameras(low, high, count: int) -> list[Camera]:
    """Return cameras on a sphere about a box, all of which they see.

    Args:
      low, high: [3] corners of the box, world units.
      count: number of cameras, evenly spread (a Fibonacci lattice).
    """
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    distance, focal = radius / np.sin(_FOV / 2), _SIZE / 2 / np.tan(_FOV / 2)
    K = np.asarray([[focal, 0, _SIZE / 2], [0, focal, _SIZE / 2], [0, 0, 1]])
    place = np.arange(count) + 0.5
    height, turn = 1 - 2 * place / count, np.pi * (1 + 5**0.5) * place
    flat = np.sqrt(1 - height**2)
    ways = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], -1)
    return [
        make_camera(
            viewmat=look_at(centre + distance * way, centre),
            K=K,
            width=_SIZE,
            height=_SIZE,
        )
        for way in ways
    ]


def _opened(path: Path, *, with_views: bool):
    """Return cameras, the origin of the coordinates of training, and the scene."""
    if not is_run(path):
        return [], np.zeros(3), open_scene_source(path)
    note_moment(path)
    run = run_folder.load_settings(path)
    files = run_folder.run_files(path)
    split = run_folder.with_refined_cameras(run_folder.load_split(run), files)
    origin = split.dataset.origin
    source: SceneSource = open_scene_source(path, origin=origin)
    if not with_views:
        return [], origin, source
    entries = view_entries(
        split.views("train"),
        max_size=run.config.max_size,
        undistort=run.config.undistort and not files.cameras.exists(),
        shutter=run.config.shutter,
    )
    return [entry.camera for entry in entries], origin, source


def _box(gaussians: Gaussians, settings: MeshSettings) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the box, in the coordinates of the Gaussians."""
    if settings.box is not None:
        low, high = (np.asarray(corner, np.float64) for corner in settings.box)
        return low, high
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
    return low - margin, high + margin


def _depth_images(
    gaussians: Gaussians, cameras: Sequence[Camera], config: RasterConfig, kind: str
) -> Iterator[DepthImage]:
    """Yield the depth of each view, 0 where it shows no surface."""
    views = render_cameras(gaussians, cameras, config, (0.0, 0.0, 0.0))
    for camera, view in zip(progress(cameras, "views"), views):
        depth = getattr(view, kind)
        solid = jnp.asarray(view.alpha) > _SOLID
        yield DepthImage(camera, jnp.where(solid, depth, 0), view.rgb)
