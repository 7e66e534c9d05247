"""Gaussians that no photograph shows: what is learnt cannot tell anything of them.

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
from gsjax.train.config import TrainConfig
from gsjax.train.frames import Frames
from gsjax.train.state import TrainState

Array = jax.Array


@partial(jax.jit, static_argnames="raster")
def _in_view(
    gaussians: Gaussians, camera: Camera, size: Array | None, raster: RasterConfig
) -> Array:
    """[N] of a batch of cameras; colours and pairs are not in the program."""
    return jnp.any(render(gaussians, camera, raster, size=size).radii > 0, 0)


def prune_invisible(
    state: TrainState, frames: Frames, config: TrainConfig, extent: float
) -> tuple[TrainState, int]:
    """``state`` without the Gaussians that none of the views show, to the bit.

    Most are fainter than the α cut everywhere; the others have drifted out of view, and
    would stand before a camera elsewhere as a blur that no photograph knows of.

    Args:
      state: of the run.
      frames: V views, at the size they were last trained at.
      config: the settings.
      extent: of the scene, in its units.

    Returns:
      The state, its slots free where there was one, and how many those were.
    """
    raster = config.raster.replace(
        outputs=("alpha",), num_size_buckets=1, absgrad=False, visible_capacity=None
    )
    seen = jnp.zeros(state.gaussians.capacity, bool)
    for view in range(frames.count):
        index = jnp.full(1, view, jnp.int32)
        shown = (frames.camera, frames.size)
        camera, size = jax.tree.map(lambda a, i=index: a[i], shown)
        camera = refine_camera(camera, state.refinement, index, extent)
        seen |= _in_view(state.gaussians, camera, size, raster)
    active = state.gaussians.active
    dropped = int(jnp.sum(active & ~seen))
    gaussians = state.gaussians.replace(active=active & seen)  # pyright: ignore
    return state.replace(gaussians=gaussians), dropped
