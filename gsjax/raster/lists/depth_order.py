"""Visible Gaussians, front to back. No derivative is taken here.

Axis legend: N slots, R the visible capacity, K slots of any number.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.raster.lists.counting import compact_indices
from gsjax.raster.lists.sorting import argsort_float, split_float
from gsjax.raster.size_buckets import run_at_bucket
from gsjax.raster.types import Array, RasterConfig


def depth_order(
    z: Array, exact_depth: Callable[[Array | None], Array], config: RasterConfig
) -> tuple[Array, Array]:
    """Return the visible slots front to back, and their number.

    Slots are compacted first if there is no room for all, or few are visible.

    Args:
      z: [N] depth; infinity for what is not visible.
      exact_depth: slots [K], or None for all → depths in float64; called within
        `jax.enable_x64(True)`.
      config: visible_capacity and num_size_buckets are used.

    Returns:
      order: [R] int32 slots; equal depths by slot; N past the last. If more than R are
        visible, those of the lowest slots are kept.
      count: [] int32, not limited to R.
    """
    slots, live = z.shape[0], z < jnp.inf
    room = min(config.visible_capacity or slots, slots)
    count = jnp.sum(live, dtype=jnp.int32)

    def sort(size: int) -> Array:
        if size == slots:
            order = _front_to_back(z, exact_depth, None)
            return jnp.where(lax.iota(jnp.int32, slots) < count, order, slots)
        some, _ = compact_indices(live, size)
        order = some[_front_to_back(depth_of_slots(z, some), exact_depth, some)]
        return jnp.pad(order, (0, room - size), constant_values=slots)

    return run_at_bucket(count, room, config.num_size_buckets, sort), count


def depth_of_slots(z: Array, slots: Array) -> Array:
    """Return ``z`` of the slots; infinity past the last."""
    return z.at[slots].get(mode="fill", fill_value=jnp.inf)


def _front_to_back(
    z: Array, exact_depth: Callable[[Array | None], Array], slots: Array | None
) -> Array:
    """Return the order [K] of depths, infinity last; float32 in full precision.

    Depth computed in float32 is off by a few of its steps, so Gaussians closer to one
    another than those would stand in any order. Rounding once is not enough either:
    depths that round to the same number would be ordered by slot.
    """
    if z.dtype != jnp.float32:
        return argsort_float(z)
    with jax.enable_x64(True):
        wide = jnp.where(z < jnp.inf, exact_depth(slots), jnp.inf)
        high, rest = split_float(wide)
    return argsort_float(high, rest)
