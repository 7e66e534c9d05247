"""Cameras of a batch and mapped cameras agree with single ones, to rounding.

A batch renders them in turn; XLA fuses the projection of another program differently
(a few units in the last place).
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    ALL,
    BACKGROUND,
    COUNT,
    WHOLE,
    assert_not_empty,
    camera_of,
    cast,
    render,
    scene_of,
)
from pictures import images, largest_difference

import gsjax
from gsjax.raster.vmap_branching import any_in_batch, min_in_batch


@pytest.mark.parametrize(("dtype", "bar"), [(jnp.float32, 1e-6), (jnp.float64, 4e-15)])
def test_single_batch_and_vmap(dtype, bar, report):
    gaussians, first = cast(scene_of("random"), dtype)
    second = cast(camera_of(centre=(30.0, 8.0)), dtype)
    cameras = gsjax.stack_cameras([first, second])
    background = jnp.asarray(BACKGROUND, dtype)
    batch = render(gaussians, cameras, WHOLE, background)
    mapped = jax.jit(
        jax.vmap(lambda c, g, b: gsjax.render(g, c, WHOLE, b), (0, None, None))
    )(cameras, gaussians, background)
    for i, camera in enumerate((first, second)):
        wanted = images(gaussians, camera, dtype=dtype)
        for way, out in (("batch", batch), ("vmap", mapped)):
            one = out._replace(**{name: getattr(out, name)[i] for name in ALL})
            error = largest_difference(one, wanted)
            report(f"{way}, {dtype.__name__}", error, bar)
            assert error <= bar, way
    assert np.abs(batch.rgb[0] - batch.rgb[1]).max() > 0.1
    assert batch.demand.pairs == mapped.demand.pairs.sum()
    assert batch.demand.visible == mapped.demand.visible.max()
    assert batch.demand.capacity == mapped.demand.capacity.max()


def test_a_batch_of_one(report):
    """It has the leading axis everywhere, radii included."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    wanted = images(gaussians, camera)
    batch = images(gaussians, gsjax.stack_cameras([camera]))
    assert batch.radii.shape == (1, COUNT)
    np.testing.assert_allclose(batch.radii[0], wanted.radii, rtol=1e-6)
    assert (wanted.radii > 0).any()
    for name in ALL:
        assert getattr(batch, name).shape == (1, *getattr(wanted, name).shape)
    one = batch._replace(**{name: getattr(batch, name)[0] for name in ALL})
    error = largest_difference(one, wanted)
    report("batch of one", error, 1e-6)
    assert error <= 1e-6
    assert batch.demand == wanted.demand


def test_a_picture_in_the_corner(report):
    """Is that of a smaller camera: limits of the linearisation, radii, gradients."""
    gaussians, camera = scene_of("random")
    corner = np.s_[:20, :30]
    weight = np.random.default_rng(0).normal(size=(20, 30, 3))
    small = dataclasses.replace(camera, width=30, height=20)

    @jax.jit
    def seen(params, camera, size):
        def loss(params):
            some = gaussians.replace(params=params)
            seen = camera.replace(visible_size=size)
            out = gsjax.render(some, seen, WHOLE, BACKGROUND)
            return jnp.sum(out.rgb[corner] * weight), out

        return jax.grad(loss, has_aux=True)(params)

    slopes, found = seen(gaussians.params, camera, jnp.asarray([30, 20]))
    wanted_slopes, wanted = seen(gaussians.params, small, None)
    assert_not_empty(wanted.alpha)
    for name in ALL:
        error = np.max(np.abs(getattr(found, name)[corner] - getattr(wanted, name)))
        report(f"in the corner, {name}", error, 1e-13)
        assert error <= 1e-13, name
    np.testing.assert_allclose(found.radii, wanted.radii, rtol=1e-12)
    assert found.demand.visible == wanted.demand.visible < COUNT
    for name, by in vars(wanted_slopes).items():
        error = np.max(np.abs(getattr(slopes, name) - by)) / np.max(np.abs(by))
        report(f"in the corner, gradient of {name}", error, 1e-12)
        assert error <= 1e-12, name


def test_a_mapped_camera_that_sees_nothing(report):
    """Beside one that sees much: sizes and branches are those that do for both."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    config = WHOLE.replace(num_size_buckets=4, pair_capacity=2**16)
    away = dataclasses.replace(camera, viewmat=camera.viewmat.at[2].multiply(-1))
    cameras = gsjax.stack_cameras([camera, away])

    @jax.jit
    def pictures_and_slopes(cameras, gaussians):
        def brightness(params):
            scene = gaussians.replace(params=params)
            view = jax.vmap(lambda c: gsjax.render(scene, c, config))(cameras)
            return jnp.sum(view.rgb), view

        return jax.grad(brightness, has_aux=True)(gaussians.params)

    slopes, view = pictures_and_slopes(cameras, gaussians)
    alone, wanted = pictures_and_slopes(gsjax.stack_cameras([camera]), gaussians)
    assert not view.overflowed.any()
    assert (view.alpha[1] == 0).all()
    np.testing.assert_array_equal(view.demand.visible, [wanted.demand.visible[0], 0])
    pairs = [(view.rgb[0], wanted.rgb[0]), *zip(*map(jax.tree.leaves, (slopes, alone)))]
    for found, one in pairs:
        error = float(jnp.linalg.norm(found - one) / jnp.linalg.norm(one))
        report("with one that sees nothing", error, 1e-5)
        assert error <= 1e-5


@pytest.mark.parametrize(("dtype", "bar"), [(jnp.float32, 1e-6), (jnp.float64, 4e-15)])
@pytest.mark.parametrize(
    "config", [WHOLE, WHOLE.replace(chunk_size=3, transmittance_min=0.3)]
)
def test_a_derivative_changes_no_image(config, dtype, bar, report):
    """With one the lists are gone through in another way; see `composite`."""
    gaussians, camera = cast(scene_of("random"), dtype)
    background = jnp.asarray(BACKGROUND, dtype)

    def picture(params):
        view = gsjax.render(
            gaussians.replace(params=params), camera, config, background
        )
        return view._replace(demand=None, overflowed=None, radii=None)

    @jax.jit
    def both(params):
        return picture(params), jax.jvp(picture, (params,), (params,))[0]

    plain, derived = both(gaussians.params)
    np.testing.assert_array_equal(derived.median_depth, plain.median_depth)
    error = largest_difference(derived, plain)
    report(f"stop {config.transmittance_min}, {dtype.__name__}", error, bar)
    assert error <= bar
    assert np.abs(plain.rgb).max() > 0.1


def test_a_batch_decides_as_one():
    """By the flag that any has, and the least index; alone, by its own."""
    for flags in ([False, True, False], [False, False]):
        found = jax.vmap(any_in_batch)(jnp.asarray(flags))
        np.testing.assert_array_equal(found, [any(flags)] * len(flags))
        for flag in flags:
            assert any_in_batch(jnp.asarray(flag)) == flag
    index = jnp.asarray([3, 1, 2])
    np.testing.assert_array_equal(jax.vmap(min_in_batch)(index), [1, 1, 1])
    assert min_in_batch(index[0]) == 3


def test_a_batch_takes_one_branch():
    """What a batch decides as one is a branch still, where `lax.cond` takes both."""
    taken = []

    def count(x):
        jax.debug.callback(lambda: taken.append(1))
        return x + 1

    @jax.vmap
    def one(x):
        return jax.lax.cond(any_in_batch(x > 5), count, lambda x: x, x)

    for x, wanted in (([1.0, 2.0], False), ([1.0, 9.0], True)):
        taken.clear()
        out = one(jnp.asarray(x))
        jax.effects_barrier()
        assert bool(taken) == wanted
        np.testing.assert_array_equal(out, np.asarray(x) + wanted)
