"""Who gets which free slot, under jit.

Axis legend: N slots.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.gaussians import GaussianParams

Array = jax.Array


class Assignment(NamedTuple):
    """Candidates and the slots that they got.

    Attributes:
      source: [N] for each slot the candidate that it was given to, or N.
      chosen: [N] bool, which candidates got a slot.
    """

    source: Array
    chosen: Array


def assign(candidates: Array, priority: Array, free: Array, limit: Array) -> Assignment:
    """Give free slots, lowest first, to the candidates of highest priority.

    Args:
      candidates: [N] bool.
      priority: [N]; among equals the lower slot goes first.
      free: [N] bool.
      limit: [] give away no more than that many.
    """
    slots = candidates.shape[0]
    place = lax.iota(jnp.int32, slots)
    # Candidates first, whatever their priority: -inf and NaN come last among them.
    by_priority = jnp.lexsort((-priority, ~candidates))
    by_slot = jnp.argsort(~free, stable=True)
    given = jnp.minimum(jnp.sum(candidates), jnp.sum(free))
    taken = place < jnp.minimum(given, limit)
    source = (
        jnp.full(slots, slots, jnp.int32)
        .at[jnp.where(taken, by_slot, slots)]
        .set(by_priority.astype(jnp.int32), mode="drop")
    )
    chosen = (
        jnp.zeros(slots, bool)
        .at[jnp.where(taken, by_priority, slots)]
        .set(True, mode="drop")
    )
    return Assignment(source, chosen)


def copy_into(
    params: GaussianParams, source: Array, born: GaussianParams
) -> GaussianParams:
    """``params`` with ``born[source]`` where a slot has a source (< N)."""
    slots = source.shape[0]

    def leaf(old, new):
        wide = (source < slots).reshape(-1, *(1,) * (old.ndim - 1))
        return jnp.where(wide, new.at[source].get(mode="clip"), old)

    return jax.tree.map(leaf, params, born)


def where_slots(mask: Array, yes: GaussianParams, no: GaussianParams):
    """Slot by slot, one or the other."""
    return jax.tree.map(
        lambda a, b: jnp.where(mask.reshape(-1, *(1,) * (a.ndim - 1)), a, b), yes, no
    )
