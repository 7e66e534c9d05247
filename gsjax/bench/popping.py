"""Popping: how much pictures change when the camera turns, beside being turned.

The frames of a camera that turns about its centre show the same rays. So each frame is
compared with the one before, rendered at the places where that one saw the same rays:
at these very places, not interpolated. If the order of the splats of a ray changes
between the two, the picture pops. Radl et al. (2024, StopThePop) compare warped frames.

The rest without popping is that of the projection: EWA depends on where in the image a
Gaussian is. Axis legend: F frames, M points, L splats at a point.
"""

from collections.abc import Mapping
from functools import partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from gsjax.cameras.camera import Camera
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, capacity_bucket
from gsjax.raster.compositing.alpha import evaluate
from gsjax.raster.compositing.blending import Parts
from gsjax.raster.compositing.ordered import blend_ordered
from gsjax.raster.exact import exact_config
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.primitives.table import with_primitive
from gsjax.raster.render import render
from gsjax.raster.render_camera import visible_order
from gsjax.raster.types import Array, Inputs, Projection, RasterConfig
from gsjax.runtime.console import progress
from gsjax.runtime.timing import interleaved
from gsjax.synthetic.stress_scenes import StressScene

_TOGETHER = 2**22  # Gaussians at points that are evaluated together
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


@partial(jax.jit, static_argnames="config")
def _project(inputs: Inputs, config: RasterConfig) -> Projection:
    primitive = config.primitive or ELLIPSOID
    order, count = visible_order(primitive, inputs, config)
    return primitive.project(inputs, config, order, count)


@partial(jax.jit, static_argnames="config")
def _alphas(projection: Projection, points: Array, config: RasterConfig) -> Array:
    """Return α [R, M]."""
    splat = projection.splat
    columns = tuple(a[None] for a in (*splat.shape, splat.u, splat.v))
    return evaluate(columns, points.T, config).alpha[0]


@partial(jax.jit, static_argnames="config")
def _blended(
    projection: Projection, ranks: Array, points: Array, config: RasterConfig
) -> Array:
    """Return colours [M, C] of the splats ``ranks`` [M, L] at points [M, 2]."""
    splat, colors = projection.splat, projection.channels.colors.T

    def some(values: Array) -> Array:
        return values.at[ranks].get(mode="fill", fill_value=0)

    columns = [some(a) for a in splat.shape]
    dx, dy = (points[:, i, None] - some(a) for i, a in enumerate((splat.u, splat.v)))
    # A pixel of its own for each point, at the origin.
    at = evaluate((*columns, -dx, -dy), np.zeros((2, 1)), config)
    keys = at.depth
    if not config.sorts_pixels:
        # All are equal, so the order of the list stays.
        keys, config = jnp.zeros_like(at.alpha), config.replace(order="pixel")
    elif splat.key:
        numbers = tuple(some(a)[..., None] for a in splat.key)
        keys = config.primitive.key(numbers, dx[..., None], dy[..., None])
    values = some(colors)
    channels = jnp.concatenate([values, jnp.ones_like(values[..., :1])], -1)
    parts = Parts(columns[0][..., None], channels)
    return blend_ordered(at, parts, keys, config)["sums"][:, :-1, 0]


def sample(
    gaussians: Gaussians,
    camera: Camera,
    points: np.ndarray,
    config: RasterConfig,
    features: Array | None = None,
) -> np.ndarray:
    """Render single places of a picture, over black.

    All Gaussians are evaluated at each, so it suits some thousands.

    Args:
      gaussians: N slots.
      camera: a single camera.
      points: [M, 2] places in px, whole or not.
      config: its primitive, limits and order apply; only colours are rendered.
      features: [N, C] in place of the SH colours.

    Returns:
      [M, C] colours.
    """
    config = with_primitive(config.replace(outputs=("rgb",)))
    projection = _project(Inputs(gaussians, camera, features), config)
    dtype, none = projection.splat.u.dtype, projection.splat.u.shape[0]
    count, block = len(points), min(1024, max(16, _TOGETHER // none))
    padded = np.pad(points, ((0, -count % block), (0, 0)), mode="edge")
    colors = []
    for start in range(0, len(padded), block):
        some = jnp.asarray(padded[start : start + block], dtype)
        seen = np.asarray(_alphas(projection, some, config) > 0).T
        room = capacity_bucket(max(1, int(seen.sum(1).max())))
        ranks = np.full((block, room), none, np.int32)
        for row, shows in zip(ranks, seen):
            found = np.flatnonzero(shows)
            row[: len(found)] = found
        colors.append(np.asarray(_blended(projection, ranks, some, config)))
    return np.concatenate(colors)[:count]


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
