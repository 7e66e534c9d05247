"""Rotations: quaternions in the order w, x, y, z, of any norm above zero.

Components are separate arrays throughout (structure of arrays): the long axis, over
Gaussians, stays innermost, which is what vector units want.
"""

import jax
import jax.numpy as jnp

from gsjax.math.numerics import near_one

Array = jax.Array


@jax.custom_jvp
def _squares(a: Array, b: Array, c: Array, d: Array) -> Array:
    """a² − b² + c² − d². Its slope by what is 0 is 0, to the last bit: of the products
    here it would be a difference of equal ones, which a compiler may round but once.
    """
    return (a - b) * (a + b) + (c - d) * (c + d)


@_squares.defjvp
def _squares_jvp(numbers, rates):
    a, b, c, d = (number * rate for number, rate in zip(numbers, rates))
    return _squares(*numbers), 2 * (a - b + c - d)


def rotation_rows(w: Array, x: Array, y: Array, z: Array):
    """Rows of the rotation matrix of a quaternion times its squared norm, as tuples.

    Homogeneous in the quaternion: none of its numbers is rounded to normalise it, and
    a direction is known to a few roundings of products alone. No product is used
    twice: a compiler would fuse it into the one sum and not into the other, and which
    it does may differ between programs, by a bit.
    """

    w2, x2, y2, z2 = (2 * q for q in (w, x, y, z))
    return (
        (_squares(w, y, x, z), x * y2 - w * z2, x * z2 + w * y2),
        (x2 * y + w2 * z, _squares(w, z, y, x), y * z2 - w * x2),
        (x2 * z - w2 * y, y2 * z + w2 * x, _squares(w, x, z, y)),
    )


def quaternion_to_matrix(quats: Array) -> Array:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] (wxyz, of any norm)."""
    components = tuple(jnp.moveaxis(jnp.asarray(quats), -1, 0))
    quat, _ = near_one(components, (1.0, 0.0, 0.0, 0.0))
    rows = jnp.stack([jnp.stack(row, -1) for row in rotation_rows(*quat)], -2)
    square = jnp.sum(jnp.square(jnp.stack(quat)), 0)
    return rows / square[..., None, None]


def covariance(quats: Array, scales: Array) -> Array:
    """Covariances R S Sᵀ Rᵀ [..., 3, 3] from wxyz [..., 4] and scales [..., 3]."""
    half = quaternion_to_matrix(quats) * jnp.asarray(scales)[..., None, :]
    return jnp.einsum("...ij,...kj->...ik", half, half, precision="highest")


def times_covariance(quats: Array, scales: Array, vectors: Array) -> Array:
    """R S Sᵀ Rᵀ v of vectors v [..., 3]: along each axis, and back."""
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
