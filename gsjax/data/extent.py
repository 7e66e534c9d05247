"""How large a captured scene is: its extent, its near plane and its usable points."""

import numpy as np

from gsjax.cameras.camera import NEAR, USUAL_EXTENT
from gsjax.data.types import Dataset
from gsjax.errors import InputError

# Cameras no farther apart than this share of their coordinates stand in one place.
_ROUNDING = 1e-12
_LEAST_EXTENT, _SAMPLED = 0.1, 5000  # share of the distance of points; points sampled


def in_one_place(centres: np.ndarray) -> bool:
    """Whether cameras at ``centres`` [V, 3] are apart by rounding at most."""
    apart = np.abs(centres - centres.mean(0)).max()
    return bool(apart <= _ROUNDING * np.abs(centres).max())


def scene_extent(centres: np.ndarray) -> float:
    """1.1 times the largest distance of a camera from their mean (Kerbl et al. 2023).

    Args:
      centres: [V, 3] where the cameras stand.

    Returns:
      The extent, above 0; 1 where all cameras stand in one place.
    """
    if in_one_place(centres):
        return 1.0
    return float(1.1 * np.linalg.norm(centres - centres.mean(0), axis=1).max())


def extent_of(scene: Dataset) -> float:
    """The extent by which a scene is trained, above 0.

    That of its cameras, see `scene_extent`; where they stand nearly in one place, that
    of its points, see `least_extent`.
    """
    centres = np.stack([view.centre for view in scene.views])
    least = least_extent(scene)
    if least > 0 and in_one_place(centres):
        return least
    return max(scene_extent(centres), least)


def least_extent(scene: Dataset) -> float:
    """A tenth of the median distance of the points from the cameras that they lie
    before, along their axes; 0 of no such points."""
    points = scene.points[finite_points(scene)]
    points = points[:: max(1, len(points) // _SAMPLED)]
    axes = np.stack([view.viewmat[2] for view in scene.views])
    depths = points @ axes[:, :3].T + axes[:, 3]
    before = depths[depths > 0]
    return _LEAST_EXTENT * float(np.median(before)) if before.size else 0.0


def near_plane(centres: np.ndarray, least: float = 0.0) -> float:
    """How near a camera Gaussians are drawn: `NEAR`, less in a scene of a small unit.

    Args:
      centres: [V, 3] where the cameras stand.
      least: that the extent is at least, see `least_extent`.

    Returns:
      The same share of the extent in any unit, at most `NEAR`, which is also that of
      cameras in one place without anything before them.
    """
    if in_one_place(centres):
        extent = least or USUAL_EXTENT
    else:
        extent = max(scene_extent(centres), least)
    return NEAR * min(1.0, extent / USUAL_EXTENT)


def finite_points(scene: Dataset) -> np.ndarray:
    """[M] bool, which of its points are."""
    return np.asarray(np.isfinite(scene.points).all(1))


def has_points(scene: Dataset) -> bool:
    """Whether there are any to start from."""
    return bool(finite_points(scene).any())


def require_points(scene: Dataset) -> None:
    """Raise unless there are points to start from."""
    if not has_points(scene):
        raise InputError(
            f"{scene.source}: no points to start from; start from random ones "
            "(--initial random)"
        )
