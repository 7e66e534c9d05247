"""Translation of a dataset towards the origin, where float32 resolves its coordinates.

A float32 coordinate of size c is off by up to c·2⁻²⁴. Seen from a distance of the
scene's width s, at a focal length of 1000 px, that is 1000·2⁻²⁴·c/s px, which reaches
the tolerance of projection, 1e-3 px, at c/s = 16. Beyond that, an axis is translated.
"""

from dataclasses import replace

import numpy as np

from gsjax.data.types import Dataset

_FAR = 16.0
# Without points: the scene is farther from the cameras than they are from each other
# (a heuristic).
_VIEW_SPREAD = 8.0


def rebase(dataset: Dataset) -> Dataset:
    """Return the dataset with an `origin`, if float32 would be too coarse without.

    Axis by axis, the origin is the median of the camera centres, rounded to few bits,
    if that exceeds 16 times the spread of cameras and points. By Sterbenz' lemma the
    subtraction is then exact in float64 for everything within half its distance, so
    adding the origin restores those coordinates bit for bit.
    """
    centres = np.stack([view.centre for view in dataset.views])
    origin = far_origin(centres, dataset.points)
    if not origin.any():
        return dataset
    views = tuple(
        replace(view, viewmat=shifted(view.viewmat, origin)) for view in dataset.views
    )
    return replace(
        dataset,
        views=views,
        points=dataset.points - origin,
        origin=dataset.origin + origin,
    )


def far_origin(centres: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the [3] offset to subtract from coordinates; 0 along axes near the origin.

    Args:
      centres: [V, 3] camera positions, V ≥ 1.
      points: [M, 3], M ≥ 0.
    """
    middle = np.median(centres, axis=0)
    spread = _spread(centres, middle)
    farther = _spread(points, middle) if len(points) else _VIEW_SPREAD * spread
    spread = max(spread, farther)
    # A single camera has no spread; 1 world unit is then as good a guess as any.
    spread = spread or 1.0
    # A multiple of a power of two near the spread has few significant bits.
    unit = 2.0 ** np.ceil(np.log2(spread))
    return np.where(np.abs(middle) > _FAR * spread, np.rint(middle / unit) * unit, 0.0)


def _spread(positions: np.ndarray, middle: np.ndarray) -> float:
    """Return the median distance from ``middle``."""
    return float(np.median(np.linalg.norm(positions - middle, axis=1)))


def shifted(viewmat: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the [4, 4] world → camera matrix after subtraction of ``origin``."""
    moved = viewmat.copy()
    moved[:3, 3] += viewmat[:3, :3] @ origin
    return moved
