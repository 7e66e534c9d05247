"""Sums of counts, and indices that follow from them. No derivative is taken here."""

import jax.numpy as jnp
from jax import lax

from gsjax.raster.types import Array
from gsjax.runtime import loops
from gsjax.runtime.devices import on_cpu

# A total of this or more is reported as 2^31 - 1: int32 sums must not wrap.
COUNT_LIMIT = 2**30


def total_count(counts: Array) -> tuple[Array, Array]:
    """Return the saturating sum of int32 counts, and whether it is in range."""
    safe = jnp.sum(counts.astype(jnp.float32)) < COUNT_LIMIT
    total = jnp.sum(jnp.where(safe, counts, 0), dtype=jnp.int32)
    return jnp.where(safe, total, 2**31 - 1), safe


def cumulative_sum(counts: Array) -> Array:
    """Return inclusive sums [n] int32 of counts [n]."""
    if on_cpu():
        return loops.cumulative_sum(counts.astype(jnp.int32))
    return jnp.cumsum(counts, dtype=jnp.int32)


def segment_ids(ends: Array, room: int, start: Array | int = 0) -> Array:
    """Return the segment of each of ``room`` items from item ``start`` on.

    Args:
      ends: [n] int32, `cumulative_sum` of the numbers of items per segment.
      room: number of items to unroll.
      start: [] the first of them.

    Returns:
      [room] int32, rising; n past the last.
    """
    place = jnp.maximum(ends - start, 0)
    if on_cpu():
        passed = jnp.zeros(room, jnp.int32).at[place].add(1, mode="drop")
        return cumulative_sum(passed)
    # On accelerators threads that write to one place wait for each other. So each
    # segment that has items is written once, to the place where they begin.
    following = jnp.append(place[1:], jnp.int32(2**31 - 1))
    place = jnp.where(place < following, place, room)
    owner = lax.iota(jnp.int32, ends.shape[0]) + 1
    passed = jnp.zeros(room, jnp.int32).at[place].set(owner, mode="drop")
    return lax.cummax(passed)


def compact_indices(chosen: Array, room: int) -> tuple[Array, Array]:
    """Return the indices where ``chosen`` is set, compacted to the front.

    Args:
      chosen: [n] bool.
      room: number of indices; of more, the first are kept.

    Returns:
      index: [room] int32, rising; n past the last.
      count: [] int32, number of set elements, not limited to ``room``.
    """
    size = chosen.shape[0]
    if on_cpu():
        whole = jnp.pad(chosen, (0, -size % loops.STRETCH))
        some = jnp.any(whole.reshape(-1, loops.STRETCH), axis=1)
        past = jnp.full(room + 1, size, jnp.int32)
        index, count = loops.places(chosen, some, past)
        return index[:room], count
    place = cumulative_sum(chosen)
    target = jnp.where(chosen, place - 1, room)
    index = jnp.full(room, size, jnp.int32)
    return index.at[target].set(lax.iota(jnp.int32, size), mode="drop"), place[-1]


def take(values: Array, index: Array) -> Array:
    """Return ``values`` at ``index``; 0 past the end."""
    return values.at[index].get(mode="fill", fill_value=0)
