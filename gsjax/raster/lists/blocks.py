"""Work done block by block, so that its cost goes with the slots in use.

`by_blocks` treats each slot by itself; `over_blocks` carries a state from one block to
the next. No derivative is taken here: a transposed loop would copy more than it saves.
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

BLOCK = 8192  # slots; their values fit a core's cache


def block_size(size: int, times: int = 1) -> int:
    """Return the slots of a block, ``times`` the usual number, at most ``size``."""
    cpu = on_cpu()
    return max(1, min(times * BLOCK, size) if cpu else size)


def over_blocks(add: Callable[[Array, T], T], count: Array, block: int, state: T) -> T:
    """Fold ``add(start, state)`` over the blocks of ``count`` slots.

    Args:
      add: (first slot of the block [] int32, state) → state.
      count: [] int32, number of slots.
      block: slots of a block.
      state: before the first block.
    """
    blocks = -(-count // block)
    return lax.fori_loop(0, blocks, lambda i, s: add(i * block, s), state)


def by_blocks(
    run: Callable[..., T], skip: Callable[..., T], needed: Array, inputs
) -> T:
    """Return ``run(needed, inputs)``, or ``skip`` for blocks without needed slots.

    Args:
      run, skip: element-wise functions of arrays [K, …] with results of equal shapes.
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
        # A branch of its own: else XLA's CPU backend (jax 0.10.2) slices the block
        # again for each use.
        update = lax.cond(any_in_batch(jnp.any(some[0])), run, skip, *some)
        put = partial(lax.dynamic_update_slice_in_dim, start_index=at, axis=0)
        return jax.tree.map(lambda all_, more: put(all_, more), out, update)

    return lax.fori_loop(0, count, add, skip(needed, inputs))
