"""The covariance of a Gaussian on the image plane: EWA splatting (Zwicker et al. 2001).

All arithmetic is on components (structure of arrays); no matrix product is used, so
no accelerator can lower its precision.
"""

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.math import rotations
from gsjax.raster.types import Array

# What keeps squares of squares within float32, far beyond what any image shows.
_LONGEST = 1e9  # px, σ along an axis: a longer one is drawn as long as this


def transform_point(viewmat: Array, point):
    """Camera coordinates of world ``point``, as components; viewmat is [4, 4]."""
    return tuple(
        sum(viewmat[i, j] * point[j] for j in range(3)) + viewmat[i, 3]
        for i in range(3)
    )


def ewa_jacobian(camera: Camera, point):
    """Rows (du/d·, dv/d·) of the Jacobian of the lens at camera ``point``."""
    at = camera.model.linearise(camera.K, *camera.shown, point)
    one, zero = jnp.ones_like(at[0]), jnp.zeros_like(at[0])
    columns = [
        jax.jvp(
            lambda *p: camera.model.project(camera.K, p),
            at,
            tuple(one if i == j else zero for i in range(3)),
        )[1]
        for j in range(3)
    ]
    return tuple(zip(*columns))


def half_covariance(camera: Camera, point, quat, scales):
    """Rows m1, m2 of J W R S, as components: the 2D covariance is M Mᵀ.

    Columns longer than `_LONGEST` are cut to it: their products would overflow, and
    the Gaussian vanish, though all that can be seen of it is that it is flat.
    """
    rotation = rotations.rotation_rows(*quat)
    per_square = 1 / sum(q * q for q in quat)
    scales = tuple(s * per_square for s in scales)
    halves = []
    for jacobian_row in ewa_jacobian(camera, point):
        in_world = [
            sum(jacobian_row[i] * camera.viewmat[i, j] for i in range(3))
            for j in range(3)
        ]
        halves.append(
            tuple(
                sum(in_world[i] * rotation[i][j] for i in range(3)) * scales[j]
                for j in range(3)
            )
        )
    shrinks = []
    for p, q in zip(*halves):
        length = lax.stop_gradient(jnp.maximum(jnp.abs(p), jnp.abs(q)))
        long = length > _LONGEST
        shrinks.append(jnp.where(long, _LONGEST / jnp.where(long, length, 1), 1))
    return [tuple(m * k for m, k in zip(half, shrinks)) for half in halves]


def dilated(m1, m2, dilation: float):
    """Covariance a, b, c, its determinant, and the determinant before dilation.

    The determinant comes from the factors, ‖m1 × m2‖² + e (‖m1‖² + ‖m2‖²) + e²: for
    needles ac − b² cancels (a third of them turn negative at 10⁴ px).
    """
    sharp_a, sharp_c = sum(m * m for m in m1), sum(m * m for m in m2)
    b = sum(p * q for p, q in zip(m1, m2))
    cross = (
        m1[1] * m2[2] - m1[2] * m2[1],
        m1[2] * m2[0] - m1[0] * m2[2],
        m1[0] * m2[1] - m1[1] * m2[0],
    )
    det_sharp = sum(n * n for n in cross)
    det = det_sharp + dilation * (sharp_a + sharp_c) + dilation * dilation
    return sharp_a + dilation, b, sharp_c + dilation, det, det_sharp
