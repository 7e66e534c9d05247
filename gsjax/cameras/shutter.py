"""Shutters: the pose from which each point is seen.

A global shutter exposes the whole image at one pose. A rolling shutter exposes rows or
columns one after another while the camera moves; its pose then depends on the point.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

Array = Any


class Shutter(NamedTuple):
    """A shutter as pure functions.

    Attributes:
      name: the name in files and messages.
      world_to_camera: (viewmat, point) → (camera point, viewmat at its exposure).
        ``viewmat`` is [4, 4], or has entries of the shape of the components if the pose
        differs from point to point; ``point`` is (x, y, z) in world coordinates.
    """

    name: str
    world_to_camera: Callable[[Array, Any], tuple[Any, Array]]


def transform_point(viewmat: Array, point) -> tuple:
    """Return camera coordinates of a world point, as components; viewmat is [4, 4]."""
    return tuple(
        sum(viewmat[i, j] * point[j] for j in range(3)) + viewmat[i, 3]
        for i in range(3)
    )


def _global(viewmat: Array, point) -> tuple[tuple, Array]:
    return transform_point(viewmat, point), viewmat


GLOBAL = Shutter("global", _global)
