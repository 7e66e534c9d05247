"""Decisions that a batch takes as one.

Under `jax.vmap` a `lax.cond` or `lax.switch` on what differs from one element of the
batch to the next runs every branch for all of them, and picks. On what these return it
runs the one branch that will do for all.
"""

from collections.abc import Callable
from functools import partial

import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from gsjax.raster.types import Array


def _as_one(decide: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """The value itself; in a batch what ``decide`` makes of all values, for each."""

    @custom_vmap
    def same(value: Array) -> Array:
        return value

    @same.def_vmap
    def _of_batch(size, batched, value):
        del size, batched  # called for a batch alone
        return same(decide(value)), False

    return same


_any, _least = (_as_one(partial(f, axis=0)) for f in (jnp.any, jnp.min))


def any_in_batch(flag: Array) -> Array:
    """Whether any of the batch has it, of each flag of a bool array."""
    return _any(flag)


def min_in_batch(index: Array) -> Array:
    """The smallest of the batch []."""
    return _least(index)
