"""Surfels from ellipsoids."""

import jax.numpy as jnp

from gsjax.gaussians import Gaussians

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
