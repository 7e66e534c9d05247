"""Sorts by one packed key, and sums of counts, are those of NumPy."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsjax.raster.lists.counting import compact_indices, cumulative_sum, total_count
from gsjax.raster.lists.sorting import (
    argsort_descending,
    argsort_float,
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


@pytest.mark.parametrize(
    ("high_count", "low_count"),
    [(1, 1), (2, 3), (256, 257), (2**10, 2**12), (2**20, 2**31 - 1)],
)
@settings(max_examples=50)
@given(data=st.data())
def test_pairs_of_narrow_and_wide_keys(high_count, low_count, data):
    counts = high_count, low_count
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


@pytest.fixture(params=["cpu", "gpu"])
def backend(request, monkeypatch):
    """Trace for this platform; each test jits a function of its own."""
    monkeypatch.setattr(jax, "default_backend", lambda: request.param)


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("size", [1, 4, 65, 10007])
def test_cumulative_sums(size):
    counts = np.random.default_rng(size).integers(0, 2**20, size).astype(np.int32)

    @jax.jit
    def sums(counts, odd):
        both = jnp.stack([counts, counts // 3])
        alone = cumulative_sum(counts), cumulative_sum(odd)
        return *alone, *jax.vmap(cumulative_sum)(both)

    values = counts, counts % 2 == 1, counts, counts // 3
    for found, value in zip(sums(*values[:2]), values, strict=True):
        assert found.dtype == jnp.int32
        np.testing.assert_array_equal(found, np.cumsum(value, dtype=np.int32))


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("capacity", [1, 30, 300])
def test_compact_indices_keeps_the_first(capacity):
    chosen = np.random.default_rng(0).random(200) < 0.3
    where = np.flatnonzero(chosen)
    index, count = jax.jit(lambda c: compact_indices(c, capacity))(chosen)
    assert int(count) == len(where)
    wanted = np.append(where, np.full(capacity, 200))[:capacity]
    np.testing.assert_array_equal(index, wanted)


@pytest.mark.usefixtures("backend")
def test_total_count_saturates():
    """Just below and above the limit, and where int32 would wrap to any number."""
    huge, just_below = 2**30, [2**30 - 2**12, 5]
    wraps = [huge, huge, 1], [huge] * 4, [*[huge] * 4, 100]
    for counts in ([3, 0, 4], just_below, [huge, 2**10], *wraps, [2**21] * 1024):
        total, safe = jax.jit(lambda c: total_count(c))(jnp.asarray(counts, jnp.int32))
        assert total.dtype == jnp.int32
        assert safe == (sum(counts) < 2**30)
        assert total == (sum(counts) if safe else 2**31 - 1)
