"""Contributions, compared with pictures of features and with pictures without one."""

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import camera_of, frustum_points, gaussians_at

import gsjax
from gsjax import RasterConfig
from gsjax.raster.contribution import contribution

# Without stops, which a removal would move.
CONFIG = RasterConfig(tile_size=8, transmittance_min=0.0, alpha_min=1e-9)
BACKGROUND = jnp.asarray([0.2, 0.9, 0.4])
SIZE = 37, 22


def scene(count: int = 60, seed: int = 0) -> gsjax.Gaussians:
    """Opaque enough that pixels stop, with slots that are not active."""
    rng = np.random.default_rng(seed)
    points = frustum_points(rng, count, far=6.0, spread=0.5)
    scales = np.exp(rng.normal(-1.2, 0.5, (count, 3)))
    gaussians = gaussians_at(points, scales, rng.uniform(0.2, 0.999, count))
    sh = rng.normal(0, 0.5, (count, 4, 3))
    params = gaussians.params.replace(sh=jnp.asarray(sh))
    active = np.asarray(gaussians.active) & (np.arange(count) % 9 != 4)
    return gaussians.replace(params=params, active=jnp.asarray(active))


# Both rules of stopping, one device and several, and a panorama that wraps.
SETTINGS = [
    (CONFIG, "pinhole"),
    (RasterConfig.fast().replace(stop_rule="before", devices=1), "equirectangular"),
]


@pytest.mark.parametrize(("config", "lens"), SETTINGS)
def test_sums_are_those_of_single_features(config, lens):
    """The picture of a feature that one Gaussian has shows the weights of that one."""
    gaussians, camera = scene(), camera_of(*SIZE, lens=lens)
    found = contribution(gaussians, camera, config, BACKGROUND)
    config = gsjax.exact_config(gaussians, camera, config)
    features = np.split(np.eye(gaussians.capacity), gaussians.capacity // 3, axis=1)
    drawn = [
        gsjax.render(gaussians, camera, config, features=jnp.asarray(some)).rgb
        for some in features
    ]
    weights = jnp.concatenate(drawn, -1)
    np.testing.assert_allclose(found.total, weights.sum((0, 1)), rtol=1e-9)
    np.testing.assert_allclose(found.largest, weights.max((0, 1)), rtol=1e-9)
    np.testing.assert_allclose(found.energy, (weights**2).sum((0, 1)), rtol=1e-9)
    assert (np.asarray(found.total)[~np.asarray(gaussians.active)] == 0).all()
    assert found.total.max() > 10


def test_removal_is_the_change_without_a_gaussian():
    gaussians, camera = scene(), camera_of(*SIZE)
    found = contribution(gaussians, camera, CONFIG, BACKGROUND).removal
    whole = gsjax.render_exact(gaussians, camera, CONFIG, BACKGROUND).rgb
    chosen = np.argsort(-np.asarray(found))[[0, 1, 5, 20, 30]]
    for slot in chosen:
        without = gaussians.replace(active=gaussians.active.at[slot].set(False))
        image = gsjax.render_exact(without, camera, CONFIG, BACKGROUND).rgb
        change = float(jnp.sum((image - whole) ** 2))
        assert float(found[slot]) == pytest.approx(change, rel=1e-6)
