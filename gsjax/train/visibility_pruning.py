"""Removal of the Gaussians that no training view shows.

Axis legend: N Gaussians (capacity), V views.
"""

from functools import partial

import jax
import jax.numpy as jnp

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians
from gsjax.raster.render import render
from gsjax.raster.types import RasterConfig
from gsjax.train.camera_refinement import refine_camera
from gsjax.train.frames import Frames
from gsjax.train.models import ViewInfo
from gsjax.train.state import Setup, TrainState

Array = jax.Array


@partial(jax.jit, static_argnames="raster")
def _in_view(
    gaussians: Gaussians, camera: Camera, size: Array | None, raster: RasterConfig
) -> Array:
    """Return [N] bool: the Gaussians visible to any camera of a batch."""
    found = render(gaussians, camera.replace(visible_size=size), raster)
    return jnp.any(found.radii > 0, 0)


def prune_invisible(
    state: TrainState, frames: Frames, setup: Setup
) -> tuple[TrainState, int]:
    """Remove the Gaussians that no view shows; the views stay bit-equal.

    They are below the α threshold everywhere, or outside of all views, where they would
    appear from other viewpoints as blur. Returns the state, and the number of Gaussians
    removed. The frames are those of the last step.
    """
    raster = setup.config.raster.replace(
        outputs=("alpha",), num_size_buckets=1, absgrad=False, visible_capacity=None
    )
    visible = jnp.zeros(state.gaussians.capacity, bool)
    apply = jax.jit(setup.model.apply)
    for view in range(frames.count):
        index = jnp.full(1, view, jnp.int32)
        arrays = frames.camera, frames.size, frames.time
        camera, size, time = jax.tree.map(lambda a, i=index: a[i], arrays)
        camera = refine_camera(camera, state.refinement, index, setup.extent)
        time = jnp.zeros(1) if time is None else time
        gaussians = apply(state.params, ViewInfo(index[0], time[0]))
        visible |= _in_view(gaussians, camera, size, raster)
    active = state.gaussians.active
    dropped = int(jnp.sum(active & ~visible))
    gaussians = state.gaussians.replace(active=active & visible)  # pyright: ignore
    return state.replace(gaussians=gaussians), dropped
