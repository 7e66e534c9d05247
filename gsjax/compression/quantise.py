"""Leave out Gaussians and round numbers, by one price of a bit.

A change is made if the error that it adds is less than the bits that it saves, times
the price. A number that is rounded to steps Δ adds h Δ² / 12, and halving Δ takes one
bit; at the best Δ that error is price / (2 ln 2) for every number.

Axis legend: N Gaussians, K spherical-harmonic bases.
"""

from collections.abc import Mapping
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
from gsjax.compression.palettes import (
    SIZES,
    Palette,
    Palettes,
    choose_palette,
    up_to_degree,
)
from gsjax.compression.parts import divide
from gsjax.gaussians import Gaussians, make_gaussians

_PER_BIT = 1 / (2 * np.log(2))
_SPHERE = 4 * np.pi  # a coefficient adds the square of its change over 4 π, on average
_GAUSSIAN_BITS = 100.0  # of one Gaussian without harmonics, about


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


def quantise(source: Source, price: float, *, palettes: int = len(SIZES)) -> Quantised:
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
    """Return the harmonics [N, K, 3], their palette, and the error."""
    seen = source.harmonics.rows(kept)
    if not has_lattice(source.suffix):
        return up_to_degree(seen, price)
    weights = source.importance.shares[:, kept].sum(0, dtype=np.float64) / _SPHERE
    candidates = (
        clusters._replace(labels=clusters.labels[kept])
        for clusters in source.palettes.first(palettes)
    )
    return choose_palette(seen, source.simplified[kept], weights, price, candidates)


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
