"""Work by blocks is the work itself, and what needs none is not done."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import camera_of, gaussians_at, on_cpu
from stages import order_of

import gsjax
from gsjax.raster.lists.blocks import BLOCK, by_blocks, over_blocks


def square_and_count(needed, inputs):
    """Whether a block was worked on shows in its last entry."""
    return inputs[0] ** 2, jnp.ones_like(needed, jnp.int32)


def nothing(needed, inputs):
    return jnp.full_like(inputs[0], -1), jnp.zeros_like(needed, jnp.int32)


@on_cpu
@pytest.mark.parametrize("size", [1, 7, BLOCK, 2 * BLOCK + 5])
def test_blocks_without_need_are_skipped(size):
    values = jnp.arange(size, dtype=jnp.float32)
    for first in {0, size // 2, size - 1}:  # the only one that is needed
        needed = jnp.arange(size) == first
        squares, done = by_blocks(square_and_count, nothing, needed, (values,))
        block = min(BLOCK, size)
        start = min(first // block * block, size - block)  # the last one begins earlier
        same_block = (np.arange(size) >= start) & (np.arange(size) < start + block)
        np.testing.assert_array_equal(done, same_block)
        np.testing.assert_array_equal(
            squares, np.where(same_block, np.square(values), -1)
        )


def test_accelerators_take_one_block(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    values = jnp.arange(2 * BLOCK + 5, dtype=jnp.float32)
    squares, done = by_blocks(square_and_count, nothing, values == 3, (values,))
    np.testing.assert_array_equal(squares, np.square(values))
    assert done.all()


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 30])
def test_over_as_many_blocks_as_there_are(count):
    def add(start, state):
        blocks, seen = state
        index = start + jnp.arange(8)
        return blocks + 1, seen.at[index].add(index < count)

    init = (0, jnp.zeros(64, jnp.int32))
    blocks, seen = jax.jit(over_blocks, static_argnums=(0, 2))(
        add, jnp.int32(count), 8, init
    )
    assert blocks == -(-count // 8)
    np.testing.assert_array_equal(seen, np.arange(64) < count)


@on_cpu
def test_order_does_not_depend_on_what_is_dead():
    """Live slots in three blocks; between them a block that is dead."""
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
