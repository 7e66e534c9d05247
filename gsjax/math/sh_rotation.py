"""Spherical harmonics of rotated and mirrored scenes.

Each degree is mapped to itself, so its matrix is the solution of a small linear system:
the basis at directions, and at the same directions turned. Axis legend: N Gaussians,
K spherical-harmonic bases.
"""

import math
from functools import cache

import numpy as np

from gsjax.errors import InputError
from gsjax.math.sh import degree_of, sh_basis

_DIRECTIONS = 64  # several for each basis function
_SNAP = 1e-12  # entries as near to a whole number are rounded to it
_ORTHOGONAL = 1e-4


def rotation_blocks(degree: int, rotation: np.ndarray) -> list[np.ndarray]:
    """Return matrices that rotate the coefficients of each degree.

    With ``c' = block @ c``, the colour of c' in the direction ``rotation @ d`` is that
    of c in the direction d.

    Args:
      degree: greatest degree, 0 to 4.
      rotation: [3, 3] orthogonal; a determinant of -1 mirrors.

    Returns:
      For each degree l from 0, [2 l + 1, 2 l + 1] float64. Turns by multiples of 90°
      about the axes have entries of exactly 0 and ±1 in degrees 0 and 1, and half turns
      in all degrees.

    Raises:
      InputError: if the matrix is not orthogonal.
    """
    rotation = np.asarray(rotation, np.float64)
    if rotation.shape != (3, 3) or not _is_orthogonal(rotation):
        got = f"{rotation.shape}, {rotation.ravel()[:9].tolist()}"
        raise InputError(
            f"rotation: expected an orthogonal matrix [3, 3], got {got}; divide it by "
            "its scale"
        )
    # The colour of c' in a direction e is that of c in the direction Rᵀ e.
    directions, inverses = _system(degree)
    before = _basis(degree, directions @ rotation)
    blocks = [np.eye(1)]
    for l in range(1, degree + 1):
        block = inverses[l] @ before[:, l * l : (l + 1) ** 2]
        whole = np.rint(block)
        blocks.append(np.where(np.abs(block - whole) < _SNAP, whole, block))
    return blocks


def rotate_sh(sh: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the coefficients of Gaussians that are rotated together with the scene.

    Args:
      sh: [N, K, C] coefficients.
      rotation: [3, 3] orthogonal; a determinant of -1 mirrors.

    Returns:
      [N, K, C] in the dtype of ``sh``, computed in float64.

    Raises:
      InputError: as `rotation_blocks`, or if K is not that of a degree from 0 to 4.
    """
    sh = np.asarray(sh)
    rotated = np.empty_like(sh)
    for l, block in enumerate(rotation_blocks(degree_of(sh.shape[1]), rotation)):
        band = slice(l * l, (l + 1) ** 2)
        signs = np.diagonal(block)
        if np.array_equal(block, np.diag(signs)):  # as for half turns: much faster
            rotated[:, band] = sh[:, band] * signs[:, None]
        else:
            turned = np.tensordot(sh[:, band], block, axes=(1, 1))
            rotated[:, band] = np.moveaxis(turned, -1, 1)
    return rotated


def _is_orthogonal(matrix: np.ndarray) -> bool:
    error = np.abs(matrix @ matrix.T - np.eye(3))
    return bool(error.max() < _ORTHOGONAL)  # False for NaN


@cache
def _system(degree: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return directions [D, 3], and the inverses [2 l + 1, D] of their basis."""
    directions = _directions()
    basis = _basis(degree, directions)
    bands = [basis[:, l * l : (l + 1) ** 2] for l in range(degree + 1)]
    return directions, [np.linalg.pinv(band) for band in bands]


def _directions() -> np.ndarray:
    """Return unit directions [D, 3], evenly spread (a Fibonacci lattice)."""
    place = np.arange(_DIRECTIONS) + 0.5
    z, turn = 1 - 2 * place / _DIRECTIONS, np.pi * (1 + math.sqrt(5)) * place
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=-1)


def _basis(degree: int, directions: np.ndarray) -> np.ndarray:
    """Return the basis [D, K] float64 at directions [D, 3]."""
    # NumPy arrays keep float64 here; the constant of degree 0 is not used.
    values = sh_basis(degree, *directions.T)  # pyright: ignore[reportArgumentType]
    return np.stack([np.asarray(value, np.float64) for value in values], axis=-1)
