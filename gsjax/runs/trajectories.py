"""Cameras of a dataset's views or along a path through it, and movies.

Axis legend: B views, F frames, N Gaussians, M points.
"""

import posixpath
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Protocol

import numpy as np

from gsjax.cameras.camera import make_camera, with_shutter
from gsjax.cameras.distortion import (
    Distortion,
    distortion_of,
    project_points,
    single_lens_fields,
)
from gsjax.cameras.lenses import panorama_intrinsics
from gsjax.cameras.shutter import SHUTTERS
from gsjax.data import camera_paths
from gsjax.data.image_files import natural_order, short_names
from gsjax.data.photos import size_within, stored_size
from gsjax.data.transforms import CameraEntry
from gsjax.data.types import Dataset, View
from gsjax.gaussians import Gaussians
from gsjax.io import images
from gsjax.io.movies import check_movie, write_movie
from gsjax.plots.contact_sheets import depth_colors
from gsjax.runs.scene_source import SceneSource
from gsjax.runs.views import render_entries
from gsjax.runtime.console import note, progress
from gsjax.train.frames import twists_of

_WIDEST_GAP = 120.0  # degrees of an orbit without a camera
_SAMPLED = 4000  # points, or Gaussians, sampled for a range of depths


class CameraPath(Protocol):
    """A path through posed views, as `gsjax.data.camera_paths.orbit`.

    It maps viewmats [B, 4, 4] to those of ``frames`` cameras [F, 4, 4].
    """

    def __call__(
        self, viewmats: np.ndarray, frames: int, *, depth: float | None
    ) -> np.ndarray: ...


# Paths by their names on the command line.
CAMERA_PATHS: dict[str, CameraPath] = {
    "orbit": camera_paths.orbit,
    "spiral": camera_paths.spiral,
    "interpolate": camera_paths.interpolate,
}


def view_entries(
    views: Sequence[View],
    *,
    max_size: int | None = None,
    undistort: bool = False,
    shutter: str = "global",
) -> list[CameraEntry]:
    """Return the cameras of views, at the size of their photographs.

    Their names are those of the photographs, relative to the folder that all share.

    Args:
      views: the views.
      max_size: longest side in px, as in training; None for no limit.
      undistort: return ideal pinholes in place of the lenses of the photographs.
      shutter: name of the shutter; a rolling one moves by the twists of the views.

    Raises:
      InputError: if the size of a photograph cannot be read.
    """
    names = [PurePosixPath(n) for n in short_names([view.name for view in views])]
    folder = posixpath.commonpath([str(n.parent) for n in names]) if names else ""
    flat = ["_".join(name.relative_to(folder).parts) for name in names]
    if len({name.casefold() for name in flat}) < len(flat):
        flat = [f"{index:05d}_{name}" for index, name in enumerate(flat)]
    scaled = [_at_photo_size(view, max_size) for view in views]
    if undistort:
        scaled = [replace(view, lens=None) for view in scaled]
    entries = [
        _entry(n, view.viewmat, view, view.near, view.lens).replace(time=view.time)
        for n, view in zip(flat, scaled)
    ]
    if not SHUTTERS[shutter].rolling:
        return entries
    return [
        entry.replace(camera=with_shutter(entry.camera, shutter, twist=twist))
        for entry, twist in zip(entries, twists_of(scaled))
    ]


def path_entries(
    dataset: Dataset,
    path: CameraPath,
    *,
    frames: int = 120,
    max_size: int | None = None,
) -> list[CameraEntry]:
    """Return the cameras of a path through all views: pinholes of median intrinsics.

    The views are visited in natural order of their names: IMG_2 before IMG_10. Where
    they are panoramas, the pinholes are 90° wide.

    Args:
      dataset, path: at least one view, and a path of `CAMERA_PATHS` or another.
      frames: F.
      max_size: longest side in px, as in training; None for no limit.

    Raises:
      InputError: if ``frames`` is below 1, or the size of a photograph cannot be read.
    """
    views = sorted(dataset.views, key=lambda view: natural_order(view.name))
    viewmats = np.stack([view.viewmat for view in views])
    depth = _median_depth(dataset)
    unseen = camera_paths.unseen_angle(viewmats, depth=depth)
    if path is camera_paths.orbit and unseen > _WIDEST_GAP:
        seen = f"{unseen:.0f}° of the orbit see sides that no photograph shows"
        note(f"warning: {seen}; --path interpolate or spiral stay near the cameras")
    poses = path(viewmats, frames, depth=depth)
    scaled = [_at_photo_size(view, max_size) for view in dataset.views]
    intrinsics = _ideal_intrinsics(scaled)
    near = min(view.near for view in views)
    return [
        _entry(f"frame_{n:04d}", pose, intrinsics, near)
        for n, pose in enumerate(poses, 1)
    ]


def _ideal_intrinsics(views: Sequence[View]) -> camera_paths.Intrinsics:
    """Return intrinsics of pinholes that show about as much as the views."""
    found = camera_paths.median_intrinsics(views)
    if all(v.lens is None or v.lens.lens.period is None for v in views):
        return found
    w, h = found.width, found.height
    K = np.array([[w / 2, 0, w / 2], [0, w / 2, h / 2], [0, 0, 1]])
    return found._replace(K=K)


def with_times(
    entries: Sequence[CameraEntry],
    span: tuple[float, float] | None = None,
    *,
    freeze_time: bool = False,
    freeze_camera: bool = False,
) -> list[CameraEntry]:
    """Return cameras with the times at which they show a scene that moves.

    Args:
      entries: F cameras, in the order of the frames.
      span: times of the first and the last frame. By default cameras keep their times,
        and if any has none, time runs from 0 to 1.
      freeze_time: show all frames at the time of the first.
      freeze_camera: show all frames from the place of the first.
    """
    times = [entry.time for entry in entries]
    if span is not None or any(time is None for time in times):
        times = np.linspace(*(span or (0.0, 1.0)), len(entries)).tolist()
    if freeze_time:
        times = times[:1] * len(entries)
    timed = [entry.replace(time=time) for entry, time in zip(entries, times)]
    if freeze_camera:
        timed = [entry.replace(camera=entries[0].camera) for entry in timed]
    return timed


def render_movie(
    source: SceneSource,
    entries: Sequence[CameraEntry],
    path: Path,
    *,
    kind: str = "rgb",
    fps: float = 24.0,
    overwrite: bool = False,
) -> int:
    """Render cameras to a movie and return the number of frames.

    Depth is shown in Turbo colours, near red and far blue, over one range for all
    frames.

    Args:
      source: the scene.
      entries: cameras of one size.
      path: .mp4, .webm, .webp or .gif file.
      kind: "rgb", "alpha" or "depth".
      fps: frames per second.
      overwrite: replace an existing file.

    Raises:
      InputError: as `write_movie`, or if the scene cannot be read.
      CapacityError: if a view needs more memory than can be addressed.
      MissingExtraError: if OpenCV is absent, or PyAV for .mp4.
    """
    images.opencv()
    check_movie(path, overwrite=overwrite)
    frames = _frames(source, entries, kind)
    return write_movie(path, frames, fps=fps, overwrite=overwrite)


def _frames(
    source: SceneSource, entries: Sequence[CameraEntry], kind: str
) -> Iterator[np.ndarray]:
    renders, gaussians = render_entries(source, entries, (kind,))
    limits = depth_limits(gaussians, entries) if kind == "depth" else None
    for _, view in zip(progress(entries, "frames"), renders):
        image = np.asarray(getattr(view, kind), np.float32)
        if kind == "depth":
            yield depth_colors(image, limits)[0]
        elif kind == "alpha":
            yield np.repeat(images.to_8_bit(image)[..., None], 3, axis=2)
        else:
            yield images.to_8_bit(image)


def _entry(
    name: str,
    viewmat: np.ndarray,
    intrinsics: View | camera_paths.Intrinsics,
    near: float,
    lens: Distortion | None = None,
) -> CameraEntry:
    fields = single_lens_fields(lens)
    size = {"width": intrinsics.width, "height": intrinsics.height}
    camera = make_camera(viewmat=viewmat, K=intrinsics.K, **size, near=near, **fields)
    return CameraEntry(name, camera)


def through_lens(entry: CameraEntry, lens: str) -> CameraEntry:
    """Return the camera with another lens at the same pose.

    Args:
      entry: a camera with its name.
      lens: "equirectangular", the whole sphere on an image twice as wide as it is high;
        or "fisheye", equidistant with 180° across the shorter side of the image.
    """
    camera = entry.camera
    width, height = camera.width, camera.height
    if lens == "equirectangular":
        width, K, coefficients = (
            2 * height,
            panorama_intrinsics(2 * height, height),
            None,
        )
    else:
        focal = min(width, height) / np.pi
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        coefficients = np.zeros(4)
    changed = make_camera(
        viewmat=camera.viewmat,
        K=K,
        width=width,
        height=height,
        near=camera.near,
        far=camera.far,
        lens=lens,
        coefficients=coefficients,
    )
    return entry.replace(camera=changed)


def _at_photo_size(view: View, max_size: int | None) -> View:
    """Return the view at the size that `load_photo` returns."""
    width, height = size_within(*stored_size(view), max_size)
    K = view.K * ([width / view.width], [height / view.height], [1])
    return replace(view, K=K, width=width, height=height)


def _median_depth(dataset: Dataset) -> float | None:
    """Return the median depth of the points in the views; None if none is in front."""
    points = dataset.points[:: 1 + len(dataset.points) // _SAMPLED]
    depths = [points @ v.viewmat[2, :3] + v.viewmat[2, 3] for v in dataset.views]
    medians = [np.median(z[z > 0]) for z in depths if (z > 0).any()]
    return float(np.median(medians)) if medians else None


def depth_limits(
    gaussians: Gaussians, entries: Sequence[CameraEntry]
) -> tuple[float, float]:
    """Return the 1st and 99th percentile of the depth of the means in all images.

    It is (0, 0) if no mean is in an image.
    """
    means = np.asarray(gaussians.params.means)[np.asarray(gaussians.active)]
    means = means[:: 1 + len(means) // _SAMPLED].astype(np.float64)
    seen = []
    for camera in (entry.camera for entry in entries):
        viewmat = np.asarray(camera.viewmat)
        local = means @ viewmat[:3, :3].T + viewmat[:3, 3]
        lens, K = distortion_of(camera), np.asarray(camera.K, np.float64)
        pixels, depth, valid = project_points(lens, K, local)
        inside = (pixels >= 0) & (pixels < (camera.width, camera.height))
        seen.append(depth[inside.all(-1) & valid & (depth > float(camera.near))])
    depths = np.concatenate(seen)
    if not len(depths):
        return 0.0, 0.0
    near, far = np.percentile(depths, (1, 99)).tolist()
    return near, far
