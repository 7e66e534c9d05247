"""The 2D covariance of a projected Gaussian: EWA splatting (Zwicker et al. 2001).

All arithmetic is on components. No matrix product is used, so no accelerator can lower
its precision.
"""

from itertools import combinations

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.cameras.lenses import ORTHOGRAPHIC, PINHOLE
from gsjax.cameras.shutter import Exposure, image_rows
from gsjax.math import rotations
from gsjax.math.numerics import materialize

# Longest σ in px that is drawn; squares of squares then fit float32.
_LONGEST = 1e9
_CHEAP = (PINHOLE, ORTHOGRAPHIC)


def ewa_jacobian(camera: Camera, point):
    """Return the rows (du/d·, dv/d·) of the lens Jacobian near a camera point.

    It is limited far outside the image, see `Lens.linearise`.
    """
    return lens_jacobian(camera, camera.linearise(point))


def lens_jacobian(camera: Camera, point):
    """Return the rows (du/d·, dv/d·) of the lens Jacobian at a camera point."""
    at = once(camera, point)
    one, zero = jnp.ones_like(at[0]), jnp.zeros_like(at[0])
    columns = [
        jax.jvp(
            lambda *p: camera.project(p),
            at,
            tuple(one if i == j else zero for i in range(3)),
        )[1]
        for j in range(3)
    ]
    u, v = zip(*columns)
    return once(camera, u), once(camera, v)


def once(camera: Camera, values):
    """Return ``values``; on CPUs, XLA then computes those of a costly lens only once.

    See `gsjax.math.numerics.materialize`. Nothing is done for a lens that is cheap.
    """
    return values if is_cheap(camera) else materialize(tuple(values))


def is_cheap(camera: Camera) -> bool:
    """Return whether XLA may well image a point again for each use of its image."""
    return camera.lens in _CHEAP and not camera.shutter.rolling


def covariance_factor(camera: Camera, exposure: Exposure, quat, scales):
    """Return the rows m1, m2 of M = J W R S; the 2D covariance is M Mᵀ.

    Args:
      camera: a single camera.
      exposure: points in camera coordinates, [R] each, from `expose`.
      quat: (w, x, y, z), any norm above zero, [R] each.
      scales: three standard deviations, [R] each.
    """
    rotation = rotations.rotation_rows(*quat)
    per_square = 1 / sum(q * q for q in quat)
    scales = tuple(s * per_square for s in scales)
    rows = []
    jacobian = ewa_jacobian(camera, exposure.point)
    for in_world in image_rows(camera, exposure, jacobian):
        if exposure.velocity is not None:
            in_world = once(camera, in_world)
        rows.append(
            tuple(
                sum(in_world[i] * rotation[i][j] for i in range(3)) * scales[j]
                for j in range(3)
            )
        )
    return shortened(*rows)


def shortened(m1, m2):
    """Shorten the columns of a factor to `_LONGEST`.

    Their products would overflow and the Gaussian would vanish, although it only
    appears flat.
    """
    shrinks = []
    for p, q in zip(m1, m2):
        length = lax.stop_gradient(jnp.maximum(jnp.abs(p), jnp.abs(q)))
        long = length > _LONGEST
        shrinks.append(jnp.where(long, _LONGEST / jnp.where(long, length, 1), 1))
    return [tuple(m * k for m, k in zip(row, shrinks)) for row in (m1, m2)]


def dilated(m1, m2, dilation: float):
    """Return the covariance a, b, c, its determinant, and that before the dilation.

    By Cauchy–Binet the determinant of M Mᵀ is the sum of the squared 2 × 2 minors of M.
    It cannot turn negative, while a c − b² cancels for needles.

    Args:
      m1, m2: rows of the factor M, of three or more columns.
      dilation: px² added to a and c.
    """
    sharp_a, sharp_c = sum(m * m for m in m1), sum(m * m for m in m2)
    b = sum(p * q for p, q in zip(m1, m2))
    pairs = [(1, 2), (2, 0), (0, 1)]
    if len(m1) != 3:
        pairs = list(combinations(range(len(m1)), 2))
    minors = [m1[i] * m2[j] - m1[j] * m2[i] for i, j in pairs]
    det_sharp = sum(n * n for n in minors)
    det = det_sharp + dilation * (sharp_a + sharp_c) + dilation * dilation
    return sharp_a + dilation, b, sharp_c + dilation, det, det_sharp
