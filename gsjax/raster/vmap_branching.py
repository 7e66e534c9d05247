"""Branch decisions that a batch takes together.

Under `jax.vmap`, `lax.cond` or `lax.switch` on a value that differs from element to
element runs every branch for all elements and selects. On the values returned here it
runs the one branch that serves all of them.
"""

from collections.abc import Callable
from functools import partial

import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from gsjax.raster.types import Array


def _together(decide: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """Return the identity, which in a batch gives ``decide`` of all values to each."""

    @custom_vmap
    def same(value: Array) -> Array:
        return value

    @same.def_vmap
    def _of_batch(size, batched, value):
        del size, batched  # called for batches only
        return same(decide(value)), False

    return same


_any, _min = (_together(partial(f, axis=0)) for f in (jnp.any, jnp.min))


def any_in_batch(flag: Array) -> Array:
    """Return the flag itself; in a batch, whether any element has it set."""
    return _any(flag)


def min_in_batch(index: Array) -> Array:
    """Return the index [] itself; in a batch, the smallest of all elements."""
    return _min(index)
