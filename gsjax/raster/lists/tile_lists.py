"""Two builders of the same tile lists: by scattering, and by sorting.

On CPUs the spans are stored front to back, and once the length of every list is known
each Gaussian is scattered to its tiles: a counting sort. On accelerators, where such a
loop would wait for its launches, spans are unrolled into keys and sorted. No derivative
is taken here.

Axis legend: R ranks, I items (spans of tiles within a row), T tiles, P pairs.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax

from gsjax.raster.lists.blocks import block_size, over_blocks
from gsjax.raster.lists.counting import cumulative_sum, segment_ids
from gsjax.raster.lists.sorting import pair_keys, sort_pairs
from gsjax.raster.size_buckets import run_at_bucket
from gsjax.raster.types import Array
from gsjax.runtime import loops


class ListBuilder(NamedTuple):
    """A way to build tile lists.

    Attributes:
      empty: the state before the first items.
      add: (state, rank, first, count) → state. Adds items [I] in rising order of rank;
        item i covers the tiles first … first + count − 1.
      ranks: (state, start [T], pairs []) → [P] ranks by tile; meaningless if there are
        more pairs than room.
    """

    empty: Any
    add: Callable[..., Any]
    ranks: Callable[..., Array]


def choose_list_builder(
    platform: str, capacity: int, ranks: int, tiles: int, num_size_buckets: int
) -> ListBuilder:
    """Return the faster builder on a platform.

    Args:
      platform: as JAX names it.
      capacity: room for pairs.
      ranks, tiles: their numbers.
      num_size_buckets: sorting has at most 2 · num_size_buckets − 1 sizes.
    """
    if platform == "cpu":
        return scatter_builder(capacity)
    return sort_builder(capacity, ranks, tiles, num_size_buckets)


def scatter_builder(capacity: int) -> ListBuilder:
    """Store the items that have tiles, then scatter them in one loop."""

    def add(state, *item):
        return loops.append(*state, item, item[2] > 0)

    def ranks(state, start, pairs):
        (items,), kept = state
        items = jnp.where(pairs <= capacity, items, 0)
        return loops.scatter_items(kept, items, start, jnp.zeros(capacity, jnp.int32))

    # At most one item per pair, and one spare row for `loops.append`.
    kept = jnp.zeros((capacity + 1, 3), jnp.int32)
    return ListBuilder((jnp.zeros(1, jnp.int32), kept), add, ranks)


def sort_builder(
    capacity: int, ranks: int, tiles: int, num_size_buckets: int
) -> ListBuilder:
    """Unroll pairs into keys and sort them by (tile, rank)."""
    in_pairs = block_size(capacity, 4)
    # The unused part of the last block may reach beyond the capacity.
    room = jnp.full(capacity + in_pairs, tiles, jnp.int32)
    keys = pair_keys(room, jnp.full_like(room, ranks), tiles + 1, ranks + 1)

    def add(state, rank, first, count):
        written, keys = state
        ends = cumulative_sum(count)
        more = jnp.minimum(ends[-1], capacity - written)
        pairs = partial(add_pairs, rank, first - (ends - count), ends, written)
        return written + more, over_blocks(pairs, more, in_pairs, keys)

    def add_pairs(rank, first, ends, written, start, keys):
        item = segment_ids(ends, in_pairs, start)
        live = item < rank.shape[0]
        tile = first.at[item].get(mode="clip") + start + lax.iota(jnp.int32, in_pairs)
        more = pair_keys(
            jnp.where(live, tile, tiles),
            jnp.where(live, rank.at[item].get(mode="clip"), ranks),
            tiles + 1,
            ranks + 1,
        )
        at = (written + start,)
        return tuple(map(lambda k, m: lax.dynamic_update_slice(k, m, at), keys, more))

    def sorted_ranks(state, start, pairs):
        del start
        _, keys = state

        def sort(size):
            low = sort_pairs([key[:size] for key in keys], ranks + 1)
            return jnp.pad(low, (0, capacity - size))

        # Sizes lie close together: sorting is quick to compile and slow to run.
        return run_at_bucket(pairs, capacity, 2 * num_size_buckets - 1, sort, step=2)

    return ListBuilder((jnp.int32(0), keys), add, sorted_ranks)
