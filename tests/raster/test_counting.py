"""Sums of counts are exact and saturate; work in blocks equals work on the whole."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import camera_of, gaussians_at, on_cpu
from stages import order_of

import gsjax
from gsjax.raster.lists.blocks import BLOCK, by_blocks, over_blocks
from gsjax.raster.lists.counting import (
    compact_indices,
    cumulative_sum,
    total_count,
)


@pytest.fixture(params=["cpu", "gpu"])
def backend(request, monkeypatch):
    """Trace for this platform. Each test jits a function of its own, because one that
    is jitted twice is traced once.
    """
    monkeypatch.setattr(jax, "default_backend", lambda: request.param)
    return request.param


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("size", [1, 4, 65, 10007])
def test_cumulative_sums(size):
    counts = np.random.default_rng(size).integers(0, 2**20, size).astype(np.int32)
    odd = counts % 2 == 1
    found, of_bools, batch = jax.jit(
        lambda c, o: (
            cumulative_sum(c),
            cumulative_sum(o),
            jax.vmap(cumulative_sum)(jnp.stack([c, c // 3])),
        )
    )(counts, odd)
    wanted = np.cumsum(counts, dtype=np.int32)
    np.testing.assert_array_equal(found, wanted)
    assert of_bools.dtype == jnp.int32
    np.testing.assert_array_equal(of_bools, np.cumsum(odd))
    np.testing.assert_array_equal(batch, [wanted, np.cumsum(counts // 3)])


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("capacity", [1, 30, 300])
def test_compact_indices_keeps_the_first(capacity):
    chosen = np.random.default_rng(0).random(200) < 0.3
    where = np.flatnonzero(chosen)
    index, count = jax.jit(lambda c: compact_indices(c, capacity))(chosen)
    assert int(count) == len(where)
    wanted = np.append(where, np.full(capacity, 200))[:capacity]
    np.testing.assert_array_equal(index, wanted)


SUMS = {
    "small": [3, 0, 4],
    "just below": [2**30 - 2**12, 5],
    "just above": [2**30, 2**10],
    "wraps to -2^31 + 1": [2**30, 2**30, 1],
    "wraps to 0": [2**30] * 4,
    "wraps to 100": [2**30] * 4 + [100],
    "many": [2**21] * 1024,
}


@pytest.mark.usefixtures("backend")
@pytest.mark.parametrize("counts", SUMS.values(), ids=SUMS)
def test_total_count_saturates(counts):
    total, safe = jax.jit(lambda c: total_count(c))(jnp.asarray(counts, jnp.int32))
    assert total.dtype == jnp.int32
    assert safe == (sum(counts) < 2**30)
    assert total == (sum(counts) if safe else 2**31 - 1)


@pytest.mark.parametrize("size", [1, 7, BLOCK, 2 * BLOCK + 5])
def test_blocks_that_are_not_needed_are_skipped(size, backend):
    """Accelerators take everything as one block."""

    def square(needed, inputs):
        return inputs[0] ** 2, jnp.ones_like(needed, jnp.int32)

    def skip(needed, inputs):
        return jnp.full_like(inputs[0], -1), jnp.zeros_like(needed, jnp.int32)

    values = jnp.arange(size, dtype=jnp.float32)
    run = jax.jit(lambda needed: by_blocks(square, skip, needed, (values,)))
    for first in {0, size // 2, size - 1}:  # the only one that is needed
        squares, done = run(jnp.arange(size) == first)
        block = min(BLOCK, size) if backend == "cpu" else size
        start = min(first // block * block, size - block)
        same_block = (np.arange(size) >= start) & (np.arange(size) < start + block)
        np.testing.assert_array_equal(done, same_block)
        wanted = np.where(same_block, np.square(values), -1)
        np.testing.assert_array_equal(squares, wanted)


def test_over_blocks_runs_as_many_as_there_are():
    @jax.jit
    def run(count):
        def add(start, state):
            index = start + jnp.arange(8)
            return state[0] + 1, state[1].at[index].add(index < count)

        return over_blocks(add, count, 8, (0, jnp.zeros(64, jnp.int32)))

    for count in (0, 1, 7, 8, 9, 30):
        blocks, seen = run(jnp.int32(count))
        assert blocks == -(-count // 8)
        np.testing.assert_array_equal(seen, np.arange(64) < count)


@on_cpu
def test_order_does_not_depend_on_dead_slots():
    """Live slots in two blocks; between them a block that is dead."""
    rng = np.random.default_rng(0)
    live = np.sort(rng.permutation(np.r_[0:BLOCK, 2 * BLOCK : 3 * BLOCK + 9])[:500])
    points = rng.normal(size=(500, 3)) + [0, 0, 5]
    few = gaussians_at(points, np.full((500, 3), 0.1), np.full(500, 0.5))
    size = 3 * BLOCK + 9
    params = jax.tree.map(
        lambda a: jnp.full((size, *a.shape[1:]), jnp.nan, a.dtype).at[live].set(a),
        few.params,
    )
    active = jnp.zeros(size, bool).at[live].set(True)
    many = gsjax.Gaussians(params=params, active=active)
    order = jax.jit(order_of, static_argnums=2)
    config = gsjax.RasterConfig(num_size_buckets=1)
    wanted, count = order(few, camera_of(), config)
    found, same = order(many, camera_of(), config)
    assert 10 < int(count) == int(same)
    np.testing.assert_array_equal(found[:count], live[np.asarray(wanted[:count])])
    assert (found[count:] == size).all()
