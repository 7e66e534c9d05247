"""Two ways from spans of tiles to the same lists: by dealing them out, and by sorting.

On CPUs the spans are kept, front to back, and once the length of every list is known
each Gaussian is dealt to its tiles: a counting sort, whose work goes with the pairs.
Accelerators, where such a loop would wait for its launches, unroll the spans into keys
and sort those. No derivative is taken here.

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
    """How lists come about.

    Attributes:
      nothing: the state before the first items.
      add: (state, rank, first, count) → state: items [I] of ranks that do not fall;
        the tiles first … first + count - 1 of each, none where ``count`` is 0.
      ranks: (state, start [T], pairs []) → [P] ranks by tile. Of no use if there are
        more pairs than room.
    """

    nothing: Any
    add: Callable[..., Any]
    ranks: Callable[..., Array]


def choose_list_builder(
    platform: str, capacity: int, ranks: int, tiles: int, num_size_buckets: int
) -> ListBuilder:
    """The faster one.

    Args:
      platform: as JAX names it.
      capacity: room for pairs.
      ranks, tiles: how many there are.
      num_size_buckets: 2 · num_size_buckets − 1 sizes at which to sort, at most.
    """
    if platform == "cpu":
        return scatter_builder(capacity)
    return sort_builder(capacity, ranks, tiles, num_size_buckets)


def scatter_builder(capacity: int) -> ListBuilder:
    """Keep the items that have tiles; then one loop over them."""

    def add(state, *item):
        return loops.append(*state, item, item[2] > 0)

    def ranks(state, start, pairs):
        (items,), kept = state
        items = jnp.where(pairs <= capacity, items, 0)
        return loops.deal(kept, items, start, jnp.zeros(capacity, jnp.int32))

    # As many as there are pairs, at most; and one, see `loops.append`.
    kept = jnp.zeros((capacity + 1, 3), jnp.int32)
    return ListBuilder((jnp.zeros(1, jnp.int32), kept), add, ranks)


def sort_builder(
    capacity: int, ranks: int, tiles: int, num_size_buckets: int
) -> ListBuilder:
    """Pairs as keys, sorted by (tile, rank)."""
    in_pairs = block_size(capacity, 4)
    # The last block may reach beyond the capacity by what is not live of it.
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

        # Sizes lie close together: to sort is quick to compile, and slow to do.
        return run_at_bucket(pairs, capacity, 2 * num_size_buckets - 1, sort, step=2)

    return ListBuilder((jnp.int32(0), keys), add, sorted_ranks)
