"""Albedo of the demonstration's solids: patterns without detail finer than 0.05.

Axis legend: R points. Every edge is a smooth step some hundredths of a unit wide, so
that photographs of a few hundred pixels hold all there is, and splats can match it.
"""

from itertools import pairwise

import numpy as np

_INK = (0.13, 0.16, 0.24)
_CREAM = (0.93, 0.89, 0.80)
# Strokes of letters in a unit square, as polylines.
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
    """Paint of a disc: a checkerboard of two tones that drift, and a dark rim."""

    def paint(points):
        x, y, _ = points
        odd_x, odd_y = (_step(np.sin(np.pi * a / 0.52), 0.2) for a in (x, y))
        check = odd_x + odd_y - 2 * odd_x * odd_y
        drift = _waves(x, y)
        light = _mix((0.90, 0.84, 0.72), (0.86, 0.70, 0.56), drift)
        dark = _mix((0.24, 0.42, 0.47), (0.30, 0.33, 0.50), drift)
        tiles = dark + (light - dark) * check
        distance = np.hypot(x, y)
        rim = _step(distance - 0.89 * radius, 0.03)
        turns = _step(np.sin(24 * np.arctan2(y, x)), 0.25)
        edge = _mix((0.16, 0.19, 0.28), (0.86, 0.52, 0.26), turns)
        return tiles + (edge - tiles) * rim

    return paint


def bands(points: np.ndarray) -> np.ndarray:
    """Paint of a sphere: bands of a palette that wind about it and swing."""
    x, y, z = points / np.sqrt((points**2).sum(axis=0))
    turn = np.arctan2(y, x)
    level = 0.5 * z + 0.09 * np.sin(3 * turn) * (1 - z * z) + 0.5
    thin = _step(np.cos(2 * np.pi * 5 * level) - 0.8, 0.16)
    return _onto(_palette(0.9 * level + 0.55), _CREAM, 0.85 * thin)


def rings(points: np.ndarray) -> np.ndarray:
    """Paint of a small sphere: golden, with darker circles about its x axis."""
    x = points[0] / np.sqrt((points**2).sum(axis=0))
    return _mix((0.93, 0.68, 0.22), (0.60, 0.24, 0.20), _step(np.sin(8.5 * x), 0.3))


def helix(major: float):
    """Paint of a torus about z: stripes that wind, over a slow palette."""

    def paint(points):
        x, y, z = points
        turn = np.arctan2(y, x)
        around = np.arctan2(z, np.hypot(x, y) - major)
        stripe = _step(np.sin(8 * turn + 2 * around) - 0.15, 0.25)
        return _onto(_palette(turn / (2 * np.pi)), _CREAM, 0.8 * stripe)

    return paint


def crate(half: float):
    """Paint of a cube: letters on its sides, stripes on its lid, all of it framed."""
    sides = ((0.80, 0.32, 0.27), (0.18, 0.50, 0.53), (0.90, 0.66, 0.28))

    def paint(points):
        x, y, z = points / half
        face = np.abs(points).argmax(axis=0)
        # Seen from outside with z up, u runs to the right.
        u = np.choose(face, (np.sign(x) * y, -np.sign(y) * x, x))
        v = np.choose(face, (z, z, y))
        color = np.asarray(sides, x.dtype).T[:, face]
        lid = _step(np.sin(2.6 * np.pi * (u + v)), 0.35) * (face == 2)
        color = _onto(color, (0.42, 0.27, 0.50), lid)
        for index, word in enumerate(("GS", "JAX")):
            found = face == index
            stroke = np.zeros_like(u)
            stroke[found] = _word(word, u[found], v[found])
            color = _onto(color, _CREAM, stroke)
        frame = _step(np.maximum(np.abs(u), np.abs(v)) - 0.88, 0.05)
        return _onto(color, _INK, frame)

    return paint


def _word(word: str, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """[R] how much the strokes of ``word`` cover (u, v) of a face, [-1, 1]²."""
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
    return _step(0.085 - nearest, 0.045)


def _to_segment(u, v, start, end) -> np.ndarray:
    along = end - start
    share = ((u - start[0]) * along[0] + (v - start[1]) * along[1]) / (along @ along)
    share = np.clip(share, 0, 1)
    return np.hypot(u - start[0] - share * along[0], v - start[1] - share * along[1])


def _waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Smooth noise in [0, 1]: a few plane waves of different lengths."""
    total = np.sin(1.7 * x + 0.6 * y + 0.4) + np.sin(-0.9 * x + 2.1 * y + 2.2)
    total += 0.6 * np.sin(3.9 * x - 2.3 * y + 1.1)
    total += 0.6 * np.sin(2.2 * x + 4.3 * y + 4.0)
    return np.clip(0.5 + total / 5, 0, 1)


def _step(x: np.ndarray, width: float) -> np.ndarray:
    """0 … 1 step of x through 0, ``width`` wide on either side."""
    x = np.minimum(np.maximum((x / width + 1) / 2, 0), 1)
    return x * x * (3 - 2 * x)


def _mix(low, high, share: np.ndarray) -> np.ndarray:
    """[3, R] from one colour to another."""
    low, high = (np.asarray(c, share.dtype)[:, None] for c in (low, high))
    return low + (high - low) * share


def _onto(color: np.ndarray, over, share: np.ndarray) -> np.ndarray:
    """``color`` [3, R] covered by one colour where ``share`` is 1."""
    return color + (np.asarray(over, color.dtype)[:, None] - color) * share


def _palette(turn: np.ndarray) -> np.ndarray:
    """Colours [3, R] of a closed, smooth path: coral, amber, teal, blue."""
    stops = np.asarray(
        [
            (0.89, 0.36, 0.34),
            (0.95, 0.68, 0.27),
            (0.16, 0.60, 0.56),
            (0.22, 0.36, 0.68),
        ],
        turn.dtype,
    )
    place = (turn % 1) * len(stops)
    low = place.astype(int) % len(stops)
    share = _step((place % 1) - 0.5, 0.5)
    first, second = stops.T[:, low], stops.T[:, (low + 1) % len(stops)]
    return first + (second - first) * share
