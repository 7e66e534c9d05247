"""Cameras of a batch and mapped cameras agree with single ones, to rounding.

A batch renders them in turn; XLA fuses the projection of another program differently
(a few units in the last place).
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
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


def test_single_batch_and_vmap(report):
    gaussians, first = scene_of("random")
    second = camera_of(centre=(30.0, 8.0))
    cameras = gsjax.stack_cameras([first, second])
    batch = render(gaussians, cameras, WHOLE, BACKGROUND)
    one = gsjax.stack_cameras([first])
    alone = jax.eval_shape(lambda c: gsjax.render(gaussians, c, WHOLE), one)
    assert alone.rgb.shape == (1, *batch.rgb.shape[1:])
    assert alone.radii.shape == (1, COUNT)
    mapped = jax.jit(jax.vmap(lambda c: gsjax.render(gaussians, c, WHOLE, BACKGROUND)))
    mapped = mapped(cameras)
    for i, camera in enumerate((first, second)):
        wanted = images(gaussians, camera, dtype=jnp.float64)
        assert (wanted.radii > 0).any()
        for name, out in {"batch": batch, "vmap": mapped}.items():
            one = out._replace(**{key: getattr(out, key)[i] for key in ALL})
            assert all(getattr(one, k).shape == getattr(wanted, k).shape for k in ALL)
            np.testing.assert_allclose(out.radii[i], wanted.radii, rtol=1e-12)
            error = largest_difference(one, wanted)
            report(name, error, 4e-15)
            assert error <= 4e-15, name
    assert np.abs(batch.rgb[0] - batch.rgb[1]).max() > 0.1
    assert batch.demand.pairs == mapped.demand.pairs.sum()
    assert batch.demand.visible == mapped.demand.visible.max()
    assert batch.demand.capacity == mapped.demand.capacity.max()


def test_a_picture_in_the_corner(report):
    """A part of the view equals a smaller camera: images, radii and gradients."""
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


def test_a_derivative_changes_no_image(report):
    """Another kernel may run under differentiation; some pixels stop early."""
    config = WHOLE.replace(chunk_size=3, transmittance_min=0.3)
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    background = jnp.asarray(BACKGROUND, jnp.float32)

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
    report("under differentiation", error, 1e-6)
    assert error <= 1e-6
    assert np.abs(plain.rgb).max() > 0.1


def test_a_batch_decides_as_one():
    for flags in ([False, True, False], [False, False]):
        found = jax.vmap(any_in_batch)(jnp.asarray(flags))
        np.testing.assert_array_equal(found, [any(flags)] * len(flags))
        for flag in flags:
            assert any_in_batch(jnp.asarray(flag)) == flag
    index = jnp.asarray([3, 1, 2])
    np.testing.assert_array_equal(jax.vmap(min_in_batch)(index), [1, 1, 1])
    assert min_in_batch(index[0]) == 3
