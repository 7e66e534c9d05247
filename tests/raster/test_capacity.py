"""Too little capacity is reported; a capacity of exactly the need is exact."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    ALL,
    BACKGROUND,
    COMPAT,
    camera_of,
    cast,
    needs_two_devices,
    render,
    scene_of,
)
from pictures import assert_same, images, largest_difference

import gsjax
from gsjax.errors import CapacityError, InputError

BEHIND = jnp.float32(BACKGROUND)


def test_capacity_of_exactly_the_need():
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    wanted = images(gaussians, camera)
    need, visible = int(wanted.demand.capacity), int(wanted.demand.visible)
    assert need == wanted.demand.pairs > 100
    exact = COMPAT.replace(pair_capacity=need, visible_capacity=visible)
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
    assert_same(images(gaussians, camera, config.replace(pair_capacity=need)), wanted)


def test_each_camera_of_a_batch_has_the_capacity():
    gaussians, first = cast(scene_of("random"), jnp.float32)
    second = cast(camera_of(centre=(60.0, 8.0)), jnp.float32)
    alone = [images(gaussians, camera) for camera in (first, second)]
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
        for place, wanted in enumerate(alone[::turn]):
            one = out._replace(**{name: getattr(out, name)[place] for name in ALL})
            assert largest_difference(one, wanted) <= 1e-6


def test_render_exact_regrows():
    """Also where most of the slots are empty, which need no capacity."""
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


def test_counts_past_32_bits_do_not_wrap():
    """4096 splats over 2^20 tiles of one pixel: 2^32 pairs, which wraps to 0."""
    scene = gsjax.make_gaussians(
        means=np.tile([0.0, 0, 1], (4096, 1)),
        quats=np.tile([1.0, 0, 0, 0], (4096, 1)),
        log_scales=np.full((4096, 3), 18.0),
        logit_opacities=np.zeros(4096),
        sh=np.zeros((4096, 1, 3)),
    )
    camera = camera_of(2**20, 1, viewmat=np.eye(4), focal=(1.0, 1.0))
    config = COMPAT.replace(
        outputs=("alpha",),
        tile_size=1,
        chunk_size=1,
        tiles_per_step=1024,
        pair_capacity=8192,
    )
    out = gsjax.render(*cast((scene, camera), jnp.float32), config)
    assert out.overflowed
    assert out.demand.pairs == out.demand.capacity == 2**31 - 1
    with pytest.raises(CapacityError, match="2,147,483,647 or more"):
        gsjax.render_exact(*cast((scene, camera), jnp.float32), config)


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
