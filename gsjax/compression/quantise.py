"""Leave out Gaussians and round numbers, by one price of a bit.

A change is made if the error that it adds is less than the bits that it saves, times
the price. A number that is rounded to steps Δ adds h Δ² / 12, and halving Δ takes one
bit; at the best Δ that error is price / (2 ln 2) for every number.

Axis legend: N Gaussians, K spherical-harmonic bases, C entries of the palette.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from gsjax.compression.harmonics import ViewedHarmonics
from gsjax.compression.importance import Importance
from gsjax.compression.lattices import (
    Lattice,
    Rows,
    has_lattice,
    lattice_of,
    round_to,
)
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.math.clustering import Clusters, codebook, kmeans, nearest_by_cost
from gsjax.math.sh import degree_of, num_bases

_PER_BIT = 1 / (2 * np.log(2))
_SPHERE = 4 * np.pi  # a coefficient adds the square of its change over 4 π, on average
_GAUSSIAN_BITS = 100.0  # of one Gaussian without harmonics, about
_ENTRY_BITS = 6.0  # of a coefficient in the palette
_PLAIN_BITS = 32.0  # of a coefficient in a format without entropy coding, at most
_PALETTES, _LARGEST_PALETTE = (64, 256, 1024, 4096, 16384), 65536
_SH_TABLE = 256


class Palettes:
    """Clusters of harmonics, each about four times as many as before.

    They are made when first used: large ones take long, and few goals need them.
    """

    def __init__(self, points: np.ndarray, weights: np.ndarray, seed: int):
        """Take [N, D] points, [N] weights and the seed of `kmeans`."""
        self._points, self._weights, self._seed = points, weights, seed
        most = min(len(points), _LARGEST_PALETTE)
        self._sizes = [size for size in _PALETTES if size < most] + [most]
        self._made: list[Clusters] = []

    def __iter__(self) -> Iterator[Clusters]:
        """Yield the clusters, fewest first; none without harmonics."""
        for place, size in enumerate(self._sizes if self._points.shape[1] else ()):
            if place == len(self._made):
                weights, seed = self._weights, self._seed
                made = kmeans(self._points, size, weights=weights, seed=seed)
                self._made.append(made)
            yield self._made[place]


class Source(NamedTuple):
    """A scene that is to be quantised.

    Attributes:
      rows: the active Gaussians as NumPy arrays, by the names of `GaussianParams`.
      importance: of each of them.
      harmonics: the spherical harmonics, as views see them.
      simplified: [N, D] harmonics above degree 0 that look nearly the same.
      palettes: clusters of them.
      suffix: of the file format.
    """

    rows: Rows
    importance: Importance
    harmonics: ViewedHarmonics
    simplified: np.ndarray
    palettes: "Palettes"
    suffix: str


class Quantised(NamedTuple):
    """A quantised scene.

    Attributes:
      rows: the Gaussians that are kept.
      kept: indices of them in the source.
      errors: mean squared error that each kind of change adds, by estimate: "removal",
        "harmonics", "colors", and the numbers by their names in `GaussianParams`.
      entries: number of palette entries that are used; 0 without a palette.
      price: of a bit.
      harmonics: [N, K, 3] coefficients before those of degree 0 are rounded.
    """

    rows: Rows
    kept: np.ndarray
    errors: dict[str, float]
    entries: int
    price: float
    harmonics: np.ndarray

    def with_change(self, source: Source, kind: str) -> Gaussians:
        """Return the kept Gaussians of the source with one kind of change alone."""
        rows = {k: np.asarray(v)[self.kept] for k, v in source.rows.items()}
        if kind == "harmonics":
            rows["sh"] = self.harmonics
        elif kind == "colors":
            rows["sh"] = np.array(rows["sh"])
            rows["sh"][:, 0] += self.rows["sh"][:, 0] - self.harmonics[:, 0]
        elif kind != "removal":
            rows[kind] = self.rows[kind]
        return as_gaussians(rows)


def make_source(rows: Rows, importance: Importance, suffix: str, seed: int) -> Source:
    """Cluster the harmonics of a scene, weighted by what its Gaussians contribute."""
    harmonics = ViewedHarmonics(
        rows["sh"], rows["means"], importance.centres, importance.shares
    )
    simplified = harmonics.simplified()[:, 1:].reshape(len(rows["sh"]), -1)
    weights = importance.shares.sum(0, dtype=np.float64)
    palettes = Palettes(simplified, weights, seed)
    return Source(rows, importance, harmonics, simplified, palettes, suffix)


def scaled(source: Source, factors: Mapping[str, float]) -> Source:
    """Return a scene whose estimated errors are multiplied by factors of their kind."""
    harmonics = source.harmonics.scaled(factors.get("harmonics", 1.0))
    importance = source.importance.scaled(factors)
    return source._replace(importance=importance, harmonics=harmonics)


def quantise(source: Source, price: float) -> Quantised:
    """Return the scene at a price of a bit, in mean squared error per bit."""
    removal = source.importance.removal
    kept = np.flatnonzero(removal > price * _GAUSSIAN_BITS)
    if not len(kept):
        kept = np.argsort(-removal)[:1]
    rows = {name: np.asarray(array)[kept] for name, array in source.rows.items()}
    importance = source.importance.rows(kept)
    errors = {"removal": float(removal.sum() - importance.removal.sum())}
    harmonics, entries, errors["harmonics"] = _harmonics(source, kept, price)
    rows["sh"] = harmonics
    lattice = lattice_of(source.suffix, rows)
    if lattice is not None:
        _round_all(rows, lattice, importance, price * _PER_BIT, errors)
    return Quantised(rows, kept, errors, entries, price, harmonics)


def _round_all(
    rows: dict[str, np.ndarray],
    lattice: Lattice,
    importance: Importance,
    allowed: float,
    errors: dict[str, float],
) -> None:
    """Round the numbers of each kind, in place."""
    curvature = importance.curvature
    energy = importance.energy
    for name in ("means", "log_scales", "logit_opacities"):
        axis = getattr(lattice, name)
        coarsest = np.inf
        if name == "means":  # half of the longest axis
            coarsest = np.exp(rows["log_scales"].max(1, keepdims=True)) / 2
        rounded = round_to(axis, rows[name], curvature[name], allowed, coarsest)
        rows[name], errors[name] = rounded.values.astype(np.float32), rounded.error
    weights = np.repeat(energy[:, None], 3, 1) / _SPHERE
    rounded = round_to(lattice.colors, rows["sh"][:, 0], weights, allowed)
    rows["sh"] = np.array(rows["sh"], np.float32)
    rows["sh"][:, 0], errors["colors"] = rounded.values, rounded.error
    rows["quats"], errors["quats"] = _round_quats(
        lattice, rows["quats"], curvature["quats"], allowed
    )


def _round_quats(
    lattice: Lattice, quats: np.ndarray, curvature: np.ndarray, allowed: float
) -> tuple[np.ndarray, float]:
    """Round the three smaller components of unit quaternions [N, 4]."""
    quats = np.asarray(quats, np.float64)
    rounded = round_to(lattice.quats, quats, curvature, allowed).values
    largest = np.abs(quats).argmax(1)[:, None]
    np.put_along_axis(rounded, largest, 0, 1)
    rest = np.sqrt(np.maximum(0, 1 - np.sum(rounded**2, 1, keepdims=True)))
    sign = np.sign(np.take_along_axis(quats, largest, 1))
    np.put_along_axis(rounded, largest, np.where(sign < 0, -rest, rest), 1)
    error = float(np.sum(curvature * np.square(rounded - quats)))
    return rounded.astype(np.float32), error


def _harmonics(
    source: Source, kept: np.ndarray, price: float
) -> tuple[np.ndarray, int, float]:
    """Return the harmonics [N, K, 3], the entries of the palette, and the error.

    Of the palettes and none, the one with the least error plus price of its bits. A
    format without entropy coding gains nothing from a palette.
    """
    seen, rest = source.harmonics.rows(kept), source.simplified[kept]
    weights = source.importance.shares[:, kept].sum(0, dtype=np.float64) / _SPHERE
    nothing = np.zeros_like(seen.sh[:, 1:])
    if not has_lattice(source.suffix):
        return _by_degree(seen, price)
    base, errors = seen.refitted(nothing)
    best = _Choice(float(errors.sum()), base, nothing, 0, float(errors.sum()))
    without = base, errors
    for palette in source.palettes:
        found = _with_palette(palette, rest, weights, price, seen, without)
        if found.cost > best.cost and best.entries:
            break  # larger ones cost even more
        best = min(best, found, key=lambda one: one.cost)
    if not best.entries:
        return best.base[:, None], 0, best.error
    sh = np.concatenate([best.base[:, None], best.rest], 1)
    return sh, best.entries, best.error


def _by_degree(seen: ViewedHarmonics, price: float) -> tuple[np.ndarray, int, float]:
    """Return the harmonics up to the degree that is worth its bits, and the error."""
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
    return best[1], 0, best[2]


class _Choice(NamedTuple):
    """Harmonics [N, K - 1, 3] with degree 0 [N, 3]; error, and it plus the bits."""

    cost: float
    base: np.ndarray
    rest: np.ndarray
    entries: int
    error: float


def _with_palette(
    palette: Clusters, rest, weights, price: float, seen: ViewedHarmonics, without
) -> _Choice:
    """Return the harmonics with one palette, one entry of which is zero.

    Labels are chosen by error plus price of their bits, as in entropy-constrained
    vector quantisation (Chou, Lookabaugh and Gray 1989).
    """
    entries = np.concatenate([np.zeros_like(rest[:1]), palette.centroids])
    bits = np.zeros(len(entries))
    labels = nearest_by_cost(rest, entries, weights, bits)
    for _ in range(2):
        bits = _bits(labels, len(entries))
        labels = nearest_by_cost(rest, entries, weights, price * bits)
    bits = _bits(labels, len(entries))
    mass = np.bincount(labels, weights, minlength=len(entries))
    entries = _truncated(entries, mass, price)
    least = 1e-6 * mass.max() + 1e-300
    shares = np.repeat(mass + least, entries.shape[1])
    table, indices = codebook(entries.ravel(), _SH_TABLE, weights=shares)
    table[np.abs(table).argmin()] = 0  # a dropped band stays dropped
    entries = table[indices].reshape(entries.shape)
    found = entries[labels].reshape(len(rest), -1, 3)
    base, errors = seen.refitted(found)
    dear = without[1] - errors < price * (bits[labels] - bits[0])
    labels = np.where(dear, 0, labels)
    found[dear], base[dear], errors[dear] = 0, without[0][dear], without[1][dear]
    used = np.unique(labels)
    stored = _ENTRY_BITS * np.count_nonzero(entries[used])
    total = float(np.sum(_bits(labels, len(entries))[labels])) + stored
    error = float(errors.sum())
    return _Choice(error + price * total, base, found, int(np.sum(used > 0)), error)


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


def rows_of(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return the active Gaussians as float32 arrays, with unit quaternions."""
    active = np.flatnonzero(np.asarray(gaussians.active))
    params = gaussians.params.__dict__
    rows = {k: np.asarray(v, np.float32)[active] for k, v in params.items()}
    norms = np.linalg.norm(rows["quats"].astype(np.float64), axis=1, keepdims=True)
    rows["quats"] = (rows["quats"] / np.where(norms > 0, norms, 1)).astype(np.float32)
    return rows


def as_gaussians(rows: Rows) -> Gaussians:
    """Return rows as Gaussians."""
    names = ("means", "quats", "log_scales", "logit_opacities", "sh")
    means, quats, log_scales, logit_opacities, sh = (rows[name] for name in names)
    return make_gaussians(
        means=means,
        quats=quats,
        log_scales=log_scales,
        logit_opacities=logit_opacities,
        sh=sh,
    )
