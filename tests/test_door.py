"""The library as a user who only knows JAX and the README meets it."""

from contextlib import contextmanager

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import COMPAT, WIDTH, camera_of, frustum_points, gaussians_at, scene_of
from jax.experimental import checkify

import gsjax
from gsjax import CapacityError, InputError

CONFIG = COMPAT.replace(outputs=("rgb", "alpha"), devices=None)
_compilations: list[str] = []
jax.monitoring.register_event_duration_secs_listener(
    lambda name, _, **__: _compilations.append(name)
)


@contextmanager
def counted_compilations():
    """Yield a list that grows by one for each program that XLA compiles."""
    start, found = len(_compilations), []
    yield found
    found += [
        x for x in _compilations[start:] if x.endswith("backend_compile_duration")
    ]


def test_render_outside_of_jit_is_compiled_once():
    gaussians, camera = scene_of("random")

    def loss(params):
        return gsjax.render(gaussians.replace(params=params), camera, CONFIG).rgb.sum()

    first = gsjax.render(gaussians, camera, CONFIG)
    slopes = jax.grad(loss)(gaussians.params)
    with counted_compilations() as programs:
        again = gsjax.render(gaussians, camera, CONFIG)
        same = jax.grad(loss)(gaussians.params)
    assert programs == []
    np.testing.assert_array_equal(again.rgb, first.rgb)
    np.testing.assert_array_equal(same.means, slopes.means)


def test_a_training_step_of_ones_own_compiles_once():
    """Results lie on the same devices as inputs, so that no step compiles again."""
    gaussians, camera = scene_of("random")

    @jax.jit
    def step(params):
        def loss(params):
            image = gsjax.render(gaussians.replace(params=params), camera, CONFIG).rgb
            return jnp.mean(jnp.square(image - 0.5))

        return jax.tree.map(lambda p, g: p - 0.1 * g, params, jax.grad(loss)(params))

    params = step(gaussians.params)
    with counted_compilations() as programs:
        for _ in range(5):
            params = step(params)
    assert programs == []
    assert step._cache_size() == 1


def test_the_default_capacity_holds_large_splats():
    points = frustum_points(np.random.default_rng(0), 60)
    camera = camera_of(160, 120, focal=(150.0, 150.0))
    config = gsjax.RasterConfig(outputs=("alpha",))
    view = gsjax.render(gaussians_at(points, 20.0, 0.05), camera, config)
    assert not view.overflowed
    assert view.check() is view


def test_an_overflow_can_be_chosen_to_be_seen():
    gaussians, camera = scene_of("random")
    small = CONFIG.replace(pair_capacity=8)
    view = gsjax.render(gaussians, camera, small)
    assert view.overflowed
    with pytest.raises(CapacityError, match=r"pair_capacity to at least \d+"):
        view.check()
    marked = gsjax.render(gaussians, camera, small.replace(on_overflow="nan"))
    assert all(np.isnan(image).all() for image in (marked.rgb, marked.alpha))
    fits = gsjax.render(gaussians, camera, CONFIG.replace(on_overflow="nan"))
    assert np.isfinite(fits.rgb).all()
    checked = checkify.checkify(
        jax.jit(lambda g: gsjax.render(g, camera, small).check().rgb)
    )
    error, _ = checked(gaussians)
    with pytest.raises(checkify.JaxRuntimeError, match="too small"):
        error.throw()


def test_plain_values_are_accepted():
    gaussians, camera = scene_of("random")
    listed = gsjax.render(gaussians, camera, CONFIG, [0.1, 0.2, 0.3]).rgb
    given = gsjax.render(gaussians, camera, CONFIG, np.array([0.1, 0.2, 0.3])).rgb
    np.testing.assert_array_equal(listed, given)
    moved = camera.replace(near=camera.near * 2)
    assert moved.near == 2 * camera.near
    assert repr(camera) == f"Camera({WIDTH} × 29 px, pinhole)"
    assert "batch of 2" in repr(gsjax.stack_cameras([camera, camera]))
    assert len(repr(gaussians)) < 100


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (lambda g, c: (g, [c, c]), "a list of Camera; stack them with gsjax.stack_cam"),
        (lambda g, c: (g.params, c), "expected gsjax.Gaussians, got GaussianParams"),
        (lambda g, c: ([g], c), "got a list of Gaussians"),
        (lambda g, c: (g, c.viewmat), "expected gsjax.Camera"),
        (lambda g, c: (g, c, np.ones(3)), "background is the argument behind it"),
        (lambda g, c: (g, c, CONFIG, np.ones(4)), "expected shape"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(InputError, match=message):
        gsjax.render(*arguments(*scene_of("random")))
