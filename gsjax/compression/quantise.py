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
    snap_quats,
)
from gsjax.compression.parts import divide
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.math.clustering import Clusters, codebook, kmeans, nearest_by_cost
from gsjax.math.sh import degree_of, num_bases

_PER_BIT = 1 / (2 * np.log(2))
_SPHERE = 4 * np.pi  # a coefficient adds the square of its change over 4 π, on average
_GAUSSIAN_BITS = 100.0  # of one Gaussian without harmonics, about
_ENTRY_BITS = 6.0  # of a coefficient in the palette
_PLAIN_BITS = 32.0  # of a coefficient in a format without entropy coding, at most
_PALETTES, _LARGEST_PALETTE = (64, 256, 1024, 4096), 16384
_SAMPLED = 64  # Gaussians per cluster from which a palette is made
_SH_TABLE = 256


class Palettes:
    """Clusters of harmonics, each four times as many as before.

    They are made when first used: large ones take long, and few goals need them.
    """

    def __init__(self, points: np.ndarray, weights: np.ndarray, seed: int):
        """Take [N, D] points, [N] weights and the seed of `kmeans`."""
        self._points, self._weights, self._seed = points, weights, seed
        most = min(len(points), _LARGEST_PALETTE)
        self._sizes = [size for size in _PALETTES if size < most] + [most]
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


class Source(NamedTuple):
    """A scene that is to be quantised.

    Attributes:
      rows: the active Gaussians as NumPy arrays, by the names of `GaussianParams`.
      importance: of each of them.
      harmonics: the spherical harmonics, as views see them.
      simplified: [N, D] harmonics above degree 0 that look nearly the same.
      palettes: clusters of them.
      suffix: of the file format.
      parts: number of files.
    """

    rows: Rows
    importance: Importance
    harmonics: ViewedHarmonics
    simplified: np.ndarray
    palettes: Palettes
    suffix: str
    parts: int = 1


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


class Coding(NamedTuple):
    """Coding of the numbers of a scene in files.

    Attributes:
      lattice: numbers that the format can store, or None if it is without entropy
        coding.
      steps: steps of the codes of each number, by the names of `Lattice`.
      palette: of the harmonics, or None if each Gaussian has its own.
    """

    lattice: Lattice | None
    steps: dict[str, np.ndarray]
    palette: Palette | None


class Quantised(NamedTuple):
    """A quantised scene.

    Attributes:
      rows: the Gaussians that are kept.
      kept: indices of them in the source.
      errors: mean squared error that each kind of change adds, by estimate: "removal",
        "harmonics", "colors", and the numbers by their names in `GaussianParams`.
      price: of a bit.
      harmonics: [N, K, 3] coefficients before those of degree 0 are rounded.
      coding: how the numbers are stored.
      part: [N] file in which each is stored, see `gsjax.compression.parts.divide`.
    """

    rows: Rows
    kept: np.ndarray
    errors: dict[str, float]
    price: float
    harmonics: np.ndarray
    coding: Coding
    part: np.ndarray

    def files(self) -> list[Gaussians]:
        """Return the Gaussians of each file; empty ones are left out."""
        rows = self.rows
        return [
            as_gaussians(
                {name: array[self.part == one] for name, array in rows.items()}
            )
            for one in np.unique(self.part)
        ]

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


def make_source(
    rows: Rows, importance: Importance, suffix: str, parts: int = 1, *, seed: int = 0
) -> Source:
    """Return a scene with clusters of harmonics, weighted by what each contributes."""
    harmonics = ViewedHarmonics(
        rows["sh"], rows["means"], importance.centres, importance.shares
    )
    simplified = harmonics.simplified()[:, 1:].reshape(len(rows["sh"]), -1)
    weights = importance.shares.sum(0, dtype=np.float64)
    palettes = Palettes(simplified, weights, seed)
    return Source(rows, importance, harmonics, simplified, palettes, suffix, parts)


def scaled(source: Source, factors: Mapping[str, float]) -> Source:
    """Return a scene whose estimated errors are multiplied by factors of their kind."""
    harmonics = source.harmonics.scaled(factors.get("harmonics", 1.0))
    importance = source.importance.scaled(factors)
    return source._replace(importance=importance, harmonics=harmonics)


def quantise(
    source: Source, price: float, *, palettes: int = len(_PALETTES) + 1
) -> Quantised:
    """Return the scene at a price of a bit, in mean squared error per bit.

    At most that many palettes are tried; without any, all harmonics above degree 0 are
    left out.
    """
    removal = source.importance.removal
    kept = np.flatnonzero(removal > price * _GAUSSIAN_BITS)
    if not len(kept):
        kept = np.argsort(-removal)[:1]
    rows = {name: np.asarray(array)[kept] for name, array in source.rows.items()}
    importance = source.importance.rows(kept)
    errors = {"removal": float(removal.sum() - importance.removal.sum())}
    rows["sh"], palette, errors["harmonics"] = _harmonics(source, kept, price, palettes)
    before, steps = rows["sh"], {}
    part = divide(importance.shares.sum(0), source.parts)
    lattice = lattice_of(source.suffix, rows, part)
    if lattice is not None:
        allowed = price * _PER_BIT
        steps, more = _round_all(rows, lattice, importance, allowed)
        errors |= more
    coding = Coding(lattice, steps, palette)
    return Quantised(rows, kept, errors, price, before, coding, part)


def _round_all(
    rows: dict[str, np.ndarray],
    lattice: Lattice,
    importance: Importance,
    allowed: float,
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Round the numbers of each kind, in place; return the steps and the errors."""
    curvature = importance.curvature
    steps, errors = {}, {}
    for name in ("means", "log_scales", "logit_opacities"):
        axis = getattr(lattice, name)
        coarsest = np.inf
        if name == "means":  # half of the longest axis
            coarsest = np.exp(rows["log_scales"].max(1, keepdims=True)) / 2
        rounded = round_to(axis, rows[name], curvature[name], allowed, coarsest)
        rows[name] = rounded.values.astype(np.float32)
        steps[name], errors[name] = rounded.steps, rounded.error
    weights = np.repeat(importance.energy[:, None], 3, 1) / _SPHERE
    rounded = round_to(lattice.colors, rows["sh"][:, 0], weights, allowed)
    rows["sh"] = np.array(rows["sh"], np.float32)
    rows["sh"][:, 0], errors["colors"] = rounded.values, rounded.error
    quats = np.asarray(rows["quats"], np.float64)
    steps["colors"] = rounded.steps
    steps["quats"] = round_to(lattice.quats, quats, curvature["quats"], allowed).steps
    found = snap_quats(lattice.quats, quats, steps["quats"])
    errors["quats"] = float(np.sum(curvature["quats"] * np.square(found - quats)))
    rows["quats"] = found.astype(np.float32)
    return steps, errors


def _harmonics(
    source: Source, kept: np.ndarray, price: float, palettes: int
) -> tuple[np.ndarray, Palette | None, float]:
    """Return the harmonics [N, K, 3], their palette, and the error.

    Of the palettes and none, the one with the least error plus price of its bits. A
    format without entropy coding gains nothing from a palette.
    """
    seen, rest = source.harmonics.rows(kept), source.simplified[kept]
    weights = source.importance.shares[:, kept].sum(0, dtype=np.float64) / _SPHERE
    none = Palette(np.zeros_like(seen.sh[:1, 1:]), np.zeros(len(kept), np.int32))
    if not has_lattice(source.suffix):
        return _by_degree(seen, price)
    base, errors = seen.refitted(np.zeros_like(seen.sh[:, 1:]))
    best = _Choice(float(errors.sum()), base, none, float(errors.sum()), 0.0)
    without, last = (base, errors), best.error
    for clusters in source.palettes.first(palettes):
        clusters = clusters._replace(labels=clusters.labels[kept])
        found = _with_palette(clusters, rest, weights, price, seen, without)
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


def _by_degree(seen: ViewedHarmonics, price: float) -> tuple[np.ndarray, None, float]:
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
