"""Exact sorts by a single packed key without payload.

On CPU a sort of keys alone is several times faster than one that carries a payload or
compares twice, and the stable sort (by merging) faster than the other; on GPU sorts of
keys alone are those that XLA hands to a radix sort. Where two parts fit into 32 bits
one uint32 is sorted, else one uint64, which is built inside `jax.enable_x64` so that
it exists whatever the user's setting; both are exact.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

Array = jax.Array


def bits_for(count: int) -> int:
    """Bits that hold the numbers 0 to count - 1."""
    return max(1, (count - 1).bit_length())


def pair_keys(
    high: Array, low: Array, high_count: int, low_count: int
) -> tuple[Array, ...]:
    """What to sort by (high, low), both int32 ≥ 0 and below their counts: one key of
    32 bits where they fit, else both.
    """
    low_bits = bits_for(low_count)
    if bits_for(high_count) + low_bits <= 32:
        return ((high.astype(jnp.uint32) << low_bits) | low.astype(jnp.uint32),)
    return high.astype(jnp.uint32), low


def sort_pairs(keys: Sequence[Array], low_count: int) -> Array:
    """``low`` of `pair_keys`, sorted by (high, low)."""
    if len(keys) == 2:
        return _sort_wide(*keys)
    mask = jnp.uint32(2 ** bits_for(low_count) - 1)
    return (lax.sort(keys[0], is_stable=True) & mask).astype(jnp.int32)


def argsort_float(values: Array) -> Array:
    """Stable ascending order [n] of floats ≥ 0 or +inf; ties by index."""
    index = lax.iota(jnp.int32, values.shape[0])
    if values.dtype == jnp.float32:
        # Bits of non-negative floats order like the floats.
        return _sort_wide(lax.bitcast_convert_type(values, jnp.uint32), index)
    return lax.sort((values, index), num_keys=2)[1]


def argsort_descending(counts: Array) -> Array:
    """Stable descending order [n] of int32 counts ≥ 0; ties by index."""
    key = (2**31 - 1 - counts).astype(jnp.uint32)
    return _sort_wide(key, lax.iota(jnp.int32, counts.shape[0]))


def _sort_wide(high: Array, low: Array) -> Array:
    """Sort by (high uint32, low int32 ≥ 0); returns ``low`` sorted."""
    with jax.enable_x64(True):
        wide = lax.convert_element_type(high, jnp.uint64) << np.uint64(32)
        key = wide | lax.convert_element_type(low, jnp.uint64)
        low_bits = lax.sort(key, is_stable=True) & np.uint64(2**32 - 1)
        return lax.convert_element_type(low_bits, jnp.int32)
