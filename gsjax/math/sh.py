"""Real spherical harmonics of static degree 0 to 4, with the signs of 3DGS.

Basis: Sloan, "Efficient Spherical Harmonic Evaluation" (JCGT 2013), signs as in
Kerbl et al. 2023: degree 1 is -C1 y, C1 z, -C1 x. Colour = basis · coefficients
+ 0.5, clipped below at 0 and not above.
"""

import math

import jax
import jax.numpy as jnp

from gsjax.errors import InputError

Array = jax.Array

C0 = 0.28209479177387814
MAX_DEGREE = 4


def num_bases(degree: int) -> int:
    """Return the number of basis functions of degrees 0 to ``degree``."""
    return (degree + 1) ** 2


def degree_of(bases: int) -> int:
    """Return the degree with ``bases`` basis functions.

    Raises:
      InputError: if no degree from 0 to 4 has that number.
    """
    degree = math.isqrt(bases) - 1
    if degree < 0 or degree > MAX_DEGREE or num_bases(degree) != bases:
        known = [num_bases(d) for d in range(MAX_DEGREE + 1)]
        raise InputError(
            f"sh: expected one of {known} spherical-harmonic coefficients per channel, "
            f"got {bases}"
        )
    return degree


def sh_basis(degree: int, x: Array, y: Array, z: Array) -> list[Array]:
    """Return the (degree + 1)² basis values at unit directions; each shaped as x."""
    basis = [jnp.full_like(x, C0)]
    if degree == 0:
        return basis
    c1 = 0.4886025119029199
    basis += [-c1 * y, c1 * z, -c1 * x]
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 2:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree >= 3:
        basis += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    if degree >= 4:
        basis += [
            2.5033429417967046 * x * y * (xx - yy),
            -1.7701307697799304 * y * z * (3 * xx - yy),
            0.9461746957575601 * x * y * (7 * zz - 1),
            -0.6690465435572892 * y * z * (7 * zz - 3),
            0.10578554691520431 * (zz * (35 * zz - 30) + 3),
            -0.6690465435572892 * x * z * (7 * zz - 3),
            0.47308734787878004 * (xx - yy) * (7 * zz - 1),
            -1.7701307697799304 * x * z * (xx - 3 * yy),
            0.6258357354491761 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ]
    return basis


def eval_sh(coefficients: Array, directions: Array) -> Array:
    """Return the sum of basis times coefficients, without the + 0.5 and the clip.

    Args:
      coefficients: [..., K, C] with K = (degree + 1)².
      directions: unit vectors [..., 3].

    Returns:
      [..., C].
    """
    degree = degree_of(coefficients.shape[-2])
    basis = jnp.stack(sh_basis(degree, *jnp.moveaxis(directions, -1, 0)), -1)
    return jnp.sum(basis[..., None] * coefficients, -2)


def rgb_to_dc(rgb: Array) -> Array:
    """Return the degree-0 coefficient of colour ``rgb`` (any shape)."""
    return (rgb - 0.5) / C0


def dc_to_rgb(dc: Array) -> Array:
    """Return the colour of a degree-0 coefficient alone (any shape)."""
    return C0 * dc + 0.5
