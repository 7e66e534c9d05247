"""Gaussians to start from: at the points of a scene, or anywhere in view of it."""

from collections.abc import Callable

import numpy as np

from gsjax.data.camera_paths import focus_point
from gsjax.data.extent import extent_of, finite_points, require_points, scene_extent
from gsjax.data.types import Dataset
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.math.sh import C0, num_bases

_MOST_SPACING = 3.0  # times the median
# Cameras that all look at one point from a narrow place see this much around it, as a
# share of how far away it is.
_IN_VIEW = 0.5


def init_gaussians(
    scene: Dataset,
    *,
    sh_degree: int = 3,
    opacity: float = 0.1,
    scale: float = 1.0,
    max_count: int = 1_000_000,
    random_count: int | None = None,
    capacity: int | Callable[[int], int] | None = None,
    seed: int = 0,
) -> Gaussians:
    """Isotropic Gaussians, as wide as their neighbours are far.

    Args:
      scene: its points are taken.
      sh_degree: colours are of degree 0, the rest is zero.
      opacity: of each, above 0 and below 1.
      scale: times the root mean square distance to the three nearest neighbours.
      max_count: of more points than that, that many are drawn.
      random_count: that many, drawn evenly from a ball around the point that the
        cameras look at, see `points_in_ball`, instead of its points.
      capacity: number of slots, or what says it of the number of Gaussians; default
        that number.
      seed: of what is drawn.

    Raises:
      InputError: if the scene has no points and ``random_count`` is None, or not a
        colour for each, or ``opacity`` or ``scale`` is out of its range.
    """
    if not 0 < opacity < 1:
        raise InputError(f"opacity {opacity}: above 0 and below 1 is wanted")
    if not 0 < scale < np.inf:
        raise InputError(f"scale {scale}: a number above 0 is wanted")
    rng = np.random.default_rng(seed)
    if random_count is not None:
        points = points_in_ball(scene, random_count, rng)
        colors = rng.uniform(size=(random_count, 3))
    else:
        require_points(scene)
        if len(scene.colors) != len(scene.points):
            raise InputError(
                f"{scene.source}: {len(scene.points)} points and {len(scene.colors)} "
                "colours; one for each is wanted"
            )
        finite = finite_points(scene)
        points, colors = scene.points[finite], scene.colors[finite] / 255.0
    if len(points) > max_count:
        chosen = np.sort(rng.choice(len(points), max_count, replace=False))
        points, colors = points[chosen], colors[chosen]
    count = len(points)
    spacing = scale * neighbour_distance(points, extent_of(scene))
    sh = np.zeros((count, num_bases(sh_degree), 3))
    sh[:, 0] = (colors - 0.5) / C0
    return make_gaussians(
        means=points,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.repeat(np.log(spacing)[:, None], 3, 1),
        logit_opacities=np.full(count, np.log(opacity / (1 - opacity))),
        sh=sh,
        capacity=capacity(count) if callable(capacity) else capacity,
    )


def neighbour_distance(points: np.ndarray, extent: float) -> np.ndarray:
    """[M] root mean square distance to the three nearest other points.

    At least 1e-7 and at most 0.1 of the extent, or three times the median where that is
    more: points in one place, and points far from all others, would otherwise be
    nothing or everything.
    """
    from scipy.spatial import cKDTree  # pyright: ignore

    count = min(4, len(points))
    if count < 2:
        return np.full(len(points), 0.01 * extent)
    distance, _ = cKDTree(points).query(points, k=count)
    rms = np.sqrt(np.mean(np.square(distance[:, 1:]), 1))
    most = max(0.1 * extent, _MOST_SPACING * float(np.median(rms)))
    return np.clip(rms, 1e-7 * extent, most)


def points_in_ball(scene: Dataset, count: int, rng: np.random.Generator) -> np.ndarray:
    """[count, 3] drawn evenly from the ball around the point that the cameras look at.

    Its radius is the scene's extent, or half of their mean distance from that point
    where that is more: cameras side by side see more of it than they are apart.
    """
    centres = np.stack([view.centre for view in scene.views])
    extent = scene_extent(centres)
    middle = focus_point([view.viewmat for view in scene.views], depth=extent)
    away = float(np.linalg.norm(centres - middle, axis=1).mean())
    extent = max(extent, _IN_VIEW * away)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = extent * rng.uniform(size=(count, 1)) ** (1 / 3)
    return middle + radius * direction
