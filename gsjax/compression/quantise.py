"""Leave out Gaussians and round numbers, by one price of a bit.

A change is made if the error that it adds is less than the bits that it saves, times
the price. A number that is rounded to steps Δ adds h Δ² / 12, and halving Δ takes one
bit; at the best Δ that error is price / (2 ln 2) for every number.

Axis legend: N Gaussians, K spherical-harmonic bases, C entries of the palette.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from gsjax.compression.importance import Importance
from gsjax.compression.lattices import Lattice, Rows, lattice_of, round_to
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.math.clustering import Clusters, codebook, kmeans, nearest_by_cost

_PER_BIT = 1 / (2 * np.log(2))
_SPHERE = 4 * np.pi  # a coefficient adds the square of its change over 4 π, on average
_GAUSSIAN_BITS = 100.0  # of one Gaussian without harmonics, before it is known
_ENTRY_BITS = 6.0  # of a coefficient in the palette
# Removals of neighbours add up: together they change more than each alone.
_TOGETHER = 4.0
PALETTES = (64, 256, 1024, 4096)
_SH_TABLE = 256


class Source(NamedTuple):
    """A scene that is to be quantised.

    Attributes:
      rows: the active Gaussians as NumPy arrays, by the names of `GaussianParams`.
      importance: of each of them.
      palettes: clusters of the harmonics above degree 0, by falling error; empty
        without harmonics.
      suffix: of the file format.
    """

    rows: Rows
    importance: Importance
    palettes: tuple[Clusters, ...]
    suffix: str


class Quantised(NamedTuple):
    """A quantised scene.

    Attributes:
      rows: the Gaussians that are kept.
      kept: indices of them in the source.
      errors: mean squared error that each kind of change adds, by estimate.
      entries: number of palette entries that are used; 0 without a palette.
      price: of a bit.
    """

    rows: Rows
    kept: np.ndarray
    errors: dict[str, float]
    entries: int
    price: float

    def gaussians(self) -> Gaussians:
        """Return the scene as Gaussians."""
        return make_gaussians(**self.rows)


def make_source(rows: Rows, importance: Importance, suffix: str, seed: int) -> Source:
    """Cluster the harmonics of a scene, weighted by the energy of its Gaussians."""
    harmonics = np.asarray(rows["sh"], np.float32)[:, 1:].reshape(len(rows["sh"]), -1)
    palettes = []
    if harmonics.shape[1]:
        weights = importance.energy
        for count in PALETTES:
            if count < len(harmonics) / 8:
                found = kmeans(harmonics, count, weights=weights, seed=seed)
                palettes.append(found)
    return Source(rows, importance, tuple(palettes), suffix)


def quantise(source: Source, price: float) -> Quantised:
    """Return the scene at a price of a bit, in mean squared error per bit."""
    importance = source.importance
    kept = np.flatnonzero(_TOGETHER * importance.removal > price * _GAUSSIAN_BITS)
    if not len(kept):
        kept = np.argsort(-importance.removal)[:1]
    rows = {name: np.asarray(array)[kept] for name, array in source.rows.items()}
    removed = np.ones(len(importance.removal), bool)
    removed[kept] = False
    errors = {"removal": float(importance.removal[removed].sum())}
    energy = importance.energy[kept]
    rows["sh"], entries, errors["harmonics"] = _harmonics(
        source, kept, energy, price, rows["sh"]
    )
    lattice = lattice_of(source.suffix, rows)
    if lattice is not None:
        curvature = {k: v[kept] for k, v in importance.curvature.items()}
        _round_all(rows, lattice, curvature, energy, price * _PER_BIT, errors)
    return Quantised(rows, kept, errors, entries, price)


def _round_all(
    rows: dict[str, np.ndarray],
    lattice: Lattice,
    curvature: Mapping[str, np.ndarray],
    energy: np.ndarray,
    allowed: float,
    errors: dict[str, float],
) -> None:
    """Round the numbers of each kind, in place."""
    for name in ("means", "log_scales", "logit_opacities"):
        axis = getattr(lattice, name)
        rounded = round_to(axis, rows[name], curvature[name], allowed)
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
    source: Source, kept: np.ndarray, energy: np.ndarray, price: float, sh: np.ndarray
) -> tuple[np.ndarray, int, float]:
    """Return the harmonics [N, K, 3], the entries of the palette, and the error.

    Of the palettes and none, the one with the least error plus price of its bits.
    """
    rest = np.asarray(sh, np.float32)[:, 1:].reshape(len(sh), -1)
    weights = energy / _SPHERE
    without = float(np.sum(weights * np.sum(np.square(rest, dtype=np.float64), 1)))
    best = (without, np.zeros_like(rest), 0, without)
    for palette in source.palettes:
        found = _with_palette(palette, rest, weights, price)
        best = min(best, found, key=lambda one: one[0])
    _, rest, entries, error = best
    if not entries:
        return np.asarray(sh)[:, :1], 0, error
    return np.concatenate([sh[:, :1], rest.reshape(len(sh), -1, 3)], 1), entries, error


def _with_palette(
    palette: Clusters, rest: np.ndarray, weights: np.ndarray, price: float
) -> tuple[float, np.ndarray, int, float]:
    """Return cost, harmonics [N, D], entries and error with one palette.

    Labels are chosen by error plus price of their bits, as in entropy-constrained
    vector quantisation (Chou, Lookabaugh and Gray 1989); one entry is zero.
    """
    entries = np.concatenate([np.zeros_like(rest[:1]), palette.centroids])
    counts = np.ones(len(entries))
    labels = nearest_by_cost(rest, entries, weights, 0 * counts)
    for _ in range(2):
        counts = np.bincount(labels, minlength=len(entries))
        bits = -np.log2(np.maximum(counts, 0.5) / len(labels))
        labels = nearest_by_cost(rest, entries, weights, price * bits)
    counts = np.bincount(labels, minlength=len(entries))
    bits = -np.log2(np.maximum(counts, 0.5) / len(labels))
    mass = np.bincount(labels, weights, minlength=len(entries))
    entries = _truncated(entries, mass, price)
    table, indices = codebook(
        entries.ravel(),
        _SH_TABLE,
        weights=np.repeat(mass + mass.sum() * 1e-6, entries.shape[1]),
    )
    entries = table[indices].reshape(entries.shape)
    found = entries[labels]
    error = float(np.sum(weights * np.sum(np.square(found - rest, dtype=float), 1)))
    used = int(np.sum(counts[1:] > 0))
    stored = _ENTRY_BITS * np.count_nonzero(entries[counts > 0])
    total = float(np.sum(counts * bits)) + stored
    return error + price * total, found, used, error


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
    return make_gaussians(**{k: jnp.asarray(v) for k, v in rows.items()})
