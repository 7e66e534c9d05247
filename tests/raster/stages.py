"""Stages of the rasteriser called one by one, for tests."""

import jax.numpy as jnp

from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.render_camera import visible_order
from gsjax.raster.types import Inputs, Projection


def order_of(gaussians, camera, config, features=None):
    """Return (order, count) of the visible slots."""
    return visible_order(ELLIPSOID, Inputs(gaussians, camera, features), config)


def project(gaussians, camera, config, order, count) -> Projection:
    """Return the projection of the slots ``order``."""
    return ELLIPSOID.project(Inputs(gaussians, camera), config, order, count)


def visible_projection(gaussians, camera, config) -> Projection:
    """Return the projection of the visible slots, front to back."""
    return project(gaussians, camera, config, *order_of(gaussians, camera, config))


def conics_of(projection: Projection):
    """Return the inverse 2D covariances [R, 3] as (xx, xy, yy)."""
    f = projection.footprint
    var_x = 1 / (f.inv_sx * f.inv_sx)
    entries = (f.var_y, -f.slope * var_x, var_x)
    return jnp.stack([entry / f.det for entry in entries], -1)
