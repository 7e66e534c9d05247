"""Division of a scene into parts of falling importance, the first of which shows it."""

from pathlib import Path

import numpy as np

FIRST_SHARE = 0.1  # of the Gaussians, in the first part


def part_ends(count: int, parts: int) -> np.ndarray:
    """Return how many of ``count`` Gaussians the first parts hold together [parts].

    The first part is a tenth, and each further one multiplies the number so far by the
    same factor: 10 % and 90 %, or 10, 22 and 68 %.
    """
    if parts == 1:
        return np.asarray([count])
    ends = np.rint(FIRST_SHARE ** np.linspace(1, 0, parts) * count).astype(int)
    return np.maximum(ends, 1)


def divide(importance: np.ndarray, parts: int) -> np.ndarray:
    """Return the part [N], from 0, of each Gaussian; the first are the most important.

    Args:
      importance: [N] numbers.
      parts: number of parts; the last ones are empty if there are fewer Gaussians.
    """
    rank = np.empty(len(importance), int)
    rank[np.argsort(-importance, kind="stable")] = np.arange(len(importance))
    return np.searchsorted(part_ends(len(importance), parts), rank, side="right")


def part_path(path: Path, part: int, parts: int) -> Path:
    """Return the path of a part, counted from 1: scene-1.sog for scene.sog."""
    if parts == 1:
        return path
    stem, dot, suffix = path.name.partition(".")
    return path.with_name(f"{stem}-{part}{dot}{suffix}")
