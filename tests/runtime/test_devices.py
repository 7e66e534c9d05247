"""Arrays and work shared among devices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import needs_two_devices

from gsjax.runtime import devices

pytestmark = needs_two_devices


@pytest.mark.parametrize(("size", "expected"), [(4, [0, 1, 2, 3]), (3, [0, 1, 2, -1])])
def test_rows_are_sharded_equally_and_in_order(size, expected):
    values = np.arange(size, dtype=np.int32)
    parts = jax.jit(lambda x: devices.shard_rows(x, 2, fill=-1))(values)
    np.testing.assert_array_equal(parts, expected)
    assert [part.data.shape for part in parts.addressable_shards] == [(2,), (2,)]
    assert devices.shard_rows(values, 1, fill=-1) is values


@pytest.mark.parametrize("count", [1, 2])
def test_mapped_work_is_concatenated_and_differentiable(count):
    def total(x):
        return devices.map_over_devices(lambda i, x: x * (i + 1), count, x).sum()

    value, slope = jax.jit(jax.value_and_grad(total))(jnp.float32(3))
    assert value == 3 * slope == 3 * sum(range(1, count + 1))


def test_placed_arrays_feed_back_without_compiling_again():
    step = jax.jit(
        lambda x: devices.map_over_devices(lambda i, x: (x + i)[None], 2, x).sum(0)
    )
    x = devices.place({"x": np.ones(3, np.float32)})["x"]
    for _ in range(3):
        x = devices.place(step(x))
    assert step._cache_size() == 1
    assert len(x.devices()) == 2
