"""Levels of a scalar quantiser, compared with a search over all intervals."""

from itertools import combinations

import numpy as np
import pytest

from gsjax.math.clustering import codebook
from gsjax.math.levels import optimal_levels


def error_of(values, mass, levels) -> float:
    nearest = np.abs(values[:, None] - levels).min(axis=1)
    return float(np.sum(mass * nearest**2))


def least_error(values, mass, count: int) -> float:
    """Return the least error of all divisions of the values into intervals."""
    found = np.inf
    for inner in combinations(range(1, len(values)), count - 1):
        parts = np.split(np.arange(len(values)), inner)
        levels = np.asarray([np.average(values[p], weights=mass[p]) for p in parts])
        found = min(found, error_of(values, mass, levels))
    return found


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("count", [1, 3, 5])
def test_no_other_levels_are_better(seed, count):
    rng = np.random.default_rng(seed)
    values, mass = np.sort(rng.normal(1e3, 1, 12)), rng.uniform(0.1, 2, 12)
    levels = optimal_levels(values, mass, count)
    assert (np.diff(levels) > 0).all()
    best = least_error(values, mass, count)
    np.testing.assert_allclose(error_of(values, mass, levels), best, rtol=1e-6)


SAMPLES = {
    "normal": lambda rng: rng.normal(size=20_000),
    "heavy tails": lambda rng: rng.standard_t(2, 20_000),
    "far values": lambda rng: np.append(rng.normal(size=20_000), [1e4, -1e3, 300]),
    "a grid and noise": lambda rng: np.append(
        rng.integers(0, 100, 9000) / 10, rng.normal(5, 1, 9000)
    ),
}


@pytest.mark.parametrize("name", SAMPLES)
def test_codebooks_are_better_than_those_of_iterations_alone(name):
    """Lloyd's iterations from quantiles and from even steps."""
    values = SAMPLES[name](np.random.default_rng(0)).astype(np.float32)
    table, indices = codebook(values, 64)
    error = np.mean(np.square(table[indices] - values))
    for start in (
        np.quantile(values, (np.arange(64) + 0.5) / 64),
        np.linspace(values.min(), values.max(), 64),
    ):
        levels = np.unique(start).astype(np.float64)
        for _ in range(100):
            nearest = np.searchsorted((levels[1:] + levels[:-1]) / 2, values)
            count = np.bincount(nearest, minlength=len(levels))
            total = np.bincount(nearest, values, minlength=len(levels))
            levels = np.where(count > 0, total / np.maximum(count, 1), levels)
            levels = np.sort(levels)
        nearest = np.searchsorted((levels[1:] + levels[:-1]) / 2, values)
        assert error <= np.mean(np.square(levels[nearest] - values)) * 1.001


def test_many_levels():
    values = np.sort(np.random.default_rng(0).normal(size=5000))
    levels = optimal_levels(values, np.ones(5000), 600)
    assert len(levels) == 600
    assert (np.diff(levels) > 0).all()
    # An even quantiser over the range has larger errors.
    even = np.linspace(values[0], values[-1], 600)
    assert error_of(values, 1, levels) < error_of(values, 1, even) / 2
