"""What accelerators run, run here: they sort pairs, and composite the chunks of all
tiles side by side. It is chosen by `jax.default_backend`, which these tests answer for.

The pictures are those of the dense reference, and the derivatives those of the CPU's
way. What a device makes of it is not tested here.
"""

from functools import partial

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
    cast,
    loss_and_gradients,
    reference,
    render,
    scene_of,
)
from pictures import errors_of

import gsjax
from gsjax.raster.counts import owners, squeeze

# Batches of fewer entries than there are, and a chunk that most lists are longer than.
SMALL = gsjax.RasterConfig.fast(
    **LIGHT, outputs=ALL, chunk_size=8, tiles_per_step=64, alpha_cap=1.0
)
CONFIGS = {"compat": COMPAT, "accurate": ACCURATE, "fast": FAST, "small": SMALL}


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch):
    """Everything that is traced within a test is traced for an accelerator."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")


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


@pytest.mark.parametrize("start", [0, 1, 4, 6, 9])
def test_owners_of_unrolled_counts(start):
    counts = np.array([2, 0, 3, 0, 0, 1], np.int32)
    whole = np.repeat(np.arange(6), counts)
    found = jax.jit(lambda ends: owners(ends, 9, start))(np.cumsum(counts))
    wanted = np.append(whole[start:], np.full(9, 6))[:9]
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("room", [1, 30, 300])
def test_squeeze_keeps_the_first(room):
    chosen = np.random.default_rng(0).random(200) < 0.3
    where = np.flatnonzero(chosen)
    index, count = jax.jit(partial(lambda c, room: squeeze(c, room), room=room))(chosen)
    assert int(count) == len(where)
    wanted = np.full(room, 200)
    wanted[: min(room, len(where))] = where[:room]
    np.testing.assert_array_equal(index, wanted)
