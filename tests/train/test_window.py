"""Laws of the SSIM window: sums over neighbours, and its own transpose."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.train import ssim_window
from gsjax.train.ssim_window import window_means

# Smaller than the window, one block, several blocks, several segments.
SIZES = [(1, 1, 3), (4, 3, 1), (70, 40, 3), (3, 700, 3)]
METHODS = {"loops": ssim_window._by_loops, "products": ssim_window._by_products}


def planes_of(shape, count=2, seed=0):
    rng = np.random.default_rng(seed)
    return [jnp.asarray(rng.normal(size=shape)) for _ in range(count)]


def dense_means(plane):
    """Return the means by one dense product per axis."""
    for axis in (0, 1):
        offset = np.subtract.outer(*(2 * [np.arange(plane.shape[axis])]))
        weights = np.exp(-0.5 * (offset / 1.5) ** 2) * (np.abs(offset) <= 5)
        weights /= np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2).sum()
        plane = np.moveaxis(np.tensordot(weights, plane, (1, axis)), 0, axis)
    return plane


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shape", SIZES, ids=str)
def test_means_are_weighted_sums(shape, method):
    planes = planes_of(shape)
    found = METHODS[method](planes)
    for one, plane in zip(found, planes, strict=True):
        np.testing.assert_allclose(one, dense_means(plane), rtol=0, atol=1e-14)


@pytest.mark.parametrize("shape", [(9, 14, 3)], ids=str)
def test_derivatives_are_the_map_itself(shape):
    (x, y), (slope, other) = planes_of(shape), planes_of(shape, seed=1)

    def means(x):
        return window_means((x,))[0]

    wanted = means(slope)
    near = {"rtol": 0, "atol": 1e-14}
    np.testing.assert_allclose(jax.jvp(means, (x,), (slope,))[1], wanted, **near)
    np.testing.assert_allclose(jax.vjp(means, x)[1](slope)[0], wanted, **near)
    np.testing.assert_allclose(jnp.vdot(wanted, other), jnp.vdot(slope, means(other)))

    def half_square(x):
        return jnp.sum(means(x) ** 2) / 2

    twice = means(wanted)
    ahead = jax.jvp(jax.grad(half_square), (x,), (slope,))[1]
    back = jax.grad(lambda x: jnp.vdot(jax.grad(half_square)(x), slope))(x)
    for found in (ahead, back):
        np.testing.assert_allclose(found, twice, **near)
    batch = jnp.stack([x, y])
    both = jax.vmap(jax.grad(half_square))(batch)
    for one, found in zip(batch, both, strict=True):
        np.testing.assert_allclose(found, jax.grad(half_square)(one), **near)
