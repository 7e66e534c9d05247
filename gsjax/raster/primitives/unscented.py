"""The image of a Gaussian by the unscented transform (Julier and Uhlmann 1997).

Seven sigma points go through the lens and the shutter instead of a linearisation at the
mean. With d₊ and d₋ the images of a pair of points relative to that of the mean,
h = α √(3 + κ), a = (d₊ − d₋) / 2h, s = (d₊ + d₋) / 2h and δ = Σ s / h, the transform's
mean and covariance are

    u(mean) + δ   and   Σ a aᵀ + Σ s sᵀ + (β − α²) δ δᵀ,

a sum of squares for β ≥ α²: with weights of either sign it would cancel, and a needle's
covariance could turn indefinite.
"""

import jax.numpy as jnp

from gsjax.cameras.camera import Camera
from gsjax.cameras.lenses import everywhere
from gsjax.cameras.shutter import expose
from gsjax.math import rotations
from gsjax.raster.primitives.ewa import shortened
from gsjax.raster.types import Array, RasterConfig

# Sigma points within so many image sizes of the mean are used. A lens may image others
# at 10⁵ px, where rounding of the point in float32 moves the splat in the image.
_FARTHEST = 100


def unscented_image(camera: Camera, config: RasterConfig, means, quat, scales):
    """Return the shift of the mean, the covariance factor, and where both hold.

    Args:
      camera: a single camera.
      config: ``unscented`` is used, (α, β, κ).
      means: (x, y, z) in world coordinates, [R] each.
      quat: (w, x, y, z), any norm above zero, [R] each.
      scales: three standard deviations, [R] each.

    Returns:
      δ (u, v), [R] each; the rows m1, m2 of seven columns; and a mask, False where a
      sigma point is not imaged, or far outside the image.
    """
    alpha, beta, kappa = config.unscented
    step = alpha * (3 + kappa) ** 0.5
    rotation = rotations.rotation_rows(*quat)
    per_square = step / sum(q * q for q in quat)
    sigmas = [s * per_square for s in scales]
    points = []
    for mean, row in zip(means, rotation):
        offsets = jnp.stack([r * s for r, s in zip(row, sigmas)])
        points.append(jnp.concatenate([mean[None], mean + offsets, mean - offsets]))
    exposure = expose(camera, tuple(points))  # pyright: ignore
    seen = exposure.point
    good = camera.lens.depth(seen) > 0.5 * camera.near
    if camera.lens.valid is not everywhere:
        good &= camera.lens.valid(camera.K, camera.coefficients, seen)
    good = jnp.all(good, axis=0)
    ahead = tuple(jnp.where(good, p, e) for p, e in zip(seen, (0, 0, 1)))
    farthest = _FARTHEST * (camera.width + camera.height)
    m, shift = [], []
    for image, period in zip(camera.project(ahead), (period_of(camera), None)):
        offset = image[1:] - image[0]
        if period is not None:  # across the seam of the image
            offset = offset - period * jnp.round(offset / period)
        good &= jnp.all(jnp.abs(offset) < farthest, axis=0)
        plus, minus = offset[:3], offset[3:]
        odd, even = (plus - minus) / (2 * step), (plus + minus) / (2 * step)
        delta = jnp.sum(even, axis=0) / step
        m.append((*odd, *even, (beta - alpha * alpha) ** 0.5 * delta))
        shift.append(delta)
    return tuple(shift), shortened(*m), good


def period_of(camera: Camera) -> Array | None:
    """Return the width in px of one turn of the image, or None."""
    if camera.lens.period is None:
        return None
    return camera.lens.period(camera.K, camera.coefficients)
