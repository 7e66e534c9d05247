"""Allocation of free slots and copies between slots; traceable.

Axis legend: N slots.
"""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax

Array = jax.Array
Tree = TypeVar("Tree")


class Assignment(NamedTuple):
    """Candidates and the slots assigned to them.

    Attributes:
      source: [N] int32, for each slot the candidate assigned to it, or N.
      chosen: [N] bool, the candidates that received a slot.
    """

    source: Array
    chosen: Array


def assign(candidates: Array, priority: Array, free: Array, limit: Array) -> Assignment:
    """Assign free slots, lowest first, to the candidates of highest priority.

    Args:
      candidates: [N] bool.
      priority: [N]; ties go to the lower slot, -inf and NaN come last.
      free: [N] bool.
      limit: [] upper limit of the number of slots to assign.
    """
    slots = candidates.shape[0]
    place = lax.iota(jnp.int32, slots)
    by_priority = jnp.lexsort((-priority, ~candidates))
    by_slot = jnp.argsort(~free, stable=True)
    given = jnp.minimum(jnp.sum(candidates), jnp.sum(free))
    taken = place < jnp.minimum(given, limit)
    receivers = jnp.full(slots, slots, jnp.int32).at[jnp.where(taken, by_slot, slots)]
    source = receivers.set(by_priority.astype(jnp.int32), mode="drop")
    givers = jnp.zeros(slots, bool).at[jnp.where(taken, by_priority, slots)]
    return Assignment(source, givers.set(True, mode="drop"))


def slot_mask(mask: Array, like: Array) -> Array:
    """Return ``mask`` [N] with trailing axes that broadcast against ``like`` [N, …]."""
    return mask.reshape(-1, *(1,) * (like.ndim - 1))


def copy_into(tree: Tree, source: Array, new: Tree) -> Tree:
    """Return ``tree`` with ``new[source]`` in each slot that has a source (< N)."""
    copied = source < source.shape[0]

    def leaf(old, new):
        row = jnp.asarray(new).at[source].get(mode="clip")
        return jnp.where(slot_mask(copied, old), row, old)

    return jax.tree.map(leaf, tree, new)


def where_slots(mask: Array, true: Tree, false: Tree) -> Tree:
    """Return each slot from ``true`` where ``mask`` [N] is set, else from ``false``."""
    return jax.tree.map(lambda a, b: jnp.where(slot_mask(mask, a), a, b), true, false)
