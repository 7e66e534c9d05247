"""Which Gaussians may be seen, front to back: the pass over every slot.

No derivative is taken here; `project.project` then works on what was found alone.
"""

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras import Camera
from gsjax.gaussians import Gaussians
from gsjax.numerics import exp_log_scale
from gsjax.raster.blocks import by_blocks
from gsjax.raster.counts import squeeze
from gsjax.raster.ladder import on_ladder
from gsjax.raster.project import (
    ewa_jacobian,
    in_depth_range,
    reach_of,
    transform_point,
    usable,
)
from gsjax.raster.sorting import argsort_float
from gsjax.raster.types import Array, RasterConfig


def depth_order(
    gaussians: Gaussians, camera: Camera, config: RasterConfig
) -> tuple[Array, Array]:
    """Slots front to back, and how many there are that may be visible.

    Conservative: what is left out has no pixel with α at or above the cut.

    Returns:
      order: [R] int32 slots, R the visible capacity; equal depths by slot; N past the
        last. If more than R are visible, those of the lowest slots are kept.
      count: [] int32, not limited to R.
    """
    params, camera = lax.stop_gradient((gaussians.params, camera))

    def look(active: Array, inputs) -> Array:
        means, log_scales, logits = inputs
        return _depths_in_view(active, means, log_scales, logits, camera, config)

    def none(active: Array, inputs) -> Array:
        shape = jax.eval_shape(look, active, inputs)
        return jnp.full(shape.shape, jnp.inf, shape.dtype)

    inputs = (params.means, params.log_scales, params.logit_opacities)
    z = by_blocks(look, none, gaussians.active, inputs)
    return _compact_and_sort(z < jnp.inf, z, config)


def _depths_in_view(
    active: Array,
    means: Array,
    log_scales: Array,
    logits: Array,
    camera: Camera,
    config: RasterConfig,
) -> Array:
    """Camera z [K] of the slots that may be visible, infinity of others."""
    means, log_scales = means.T, log_scales.T
    x, y, z = transform_point(camera.viewmat, means)
    live = active & in_depth_range(camera, z) & jnp.isfinite(logits)
    live &= usable(camera)
    for value in (*means, *log_scales):
        live &= jnp.isfinite(value)
    point = (jnp.where(live, x, 0), jnp.where(live, y, 0), jnp.where(live, z, 1))
    u, v = camera.model.project_point(camera.K, point)
    # A view matrix that scales, as one being optimised may, enlarges what it shows.
    rotation = camera.viewmat[:3, :3]
    gram = jnp.sum(rotation[:, None] * rotation[None], axis=-1)
    stretch = jnp.maximum(jnp.max(jnp.sum(jnp.abs(gram), axis=1)), 1)
    largest = exp_log_scale(jnp.max(jnp.where(live, log_scales, 0), axis=0))
    reach = reach_of(jax.nn.sigmoid(logits), config)
    for centre, row, size in zip(
        (u, v), ewa_jacobian(camera, point), (camera.width, camera.height)
    ):
        gain = stretch * sum(j * j for j in row)
        square = largest * largest * gain
        extent = jnp.sqrt(reach * (square + config.dilation))
        extent = extent * 1.001 + 0.01  # room for rounding
        # Phrased so that neither an overflow nor a NaN gets through.
        live &= (square < jnp.inf) & (jnp.abs(centre) < jnp.inf)
        live &= (centre + extent >= 0.5) & (centre - extent <= size - 0.5)
    return jnp.where(live & (reach > 0), z, jnp.inf)


def _compact_and_sort(
    live: Array, z: Array, config: RasterConfig
) -> tuple[Array, Array]:
    """Live slots by depth: squeezed together first, then sorted at their number."""
    slots = live.shape[0]
    room = min(config.visible_capacity or slots, slots)
    packed, count = squeeze(live, room)

    def sort(size: int) -> Array:
        some = packed[:size]
        depth = z.at[some].get(mode="fill", fill_value=jnp.inf)
        order = some[argsort_float(depth)]
        return jnp.pad(order, (0, room - size), constant_values=slots)

    return on_ladder(count, room, config.rungs, sort), count
