"""The 2D covariance of a projected Gaussian: EWA splatting (Zwicker et al. 2001).

All arithmetic is on components. No matrix product is used, so no accelerator can lower
its precision.
"""

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.math import rotations
from gsjax.raster.types import Array

# Longest σ in px that is drawn; squares of squares then fit float32.
_LONGEST = 1e9


def ewa_jacobian(camera: Camera, point):
    """Return the rows (du/d·, dv/d·) of the lens Jacobian at a camera point."""
    at = camera.linearise(point)
    one, zero = jnp.ones_like(at[0]), jnp.zeros_like(at[0])
    columns = [
        jax.jvp(
            lambda *p: camera.project(p),
            at,
            tuple(one if i == j else zero for i in range(3)),
        )[1]
        for j in range(3)
    ]
    return tuple(zip(*columns))


def covariance_factor(camera: Camera, viewmat: Array, point, quat, scales):
    """Return the rows m1, m2 of M = J W R S; the 2D covariance is M Mᵀ.

    Columns longer than `_LONGEST` are shortened to it. Their products would overflow
    and the Gaussian would vanish, although it only appears flat.

    Args:
      camera: a single camera.
      viewmat: [4, 4] pose at the exposure of the point.
      point: (x, y, z) in camera coordinates, [R] each.
      quat: (w, x, y, z), any norm above zero, [R] each.
      scales: three standard deviations, [R] each.
    """
    rotation = rotations.rotation_rows(*quat)
    per_square = 1 / sum(q * q for q in quat)
    scales = tuple(s * per_square for s in scales)
    rows = []
    for jacobian_row in ewa_jacobian(camera, point):
        in_world = [
            sum(jacobian_row[i] * viewmat[i, j] for i in range(3)) for j in range(3)
        ]
        rows.append(
            tuple(
                sum(in_world[i] * rotation[i][j] for i in range(3)) * scales[j]
                for j in range(3)
            )
        )
    shrinks = []
    for p, q in zip(*rows):
        length = lax.stop_gradient(jnp.maximum(jnp.abs(p), jnp.abs(q)))
        long = length > _LONGEST
        shrinks.append(jnp.where(long, _LONGEST / jnp.where(long, length, 1), 1))
    return [tuple(m * k for m, k in zip(row, shrinks)) for row in rows]


def dilated(m1, m2, dilation: float):
    """Return the covariance a, b, c, its determinant, and that before the dilation.

    By Cauchy–Binet the determinant of M Mᵀ is the sum of the squared 2 × 2 minors of M.
    It cannot turn negative, while a c − b² cancels for needles.

    Args:
      m1, m2: rows of the factor M, from `covariance_factor`.
      dilation: px² added to a and c.
    """
    sharp_a, sharp_c = sum(m * m for m in m1), sum(m * m for m in m2)
    b = sum(p * q for p, q in zip(m1, m2))
    minors = (
        m1[1] * m2[2] - m1[2] * m2[1],
        m1[2] * m2[0] - m1[0] * m2[2],
        m1[0] * m2[1] - m1[1] * m2[0],
    )
    det_sharp = sum(n * n for n in minors)
    det = det_sharp + dilation * (sharp_a + sharp_c) + dilation * dilation
    return sharp_a + dilation, b, sharp_c + dilation, det, det_sharp
