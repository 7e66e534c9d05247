"""The still life of the demo: a floor, a ball, a crate, a ring and a small ball.

Right-handed, z up, floor at z = 0.
"""

from functools import cache

import numpy as np

from gsjax.synthetic import albedo
from gsjax.synthetic.shapes import Solid, box, disc, sphere, torus

GROUND_RADIUS = 2.1


@cache
def solids() -> tuple[Solid, ...]:
    """Return the still life, the floor first."""

    def turned(degrees: float) -> np.ndarray:
        cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        return np.asarray([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])

    upright = turned(35) @ np.asarray([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    tilted = np.asarray([[0.8, 0, 0.6], [0, 1.0, 0], [-0.6, 0, 0.8]])

    half, major, minor = 0.46, 0.46, 0.17
    ring, ring_place = torus(major, minor), (0.72, -0.62, major + minor)
    cube, cube_place = box((half, half, half)), (0.1, 0.9, half)
    rows = (
        (disc(GROUND_RADIUS), (0, 0, 0), np.eye(3), albedo.ground(GROUND_RADIUS)),
        (sphere(0.56), (-0.85, -0.35, 0.56), tilted, albedo.bands),
        (cube, cube_place, turned(24), albedo.crate(half)),
        (ring, ring_place, upright, albedo.helix(major)),
        (sphere(0.24), (-0.12, -1.22, 0.24), turned(70), albedo.rings),
    )
    return tuple(Solid(s, np.asarray(p, float), axes, c) for s, p, axes, c in rows)
