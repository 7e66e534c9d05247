"""Surfels from ellipsoids, and at initial points."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from gsjax.gaussians import Gaussians

_NEIGHBOURS = 8
_THIN = 7.0  # by which the logarithm of the third scale is less than the others

# Unit quaternions (w, x, y, z) that bring the first, second or third axis to the third.
_TO_THIRD = ((0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5), (1.0, 0.0, 0.0, 0.0))
_ORDER = ((1, 2, 0), (2, 0, 1), (0, 1, 2))


def flattened(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians whose third axis is their shortest: the normal of a surfel.

    Covariances stay as they are, so ellipsoids look the same.
    """
    params = gaussians.params
    shortest = jnp.argmin(params.log_scales, axis=-1)
    turn = jnp.asarray(_TO_THIRD, params.quats.dtype)[shortest]
    order = jnp.asarray(_ORDER)[shortest]
    w, x, y, z = jnp.moveaxis(params.quats, -1, 0)
    a, b, c, d = jnp.moveaxis(turn, -1, 0)
    quats = (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )
    params = params.replace(  # pyright: ignore
        quats=jnp.stack(quats, -1),
        log_scales=jnp.take_along_axis(params.log_scales, order, axis=-1),
    )
    return gaussians.replace(params=params)  # pyright: ignore


def laid_on_points(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians that lie in the planes through their nearest neighbours.

    The third axis becomes the direction in which the means of the eight nearest
    neighbours vary least, and the third scale a thousandth of the others.

    Args:
      gaussians: initial, concrete; from `gsjax.init.gaussians.init_gaussians`.
    """
    params, slots = gaussians.params, np.flatnonzero(np.asarray(gaussians.active))
    means = np.asarray(params.means, np.float64)[slots]
    quats, log_scales = np.array(params.quats), np.array(params.log_scales)
    log_scales[slots, 2] = log_scales[slots, :2].min(-1) - _THIN
    if len(slots) > 3:
        count = min(_NEIGHBOURS + 1, len(slots))
        near = means[KDTree(means).query(means, count)[1]]
        near = near - near.mean(1, keepdims=True)
        _, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
        axes = axes[:, :, ::-1]  # the least last
        axes[:, :, 1] *= np.linalg.det(axes)[:, None]
        quats[slots] = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]]
    dtype = params.quats.dtype
    params = params.replace(  # pyright: ignore
        quats=jnp.asarray(quats, dtype), log_scales=jnp.asarray(log_scales, dtype)
    )
    return gaussians.replace(params=params)  # pyright: ignore
