"""Which Gaussians may be seen, front to back: the pass over every slot.

No derivative is taken here; `project.project` then works on what was found alone.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians
from gsjax.math.numerics import exp_log_scale
from gsjax.raster.lists import occlusion_culling
from gsjax.raster.lists.blocks import by_blocks
from gsjax.raster.lists.counting import compact_indices
from gsjax.raster.lists.occlusion_culling import Box
from gsjax.raster.lists.sorting import argsort_float, split_float
from gsjax.raster.primitives.ellipsoid import ellipses, in_depth_range, reach_of, usable
from gsjax.raster.primitives.ewa import ewa_jacobian, transform_point
from gsjax.raster.size_buckets import run_at_bucket
from gsjax.raster.types import Array, RasterConfig
from gsjax.raster.vmap_branching import any_in_batch


class _InView(NamedTuple):
    """What one look at a slot tells, [K] each.

    Attributes:
      z: camera z; infinity for what cannot be visible.
      box: u, v and half the width and height, px, of a box that holds it.
      wide: whether it may close squares of the view, see `occlude`.
    """

    z: Array
    box: Box
    wide: Array


def depth_order(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig,
    features: Array | None = None,
) -> tuple[Array, Array]:
    """Slots front to back, and how many there are that may be visible.

    Conservative: what is left out has no pixel with α at or above the cut, or, with
    ``config.occlusion``, lies behind what has stopped every such pixel.

    Returns:
      order: [R] int32 slots, R the visible capacity; equal depths by slot; N past the
        last. If more than R are visible, those of the lowest slots are kept.
      count: [] int32, not limited to R.
    """
    inputs = (gaussians, camera, features)
    gaussians, camera, features = lax.stop_gradient(inputs)
    params, active = gaussians.params, gaussians.active

    def look(active: Array, inputs) -> _InView:
        return _look(active, inputs, camera, config)

    def none(active: Array, inputs) -> _InView:
        shapes = jax.eval_shape(look, active, inputs)
        nothing = jax.tree.map(jnp.zeros_like, shapes)
        return nothing._replace(z=jnp.full_like(nothing.z, jnp.inf))

    inputs = (params.means, params.log_scales, params.logit_opacities)
    seen = by_blocks(look, none, active, inputs)
    z = seen.z
    if config.occlusion and config.stop > 0:
        some = any_in_batch(jnp.any(seen.wide))
        search = partial(_unhidden, gaussians, camera, config, features)
        z = lax.cond(some, search, lambda seen: seen.z, seen)
    return _compact_and_sort(z, params.means, camera.viewmat, config)


def _unhidden(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig,
    features: Array | None,
    seen: _InView,
) -> Array:
    """``seen.z`` [N], infinity for what lies behind pixels that have all stopped."""
    slots, count = _front_most(seen.wide, seen.z)
    front = ellipses(gaussians, camera, config, slots, count, features)
    size = camera.width, camera.height
    closed = occlusion_culling.closed_from(
        front, _z_of(seen.z, slots), count, *size, config
    )

    def left(seen: _InView) -> Array:
        hidden = occlusion_culling.behind(closed, seen.box, seen.z, *size)
        return jnp.where(hidden, jnp.inf, seen.z)

    some = any_in_batch(jnp.any(closed < jnp.inf))
    return lax.cond(some, left, lambda seen: seen.z, seen)


def _front_most(wide: Array, z: Array) -> tuple[Array, Array]:
    """Slots of the front-most wide ones, front to back, and their number.

    Of more than four times `occlusion_culling.CANDIDATES` the rest are not looked at.
    """
    slots, count = compact_indices(
        wide, min(4 * occlusion_culling.CANDIDATES, wide.shape[0])
    )
    order = argsort_float(_z_of(z, slots))[: occlusion_culling.CANDIDATES]
    return slots[order], jnp.minimum(count, order.shape[0])


def _look(
    active: Array,
    inputs: tuple[Array, Array, Array],
    camera: Camera,
    config: RasterConfig,
) -> _InView:
    """One look at slots [K]: means, log scales and logits of opacities."""
    means, log_scales, logits = inputs[0].T, inputs[1].T, inputs[2]
    x, y, z = transform_point(camera.viewmat, means)
    if z.dtype == jnp.float32:
        # Rounded once, so that what lies behind another one is not before it.
        with jax.enable_x64(True):
            z = lax.convert_element_type(_wide_z(camera.viewmat, means), jnp.float32)
    live = active & in_depth_range(camera, z) & jnp.isfinite(logits)
    live &= usable(camera)
    for value in (*means, *log_scales):
        live &= jnp.isfinite(value)
    point = (jnp.where(live, x, 0), jnp.where(live, y, 0), jnp.where(live, z, 1))
    centres = camera.model.project(camera.K, point)
    # A view matrix that scales, as one being optimised may, enlarges what it shows.
    rotation = camera.viewmat[:3, :3]
    gram = jnp.sum(rotation[:, None] * rotation[None], axis=-1)
    stretch = jnp.maximum(jnp.max(jnp.sum(jnp.abs(gram), axis=1)), 1)
    a, b, c = (jnp.where(live, s, 0) for s in log_scales)
    low, high = jnp.minimum(a, b), jnp.maximum(a, b)
    largest = exp_log_scale(jnp.maximum(high, c))
    middle = exp_log_scale(jnp.maximum(low, jnp.minimum(high, c)))
    opacity = jax.nn.sigmoid(logits)
    reach = reach_of(opacity, config)
    extents, wide = [], jnp.zeros_like(live)
    for centre, row, size in zip(centres, ewa_jacobian(camera, point), camera.shown):
        gain = stretch * sum(j * j for j in row)
        square = largest * largest * gain
        extent = jnp.sqrt(reach * (square + config.dilation))
        extent = extent * 1.001 + 0.01  # room for rounding
        # Phrased so that neither an overflow nor a NaN gets through.
        live &= (square < jnp.inf) & (jnp.abs(centre) < jnp.inf)
        live &= (centre + extent >= 0.5) & (centre - extent <= size - 0.5)
        extents.append(extent)
        wide |= occlusion_culling.is_wide(middle * middle * gain, opacity)
    live &= reach > 0
    return _InView(jnp.where(live, z, jnp.inf), Box(*centres, *extents), live & wide)


def _wide_z(viewmat: Array, means) -> Array:
    """Camera z [K] in float64, of components in float32; within `jax.enable_x64`."""

    def wide(value: Array) -> Array:
        return lax.convert_element_type(value, jnp.float64)

    row = viewmat[2]
    return sum(wide(row[i]) * wide(means[i]) for i in range(3)) + wide(row[3])


def _front_to_back(z: Array, means: Array, viewmat: Array) -> Array:
    """Order [K] of camera z, infinity last; float32 in full, of the means [K, 3].

    As computed in float32, z is off by some of its steps, and what is nearer to one
    another than those stands in any order: a colour is off by as much as they differ
    (the case "depth/within a step" of `gsjax stress`). Nor would rounding once do: what
    rounds to the same number would be ordered by slot.
    """
    if z.dtype != jnp.float32:
        return argsort_float(z)
    with jax.enable_x64(True):
        wide = jnp.where(z < jnp.inf, _wide_z(viewmat, means.T), jnp.inf)
        high, rest = split_float(wide)
    return argsort_float(high, rest)


def _compact_and_sort(
    z: Array, means: Array, viewmat: Array, config: RasterConfig
) -> tuple[Array, Array]:
    """Slots of finite depth z [N] by it, and how many there are.

    Where there is no room for all, or few are live, they are squeezed together first.
    """
    slots, live = z.shape[0], z < jnp.inf
    room = min(config.visible_capacity or slots, slots)
    count = jnp.sum(live, dtype=jnp.int32)

    def sort(size: int) -> Array:
        if size == slots:
            order = _front_to_back(z, means, viewmat)
            return jnp.where(lax.iota(jnp.int32, slots) < count, order, slots)
        some, _ = compact_indices(live, size)
        rows = means.at[some].get(mode="clip")
        order = some[_front_to_back(_z_of(z, some), rows, viewmat)]
        return jnp.pad(order, (0, room - size), constant_values=slots)

    return run_at_bucket(count, room, config.num_size_buckets, sort), count


def _z_of(z: Array, slots: Array) -> Array:
    """``z`` of the slots; infinity past the last."""
    return z.at[slots].get(mode="fill", fill_value=jnp.inf)
