"""Rotations: quaternions in the order w, x, y, z, of any norm above zero.

Components are separate arrays throughout (structure of arrays): the long axis, over
Gaussians, stays innermost, which is what vector units want.
"""

import jax
import jax.numpy as jnp

from gsjax.numerics import safe_normalize

Array = jax.Array


def rotation_rows(w: Array, x: Array, y: Array, z: Array):
    """Rows of the rotation matrix of a unit quaternion, as nested tuples."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def quaternion_to_matrix(quats: Array) -> Array:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] (wxyz, normalised here)."""
    unit, _ = safe_normalize(
        tuple(jnp.moveaxis(jnp.asarray(quats), -1, 0)), (1.0, 0.0, 0.0, 0.0)
    )
    return jnp.stack([jnp.stack(row, -1) for row in rotation_rows(*unit)], -2)


def covariance(quats: Array, scales: Array) -> Array:
    """Covariances R S Sᵀ Rᵀ [..., 3, 3] from wxyz [..., 4] and scales [..., 3]."""
    half = quaternion_to_matrix(quats) * jnp.asarray(scales)[..., None, :]
    return jnp.einsum("...ij,...kj->...ik", half, half, precision="highest")
