"""Elementary functions against NumPy's in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.numerics import exp_negative

pytestmark = pytest.mark.as_users


def test_exponential_of_negative_numbers(report):
    x = np.concatenate([-np.logspace(-20, np.log10(87), 100_000), [0.0]])
    x = x.astype(np.float32)
    found = np.asarray(jax.jit(exp_negative)(x))
    assert found.dtype == np.float32
    error = np.abs(found.astype(float) / np.exp(x.astype(float)) - 1)
    for bound, limit in ((-12.0, 1e-6), (-87.0, 4e-6)):
        report(f"exponential from {bound:g}", error[x >= bound].max(), limit)
        assert error[x >= bound].max() <= limit
    assert found[-1] == 1
    assert found.max() <= 1
    below = np.asarray(exp_negative(jnp.float32([-88, -1e4, -3e38, -np.inf])))
    assert np.all((below >= 0) & (below < 2e-38))
    assert np.isnan(exp_negative(jnp.float32(np.nan)))


def test_exponential_of_negative_numbers_in_float64_is_the_usual_one():
    with jax.enable_x64(True):
        x = -jnp.logspace(-20, 2.8, 1000)
        assert x.dtype == np.float64
        assert np.array_equal(exp_negative(x), jnp.exp(x))


def test_exponential_of_negative_numbers_is_its_own_derivative():
    x = -jnp.logspace(-5, 1.9, 100, dtype=jnp.float32)
    direction = jnp.cos(x)
    value, slope = jax.jvp(exp_negative, (x,), (direction,))
    assert np.array_equal(slope, value * direction)
    back = jax.vjp(exp_negative, x)[1](direction)[0]
    assert np.array_equal(back, slope)
