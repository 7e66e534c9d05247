"""Sorts by one packed key equal NumPy's stable sorts, whatever the widths."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsjax.raster.lists.sorting import (
    argsort_descending,
    argsort_float,
    bits_for,
    pair_keys,
    sort_pairs,
    split_float,
)

LENGTH = 64  # one shape, one compilation


@partial(jax.jit, static_argnames=("high_count", "low_count"))
def sort_by_both(high, low, high_count, low_count):
    return sort_pairs(pair_keys(high, low, high_count, low_count), low_count)


argsort = jax.jit(argsort_float)
split = jax.jit(split_float)
descending = jax.jit(argsort_descending)


def numbers(limit):
    return st.lists(st.integers(0, limit), min_size=LENGTH, max_size=LENGTH)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 255, 256, 257, 2**20])
def test_bits_hold_the_largest(count):
    assert count - 1 < 2 ** bits_for(count)
    assert count == 1 or count - 1 >= 2 ** (bits_for(count) - 1)


@pytest.mark.parametrize(("high_bits", "low_bits"), [(10, 12), (20, 31)])
@settings(max_examples=50)
@given(data=st.data())
def test_pairs_of_narrow_and_wide_keys(high_bits, low_bits, data):
    counts = 2**high_bits, min(2**low_bits, 2**31 - 1)
    high, low = (np.int32(data.draw(numbers(count - 1))) for count in counts)
    got = sort_by_both(high, low, *counts)
    assert got.dtype == jnp.int32
    np.testing.assert_array_equal(got, low[np.lexsort((low, high))])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@settings(max_examples=50)
@given(data=st.data())
def test_floats_with_ties_and_infinities(dtype, data):
    whole = np.dtype(dtype).name.replace("float", "uint")
    # Any normal float from its bits, and infinity; ties drawn in.
    low, high, one = np.array([np.finfo(dtype).tiny, np.inf, 1], dtype).view(whole)
    common = [0, int(high), int(one)]
    bits = st.one_of(st.integers(int(low), int(high)), st.sampled_from(common))
    drawn = data.draw(st.lists(bits, min_size=LENGTH, max_size=LENGTH))
    values = np.asarray(drawn, whole).view(dtype)
    np.testing.assert_array_equal(argsort(values), np.argsort(values, kind="stable"))


@settings(max_examples=50)
@given(data=st.data())
def test_floats_in_two_parts(data):
    """The order is that of the float64 values, but for their last three bits."""
    tiny, largest = np.finfo(np.float32).tiny, np.finfo(np.float32).max
    low, top, high = np.array([tiny, 2.0**127, largest]).view(np.uint64).tolist()
    # The halfway point below a power of two rounds up to it, into the next exponent.
    edges = st.sampled_from([low, top - 2**29, top - 2**28, high - 2**32])
    start = data.draw(st.one_of(edges, st.integers(low, high - 2**32)))
    near = st.integers(start, start + 2**31)  # some steps of float32
    bits = st.one_of(near, st.integers(low, high), st.sampled_from([start]))
    drawn = data.draw(st.lists(bits, min_size=LENGTH, max_size=LENGTH))
    values = (np.asarray(drawn, np.uint64) & ~np.uint64(7)).view(np.float64)
    values[data.draw(st.integers(0, LENGTH - 1))] = np.inf
    np.testing.assert_array_equal(
        argsort(*split(values)), np.argsort(values, kind="stable")
    )


@settings(max_examples=50)
@given(counts=numbers(2**31 - 1))
def test_descending(counts):
    counts = np.asarray(counts, np.int32)
    wanted = np.argsort(-counts.astype(np.int64), kind="stable")
    np.testing.assert_array_equal(descending(counts), wanted)
