"""Surfels and the images of geometry in float32: the references, and bad numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import camera_of
from scipy.spatial.transform import Rotation
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


def thin_params(params, camera, seed):
    """Return Gaussians of scales from e⁻²⁵ to e², seen almost from their edge."""
    rng = np.random.default_rng(seed)
    view, count = np.asarray(camera.viewmat), len(params.means)
    eye = -view[:3, :3].T @ view[:3, 3]
    means = np.resize(np.asarray(some_scene().params.means), (count, 3))
    ray = (means - eye) / np.linalg.norm(means - eye, axis=1, keepdims=True)
    side = np.cross(ray, rng.normal(size=ray.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    normal = side + 10 ** rng.uniform(-7, -1, (count, 1)) * ray
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = np.cross(normal, np.cross(side, ray))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normal, first), normal], -1)
    leaves = {
        "means": means,
        "quats": Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]],
        "log_scales": rng.uniform(-25, 2, (count, 3)),
        "logit_opacities": rng.normal(size=count),
        "sh": rng.normal(size=params.sh.shape),
    }
    return params.replace(**{k: jnp.asarray(v, "f4") for k, v in leaves.items()})


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
    most = {"surfel": 1e18, "ellipsoid": np.inf}[kind]  # 1e18: that training takes
    for seed in range(6):
        params = thin_params(params, camera, seed)
        found = whole(params, poisoned)
        for leaf in jax.tree.leaves(found):
            assert np.abs(np.asarray(leaf)).max() < most  # and not NaN
