"""Initial Gaussians: at the points of a dataset, or at random in view of it."""

from collections.abc import Callable

import numpy as np

from gsjax.data.camera_paths import focus_point
from gsjax.data.extent import extent_of, finite_points, require_points, scene_extent
from gsjax.data.types import Dataset
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.math.sh import C0, num_bases

_MAX_SPACING = 3.0  # times the median
# Cameras close together that look at one point see this much around it, as a share of
# its distance.
_VISIBLE_SHARE = 0.5


def init_gaussians(
    dataset: Dataset,
    *,
    sh_degree: int = 3,
    opacity: float = 0.1,
    scale: float = 1.0,
    max_count: int = 1_000_000,
    random_count: int | None = None,
    capacity: int | Callable[[int], int] | None = None,
    seed: int = 0,
) -> Gaussians:
    """Return isotropic Gaussians whose scales follow the distance to their neighbours.

    Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023.

    Args:
      dataset: provides points, colours and cameras.
      sh_degree: degree of the SH coefficients; those above degree 0 are zero.
      opacity: initial opacity, between 0 and 1 exclusive.
      scale: factor on the root mean square distance to the three nearest neighbours.
      max_count: upper limit; a random subset is drawn from more points.
      random_count: number of random points from `points_in_ball`, with random colours,
        that replace those of the dataset; None for the dataset's.
      capacity: number of slots, or a function of the number of Gaussians; default that
        number.
      seed: seed of the random draws.

    Returns:
      Gaussians in float64 if x64 is enabled, else float32.

    Raises:
      InputError: if the dataset has no points and ``random_count`` is None, if points
        and colours differ in number, or if ``opacity`` or ``scale`` is out of range.
    """
    if not 0 < opacity < 1:
        raise InputError(f"opacity: expected a value between 0 and 1, got {opacity}")
    if not 0 < scale < np.inf:
        raise InputError(f"scale: expected a finite value above 0, got {scale}")
    rng = np.random.default_rng(seed)
    if random_count is not None:
        points = points_in_ball(dataset, random_count, rng)
        colors = rng.uniform(size=(random_count, 3))
    else:
        require_points(dataset)
        if len(dataset.colors) != len(dataset.points):
            raise InputError(
                f"{dataset.source}: expected a colour for each point, got "
                f"{len(dataset.points)} points and {len(dataset.colors)} colours"
            )
        finite = finite_points(dataset)
        points, colors = dataset.points[finite], dataset.colors[finite] / 255.0
    if len(points) > max_count:
        chosen = np.sort(rng.choice(len(points), max_count, replace=False))
        points, colors = points[chosen], colors[chosen]
    count = len(points)
    spacing = scale * neighbour_distance(points, extent_of(dataset))
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
    """Return [M] root mean square distances to the three nearest other points.

    Values are clipped from below to 1e-7 of the extent, and from above to 0.1 of the
    extent or three times the median, whichever is larger: scales of coincident points
    and of outliers would otherwise vanish or cover the scene.
    """
    from scipy.spatial import cKDTree  # pyright: ignore

    count = min(4, len(points))
    if count < 2:
        return np.full(len(points), 0.01 * extent)
    distance, _ = cKDTree(points).query(points, k=count)
    rms = np.sqrt(np.mean(np.square(distance[:, 1:]), 1))
    most = max(0.1 * extent, _MAX_SPACING * float(np.median(rms)))
    return np.clip(rms, 1e-7 * extent, most)


def points_in_ball(
    dataset: Dataset, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Return [count, 3] points drawn uniformly from a ball in view of the cameras.

    Its centre is the point that the cameras look at. Its radius is the extent of the
    cameras, or half of their mean distance from the centre if that is larger.
    """
    centres = np.stack([view.centre for view in dataset.views])
    extent = scene_extent(centres)
    middle = focus_point([view.viewmat for view in dataset.views], depth=extent)
    away = float(np.linalg.norm(centres - middle, axis=1).mean())
    extent = max(extent, _VISIBLE_SHARE * away)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = extent * rng.uniform(size=(count, 1)) ** (1 / 3)
    return middle + radius * direction
