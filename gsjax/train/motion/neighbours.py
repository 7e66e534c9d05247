"""Pairs of neighbours along a Z-order curve, for regularisers of motion.

Axis legend: N Gaussians (capacity).
"""

import jax
import jax.numpy as jnp

Array = jax.Array
_BITS = 10


def neighbours(key: Array, means: Array, active: Array) -> tuple[Array, Array]:
    """Return an order of the slots in which successors are near, and how near.

    The order is that of Z-order curves (Morton 1966) of random offset, so that calls
    with several keys find different neighbours.

    Args:
      key: random key.
      means: [N, 3].
      active: [N] bool.

    Returns:
      order: [N] int32, active slots first.
      near: [N] weight of the pair of a slot in the order and its successor, from 0 to
        1: 1 / (1 + (distance / median distance)²); 0 without a successor.
    """
    known = jnp.where(active[:, None], means, jnp.nan)
    low, high = jnp.nanmin(known, 0), jnp.nanmax(known, 0)
    side = jnp.max(high - low)
    start = low - jax.random.uniform(key, (3,), means.dtype) * side
    unit = (means - start) / (2 * side)
    cells = jnp.clip(unit * 2**_BITS, 0, 2**_BITS - 1).astype(jnp.uint32)
    code = jnp.zeros(means.shape[0], jnp.uint32)
    for axis in range(3):
        code |= _spread(cells[:, axis]) << axis
    code = jnp.where(active, code, jnp.uint32(2**32 - 1))
    order = jnp.argsort(code).astype(jnp.int32)
    placed, used = means[order], active[order]
    distance = jnp.linalg.norm(placed[1:] - placed[:-1], axis=1)
    pair = used[1:] & used[:-1]
    median = jnp.nanmedian(jnp.where(pair, distance, jnp.nan))
    near = jnp.where(pair, 1 / (1 + jnp.square(distance / median)), 0)
    return order, jnp.pad(near, (0, 1))


def _spread(cell: Array) -> Array:
    """Return the bits of a number below 2¹⁰ with two zeros after each."""
    for shift, mask in (
        (16, 0x030000FF),
        (8, 0x0300F00F),
        (4, 0x030C30C3),
        (2, 0x09249249),
    ):
        cell = (cell | (cell << shift)) & jnp.uint32(mask)
    return cell
