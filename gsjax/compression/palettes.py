"""Harmonics that Gaussians share, chosen by one price of a bit.

Axis legend: N Gaussians, K spherical-harmonic bases, C entries of the palette, D =
3 (K − 1) coefficients above degree 0.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from gsjax.compression.harmonics import ViewedHarmonics
from gsjax.math.clustering import Clusters, codebook, kmeans, nearest_by_cost
from gsjax.math.sh import degree_of, num_bases

_ENTRY_BITS = 6.0  # of a coefficient in the palette
_PLAIN_BITS = 32.0  # of a coefficient in a format without entropy coding, at most
SIZES = (64, 256, 1024, 4096, 16384)
_SAMPLED = 64  # Gaussians per cluster from which a palette is made
_SH_TABLE = 256


class Palettes:
    """Clusters of harmonics, each four times as many as before.

    They are made when first used: large ones take long, and few goals need them.
    """

    def __init__(self, points: np.ndarray, weights: np.ndarray, seed: int):
        """Take [N, D] points, [N] weights and the seed of `kmeans`."""
        self._points, self._weights, self._seed = points, weights, seed
        most = min(len(points), SIZES[-1])
        self._sizes = [size for size in SIZES if size < most] + [most]
        self._made: list[Clusters] = []

    def first(self, count: int) -> Iterator[Clusters]:
        """Yield the smallest of them, fewest clusters first; none without harmonics."""
        sizes = self._sizes[:count] if self._points.shape[1] else ()
        for place, size in enumerate(sizes):
            if place == len(self._made):
                self._made.append(self._make(size))
            yield self._made[place]

    def _make(self, size: int) -> Clusters:
        points, weights = self._points, self._weights
        total = weights.sum()
        if len(points) <= _SAMPLED * size or total <= 0:
            return kmeans(points, size, weights=weights, seed=self._seed)
        rng = np.random.default_rng(self._seed)
        some = rng.choice(len(points), _SAMPLED * size, p=weights / total)
        centroids = kmeans(points[some], size, seed=self._seed).centroids
        free = np.zeros(len(centroids))
        labels = nearest_by_cost(points, centroids, np.ones(len(points)), free)
        return Clusters(centroids, labels)


class Palette(NamedTuple):
    """Harmonics above degree 0 that Gaussians share.

    Attributes:
      entries: [C, K - 1, 3] coefficients; the first are zero.
      labels: [N] entry of each Gaussian.
    """

    entries: np.ndarray
    labels: np.ndarray

    @property
    def used(self) -> int:
        """Number of entries that are used, without zero."""
        return len(np.setdiff1d(self.labels, [0]))


def choose_palette(
    seen: ViewedHarmonics,
    simplified: np.ndarray,
    weights: np.ndarray,
    price: float,
    candidates: Iterable[Clusters],
) -> tuple[np.ndarray, Palette, float]:
    """Return the harmonics [N, K, 3], their palette, and the error.

    Of the palettes and none, the one with the least error plus price of its bits.

    Args:
      seen: the harmonics, as views see them.
      simplified: [N, D] harmonics above degree 0 that look nearly the same.
      weights: [N] error per squared change of a coefficient.
      price: of a bit.
      candidates: clusters of ``simplified``, fewest first.
    """
    none = Palette(np.zeros_like(seen.sh[:1, 1:]), np.zeros(len(seen.sh), np.int32))
    base, errors = seen.refitted(np.zeros_like(seen.sh[:, 1:]))
    best = _Choice(float(errors.sum()), base, none, float(errors.sum()), 0.0)
    without, last = (base, errors), best.error
    for clusters in candidates:
        found = _with_palette(clusters, simplified, weights, price, seen, without)
        if found.cost > best.cost and best.palette is not none:
            break  # larger ones cost even more
        # The next one is four times as large. Of the error it leaves the same share as
        # this one did, about, and takes two times as many bits more, at the least.
        gain = found.error * (1 - min(found.error / max(last, 1e-300), 1))
        best, last = min(best, found, key=lambda one: one.cost), found.error
        if gain < 2 * price * found.stored:
            break
    if best.palette is none:
        none = none._replace(entries=none.entries[:, :0])
        return best.base[:, None], none, best.error
    rest = best.palette.entries[best.palette.labels]
    sh = np.concatenate([best.base[:, None], rest], 1)
    return sh, best.palette, best.error


def up_to_degree(seen: ViewedHarmonics, price: float) -> tuple[np.ndarray, None, float]:
    """Return the harmonics up to the degree that is worth its bits, and the error.

    For formats without entropy coding, which gain nothing from a palette.
    """
    bases = seen.sh.shape[1]
    best = (np.inf, seen.sh, 0.0)
    for degree in range(degree_of(bases) + 1):
        stored = num_bases(degree)
        rest = np.array(seen.sh[:, 1:])
        rest[:, stored - 1 :] = 0
        base, errors = seen.refitted(rest)
        sh = np.concatenate([base[:, None], rest[:, : stored - 1]], 1)
        cost = errors.sum() + price * _PLAIN_BITS * 3 * stored * len(sh)
        best = min(best, (cost, sh, float(errors.sum())), key=lambda one: one[0])
    return best[1], None, best[2]


class _Choice(NamedTuple):
    """A palette with degree 0 [N, 3]; its error, and that plus the price of all bits.

    ``stored`` are the bits of the palette.
    """

    cost: float
    base: np.ndarray
    palette: Palette
    error: float
    stored: float


def _with_palette(
    clusters: Clusters, rest, weights, price: float, seen: ViewedHarmonics, without
) -> _Choice:
    """Return the harmonics with one palette, one entry of which is zero.

    Labels are chosen by error plus price of their bits, as in entropy-constrained
    vector quantisation (Chou, Lookabaugh and Gray 1989).
    """
    entries = np.concatenate([np.zeros_like(rest[:1]), clusters.centroids])
    labels = clusters.labels + 1
    for _ in range(2):
        bits = _bits(labels, len(entries))
        labels = nearest_by_cost(rest, entries, weights, price * bits)
    bits = _bits(labels, len(entries))
    mass = np.bincount(labels, weights, minlength=len(entries))
    entries = _truncated(entries, mass, price)
    entries = with_table(entries.reshape(len(entries), -1, 3), mass)
    base, errors = seen.refitted(entries[labels])
    dear = without[1] - errors < price * (bits[labels] - bits[0])
    labels = np.where(dear, 0, labels)
    base[dear], errors[dear] = without[0][dear], without[1][dear]
    stored = _ENTRY_BITS * np.count_nonzero(entries[np.unique(labels)])
    total = float(np.sum(_bits(labels, len(entries))[labels])) + stored
    palette = Palette(entries, labels)
    error = float(errors.sum())
    return _Choice(error + price * total, base, palette, error, stored)


def with_table(entries: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Return entries [C, K - 1, 3] of numbers from a table of 256, one of them zero.

    Args:
      entries: the entries; bands that are zero stay zero.
      mass: [C] weights of them.
    """
    least = 1e-6 * mass.max() + 1e-300
    shares = np.repeat(mass + least, entries[0].size)
    table, indices = codebook(entries.ravel(), _SH_TABLE, weights=shares)
    table[np.abs(table).argmin()] = 0
    return table[indices].reshape(entries.shape)


def _bits(labels: np.ndarray, count: int) -> np.ndarray:
    """Return the bits [C] of each label, by how often it occurs."""
    counts = np.bincount(labels, minlength=count)
    return -np.log2(np.maximum(counts, 0.5) / len(labels))


def _truncated(entries: np.ndarray, mass: np.ndarray, price: float) -> np.ndarray:
    """Set bands of entries to zero that are worth less than their bits."""
    degree = int(np.sqrt(entries.shape[1] // 3 + 1)) - 1
    entries = entries.copy()
    for band in range(1, degree + 1):
        part = entries[:, 3 * (band**2 - 1) : 3 * ((band + 1) ** 2 - 1)]
        error = mass * np.sum(np.square(part, dtype=np.float64), 1)
        part[error < price * _ENTRY_BITS * part.shape[1]] = 0
    return entries
