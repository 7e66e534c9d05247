"""Exact sorts by a single packed key without payload.

On CPUs a sort of keys alone is several times faster than one with a payload or two
keys, and the stable sort (by merging) faster than the unstable one. On GPUs XLA hands
large sorts of keys alone to a radix sort. Two parts that fit 32 bits are packed into
one uint32, others into one uint64, built inside `jax.enable_x64` so that it exists
whatever the user's setting. Both are exact.
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
    """Sort keys; equal ones are identical, so stability only decides the speed."""
    return lax.sort(keys, is_stable=on_cpu())


def bits_for(count: int) -> int:
    """Return the number of bits that hold 0 to count − 1."""
    return max(1, (count - 1).bit_length())


def pair_keys(
    high: Array, low: Array, high_count: int, low_count: int
) -> tuple[Array, ...]:
    """Return the keys that sort by (high, low), both int32 ≥ 0 and below their counts.

    One key if both fit 32 bits, else two.
    """
    low_bits = bits_for(low_count)
    if bits_for(high_count) + low_bits <= 32:
        return ((high.astype(jnp.uint32) << low_bits) | low.astype(jnp.uint32),)
    return high.astype(jnp.uint32), low


def sort_pairs(keys: Sequence[Array], low_count: int) -> Array:
    """Return ``low`` of `pair_keys`, sorted by (high, low)."""
    if len(keys) == 2:
        return _sort_wide(*keys)
    mask = jnp.uint32(2 ** bits_for(low_count) - 1)
    return (_sort(keys[0]) & mask).astype(jnp.int32)


def argsort_float(values: Array, rest: Array | None = None) -> Array:
    """Return the stable ascending order [n] of floats ≥ 0 or +inf; ties by index.

    Args:
      values: [n].
      rest: [n] int32 of `split_float`, the part that float32 cannot hold; or None.
    """
    index = lax.iota(jnp.int32, values.shape[0])
    if values.dtype != jnp.float32:
        return lax.sort((values, index), num_keys=2)[1]
    # Bits of non-negative floats order like the floats.
    bits = lax.bitcast_convert_type(values, jnp.uint32)
    if rest is None:
        return _sort_wide(bits, index)
    # 31 bits of the float and 31 of the rest; the index replaces the lowest bits,
    # beyond the two that are free.
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
    """Split float64 ``values`` ≥ 0 or +inf into a float32 and a remainder.

    Call within ``jax.enable_x64(True)``.

    Returns:
      The nearest float32, and the remainder as int32 in units of 2⁻³¹ of the distance
      to the next float32. `argsort_float` orders by both as by the float64, up to the
      bits that indices take: to a relative 2⁻³⁷ for a million values.
    """
    # `lax.reduce_precision`, because XLA may drop a cast to float32 and back where it
    # may keep excess precision.
    limits = np.finfo(np.float32)
    rounded = lax.reduce_precision(values, limits.nexp, limits.nmant)
    high = lax.convert_element_type(rounded, jnp.float32)
    # 2^(1 − e) for a float in [2^e, 2^(e + 1)): its exponent bits, 1 to 254, mirrored.
    bits = lax.bitcast_convert_type(high, jnp.uint32)
    mirrored = (np.uint32(255) - (bits >> np.uint32(23))) << np.uint32(23)
    per_size = lax.bitcast_convert_type(mirrored, jnp.float32)
    per_step = lax.convert_element_type(per_size, jnp.float64) * 2.0**22
    left = (values - rounded) * per_step
    # At most half a step; 0 for infinities and zeros.
    usual = jnp.isfinite(high) & (high >= limits.tiny)
    left = jnp.where(usual, left, 0.0)
    return high, lax.convert_element_type(left * 2.0**_REST_BITS, jnp.int32)


def argsort_descending(counts: Array) -> Array:
    """Return the stable descending order [n] of int32 counts ≥ 0; ties by index."""
    key = (2**31 - 1 - counts).astype(jnp.uint32)
    return _sort_wide(key, lax.iota(jnp.int32, counts.shape[0]))


def _sort_wide(high: Array, low: Array) -> Array:
    """Return ``low`` sorted by (high uint32, low int32 ≥ 0)."""
    with jax.enable_x64(True):
        wide = lax.convert_element_type(high, jnp.uint64) << np.uint64(32)
        key = wide | lax.convert_element_type(low, jnp.uint64)
        low_bits = _sort(key) & np.uint64(2**32 - 1)
        return lax.convert_element_type(low_bits, jnp.int32)
