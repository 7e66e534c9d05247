"""Packed single-key sorts equal numpy's stable sorts, whatever the widths."""

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


sort_narrow = partial(sort_by_both, high_count=2**10, low_count=2**12)
sort_wide = partial(sort_by_both, high_count=2**20, low_count=2**31 - 1)
argsort = jax.jit(argsort_float)
split = jax.jit(split_float)
descending = jax.jit(argsort_descending)


def numbers(limit):
    return st.lists(st.integers(0, limit), min_size=LENGTH, max_size=LENGTH)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 255, 256, 257, 2**20])
def test_bits_hold_the_largest(count):
    assert count - 1 < 2 ** bits_for(count)
    assert count == 1 or count - 1 >= 2 ** (bits_for(count) - 1)


@settings(deadline=None, max_examples=50)
@given(high=numbers(2**10 - 1), low=numbers(2**12 - 1))
def test_narrow_keys(high, low):
    got = sort_narrow(jnp.asarray(high, jnp.int32), jnp.asarray(low, jnp.int32))
    np.testing.assert_array_equal(got, np.asarray(low)[np.lexsort((low, high))])


@settings(deadline=None, max_examples=50)
@given(high=numbers(2**20 - 1), low=numbers(2**31 - 2))
def test_wide_keys(high, low):
    got = sort_wide(jnp.asarray(high, jnp.int32), jnp.asarray(low, jnp.int32))
    assert got.dtype == jnp.int32
    np.testing.assert_array_equal(got, np.asarray(low)[np.lexsort((low, high))])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@settings(deadline=None, max_examples=50)
@given(data=st.data())
def test_floats_with_ties_and_infinities(dtype, data):
    whole = np.dtype(dtype).name.replace("float", "uint")
    # Any normal float from its bits, and infinity; ties drawn in.
    low, high = (int(np.asarray(v, dtype).view(whole)) for v in
                 (np.finfo(dtype).tiny, np.inf))  # fmt: skip
    common = [0, high, int(np.asarray(1, dtype).view(whole))]
    bits = st.one_of(st.integers(low, high), st.sampled_from(common))
    drawn = data.draw(st.lists(bits, min_size=LENGTH, max_size=LENGTH))
    values = np.asarray(drawn, whole).view(dtype)
    np.testing.assert_array_equal(argsort(values), np.argsort(values, kind="stable"))


@settings(deadline=None, max_examples=50)
@given(data=st.data())
def test_floats_in_two_parts(data):
    """As the float64 that they are of: all but the last three bits count, of 64."""
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


def test_full_precision_of_the_depth():
    """Neighbouring floats are told apart: no bit of the depth is dropped."""
    start = np.float32(3.7)
    values = start + np.arange(LENGTH, dtype=np.float32) * np.spacing(start)
    assert len(np.unique(values)) == LENGTH
    shuffled = np.random.default_rng(0).permutation(values)
    np.testing.assert_array_equal(shuffled[argsort(shuffled)], values)


@settings(deadline=None, max_examples=50)
@given(counts=numbers(2**31 - 1))
def test_descending(counts):
    counts = np.asarray(counts, np.int32)
    wanted = np.argsort(-counts.astype(np.int64), kind="stable")
    np.testing.assert_array_equal(descending(counts), wanted)
