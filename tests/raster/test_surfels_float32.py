"""Surfels and the images of geometry in float32: the references, and bad numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import camera_of
from test_surfels import (
    GEOMETRY,
    HEIGHT,
    WIDTH,
    camera_in,
    config_for,
    config_of,
    load,
    scene_of,
    some_scene,
)

import gsjax
from gsjax.init.surfels import flattened

pytestmark = pytest.mark.usefixtures("float32")


def test_images():
    data = load("surfels")
    config = config_of("thr", GEOMETRY, primitive="surfel")
    near = float(data["near"])
    colors = jnp.asarray(data["colours"], jnp.float32)
    view = gsjax.render(scene_of(data), camera_in(data, near), config, features=colors)
    clear = data["thr_robust"] & data["thr_robust_depth"]
    for name, image in (("image", view.rgb), ("normal", view.normals)):
        error = np.abs(np.asarray(image) - data[f"thr_{name}"])[clear]
        assert error.max() < 1e-4
    depth = np.asarray(view.depth * view.alpha)
    assert np.abs(depth - data["thr_depth_sel"])[clear].max() < 1e-3
    assert np.quantile(np.abs(depth - data["thr_depth_sel"])[clear], 0.99) < 1e-4


@pytest.mark.parametrize("kind", ["surfel", "ellipsoid"])
def test_bad_numbers(kind):
    """A slot for each bad number in each parameter: all finite, others unchanged."""
    scene, camera = flattened(some_scene()), camera_of(WIDTH, HEIGHT)
    bad = [np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-40, -100.0]
    leaves = ("means", "quats", "log_scales", "logit_opacities", "sh")
    many = {name: np.array(getattr(scene.params, name)) for name in leaves}
    many = {name: np.concatenate([leaf, leaf[:35]]) for name, leaf in many.items()}
    slots = iter(range(len(scene.active), len(scene.active) + 35))
    for value in bad:
        for name in leaves:
            slot = next(slots)
            many[name][slot] = value
            if np.isfinite(value):  # drawn perhaps, but not here
                many["logit_opacities"][slot] = min(value, -50.0)
    params = scene.params.replace(**{k: jnp.asarray(v) for k, v in many.items()})
    poisoned = gsjax.Gaussians(params=params, active=jnp.ones(95, bool))
    config = config_for(kind, outputs=GEOMETRY)

    @jax.jit
    def whole(params, gaussians):
        def total(params):
            view = gsjax.render(gaussians.replace(params=params), camera, config)
            images = [getattr(view, name) for name in config.outputs]
            return sum(jnp.sum(image) for image in images), images

        return jax.value_and_grad(total, has_aux=True)(params)

    (_, images), slopes = whole(poisoned.params, poisoned)
    for image in (*images, *jax.tree.leaves(slopes)):
        assert np.isfinite(np.asarray(image)).all()
    off = poisoned.replace(active=jnp.arange(95) < 60)
    (_, clean), _ = whole(off.params, off)
    for image, alone in zip(images, clean):
        np.testing.assert_array_equal(np.asarray(image), np.asarray(alone))
