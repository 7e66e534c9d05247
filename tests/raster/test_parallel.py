"""Parallel compositing, which accelerators run, run here on a CPU.

The kernel is chosen by `jax.default_backend`, which these tests answer for. Images are
compared with the dense reference, and derivatives with those of the CPU's kernels.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    ACCURATE,
    ALL,
    BACKGROUND,
    COMPAT,
    FAST,
    LIGHT,
    assert_not_empty,
    camera_of,
    cast,
    loss_and_gradients,
    reference,
    render,
    scene_of,
)
from pictures import errors_of

import gsjax
from gsjax.raster.compositing.compositor import choose, choose_for_gradient
from gsjax.raster.compositing.parallel import PARALLEL
from gsjax.raster.compositing.types import Task
from gsjax.raster.lists.binning import make_grid

# Batches of fewer entries than there are, and a chunk that most lists are longer than.
SMALL = gsjax.RasterConfig.fast(
    **LIGHT, outputs=ALL, chunk_size=8, tiles_per_step=64, alpha_max=1.0
)
CONFIGS = {"compat": COMPAT, "accurate": ACCURATE, "fast": FAST, "small": SMALL}


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch):
    """Trace everything within a test for an accelerator."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")


def test_the_kernel_is_chosen():
    task = Task("gpu", 3, 4, make_grid(64, 48, 8, 1), COMPAT)
    assert choose(task) is choose_for_gradient(task) is PARALLEL


def _renders(gaussians, camera, background, config):
    return gsjax.render(gaussians, camera, config, background)


renders = jax.jit(_renders, static_argnames="config")


@pytest.mark.parametrize("name", CONFIGS)
@pytest.mark.parametrize("kind", ["random", "wall", "saturated", "fog", "around"])
def test_the_picture_is_that_of_the_reference(kind, name, report):
    scene, config = scene_of(kind), CONFIGS[name]
    found = renders(*scene, BACKGROUND, config)
    wanted = reference(*scene, config, BACKGROUND)
    assert not found.overflowed
    assert_not_empty(found.alpha)
    errors, _ = errors_of(found, wanted, 1e-9)
    for output, error in errors.items():
        report(f"{kind}, {name}, {output}", error, 1e-10)
        assert error <= 1e-10, output


@pytest.mark.parametrize("kind", ["random", "fog"])
def test_float32_errs_as_it_does_on_a_cpu(kind, report):
    scene = scene_of(kind)
    given = cast((*scene, BACKGROUND), jnp.float32)
    found = renders(*given, COMPAT)
    wanted = reference(*scene, COMPAT, BACKGROUND)
    errors, _ = errors_of(found, wanted, 1e-4)
    for output in ("rgb", "alpha", "depth"):
        report(f"{kind}, float32, {output}", errors[output], 1e-5)
        assert errors[output] <= 1e-5, output


def _loss_and_gradients(gaussians, camera):
    return loss_and_gradients.__wrapped__(gaussians, camera)


gradients_here = jax.jit(_loss_and_gradients)


@pytest.mark.parametrize("kind", ["random", "wall", "saturated"])
def test_gradients_are_those_of_the_other_way(kind, monkeypatch, report):
    scene = scene_of(kind)
    _, found = gradients_here(*scene)
    monkeypatch.undo()
    _, wanted = loss_and_gradients(*scene)
    # Of round Gaussians that by the rotation is rounding alone.
    least = 1e-8 * max(map(np.linalg.norm, jax.tree.leaves(wanted)))
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted)):
        error = np.linalg.norm(one - other) / max(np.linalg.norm(other), least)
        report(f"{kind}, gradient of {other.shape}", error, 1e-9)
        assert error <= 1e-9
    assert np.linalg.norm(jax.tree.leaves(wanted)[0]) > 0


def _rich(gaussians, camera, features, probe, mask):
    """A loss of every output, by parameters, features and the absolute probe."""
    weight = np.random.default_rng(3).normal(size=(camera.height, camera.width))

    def loss(params, features, probe):
        scene = gaussians.replace(params=params)
        more = {"features": features, "probe": probe, "mask": mask}
        out = gsjax.render(scene, camera, RICH, **more)
        total = jnp.sum(jnp.where(mask, jnp.sum(out.rgb, -1) * weight, 0))
        total += jnp.sum(jnp.where(mask, out.median_depth * weight, 0))
        return total, jnp.where(mask, out.median_depth, 0)

    arguments = gaussians.params, features, probe
    return jax.value_and_grad(loss, (0, 1, 2), has_aux=True)(*arguments)


# Sizes to choose from, a cap that lets α be 1, and no stop.
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
    gaussians, camera = scene_of("random")
    rng = np.random.default_rng(2)
    mask = np.zeros((camera.height, camera.width), bool)
    mask[3:20, 10:40] = True
    features = rng.random((gaussians.capacity, 5))
    given = gaussians, camera, features, np.zeros((gaussians.capacity, 2)), mask
    found = jax.jit(lambda *a: _rich(*a))(*given)
    monkeypatch.undo()
    wanted = jax.jit(lambda *a: _rich(*a))(*given)
    least = 1e-8 * max(map(np.linalg.norm, jax.tree.leaves(wanted[1])))
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted)):
        error = np.linalg.norm(one - other) / max(np.linalg.norm(other), least)
        report(f"mask, features, absgrad, of {other.shape}", error, 1e-9)
        assert error <= 1e-9
    assert np.linalg.norm(wanted[1][2]) > 0  # of the probe
    assert np.count_nonzero(wanted[0][1]) > 50


@pytest.mark.parametrize("count", [1, 7, 1000])
def test_a_half_is_crossed_once(count):
    """There is one median depth where less than half is left, and none elsewhere; also
    with a chunk for each Gaussian, in float32, where every chunk rounds T."""
    rng = np.random.default_rng(count)
    depth = np.sort(rng.uniform(1, 2, count))
    scene = gsjax.make_gaussians(
        means=np.stack([0 * depth, 0 * depth, depth], -1),
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.full((count, 3), -1.0),
        logit_opacities=rng.normal(1 - np.log(count), 0.1, count),
        sh=np.zeros((count, 1, 3)),
    )
    camera = camera_of(viewmat=np.eye(4))
    config = gsjax.RasterConfig(
        **{**LIGHT, "pair_capacity": 32_768},
        chunk_size=1,
        alpha_min=1e-6,
        outputs=("alpha", "median_depth"),
    )
    found = renders(*cast((scene, camera), jnp.float32), None, config)
    assert not found.overflowed
    alpha, median = np.asarray(found.alpha), np.asarray(found.median_depth)
    far = np.abs(alpha - 0.5) > 1e-5
    assert (alpha[far] > 0.5).any()
    assert (alpha[far] < 0.5).any()
    np.testing.assert_array_equal((median > 0)[far], (alpha > 0.5)[far])
    # The sum of two would lie beyond all.
    assert ((median == 0) | (median < 2.001)).all()


def _both_ways(gaussians, camera, direction, cotangent):
    """Derivative along ``direction``, forward and by the transpose, both weighted."""

    def picture(means):
        params = gaussians.params.replace(means=means)
        return gsjax.render(gaussians.replace(params=params), camera, COMPAT).rgb

    _, slope = jax.jvp(picture, (gaussians.params.means,), (direction,))
    _, back = jax.vjp(picture, gaussians.params.means)
    return jnp.sum(slope * cotangent), jnp.sum(back(cotangent)[0] * direction)


@pytest.mark.long
def test_forward_and_reverse_mode_agree():
    gaussians, camera = scene_of("random")
    rng = np.random.default_rng(0)
    direction = rng.normal(size=gaussians.params.means.shape)
    cotangent = rng.normal(size=(camera.height, camera.width, 3))
    forward, back = jax.jit(_both_ways)(gaussians, camera, direction, cotangent)
    assert abs(forward) > 1e-3
    np.testing.assert_allclose(forward, back, rtol=1e-10)


def _curvature(gaussians, camera, first, second):
    """u H v and v H u of a squared picture, by the means."""

    def loss(means):
        params = gaussians.params.replace(means=means)
        rgb = gsjax.render(gaussians.replace(params=params), camera, COMPAT).rgb
        return jnp.sum(jnp.square(rgb))

    means = gaussians.params.means

    def along(direction):
        return jax.jvp(jax.grad(loss), (means,), (direction,))[1]

    products = jax.vmap(along)(jnp.stack([first, second]))
    return jnp.sum(second * products[0]), jnp.sum(first * products[1])


@pytest.mark.long
def test_second_derivatives_are_symmetric():
    gaussians, camera = scene_of("random")
    rng = np.random.default_rng(1)
    first, second = rng.normal(size=(2, *gaussians.params.means.shape))
    one, other = jax.jit(_curvature)(gaussians, camera, first, second)
    assert abs(one) > 1e-3
    np.testing.assert_allclose(one, other, rtol=1e-8)


def test_too_little_room_is_told_and_changes_no_count(monkeypatch):
    scene = scene_of("random")
    enough = renders(*scene, BACKGROUND, COMPAT)
    little = renders(*scene, BACKGROUND, COMPAT.replace(pair_capacity=300))
    assert little.overflowed
    assert little.demand.pairs == enough.demand.pairs > 300
    assert little.demand.capacity == enough.demand.capacity == enough.demand.pairs
    # A capacity of what was wanted is enough.
    fits = COMPAT.replace(pair_capacity=int(little.demand.capacity))
    again = renders(*scene, BACKGROUND, fits)
    assert not again.overflowed
    np.testing.assert_array_equal(again.rgb, enough.rgb)
    monkeypatch.undo()
    assert render(*scene, COMPAT, BACKGROUND).demand.pairs == enough.demand.pairs


def test_each_of_a_batch_is_as_it_is_alone():
    (one, camera), (other, _) = scene_of("random"), scene_of("wall")
    both = jax.tree.map(lambda *a: jnp.stack(a), one, other)
    found = jax.jit(
        jax.vmap(lambda g: gsjax.render(g, camera, COMPAT, BACKGROUND).rgb)
    )(both)
    for place, scene in enumerate((one, other)):
        alone = renders(scene, camera, BACKGROUND, COMPAT).rgb
        np.testing.assert_allclose(found[place], alone, atol=1e-12)


def test_batches_of_cameras_and_devices_make_the_same_pictures():
    gaussians, camera = scene_of("random")
    alone = renders(gaussians, camera, BACKGROUND, COMPAT).rgb
    several = gsjax.stack_cameras([camera, camera])
    both = renders(gaussians, several, BACKGROUND, COMPAT).rgb
    np.testing.assert_allclose(both, [alone, alone], atol=1e-12)
    if jax.local_device_count() > 1:
        shared = renders(gaussians, camera, BACKGROUND, COMPAT.replace(devices=2))
        np.testing.assert_allclose(shared.rgb, alone, atol=1e-12)


def test_nothing_is_nothing():
    gaussians, camera = scene_of("random")
    none = gaussians.replace(active=np.zeros(gaussians.capacity, bool))
    found = renders(none, camera, BACKGROUND, COMPAT)
    assert not np.any(found.alpha)
    assert not np.any(found.median_depth)
    behind = np.broadcast_to(BACKGROUND, found.rgb.shape)
    np.testing.assert_array_equal(found.rgb, behind)
