"""Blending of one chunk, where rounding could tell two stories of one pixel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax import RasterConfig
from gsjax.raster.compositing.alpha import pixel_centres
from gsjax.raster.compositing.blending import (
    Chunk,
    Parts,
    blend_chunk,
    running_product,
)

pytestmark = pytest.mark.as_users

TILES, SPLATS, TILE = 16, 6, 8


@jax.jit
def blend(alpha, carried):
    """What a chunk of splats of one alpha everywhere, all of depth 1, adds to
    transmittances ``carried`` [TILES, P]: (what is left, the median depth).
    """
    config = RasterConfig(outputs=("rgb", "median_depth"), tile_size=TILE)
    one = jnp.ones((TILES, SPLATS, 1), alpha.dtype)
    flat = jnp.zeros((TILES, SPLATS, 5), alpha.dtype)
    parts = Parts(
        splats=jnp.concatenate([flat, alpha[..., None]], -1),
        channels=one,
        depth=one,
    )
    chunk = Chunk(parts, corner=jnp.zeros((TILES, 2), alpha.dtype))
    pixels = pixel_centres(TILE, alpha.dtype)
    left, out = blend_chunk(carried, chunk, pixels, config)
    return left, out["median"]


@pytest.mark.usefixtures("float32")
def test_one_half_is_crossed_once():
    """Transmittances within rounding of one half, on either side, at some splat."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        alpha = rng.uniform(0.02, 0.9, (TILES, SPLATS)).astype(np.float32)
        passed = np.cumprod(1 - alpha.astype(np.float64), 1)
        at_half = 0.5 / passed[np.arange(TILES), rng.integers(1, SPLATS, TILES)]
        nearly = 1 + np.arange(-32, 32) * 2.0**-25
        carried = (at_half[:, None] * nearly).astype(np.float32)
        left, median = blend(alpha, carried)
        crossed = (carried > 0.5) & (np.asarray(left) <= 0.5)
        assert crossed.any()
        assert not crossed.all()
        np.testing.assert_array_equal(median, crossed)


@pytest.mark.usefixtures("float32")
@pytest.mark.parametrize(
    ("largest", "bound"), [(0.004, 1.3), (0.2, 1.9), (0.6, 2.7), (1.0, 2.7)]
)
def test_product_rounds_less_than_once_a_factor(largest, bound):
    """The error of 32 factors, in roundings: two small ones round once together."""
    alpha = np.random.default_rng(1).uniform(0, largest, (50, 32, 40))
    alpha = alpha.astype(np.float32)
    total, before = jax.jit(running_product)(alpha)
    exact = np.cumprod(1 - alpha.astype(np.float64), 1)
    for found, wanted in ((total, exact[:, -1]), (before[:, 1:], exact[:, :-1])):
        relative = np.abs(np.asarray(found) / wanted - 1)
        assert relative.max() < 16 * 2.0**-24
        assert np.sqrt(np.mean(relative**2)) < bound * 2.0**-24


@pytest.mark.usefixtures("float32")
@pytest.mark.parametrize("size", [1, 2, 5])
def test_products_of_any_number(size):
    alpha = np.random.default_rng(size).uniform(0, 1, (3, size, 4)).astype(np.float32)
    total, before = jax.jit(running_product)(alpha)
    passed = np.cumprod(1 - alpha.astype(np.float64), 1)
    np.testing.assert_allclose(total, passed[:, -1], rtol=size * 2.0**-23)
    np.testing.assert_allclose(before[:, 1:], passed[:, :-1], rtol=size * 2.0**-23)
    np.testing.assert_array_equal(before[:, 0], 1)
