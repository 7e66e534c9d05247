"""Optimal levels of a scalar quantiser, by dynamic programming.

Axis legend: M values, L levels, B bins.
"""

import numpy as np

_BINS = 2048  # among which the boundaries of levels are chosen
_COARSE = 512  # bins of the estimated density; more are noisy
# Bins of one level, at most: a multiple of their mean.
_REACH, _LEAST_REACH = 8, 64


def optimal_levels(values: np.ndarray, mass: np.ndarray, count: int) -> np.ndarray:
    """Return levels that minimise the weighted squared error of rounding to them.

    The optimum among levels whose intervals end at the boundaries of bins, which is the
    optimum of all if there are at most 2048 values (Bruce, "Optimum quantization", MIT
    Research Laboratory of Electronics, 1965). Bins are narrow where levels of a good
    quantiser are dense.

    Args:
      values: [M] float64, ascending and distinct; more than ``count``.
      mass: [M] positive weights.
      count: number of levels L.

    Returns:
      [L] float64, ascending.
    """
    bins = _bins(values, mass, count)
    centre = values.mean()
    sums = [_sums(bins, mass * (values - centre) ** power) for power in range(3)]
    ends = _best_ends(sums, count)
    total, moment = (np.diff(one[ends]) for one in sums[:2])
    return centre + moment / total


def _bins(values: np.ndarray, mass: np.ndarray, count: int) -> np.ndarray:
    """Return the bin [M] of each value, from 0 and rising by at most 1."""
    number = max(_BINS, _REACH * count)
    if len(values) <= number:
        return np.arange(len(values))
    low, extent = values[0], values[-1] - values[0]
    coarse = np.minimum((values - low) / extent * _COARSE, _COARSE - 1).astype(int)
    # Levels of a good quantiser have the cube root of the density of the values (Panter
    # and Dite, "Quantization distortion in pulse-count modulation", 1951).
    density = np.cbrt(np.bincount(coarse, mass, minlength=_COARSE))
    place = np.concatenate([[0.0], np.cumsum(density)]) / density.sum()
    share = np.interp(values, np.linspace(low, low + extent, _COARSE + 1), place)
    fine = np.minimum(share * number, number - 1).astype(int)
    bins = np.cumsum(np.diff(fine, prepend=fine[0]) > 0)
    if bins[-1] < 2 * count:  # a few far values: equal numbers of values instead
        bins = np.arange(len(values)) * number // len(values)
    return bins


def _sums(bins: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the sums [B + 1] of the weights before each boundary of bins."""
    return np.concatenate([[0.0], np.cumsum(np.bincount(bins, weights))])


def _best_ends(sums: list[np.ndarray], count: int) -> np.ndarray:
    """Return the boundaries [L + 1] of the intervals with the least squared error.

    Args:
      sums: of mass, mass · value and mass · value², [B + 1] each.
      count: number of intervals L, less than B.
    """
    number = len(sums[0]) - 1
    reach = min(number, max(_LEAST_REACH, _REACH * -(-number // count)))
    end = np.arange(number + 1)[:, None]
    start = end - 1 - np.arange(reach)
    valid, start = start >= 0, np.maximum(start, 0)
    mass, moment, square = (one[end] - one[start] for one in sums)
    error = square - moment**2 / np.where(mass > 0, mass, 1)
    error = np.where(valid, np.maximum(error, 0), np.inf)
    best = np.full(number + 1, np.inf)  # of the bins before each boundary
    best[0] = 0
    rows, before = end[:, 0], []
    for _ in range(count):
        totals = best[start] + error
        choice = totals.argmin(axis=1)
        best = totals[rows, choice]
        before.append(start[rows, choice])
    ends = [number]
    for starts in reversed(before):
        ends.append(int(starts[ends[-1]]))
    return np.asarray(ends[::-1])
