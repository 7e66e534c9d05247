"""Scenes that lie far out, brought near the origin of coordinates and back.

In float32 a coordinate of size c is off by up to c·2⁻²⁴. Seen from as far as the
scene is wide, s, at a focal length of 1000 px, that is 1000·2⁻²⁴·c/s px: 1e-3 px, the
bar of the projection, at c/s = 16. From there on an axis is shifted.
"""

from dataclasses import replace

import numpy as np

from gsjax.data.types import Dataset

_FAR = 16.0
# A heuristic for scenes without points: what cameras look at is farther from them
# than they are from each other.
_VIEW_SPREAD = 8.0


def rebase(scene: Dataset) -> Dataset:
    """The same scene with an `origin`, where float32 would be too coarse without.

    Axis by axis, the origin is the median of the camera centres, rounded to few bits,
    if that is more than 16 times the spread of cameras and points away from 0. By
    Sterbenz' lemma subtracting it is then exact in float64 for everything within half
    its distance, so that adding it again restores the coordinates bit for bit.
    """
    centres = np.stack([view.centre for view in scene.views])
    origin = far_origin(centres, scene.points)
    if not origin.any():
        return scene
    views = tuple(
        replace(view, viewmat=shifted(view.viewmat, origin)) for view in scene.views
    )
    return replace(
        scene,
        views=views,
        points=scene.points - origin,
        origin=scene.origin + origin,
    )


def far_origin(centres: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[3] what to subtract from coordinates; 0 along axes that are near enough.

    Args:
      centres: [V, 3] of the cameras, V ≥ 1.
      points: [M, 3], M ≥ 0.
    """
    middle = np.median(centres, axis=0)
    spread = _spread(centres, middle)
    if len(points):
        spread = max(spread, _spread(points, middle))
    else:
        spread *= _VIEW_SPREAD
    # One camera alone has no spread; 1 world unit is then as good a guess as any.
    spread = spread or 1.0
    # A multiple of a power of two near the spread: few significant bits.
    unit = 2.0 ** np.ceil(np.log2(spread))
    return np.where(np.abs(middle) > _FAR * spread, np.rint(middle / unit) * unit, 0.0)


def _spread(positions: np.ndarray, middle: np.ndarray) -> float:
    """Median distance from ``middle``."""
    return float(np.median(np.linalg.norm(positions - middle, axis=1)))


def shifted(viewmat: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """[4, 4] world → camera of coordinates from which ``origin`` was subtracted."""
    moved = viewmat.copy()
    moved[:3, 3] += viewmat[:3, :3] @ origin
    return moved
