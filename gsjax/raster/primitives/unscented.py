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
from gsjax.cameras.shutter import expose, transform_point
from gsjax.math import rotations
from gsjax.math.numerics import materialize
from gsjax.raster.primitives.ewa import is_cheap, shortened
from gsjax.raster.types import Array, RasterConfig

# How far a sigma point may be from the mean, in width + height of the image. Farther
# ones lie next to the plane of the camera, or where the polynomial of a lens is steep:
# the transform would smear the splat over the whole image.
_FARTHEST = 1


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
    axes = [tuple(row[j] * sigmas[j] for row in rotation) for j in range(3)]
    seen = _sigma_points(camera, means, axes)
    good = _imaged(camera, seen)
    ahead = [tuple(jnp.where(good, p, e) for p, e in zip(q, (0, 0, 1))) for q in seen]
    images = zip(*(materialize(camera.project(point)) for point in ahead))
    if len(seen) == 1:
        images = [list(image) for (image,) in images]
    farthest = _FARTHEST * (camera.width + camera.height)
    m, shift = [], []
    for (middle, *others), period in zip(images, (period_of(camera), None)):
        offsets = [place - middle for place in others]
        if period is not None:  # across the seam of the image
            offsets = [o - period * jnp.round(o / period) for o in offsets]
        for offset in offsets:
            good &= jnp.abs(offset) < farthest
        pairs = list(zip(offsets[:3], offsets[3:]))
        odd = [(plus - minus) / (2 * step) for plus, minus in pairs]
        even = [(plus + minus) / (2 * step) for plus, minus in pairs]
        delta = sum(even) / step
        m.append((*odd, *even, (beta - alpha * alpha) ** 0.5 * delta))
        shift.append(delta)
    return tuple(shift), shortened(*m), good


def _sigma_points(camera: Camera, means, axes) -> list[tuple[Array, ...]]:
    """Return the mean and the six sigma points in camera coordinates.

    Args:
      camera: a single camera.
      means: (x, y, z), [R] each.
      axes: three times (x, y, z), [R] each, from the mean to three of the points.

    Returns:
      seven points of a lens that is cheap; else, for a smaller program, one point of
      components [7, R].
    """
    if is_cheap(camera):
        turn = camera.viewmat.at[:, 3].set(0)
        middle = materialize(transform_point(camera.viewmat, means))
        axes = [materialize(transform_point(turn, axis)) for axis in axes]
        signs = (1, -1)
        return [middle] + [
            tuple(p + sign * q for p, q in zip(middle, axis))
            for sign in signs
            for axis in axes
        ]
    points = []
    for mean, *offsets in zip(means, *axes):
        some = jnp.stack(offsets)
        points.append(jnp.concatenate([mean[None], mean + some, mean - some]))
    return [expose(camera, tuple(points)).point]  # pyright: ignore


def _imaged(camera: Camera, points) -> Array:
    """Return where all points of `_sigma_points` are imaged, [R]."""
    good = jnp.asarray(True)
    for point in points:
        good &= camera.lens.depth(point) > 0.5 * camera.near
        if camera.lens.valid is not everywhere:
            good &= camera.lens.valid(camera.K, camera.coefficients, point)
    return good if len(points) > 1 else jnp.all(good, axis=0)


def period_of(camera: Camera) -> Array | None:
    """Return the width in px of one turn of the image, or None."""
    if camera.lens.period is None:
        return None
    return camera.lens.period(camera.K, camera.coefficients)
