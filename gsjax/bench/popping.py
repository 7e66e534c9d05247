"""Popping: how much pictures change when the camera turns, beside being turned.

The frames of a camera that turns about its centre show the same rays. So each frame is
compared with the one before, rendered at the places where that one saw the same rays:
at these very places, not interpolated. If the order of the splats of a ray changes
between the two, the picture pops. Radl et al. (2024, StopThePop) compare warped frames.

The rest without popping is that of the projection: EWA depends on where in the image a
Gaussian is. Axis legend: F frames, M points.
"""

from collections.abc import Mapping
from functools import partial
from itertools import pairwise
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from gsjax.cameras.camera import Camera
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.raster.exact import exact_config
from gsjax.raster.render import render
from gsjax.raster.sampling import sample
from gsjax.raster.types import Array, RasterConfig
from gsjax.runtime.console import progress
from gsjax.runtime.timing import interleaved
from gsjax.synthetic.stress_scenes import StressScene

ORDERS: Mapping[str, dict[str, Any]] = {
    "center": {},
    **{f"window {w}": {"order": "window", "order_window": w} for w in (1, 2, 4)},
    "pixel": {"order": "pixel"},
}
_WIDE = 16, 64  # windows whose popping is measured, but not their time


def turned(camera: Camera, frames: int, degrees: float, axis=(0.0, 1.0, 0.0)):
    """Return F cameras that turn about their centre.

    Args:
      camera: a single camera, the first.
      frames: F.
      degrees: between two frames.
      axis: [3] in camera coordinates.
    """
    view = np.asarray(camera.viewmat, np.float64)
    axis = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    turns = Rotation.from_rotvec(
        np.radians(degrees) * np.arange(frames)[:, None] * axis
    )
    views = np.tile(np.eye(4), (frames, 1, 1))
    views[:, :3] = turns.as_matrix() @ view[:3]
    return [camera.replace(viewmat=jnp.asarray(v, camera.viewmat.dtype)) for v in views]


def same_rays(first: Camera, second: Camera, points: np.ndarray) -> np.ndarray:
    """Return the places [M, 2] where ``first`` sees the rays of ``second`` at points.

    Both are pinholes at one place. Places behind the camera are NaN.
    """
    views = [np.asarray(c.viewmat, np.float64)[:3, :3] for c in (first, second)]
    K = np.asarray(first.K, np.float64)
    rays = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(K).T
    seen = rays @ (views[0] @ views[1].T).T @ K.T
    front = np.where(seen[:, 2:] > 0, seen[:, 2:], np.nan)
    return seen[:, :2] / front


def popping(
    gaussians: Gaussians,
    cameras: list[Camera],
    config: RasterConfig,
    *,
    points: np.ndarray | None = None,
    features: Array | None = None,
) -> np.ndarray:
    """Return the popping [F - 1] between consecutive frames.

    It is the mean over places and channels of the absolute difference between a frame
    and the one before at the places where that one saw the same rays, in colour units.

    Args:
      gaussians: N slots.
      cameras: F pinholes that turn about their centre.
      config: as for `sample`.
      points: [M, 2] places in each frame; default all centres of pixels. Those that the
        frame before did not show, half a pixel from its border or more, are left out.
      features: [N, C] in place of the SH colours.

    Raises:
      InputError: if a camera is no pinhole or has another centre than the first.
    """
    _check_turn(cameras)
    first = cameras[0]
    if points is None:
        grid = np.mgrid[: first.height, : first.width] + 0.5
        points = grid[::-1].reshape(2, -1).T
    changes = []
    for before, after in pairwise(cameras):
        places = same_rays(before, after, points)
        size = np.asarray([first.width, first.height])
        valid = ((places >= 0.5) & (places <= size - 0.5)).all(1)
        now = sample(gaussians, after, points[valid], config, features)
        then = sample(gaussians, before, places[valid], config, features)
        changes.append(np.abs(now - then).mean() if valid.any() else np.nan)
    return np.asarray(changes)


def _check_turn(cameras: list[Camera]) -> None:
    centres = []
    for camera in cameras:
        if camera.lens.name != "pinhole":
            raise InputError(
                f"popping: expected pinhole cameras, got {camera.lens.name}; undistort "
                "the camera first"
            )
        view = np.asarray(camera.viewmat, np.float64)
        centres.append(-view[:3, :3].T @ view[:3, 3])
    moved = np.linalg.norm(np.asarray(centres) - centres[0], axis=1).max()
    if moved > 1e-4 * max(1.0, float(np.linalg.norm(centres[0]))):
        raise InputError(
            f"popping: expected cameras at one place, got ones {moved:.3g} apart; turn "
            "one with gsjax.bench.popping.turned"
        )


def measure_popping(
    scene: StressScene,
    *,
    frames: int = 5,
    degrees: float = 0.25,
    points: int = 1024,
    repeats: int = 5,
) -> list[dict]:
    """Return a row for each order: its time, popping and what a window misorders.

    Args:
      scene: with a pinhole camera.
      frames: pictures of the turn, about the camera's vertical axis.
      degrees: between two of them.
      points: random places that are compared.
      repeats: timings; the median is reported.

    Returns:
      Rows with order, "forward ms" (None for wide windows, which no fast kernel draws),
      "popping" (of 255 levels), "of center" (relative to that order) and "misordered"
      (of the first frame).
    """
    gaussians, camera = scene.gaussians, scene.camera
    rng = np.random.default_rng(0)
    places = rng.uniform(0, 1, (points, 2)) * (camera.width, camera.height)
    cameras = turned(camera, frames, degrees)
    base = exact_config(gaussians, camera, RasterConfig(outputs=("rgb",)))
    calls, rows = {}, []
    wide = {f"window {w}": {"order": "window", "order_window": w} for w in _WIDE}
    for name in progress([*ORDERS, *wide], "orders"):
        config = base.replace(**{**ORDERS, **wide}[name])
        change = popping(gaussians, cameras, config, points=places)
        late = None
        if name in ORDERS:
            calls[name] = partial(render, gaussians, camera, config)
            late = calls[name]().misordered
        rows.append(
            {
                "order": name,
                "popping": 255 * float(np.nanmean(change)),
                "misordered": None if late is None else int(late),
            }
        )
    ms = interleaved(calls, repeats)
    for row in rows:
        row["forward ms"] = ms.get(row["order"])
        row["of center"] = row["popping"] / max(rows[0]["popping"], 1e-12)
    return rows
