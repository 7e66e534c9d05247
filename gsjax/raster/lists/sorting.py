"""Exact sorts by a single packed key without payload.

On CPU a sort of keys alone is several times faster than one that carries a payload or
compares twice, and the stable sort (by merging) faster than the other; on GPU sorts of
keys alone are those that XLA hands to a radix sort where there are many (on an H200,
jax 0.11.2, 24,576 keys of 32 bits and 187,500 of 64, but not 100,000 of those), and
where there are few, to be stable costs it a second array. Where two parts fit into 32
bits one uint32 is sorted, else one uint64, which is built inside `jax.enable_x64` so
that it exists whatever the user's setting; both are exact.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.runtime.devices import on_cpu

Array = jax.Array

_REST_BITS = 31


def _sort(keys: Array) -> Array:
    """Equal keys are the same, so their order is a matter of speed alone."""
    return lax.sort(keys, is_stable=on_cpu())


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
    return (_sort(keys[0]) & mask).astype(jnp.int32)


def argsort_float(values: Array, rest: Array | None = None) -> Array:
    """Stable ascending order [n] of floats ≥ 0 or +inf; ties by index.

    Args:
      values: [n].
      rest: [n] int32 of `split_float`, what float32 ``values`` lack; or None.
    """
    index = lax.iota(jnp.int32, values.shape[0])
    if values.dtype != jnp.float32:
        return lax.sort((values, index), num_keys=2)[1]
    # Bits of non-negative floats order like the floats.
    bits = lax.bitcast_convert_type(values, jnp.uint32)
    if rest is None:
        return _sort_wide(bits, index)
    # 31 bits of the float and as many of the rest; the index takes the place of those
    # that count least, beyond the two that are free.
    low_bits = bits_for(values.shape[0])
    with jax.enable_x64(True):
        wide = lax.convert_element_type(bits, jnp.uint64) << np.uint64(_REST_BITS)
        rest = lax.convert_element_type(rest, jnp.int64)
        wide += lax.convert_element_type(rest, jnp.uint64)  # may be negative: wraps
        wide = wide >> np.uint64(max(low_bits - 2, 0))
        key = (wide << np.uint64(low_bits)) | lax.convert_element_type(
            index, jnp.uint64
        )
        low = _sort(key) & np.uint64(2**low_bits - 1)
        return lax.convert_element_type(low, jnp.int32)


def split_float(values: Array) -> tuple[Array, Array]:
    """float64 ``values`` ≥ 0 or +inf as float32, and what that lacks of them.

    Within ``jax.enable_x64(True)``.

    Returns:
      The nearest float32, and int32 in units of 2⁻³¹ of the distance to the next. By
      both `argsort_float` orders as by the float64, but for as many of those 31 bits
      as the indices take beyond two: of a million values, to 2⁻³⁷ of each.
    """
    # By `lax.reduce_precision`: float64 to float32 and back is no rounding to XLA where
    # it may keep excess precision, as it may on GPU.
    limits = np.finfo(np.float32)
    rounded = lax.reduce_precision(values, limits.nexp, limits.nmant)
    high = lax.convert_element_type(rounded, jnp.float32)
    # Of a float between 2^e and its double, 2^(1 - e): the exponent's bits, 1 to 254,
    # mirrored.
    bits = lax.bitcast_convert_type(high, jnp.uint32)
    mirrored = (np.uint32(255) - (bits >> np.uint32(23))) << np.uint32(23)
    per_size = lax.bitcast_convert_type(mirrored, jnp.float32)
    per_step = lax.convert_element_type(per_size, jnp.float64) * 2.0**22
    left = (values - rounded) * per_step
    # Half a step at most; and nothing of infinities and zeros.
    usual = jnp.isfinite(high) & (high >= limits.tiny)
    left = jnp.where(usual, left, 0.0)
    return high, lax.convert_element_type(left * 2.0**_REST_BITS, jnp.int32)


def argsort_descending(counts: Array) -> Array:
    """Stable descending order [n] of int32 counts ≥ 0; ties by index."""
    key = (2**31 - 1 - counts).astype(jnp.uint32)
    return _sort_wide(key, lax.iota(jnp.int32, counts.shape[0]))


def _sort_wide(high: Array, low: Array) -> Array:
    """Sort by (high uint32, low int32 ≥ 0); returns ``low`` sorted."""
    with jax.enable_x64(True):
        wide = lax.convert_element_type(high, jnp.uint64) << np.uint64(32)
        key = wide | lax.convert_element_type(low, jnp.uint64)
        low_bits = _sort(key) & np.uint64(2**32 - 1)
        return lax.convert_element_type(low_bits, jnp.int32)
