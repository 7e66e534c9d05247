"""Work block by block: on each slot by itself (`by_blocks`), or one block after another
with what those before came to (`over_blocks`).

What is paid then goes with the slots in use and not with the capacity. Made for what
no derivative is taken of: a transposed loop would copy more than it saves. Nor are the
blocks shared by devices: on CPU the exchange of what comes out costs as much.
Accelerators, where a loop waits for its launches, take everything as one block.
"""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.raster.lists.counting import compact_indices
from gsjax.raster.types import Array
from gsjax.raster.vmap_branching import any_in_batch
from gsjax.runtime.devices import on_cpu

T = TypeVar("T")

BLOCK = 8192  # slots; what they hold stays in a core's cache


def block_size(size: int, times: int = 1) -> int:
    """Slots of a block, ``times`` the usual many, where there are ``size`` in all."""
    cpu = on_cpu()
    return max(1, min(times * BLOCK, size) if cpu else size)


def over_blocks(add: Callable[[Array, T], T], count: Array, block: int, state: T) -> T:
    """``add(start, state)`` for each block of ``count`` slots, one after the other.

    Args:
      add: from the block's first slot [] int32, and what those before came to.
      count: [] int32, known when it runs.
      block: slots of a block.
      state: before the first.
    """
    blocks = -(-count // block)
    return lax.fori_loop(0, blocks, lambda i, s: add(i * block, s), state)


def by_blocks(
    run: Callable[..., T], skip: Callable[..., T], needed: Array, inputs
) -> T:
    """``run(needed, inputs)``, and ``skip`` where a block holds nothing needed.

    Args:
      run, skip: from arrays [K, …] to arrays [K, …] alike, element by element.
      needed: [N] bool.
      inputs: arrays [N, …].

    Returns:
      Arrays [N, …].
    """
    size = needed.shape[0]
    block = block_size(size)
    if block == size:
        return lax.cond(any_in_batch(jnp.any(needed)), run, skip, needed, inputs)
    blocks = jnp.pad(needed, (0, -size % block)).reshape(-1, block)
    which, count = compact_indices(
        any_in_batch(jnp.any(blocks, axis=1)), blocks.shape[0]
    )

    def add(i: Array, out: T) -> T:
        # The last block begins earlier instead of ending later.
        at = jnp.minimum(which[i] * block, size - block)
        part = partial(lax.dynamic_slice_in_dim, start_index=at, slice_size=block)
        some = jax.tree.map(part, (needed, inputs))
        # A branch of its own, else XLA's CPU backend (jax 0.10.2) would cut the block
        # out anew for each use of it.
        update = lax.cond(any_in_batch(jnp.any(some[0])), run, skip, *some)
        put = partial(lax.dynamic_update_slice_in_dim, start_index=at, axis=0)
        return jax.tree.map(lambda all_, more: put(all_, more), out, update)

    return lax.fori_loop(0, count, add, skip(needed, inputs))
