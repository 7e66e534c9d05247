"""Spherical harmonics, judged in the directions from which a Gaussian is seen.

A Gaussian with weights e_v in views of directions d_v is drawn with an error
Σ_v e_v |Y(d_v) · (x − x')|² if its coefficients x become x'. Directions from which no
view sees it do not count. Neighbours show the same light, and lose it alike, so the
weights e_v are those of changes that add up (`Importance.shares`).

Axis legend: N Gaussians, V views, K bases, D = 3 (K − 1) coefficients above degree 0.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.math.sh import degree_of, sh_basis

Array = jax.Array

_CHUNK = 4096  # Gaussians whose directions are held together
_RIDGE = 0.02  # of the mean weight of a direction, for coefficients above degree 0


class ViewedHarmonics:
    """Coefficients with the directions and weights with which views see them.

    Attributes:
      sh: [N, K, 3] coefficients.
    """

    def __init__(self, sh, means, centres, energy):
        """Take [N, K, 3], [N, 3], [V, 3] and [V, N] weights."""
        self.sh = np.asarray(sh, np.float32)
        self._means = np.asarray(means, np.float32)
        self._centres = np.asarray(centres, np.float32)
        self._energy = np.asarray(energy, np.float32)
        # Weights of about 1: those of means over pixels are near the smallest float32.
        self._unit = float(self._energy.max(initial=0)) or 1.0

    def rows(self, kept: np.ndarray) -> "ViewedHarmonics":
        """Return those of some Gaussians, by their indices."""
        energy = self._energy[:, kept]
        return ViewedHarmonics(self.sh[kept], self._means[kept], self._centres, energy)

    def scaled(self, factor: float) -> "ViewedHarmonics":
        """Return the same with weights times a factor."""
        energy = self._energy * np.float32(factor)
        return ViewedHarmonics(self.sh, self._means, self._centres, energy)

    def simplified(self) -> np.ndarray:
        """Return small coefficients [N, K, 3] with nearly the same colours as seen.

        Ridge regression: what no view sees becomes zero, which is easier to store.
        """
        return self._by_chunks(_simplified)[0]

    def refitted(self, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the best degree 0 for other harmonics, and the error.

        Args:
          rest: [N, K - 1, 3] coefficients above degree 0.

        Returns:
          [N, 3] coefficients of degree 0, and the errors [N].
        """
        base, error = self._by_chunks(_refitted, np.asarray(rest, np.float32))
        return base, error.astype(np.float64) * self._unit

    def _by_chunks(self, work, *extra: np.ndarray) -> list[np.ndarray]:
        count, results = len(self.sh), []
        size = min(_CHUNK, 1 << max(count - 1, 1).bit_length())
        for start in range(0, count, size):
            rows = slice(start, start + size)
            arrays = [self.sh[rows], self._means[rows], *(a[rows] for a in extra)]
            short = size - len(arrays[0])
            arrays = [
                np.pad(a, ((0, short), *((0, 0),) * (a.ndim - 1))) for a in arrays
            ]
            energy = np.pad(self._energy[:, rows] / self._unit, ((0, 0), (0, short)))
            found = work(*arrays[:2], self._centres, energy, *arrays[2:])
            results.append([np.asarray(a)[: size - short] for a in found])
        return [np.concatenate(parts) for parts in zip(*results)]


def _bases(means: Array, centres: Array, bases: int) -> Array:
    """Return the basis functions [V, N, K] in the directions from the centres."""
    ways = means - centres[:, None]
    length = jnp.linalg.norm(ways, axis=-1, keepdims=True)
    ways = ways / jnp.maximum(length, 1e-12)
    return jnp.stack(sh_basis(degree_of(bases), *jnp.moveaxis(ways, -1, 0)), -1)


@jax.jit
def _simplified(sh: Array, means: Array, centres: Array, energy: Array) -> tuple[Array]:
    basis = _bases(means, centres, sh.shape[1])
    dots = partial(jnp.einsum, precision=lax.Precision.HIGHEST)
    gram = dots("vn,vnk,vnl->nkl", energy, basis, basis)
    whole = jnp.sum(energy, 0) / (4 * jnp.pi)
    ridge = jnp.full(sh.shape[1], _RIDGE).at[0].set(1e-6)
    # A Gaussian that no view sees loses its harmonics.
    diagonal = jnp.where(whole > 0, whole, 1)[:, None] * ridge
    system = gram + jnp.eye(sh.shape[1]) * diagonal[..., None]
    right = dots("nkl,nlc->nkc", gram, sh) + sh.at[:, 1:].set(0) * diagonal[..., None]
    return (jnp.linalg.solve(system, right),)


@jax.jit
def _refitted(sh, means, centres, energy, rest) -> tuple[Array, Array]:
    basis = _bases(means, centres, sh.shape[1])
    dots = partial(jnp.einsum, precision=lax.Precision.HIGHEST)
    change = dots("vnk,nkc->vnc", basis[..., 1:], sh[:, 1:] - rest)
    whole = jnp.sum(energy, 0)[:, None]
    mean = dots("vn,vnc->nc", energy, change) / jnp.where(whole > 0, whole, 1)
    error = jnp.sum(dots("vn,vnc->nc", energy, jnp.square(change - mean)), -1)
    return sh[:, 0] + mean / basis[0, :, :1], error
