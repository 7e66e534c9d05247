"""Albedo of the demo's solids: patterns without detail finer than 0.05 units.

Every edge is a smooth step a few hundredths of a unit wide, which photographs of a few
hundred pixels resolve.

Axis legend: R points.
"""

from itertools import pairwise

import numpy as np

_INK = (0.13, 0.16, 0.24)
_CREAM = (0.93, 0.89, 0.80)
# Strokes of letters in the unit square, as polylines.
_LETTERS = {
    "G": (
        [(1, 0.85), (0.7, 1), (0.3, 1), (0, 0.7), (0, 0.3), (0.3, 0), (0.7, 0)],
        [(0.7, 0), (1, 0.25), (1, 0.48), (0.6, 0.48)],
    ),
    "S": (
        [(1, 0.85), (0.7, 1), (0.3, 1), (0, 0.8), (0.15, 0.58), (0.85, 0.42)],
        [(0.85, 0.42), (1, 0.2), (0.7, 0), (0.3, 0), (0, 0.15)],
    ),
    "J": ([(0.95, 1), (0.95, 0.3), (0.65, 0), (0.3, 0), (0, 0.3)],),
    "A": ([(0, 0), (0.5, 1), (1, 0)], [(0.2, 0.34), (0.8, 0.34)]),
    "X": ([(0, 0), (1, 1)], [(0, 1), (1, 0)]),
}


def ground(radius: float):
    """Return the albedo of a disc: a checkerboard of varying tones with a dark rim."""

    def albedo(points):
        x, y, _ = points
        odd_x, odd_y = (smooth_step(np.sin(np.pi * a / 0.52), 0.2) for a in (x, y))
        check = odd_x + odd_y - 2 * odd_x * odd_y
        drift = _waves(x, y)
        light = _blend((0.90, 0.84, 0.72), (0.86, 0.70, 0.56), drift)
        dark = _blend((0.24, 0.42, 0.47), (0.30, 0.33, 0.50), drift)
        tiles = _blend(dark, light, check)
        distance = np.hypot(x, y)
        rim = smooth_step(distance - 0.89 * radius, 0.03)
        turns = smooth_step(np.sin(24 * np.arctan2(y, x)), 0.25)
        edge = _blend((0.16, 0.19, 0.28), (0.86, 0.52, 0.26), turns)
        return _blend(tiles, edge, rim)

    return albedo


def bands(points: np.ndarray) -> np.ndarray:
    """Return the albedo of a sphere: wavy bands of a palette."""
    x, y, z = points / np.sqrt((points**2).sum(axis=0))
    level = 0.5 * z + 0.09 * np.sin(3 * np.arctan2(y, x)) * (1 - z * z) + 0.5
    thin = smooth_step(np.cos(2 * np.pi * 5 * level) - 0.8, 0.16)
    return _blend(_palette(0.9 * level + 0.55), _CREAM, 0.85 * thin)


def rings(points: np.ndarray) -> np.ndarray:
    """Return the albedo of a small sphere: golden, with dark rings about its x axis."""
    x = points[0] / np.sqrt((points**2).sum(axis=0))
    ring = smooth_step(np.sin(8.5 * x), 0.3)
    return _blend((0.93, 0.68, 0.22), (0.60, 0.24, 0.20), ring)


def helix(major: float):
    """Return the albedo of a torus about z: helical stripes over a palette."""

    def albedo(points):
        x, y, z = points
        turn = np.arctan2(y, x)
        around = np.arctan2(z, np.hypot(x, y) - major)
        stripe = smooth_step(np.sin(8 * turn + 2 * around) - 0.15, 0.25)
        return _blend(_palette(turn / (2 * np.pi)), _CREAM, 0.8 * stripe)

    return albedo


def crate(half: float):
    """Return the albedo of a cube: letters on the sides, a striped lid, a frame."""
    sides = ((0.80, 0.32, 0.27), (0.18, 0.50, 0.53), (0.90, 0.66, 0.28))

    def albedo(points):
        x, y, z = points / half
        face = np.abs(points).argmax(axis=0)
        # Seen from outside with z up, u points to the right.
        u = np.choose(face, (np.sign(x) * y, -np.sign(y) * x, x))
        v = np.choose(face, (z, z, y))
        color = np.asarray(sides, x.dtype).T[:, face]
        lid = smooth_step(np.sin(2.6 * np.pi * (u + v)), 0.35) * (face == 2)
        color = _blend(color, (0.42, 0.27, 0.50), lid)
        for index, word in enumerate(("GS", "JAX")):
            found = face == index
            stroke = np.zeros_like(u)
            stroke[found] = _word(word, u[found], v[found])
            color = _blend(color, _CREAM, stroke)
        frame = smooth_step(np.maximum(np.abs(u), np.abs(v)) - 0.88, 0.05)
        return _blend(color, _INK, frame)

    return albedo


def _word(word: str, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return [R] in [0, 1]: coverage of (u, v) in [-1, 1]² by the strokes of a word."""
    gap, height = 0.2, 0.9
    width = (1.44 - gap * (len(word) - 1)) / len(word)
    nearest = np.full_like(u, np.inf)
    for place, letter in enumerate(word):
        left = -0.72 + place * (width + gap)
        for line in _LETTERS[letter]:
            corners = np.asarray(line) * (width, height) + (left, -height / 2)
            corners = corners.astype(u.dtype)
            for start, end in pairwise(corners):
                nearest = np.minimum(nearest, _to_segment(u, v, start, end))
    return smooth_step(0.085 - nearest, 0.045)


def _to_segment(u, v, start, end) -> np.ndarray:
    """Return [R] distances of (u, v) to a line segment."""
    along = end - start
    share = ((u - start[0]) * along[0] + (v - start[1]) * along[1]) / (along @ along)
    share = np.clip(share, 0, 1)
    return np.hypot(u - start[0] - share * along[0], v - start[1] - share * along[1])


def _waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return smooth noise in [0, 1]: a sum of plane waves."""
    total = np.sin(1.7 * x + 0.6 * y + 0.4) + np.sin(-0.9 * x + 2.1 * y + 2.2)
    total += 0.6 * np.sin(3.9 * x - 2.3 * y + 1.1)
    total += 0.6 * np.sin(2.2 * x + 4.3 * y + 4.0)
    return np.clip(0.5 + total / 5, 0, 1)


def smooth_step(x: np.ndarray, width: float) -> np.ndarray:
    """Return a smooth step from 0 to 1 over [-width, width]."""
    x = np.minimum(np.maximum((x / width + 1) / 2, 0), 1)
    return x * x * (3 - 2 * x)


def _blend(low, high, share: np.ndarray) -> np.ndarray:
    """Interpolate between colours, [3] or [3, R], by ``share`` [R]."""
    low, high = (np.asarray(c, share.dtype).reshape(3, -1) for c in (low, high))
    return low + (high - low) * share


def _palette(turn: np.ndarray) -> np.ndarray:
    """Return colours [3, R] of a smooth cyclic palette: coral, amber, teal, blue."""
    red, green = (0.89, 0.95, 0.16, 0.22), (0.36, 0.68, 0.60, 0.36)
    stops = np.asarray([red, green, (0.34, 0.27, 0.56, 0.68)], turn.dtype)
    place = (turn % 1) * 4
    low = place.astype(int) % 4
    share = smooth_step((place % 1) - 0.5, 0.5)
    return _blend(stops[:, low], stops[:, (low + 1) % 4], share)
