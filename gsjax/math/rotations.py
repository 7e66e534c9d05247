"""Rotations by quaternions w, x, y, z of any norm above zero.

Components are separate arrays, so that the long axis over Gaussians is innermost and
vectorises.
"""

import jax
import jax.numpy as jnp

from gsjax.math.numerics import near_one

Array = jax.Array


@jax.custom_jvp
def _squares(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Return a² − b² + c² − d²; the derivative by a zero is exactly zero.

    The derivative of the products would be a difference of equal terms, of which a
    compiler may round only one.
    """
    return (a - b) * (a + b) + (c - d) * (c + d)


@_squares.defjvp
def _squares_jvp(numbers, rates):
    a, b, c, d = (number * rate for number, rate in zip(numbers, rates))
    return _squares(*numbers), 2 * (a - b + c - d)


def rotation_rows(w: Array, x: Array, y: Array, z: Array):
    """Return the rows of a quaternion's rotation matrix times its squared norm.

    Homogeneous in the quaternion, so that normalising rounds nothing. No product is
    used twice: a compiler might fuse it into one sum and not the other, which differs
    by a bit between programs.
    """

    w2, x2, y2, z2 = (2 * q for q in (w, x, y, z))
    return (
        (_squares(w, y, x, z), x * y2 - w * z2, x * z2 + w * y2),
        (x2 * y + w2 * z, _squares(w, z, y, x), y * z2 - w * x2),
        (x2 * z - w2 * y, y2 * z + w2 * x, _squares(w, x, z, y)),
    )


def quaternion_to_matrix(quats: Array) -> Array:
    """Return rotation matrices [..., 3, 3] of quaternions [..., 4] (wxyz, any norm)."""
    components = tuple(jnp.moveaxis(jnp.asarray(quats), -1, 0))
    quat, _ = near_one(components, (1.0, 0.0, 0.0, 0.0))
    rows = jnp.stack([jnp.stack(row, -1) for row in rotation_rows(*quat)], -2)
    square = jnp.sum(jnp.square(jnp.stack(quat)), 0)
    return rows / square[..., None, None]


def covariance(quats: Array, scales: Array) -> Array:
    """Return R S Sᵀ Rᵀ [..., 3, 3] of wxyz [..., 4] and scales [..., 3]."""
    half = quaternion_to_matrix(quats) * jnp.asarray(scales)[..., None, :]
    return jnp.einsum("...ij,...kj->...ik", half, half, precision="highest")


def times_covariance(quats: Array, scales: Array, vectors: Array) -> Array:
    """Return R S Sᵀ Rᵀ v of vectors v [..., 3], without forming the matrix."""
    quat, scale, vector = (
        tuple(jnp.moveaxis(a, -1, 0)) for a in (quats, scales, vectors)
    )
    quat, _ = near_one(quat, (1.0, 0.0, 0.0, 0.0))
    rows, square = rotation_rows(*quat), sum(q * q for q in quat)
    along = [
        sum(r * v for r, v in zip(column, vector)) * jnp.square(s / square)
        for column, s in zip(zip(*rows), scale)
    ]
    back = [sum(r * a for r, a in zip(row, along)) for row in rows]
    return jnp.stack(back, -1)
