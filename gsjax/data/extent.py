"""Extent, near plane and usable points of a dataset."""

import numpy as np

from gsjax.cameras.camera import NEAR, USUAL_EXTENT
from gsjax.data.types import Dataset
from gsjax.errors import InputError

# Cameras whose distances are below this share of their coordinates coincide.
_ROUNDING = 1e-12
_LEAST_EXTENT = 0.1  # share of the distance of the points
_SAMPLED = 5000  # points


def cameras_coincide(centres: np.ndarray) -> bool:
    """Return whether camera positions [V, 3] differ by rounding at most."""
    apart = np.abs(centres - centres.mean(0)).max()
    return bool(apart <= _ROUNDING * np.abs(centres).max())


def scene_extent(centres: np.ndarray) -> float:
    """Return 1.1 times the largest distance of a camera from the mean position.

    It is 1 if all camera positions [V, 3] coincide. Kerbl et al., "3D Gaussian
    Splatting for Real-Time Radiance Field Rendering", 2023.
    """
    if cameras_coincide(centres):
        return 1.0
    return float(1.1 * np.linalg.norm(centres - centres.mean(0), axis=1).max())


def extent_of(dataset: Dataset) -> float:
    """Return the extent that a training of the dataset scales its lengths with.

    It is the `scene_extent` of the cameras and at least the `least_extent` of the
    points, which replaces it if the cameras coincide.
    """
    centres = np.stack([view.centre for view in dataset.views])
    least = least_extent(dataset)
    if least > 0 and cameras_coincide(centres):
        return least
    return max(scene_extent(centres), least)


def least_extent(dataset: Dataset) -> float:
    """Return a tenth of the median depth of the points in front of the cameras.

    The result is 0 if there are no such points.
    """
    points = dataset.points[finite_points(dataset)]
    points = points[:: max(1, len(points) // _SAMPLED)]
    axes = np.stack([view.viewmat[2] for view in dataset.views])
    depths = points @ axes[:, :3].T + axes[:, 3]
    before = depths[depths > 0]
    return _LEAST_EXTENT * float(np.median(before)) if before.size else 0.0


def near_plane(centres: np.ndarray, least: float = 0.0) -> float:
    """Return the near plane: a fixed share of the extent, at most `NEAR`.

    Args:
      centres: [V, 3] camera positions. If all coincide, ``least`` is the extent.
      least: lower bound of the extent, see `least_extent`; 0 for none.
    """
    extent = max(scene_extent(centres), least)
    if cameras_coincide(centres):
        extent = least or USUAL_EXTENT
    return NEAR * min(1.0, extent / USUAL_EXTENT)


def finite_points(dataset: Dataset) -> np.ndarray:
    """Return [M] bool: which points have finite coordinates."""
    return np.asarray(np.isfinite(dataset.points).all(1))


def has_points(dataset: Dataset) -> bool:
    """Return whether any point has finite coordinates."""
    return bool(finite_points(dataset).any())


def require_points(dataset: Dataset) -> None:
    """Raise `InputError` if the dataset has no usable points."""
    if not has_points(dataset):
        remedy = "start from random ones (--initial random)"
        raise InputError(f"{dataset.source}: no points to start from; {remedy}")
