"""Sums of counts are exact, and saturate; lists are what the counts stand for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.raster.lists.counting import (
    compact_indices,
    cumulative_sum,
    segment_ids,
    total_count,
)


@pytest.fixture(params=["cpu", "gpu"], autouse=True)
def backend(request, monkeypatch):
    """Accelerators have other ways to the same. (A function that is jitted twice is
    traced once: so each test jits one of its own.)"""
    monkeypatch.setattr(jax, "default_backend", lambda: request.param)


@pytest.mark.parametrize("size", [1, 2, 3, 4, 65, 10007])
def test_running_totals(size):
    counts = np.random.default_rng(size).integers(0, 2**20, size).astype(np.int32)
    wanted = np.cumsum(counts, dtype=np.int32)
    np.testing.assert_array_equal(jax.jit(lambda c: cumulative_sum(c))(counts), wanted)
    odd = counts % 2 == 1
    found = jax.jit(lambda c: cumulative_sum(c))(odd)
    assert found.dtype == jnp.int32
    np.testing.assert_array_equal(found, np.cumsum(odd))
    batch = jax.jit(jax.vmap(lambda c: cumulative_sum(c)))(
        np.stack([counts, counts // 3])
    )
    np.testing.assert_array_equal(batch, [wanted, np.cumsum(counts // 3)])


@pytest.mark.parametrize("room", [1, 30, 300])
def test_squeeze_keeps_the_first(room):
    chosen = np.random.default_rng(0).random(200) < 0.3
    where = np.flatnonzero(chosen)
    index, count = jax.jit(lambda c: compact_indices(c, room))(chosen)
    assert int(count) == len(where)
    wanted = np.full(room, 200)
    wanted[: min(room, len(where))] = where[:room]
    np.testing.assert_array_equal(index, wanted)


@pytest.mark.parametrize("start", [0, 1, 4, 6, 9])
def test_owners_of_unrolled_counts(start):
    counts = np.array([2, 0, 3, 0, 0, 1], np.int32)
    whole = np.repeat(np.arange(6), counts)
    found = jax.jit(lambda ends: segment_ids(ends, 9, start))(np.cumsum(counts))
    wanted = np.append(whole[start:], np.full(9, 6))[:9]
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("extra", [-2, 0, 1, 2**30])
def test_counts_are_caught_before_they_wrap(extra):
    counts = np.full(1024, 2**21, np.int32)  # 2^31 in all: would wrap to -2^31
    counts[0] = 2**21 + extra
    total, safe = jax.jit(lambda c: total_count(c))(counts)
    assert not safe
    assert int(total) == 2**31 - 1
    total, safe = jax.jit(lambda c: total_count(c))(counts[:100])
    assert bool(safe) == (int(counts[:100].astype(np.int64).sum()) < 2**30)
