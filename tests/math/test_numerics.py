"""Elementary functions and rotations against NumPy in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.math.numerics import (
    exp_negative,
    materialize,
    materialize_mask,
    near_one,
    safe_normalize,
)
from gsjax.math.rotations import covariance, quaternion_to_matrix, times_covariance


def test_exponential_is_accurate(report):
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


def test_exponential_is_its_own_derivative():
    """And exact in float64."""
    with jax.enable_x64(True):
        wide = -jnp.logspace(-20, 2.8, 1000)
        assert np.array_equal(exp_negative(wide), jnp.exp(wide))
    x = -jnp.logspace(-5, 1.9, 100, dtype=jnp.float32)
    direction = jnp.cos(x)
    value, slope = jax.jvp(exp_negative, (x,), (direction,))
    back = jax.vjp(exp_negative, x)[1](direction)[0]
    assert np.array_equal(slope, value * direction)
    assert np.array_equal(back, slope)


FALLBACK = (1.0, 0.0, 0.0)


def test_near_one_rounds_nothing():
    """Vectors of every magnitude are multiplied by one power of two, to the bit."""
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(4000, 3)) * np.logspace(-33, 37, 4000)[:, None]
    rows = rows.astype(np.float32)
    limits = np.finfo(np.float32)
    ends = limits.max, limits.tiny, 1.5, np.nextafter(np.float32(1.5), 0)
    rows[:4] = np.column_stack([ends, np.zeros((4, 2))])
    scaled, good = jax.jit(lambda r: near_one(r, FALLBACK))(tuple(rows.T))
    scaled = np.stack(scaled, 1).astype(float)
    assert np.all(good)
    largest = np.abs(scaled).max(1)
    assert largest[0] < 4
    assert np.all((largest[1:] >= 0.75) & (largest[1:] <= 1.5))
    place = np.abs(rows).argmax(1)[:, None]
    ratio = np.take_along_axis(scaled, place, 1) / np.take_along_axis(rows, place, 1)
    assert np.all(np.frexp(ratio)[0] == 0.5), "a power of two"
    assert np.array_equal(scaled, rows * ratio)


@pytest.mark.parametrize("bad", [0.0, 1e-40, np.inf, -np.inf, np.nan])
def test_a_vector_without_direction_becomes_the_fallback(bad):
    def first(rows):
        return sum(c for c in safe_normalize(tuple(rows), FALLBACK)[0])

    row = jnp.float32([bad, 0, bad])
    unit, good = safe_normalize(tuple(row), FALLBACK)
    assert not good
    assert tuple(map(float, unit)) == FALLBACK
    assert np.array_equal(jax.grad(first)(row), np.zeros(3))


@pytest.mark.parametrize("norm", [1e-30, 3e30])
def test_a_rotation_does_not_depend_on_the_norm(norm):
    """And its derivative along the quaternion is zero."""
    quats = np.random.default_rng(1).normal(size=(50, 4))
    turned = np.asarray(quaternion_to_matrix(jnp.float32(quats * norm)), float)
    quats = jnp.float32(quats)
    usual, along = jax.jvp(quaternion_to_matrix, (quats,), (quats,))
    assert np.abs(turned - usual).max() < 5e-7
    assert np.abs(turned @ turned.swapaxes(1, 2) - np.eye(3)).max() < 1e-6
    assert np.abs(along).max() < 2e-6


@pytest.mark.parametrize("norm", [1e-25, 1e25])
def test_times_covariance_agrees_with_the_matrix(norm):
    rng = np.random.default_rng(4)
    quats = jnp.float32(norm * rng.normal(size=(2, 50, 4)))
    scales = jnp.exp(jnp.float32(rng.normal(size=(2, 50, 3))))
    vectors = jnp.float32(rng.normal(size=(2, 50, 3)))
    found = times_covariance(quats, scales, vectors)
    wanted = np.einsum("...ij,...j", covariance(quats, scales), vectors)
    near = 2e-6 * jnp.max(scales, -1, keepdims=True) ** 2
    assert jnp.all(jnp.abs(found - wanted) < near)


def test_derivatives_by_zero_components_are_exactly_zero():
    """An optimiser that normalises gradients would amplify rounding to full steps."""
    rng = np.random.default_rng(2)
    quats = jnp.float32(rng.normal(size=(500, 4)) * [1, 0, 0, 1])
    weights = jnp.float32(rng.normal(size=(500, 2, 2)))

    @jax.jit
    @jax.grad
    def slopes(quats):
        return jnp.sum(weights * quaternion_to_matrix(quats)[:, :2, :2])

    found = slopes(quats)
    assert np.array_equal(found[:, 1:3], np.zeros((500, 2)))
    assert np.abs(found[:, ::3]).min(0).max() > 0


def test_materialized_values_are_unchanged(monkeypatch):
    values = jnp.float32([3e38, -1e-37, 1 / 3, 0.0, -0.0, np.inf, 5.0])
    mask = jnp.asarray([True, True, True, True, True, True, False])
    assert np.array_equal(jax.jit(materialize_mask)(mask), mask)
    (found,) = jax.jit(lambda v: materialize((v,), mask))(values)
    assert found.dtype == values.dtype
    assert np.array_equal(found[mask].view(np.int32), values[mask].view(np.int32))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert materialize_mask(mask) is mask
    assert materialize(values, mask) is values


@pytest.mark.parametrize("double", [False, True])
def test_materialized_values_are_differentiable(double):
    with jax.enable_x64(double):
        values = jnp.linspace(-3.0, 3.0, 7)
        mask = values > -2.5

        def total(values):
            return jnp.sum(jnp.where(mask, materialize((jnp.sin(values),), mask)[0], 0))

        expected = np.where(mask, jnp.cos(values), 0)
        assert np.array_equal(jax.jit(jax.grad(total))(values), expected)
