"""A camera's path through what a run was trained on, and movies along a path.

Axis legend: F frames, N Gaussians, M points.
"""

import posixpath
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from gsjax.cameras.camera import make_camera, resize_camera
from gsjax.data import camera_paths
from gsjax.data.image_files import natural_order, short_names
from gsjax.data.photos import size_within, stored_size
from gsjax.data.transforms import CameraEntry
from gsjax.data.types import Dataset, View
from gsjax.gaussians import Gaussians
from gsjax.io import images
from gsjax.io.movies import check_movie, write_movie
from gsjax.plots.contact_sheets import depth_colors
from gsjax.runs.folder import Data
from gsjax.runs.scene_source import SceneSource
from gsjax.runs.views import prepared, rendered
from gsjax.runtime.console import note, progress

PATHS = ("test", "train", "orbit", "spiral", "interpolate")
MOVIE_SUFFIXES = (".gif", ".webp", ".webm")
_WIDEST_GAP = 120.0  # degrees of an orbit without a camera
_SAMPLED = 4000  # points, or Gaussians, to look at for a range of depths


def path_entries(
    data: Data,
    path: str,
    *,
    frames: int = 120,
    max_size: int | None = None,
    size: tuple[int, int] | None = None,
) -> list[CameraEntry]:
    """Cameras of a path, with names for their pictures.

    Args:
      data: of the run.
      path: of `PATHS`; "test" and "train" are the views themselves, the others go by
        all of them, in order of their names, in which IMG_2 is before IMG_10; see
        `gsjax.data.camera_paths`.
      frames: F, of the others.
      max_size: px, longest side, as in training; None as the photographs are.
      size: (width, height) in px to scale to instead.

    Raises:
      InputError: if ``frames`` is below 1, or a photograph's size cannot be read.
    """
    if path in ("test", "train"):
        chosen = data.test if path == "test" else data.train
        entries = _view_entries([data.scene.views[i] for i in chosen], max_size)
    else:
        entries = _flight(data.scene, path, frames, max_size)
    if size is None:
        return entries
    return [CameraEntry(e.name, resize_camera(e.camera, *size)) for e in entries]


def write_flight(
    subject: SceneSource,
    entries: Sequence[CameraEntry],
    path: Path,
    *,
    kind: str = "rgb",
    fps: float = 24.0,
    overwrite: bool = False,
) -> int:
    """Render the cameras to a movie; returns the number of frames.

    Depth is shown in Turbo colours, near red and far blue, over one range for all
    frames.

    Args:
      subject: what to render.
      entries: the cameras, of one size.
      path: .gif, .webp or .webm.
      kind: "rgb", "alpha" or "depth".
      fps: frames per second.
      overwrite: whether a movie that exists may be replaced.

    Raises:
      InputError: as `write_movie`, or if the scene cannot be read.
      CapacityError: if a view wants more memory than can be addressed.
      MissingExtraError: if OpenCV is absent.
    """
    images.opencv()
    check_movie(path, overwrite=overwrite)
    frames = _pictures(subject, entries, kind)
    return write_movie(path, frames, fps=fps, overwrite=overwrite)


def _pictures(
    subject: SceneSource, entries: Sequence[CameraEntry], kind: str
) -> Iterator[np.ndarray]:
    cameras = [entry.camera for entry in entries]
    gaussians, config = prepared(subject, cameras, (kind,))
    limits = _depth_limits(gaussians, entries) if kind == "depth" else None
    views = rendered(gaussians, cameras, config, subject.background)
    for _, view in zip(progress(entries, "frames"), views):
        image = np.asarray(getattr(view, kind), np.float32)
        if kind == "depth":
            yield depth_colors(image, limits)[0]
        elif kind == "alpha":
            yield np.repeat(images.to_8_bit(image)[..., None], 3, axis=2)
        else:
            yield images.to_8_bit(image)


# --- cameras ---


def _view_entries(views: Sequence[View], max_size: int | None) -> list[CameraEntry]:
    names = [PurePosixPath(n) for n in short_names([view.name for view in views])]
    folder = posixpath.commonpath([str(n.parent) for n in names]) if names else ""
    flat = ["_".join(name.relative_to(folder).parts) for name in names]
    clear = len({name.casefold() for name in flat}) == len(flat)
    entries = []
    for index, (shown, view) in enumerate(zip(flat, views)):
        shown = shown if clear else f"{index:05d}_{shown}"
        trained = _as_trained(view, max_size)
        entries.append(_entry(shown, trained.viewmat, trained, view.near))
    return entries


def _flight(
    scene: Dataset, path: str, frames: int, max_size: int | None
) -> list[CameraEntry]:
    views = sorted(scene.views, key=lambda view: natural_order(view.name))
    viewmats = np.stack([view.viewmat for view in views])
    fly = {
        "orbit": camera_paths.orbit,
        "spiral": camera_paths.spiral,
        "interpolate": camera_paths.interpolate,
    }[path]
    depth = _depth_ahead(scene)
    unseen = camera_paths.unseen_angle(viewmats, depth=depth)
    if path == "orbit" and unseen > _WIDEST_GAP:
        note(
            f"warning: {unseen:.0f}° of the orbit are on sides that no camera saw, and "
            "look accordingly; --path interpolate or spiral stay where the cameras were"
        )
    flown = fly(viewmats, frames, depth=depth)
    lens = camera_paths.median_intrinsics(
        [_as_trained(v, max_size) for v in scene.views]
    )
    near = min(view.near for view in scene.views)
    return [
        _entry(f"frame_{n:04d}", pose, lens, near) for n, pose in enumerate(flown, 1)
    ]


def _entry(
    name: str, viewmat: np.ndarray, lens: View | camera_paths.Intrinsics, near: float
) -> CameraEntry:
    camera = make_camera(
        viewmat=viewmat, K=lens.K, width=lens.width, height=lens.height, near=near
    )
    return CameraEntry(name, camera)


def _as_trained(view: View, max_size: int | None) -> View:
    """The view at the size at which `load_photo` gives its photograph; where that is
    not there, at the size that the camera is for."""
    width, height = size_within(*stored_size(view), max_size)
    K = view.K * ([width / view.width], [height / view.height], [1])
    return replace(view, K=K, width=width, height=height, lens=None)


def _depth_ahead(scene: Dataset) -> float | None:
    """How far from the cameras the points are; None if none is before any of them."""
    points = scene.points[:: 1 + len(scene.points) // _SAMPLED]
    depths = [points @ v.viewmat[2, :3] + v.viewmat[2, 3] for v in scene.views]
    medians = [np.median(z[z > 0]) for z in depths if (z > 0).any()]
    return float(np.median(medians)) if medians else None


def _depth_limits(
    gaussians: Gaussians, entries: Sequence[CameraEntry]
) -> tuple[float, float]:
    """Near and far of what the cameras see, by the Gaussians' means (a heuristic)."""
    means = np.asarray(gaussians.params.means)[np.asarray(gaussians.active)]
    means = means[:: 1 + len(means) // _SAMPLED].astype(np.float64)
    seen = []
    for _, camera in entries:
        viewmat, K = np.asarray(camera.viewmat), np.asarray(camera.K)
        local = means @ viewmat[:3, :3].T + viewmat[:3, 3]
        local = local[local[:, 2] > float(camera.near)]
        # On the host: there is another number of points each time.
        seen_at = camera.model.project(K, tuple(local.T))  # pyright: ignore
        u, v = map(np.asarray, seen_at)
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        seen.append(local[inside, 2])
    depths = np.concatenate(seen)
    if not len(depths):
        return 0.0, 0.0
    near, far = np.percentile(depths, (1, 99))
    return float(near), float(far)
