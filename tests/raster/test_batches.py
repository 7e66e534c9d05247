"""Batches, parts and derivatives of images are the images; so are those that just fit.

A batch renders its cameras in turn; XLA fuses the projection of another program
differently (a few units in the last place). Too little capacity is reported.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    ALL,
    BACKGROUND,
    COMPAT,
    COUNT,
    WHOLE,
    assert_not_empty,
    camera_of,
    cast,
    gaussians_at,
    needs_two_devices,
    render,
    scene_of,
)
from pictures import assert_same, images, largest_difference

import gsjax
from gsjax.errors import CapacityError, InputError

BEHIND = jnp.float32(BACKGROUND)


def test_single_batch_and_vmap(report):
    """Each camera has a background and a mask of its own."""
    gaussians, first = scene_of("random")
    cameras = gsjax.stack_cameras([first, camera_of(centre=(30.0, 8.0))])
    one = jax.tree.map(lambda a: a[:1], cameras)
    alone = jax.eval_shape(lambda c: gsjax.render(gaussians, c, WHOLE), one)
    assert alone.rgb.shape == (1, first.height, first.width, 3)
    assert alone.radii.shape == (1, COUNT)
    backgrounds = np.random.default_rng(0).uniform(size=(2, 3))
    masks = np.mgrid[: first.height, : first.width] > 9

    def draw(camera, background, mask):
        return render(gaussians, camera, WHOLE, background, mask=mask)

    batch = draw(cameras, backgrounds, masks)
    mapped = jax.jit(jax.vmap(draw))(cameras, backgrounds, masks)
    for i in range(2):
        camera = jax.tree.map(lambda a, i=i: a[i], cameras)
        wanted = draw(camera, backgrounds[i], masks[i])
        assert_not_empty(wanted.alpha)
        for name, out in {"batch": batch, "vmap": mapped}.items():
            one = out._replace(**{key: getattr(out, key)[i] for key in ALL})
            assert all(getattr(one, k).shape == getattr(wanted, k).shape for k in ALL)
            np.testing.assert_allclose(out.radii[i], wanted.radii, rtol=1e-12)
            error = largest_difference(one, wanted)
            report(name, error, 4e-15)
            assert error <= 4e-15, name
        np.testing.assert_array_equal(batch.rgb[i], wanted.rgb)
        assert mapped.demand.pairs[i] == wanted.demand.pairs
    assert np.abs(batch.rgb[0] - batch.rgb[1]).max() > 0.1
    assert batch.demand.pairs == mapped.demand.pairs.sum()
    assert batch.demand.visible == mapped.demand.visible.max()
    assert batch.demand.capacity == mapped.demand.capacity.max()


def test_a_picture_in_the_corner(report):
    """A part of the view equals a smaller camera: images, radii and gradients."""
    gaussians, camera = scene_of("random")
    corner = np.s_[:20, :30]
    weight = np.random.default_rng(0).normal(size=(20, 30, 3))
    small = camera.replace(width=30, height=20)

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
        moved = gaussians.replace(params=params)
        view = gsjax.render(moved, camera, config, background)
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


SPARSE = {"tile_size": 4, "tiles_per_step": 8, "chunk_size": 64}


@pytest.mark.parametrize("changes", [{}, SPARSE], ids=["pairs", "chunks"])
def test_capacity_of_exactly_the_need(changes):
    """Pairs decide, or chunks that are mostly empty."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    wanted = images(gaussians, camera, COMPAT.replace(**changes))
    need, visible = int(wanted.demand.capacity), int(wanted.demand.visible)
    assert need >= wanted.demand.pairs > 100
    assert (need > wanted.demand.pairs) == bool(changes)
    exact = COMPAT.replace(pair_capacity=need, visible_capacity=visible, **changes)
    assert_same(images(gaussians, camera, exact), wanted)
    out = render(gaussians, camera, exact.replace(pair_capacity=need - 1), BEHIND)
    assert out.overflowed
    assert out.demand == wanted.demand
    out = render(gaussians, camera, exact.replace(visible_capacity=visible - 1), BEHIND)
    assert out.overflowed
    assert out.demand.visible == visible


@needs_two_devices
def test_capacity_over_two_devices():
    """The demand is that of the device with the most, times the devices."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    config = COMPAT.replace(devices=2)
    wanted = images(gaussians, camera)
    small = config.replace(pair_capacity=2 * (int(wanted.demand.capacity) // 2) - 2)
    out = render(gaussians, camera, small, BEHIND)
    assert out.overflowed
    need = int(out.demand.capacity)
    assert need >= wanted.demand.capacity
    assert out.demand.pairs == wanted.demand.pairs
    assert_same(images(gaussians, camera, config.replace(pair_capacity=need)), wanted)


def test_each_camera_of_a_batch_has_the_capacity():
    gaussians, first = cast(scene_of("random"), jnp.float32)
    second = cast(camera_of(centre=(60.0, 8.0)), jnp.float32)
    alone = (images(gaussians, camera) for camera in (first, second))
    needs = [int(one.demand.capacity) for one in alone]
    assert needs[0] != needs[1]
    for turn in (1, -1):  # the need may be that of the first or of the last
        cameras = gsjax.stack_cameras([first, second][::turn])
        small = COMPAT.replace(pair_capacity=min(needs))
        out = render(gaussians, cameras, small, BEHIND)
        assert out.overflowed
        assert out.demand.capacity == max(needs)
        out = images(gaussians, cameras, COMPAT.replace(pair_capacity=max(needs)))
        assert out.demand.pairs == sum(needs)


def test_render_exact_regrows():
    """Also where most slots are empty, or where a mask has a hole.

    Empty slots need no capacity; the pairs of a hole are counted, but not blended.
    """
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    grown, tiny = gsjax.grow(gaussians, 4096), COMPAT.replace(pair_capacity=1)
    out = gsjax.render_exact(grown, camera, tiny, BEHIND)
    assert not out.overflowed
    assert_same(out, images(gaussians, camera))
    fitted = gsjax.exact_config(grown, camera, tiny)
    assert fitted.visible_capacity == 1024
    assert fitted.replace(pair_capacity=1, visible_capacity=None) == tiny
    with pytest.raises(CapacityError, match="expected a pair capacity"):
        gsjax.render_exact(grown, camera, tiny, BEHIND, max_capacity=100)
    scene, ring = cast(scene_of("huge"), jnp.float32), np.ones(out.alpha.shape, bool)
    ring[8:20, 8:32] = False
    wanted = render(*scene, COMPAT, BEHIND, mask=ring)
    cramped = COMPAT.replace(pair_capacity=int(wanted.demand.capacity) - 1)
    assert render(*scene, cramped, BEHIND, mask=ring).overflowed
    out = gsjax.render_exact(*scene, cramped, BEHIND, mask=ring)
    assert not out.overflowed
    np.testing.assert_array_equal(out.rgb[ring], wanted.rgb[ring])


def test_counts_past_32_bits_do_not_wrap():
    """4096 splats over 2^20 tiles of one pixel: 2^32 pairs, which wraps to 0."""
    points, eye = np.tile([0.0, 0, 1], (4096, 1)), np.eye(4)
    gaussians = gaussians_at(points, np.exp(18), 0.5, viewmat=eye, degree=0)
    camera = camera_of(2**20, 1, viewmat=eye, focal=(1.0, 1.0))
    tiles = {"tile_size": 1, "chunk_size": 1, "tiles_per_step": 1024}
    config = COMPAT.replace(outputs=("alpha",), **tiles)
    scene = cast((gaussians, camera), jnp.float32)
    out = gsjax.render(*scene, config)
    assert out.overflowed
    assert out.demand.pairs == out.demand.capacity == 2**31 - 1
    with pytest.raises(CapacityError, match="2,147,483,647 or more"):
        gsjax.render_exact(*scene, config)


@pytest.mark.parametrize("call", [gsjax.render_exact, gsjax.exact_config, gsjax.plan])
def test_functions_that_need_concrete_values_reject_tracers(call):
    gaussians, camera = scene_of("random")
    scene = gaussians, camera
    batch = jax.tree.map(lambda a: jnp.asarray(a)[None], scene)
    calls = {
        "jit": lambda: jax.jit(call)(*scene),
        "jit of the camera": lambda: jax.jit(lambda c: call(gaussians, c))(camera),
        "scan": lambda: jax.lax.scan(lambda _, one: (None, call(*one)), None, batch),
    }
    if call is gsjax.plan:  # others compile a render before they reject vmap
        calls["vmap"] = lambda: jax.vmap(call)(*batch)
    for transformed in calls.values():
        with pytest.raises(InputError, match="need concrete values"):
            transformed()
