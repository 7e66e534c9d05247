"""The compositor of accelerators, run on a CPU.

`jax.default_backend` is replaced, by which the kernel is chosen. Images are compared
with the dense reference, derivatives with those of the kernels of CPUs.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    ALL,
    BACKGROUND,
    COMPAT,
    COUNT,
    LIGHT,
    assert_not_empty,
    camera_of,
    cast,
    gaussians_at,
    loss_and_gradients,
    reference,
    scene_of,
)
from pictures import assert_close, errors_of

import gsjax
from gsjax.raster.compositing.compositor import choose, choose_for_gradient
from gsjax.raster.compositing.parallel import PARALLEL
from gsjax.raster.compositing.types import Task
from gsjax.raster.lists.binning import make_grid

# Batches of fewer entries than there are, and a chunk that most lists are longer than.
SMALL = gsjax.RasterConfig.fast(
    **LIGHT, outputs=ALL, chunk_size=8, tiles_per_step=64, alpha_max=1.0
)
CONFIGS = {"compat": COMPAT, "small": SMALL}


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch):
    """Trace everything within a test for an accelerator."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")


def test_the_kernel_is_chosen():
    task = Task("gpu", 3, 4, make_grid(64, 48, 8, 1), COMPAT)
    assert choose(task) is choose_for_gradient(task) is PARALLEL


@partial(jax.jit, static_argnames="config")
def renders(gaussians, camera, background, config):
    return gsjax.render(gaussians, camera, config, background)


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize("kind", ["random", "wall", "saturated", "fog"])
def test_images_are_those_of_the_reference(kind, name, report):
    scene, config = scene_of(kind), CONFIGS[name]
    found = renders(*scene, BACKGROUND, config)
    wanted = reference(*scene, config, BACKGROUND)
    assert not found.overflowed
    assert_not_empty(found.alpha)
    errors, _ = errors_of(found, wanted, 1e-9)
    for output, error in errors.items():
        report(f"{kind}, {name}, {output}", error, 1e-10)
        assert error <= 1e-10, output


def assert_same_gradients(name, found, wanted, report):
    # Gradients by the rotations of round Gaussians are rounding alone.
    least = 1e-8 * max(map(np.linalg.norm, jax.tree.leaves(wanted)))
    assert_close(report, name, found, wanted, 1e-9, least)


gradients_here = jax.jit(lambda *scene: loss_and_gradients.__wrapped__(*scene))


@pytest.mark.parametrize("kind", ["random", "wall", "saturated"])
def test_gradients_are_those_of_other_kernels(kind, monkeypatch, report):
    scene = scene_of(kind)
    _, found = gradients_here(*scene)
    monkeypatch.undo()
    _, wanted = loss_and_gradients(*scene)
    assert_same_gradients(kind, found, wanted, report)
    assert np.linalg.norm(jax.tree.leaves(wanted)[0]) > 0


# Several sizes, α up to 1, and no stop.
RICH = gsjax.RasterConfig(
    **{**LIGHT, "num_size_buckets": 4},
    alpha_max=1.0,
    transmittance_min=0.0,
    absgrad=True,
    outputs=ALL,
    chunk_size=4,
)


@pytest.mark.long
def test_features_masks_and_absolute_gradients(monkeypatch, report):
    """Gradients of every output by parameters, features and the absolute probe."""
    gaussians, camera = scene_of("random")
    rng = np.random.default_rng(2)
    mask = np.zeros((camera.height, camera.width), bool)
    mask[3:20, 10:40] = True
    features, probe = rng.random((gaussians.capacity, 5)), np.zeros((COUNT, 2))
    weight = rng.normal(size=mask.shape)

    def loss(params, features, probe):
        scene = gaussians.replace(params=params)
        more = {"features": features, "probe": probe, "mask": mask}
        out = gsjax.render(scene, camera, RICH, **more)
        total = jnp.sum(jnp.where(mask, jnp.sum(out.rgb, -1) * weight, 0))
        total += jnp.sum(jnp.where(mask, out.median_depth * weight, 0))
        return total, jnp.where(mask, out.median_depth, 0)

    def slopes():
        by_all = jax.jit(
            lambda *given: jax.value_and_grad(loss, (0, 1, 2), has_aux=True)(*given)
        )
        return by_all(gaussians.params, features, probe)

    found = slopes()
    monkeypatch.undo()
    wanted = slopes()
    assert_same_gradients("mask, features, absgrad", found, wanted, report)
    assert np.linalg.norm(wanted[1][2]) > 0  # by the probe
    assert np.count_nonzero(wanted[0][1]) > 50


@pytest.mark.parametrize("platform", ["cpu", "gpu"])
def test_one_half_is_crossed_once(platform, monkeypatch):
    """A median depth exists exactly where less than half of the light passes.

    Each Gaussian has a chunk of its own, in float32, so that every chunk rounds T.
    """
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    rng, count = np.random.default_rng(0), 1000
    depth = np.sort(rng.uniform(1, 2, count))
    points = np.stack([0 * depth, 0 * depth, depth], -1)
    opacities = np.exp(rng.normal(1, 0.1, count)) / count
    scene = gaussians_at(points, np.exp(-1), opacities, viewmat=np.eye(4), degree=0)
    camera = camera_of(viewmat=np.eye(4))
    config = gsjax.RasterConfig(**LIGHT, outputs=("alpha", "median_depth"))
    config = config.replace(pair_capacity=32_768, chunk_size=1, alpha_min=1e-6)
    drawn = jax.jit(lambda *scene: gsjax.render(*scene, config))
    found = drawn(*cast((scene, camera), jnp.float32))
    assert not found.overflowed
    alpha, median = np.asarray(found.alpha), np.asarray(found.median_depth)
    far = np.abs(alpha - 0.5) > 1e-5
    assert (alpha[far] > 0.5).any()
    assert (alpha[far] < 0.5).any()
    np.testing.assert_array_equal((median > 0)[far], (alpha > 0.5)[far])
    # The sum of two depths would lie beyond all.
    assert ((median == 0) | (median < 2.001)).all()


def test_capacities_batches_and_devices_make_the_same_images():
    """A mapped scene, a batch of cameras, two devices; too little is reported."""
    (one, camera), (other, _) = scene_of("random"), scene_of("wall")
    first, second = (renders(g, camera, BACKGROUND, COMPAT) for g in (one, other))
    little = renders(one, camera, BACKGROUND, COMPAT.replace(pair_capacity=300))
    assert little.overflowed
    assert little.demand == first.demand
    assert little.demand.capacity == little.demand.pairs > 300
    fits = COMPAT.replace(pair_capacity=int(little.demand.capacity))
    again = renders(one, camera, BACKGROUND, fits)
    assert not again.overflowed
    np.testing.assert_array_equal(again.rgb, first.rgb)
    both = jax.tree.map(lambda *a: jnp.stack(a), one, other)
    mapped = jax.vmap(lambda g: renders(g, camera, BACKGROUND, COMPAT).rgb)
    found = jax.jit(mapped)(both)
    np.testing.assert_allclose(found, [first.rgb, second.rgb], atol=1e-12)
    several = gsjax.stack_cameras([camera, camera])
    batch = renders(one, several, BACKGROUND, COMPAT).rgb
    np.testing.assert_allclose(batch, [first.rgb] * 2, atol=1e-12)
    if jax.local_device_count() > 1:
        shared = renders(one, camera, BACKGROUND, COMPAT.replace(devices=2))
        np.testing.assert_allclose(shared.rgb, first.rgb, atol=1e-12)
