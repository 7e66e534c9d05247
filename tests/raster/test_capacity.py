"""Capacity is never silent: one too few is reported, exactly enough is exact."""

from importlib import import_module

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
from gsjax.raster.exact import _for_active
from gsjax.raster.lists.counting import total_count


@pytest.mark.new_emitters
def test_capacity_of_exactly_the_need():
    gaussians, camera = scene_of("random")
    wanted = images(gaussians, camera)
    need, visible = int(wanted.demand.capacity), int(wanted.demand.visible)
    assert need == wanted.demand.pairs > 100
    exact = COMPAT.replace(pair_capacity=need, visible_capacity=visible)
    assert_same(images(gaussians, camera, exact), wanted)
    given = cast((gaussians, camera), jnp.float32)
    for size in (1, need - 1):  # too few for the items, and for the pairs
        out = render(*given, exact.replace(pair_capacity=size), np.float32(BACKGROUND))
        assert out.overflowed
        assert out.demand == wanted.demand
    short = exact.replace(visible_capacity=visible - 1)
    out = render(*given, short, np.float32(BACKGROUND))
    assert out.overflowed
    assert out.demand.visible == visible


@pytest.mark.new_emitters
@needs_two_devices
def test_capacity_over_two_devices():
    """The demand is that of the device with the most, times the devices."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    config = COMPAT.replace(devices=2)
    wanted = images(gaussians, camera)
    need = int(render(gaussians, camera, config).demand.capacity)
    assert need >= wanted.demand.capacity
    enough = config.replace(pair_capacity=need)
    assert_same(images(gaussians, camera, enough), wanted)
    out = render(gaussians, camera, enough.replace(pair_capacity=need - 2))
    assert out.overflowed
    assert out.demand.capacity == need


def test_each_camera_of_a_batch_has_the_room():
    gaussians, first = cast(scene_of("random"), jnp.float32)
    second = cast(camera_of(centre=(60.0, 8.0)), jnp.float32)
    alone = {0: images(gaussians, first), 1: images(gaussians, second)}
    needs = [int(alone[i].demand.capacity) for i in alone]
    assert needs[0] != needs[1]
    for order in ((0, 1), (1, 0)):
        cameras = gsjax.stack_cameras([(first, second)[i] for i in order])
        small = COMPAT.replace(pair_capacity=min(needs))
        out = render(gaussians, cameras, small, jnp.float32(BACKGROUND))
        assert out.overflowed
        assert out.demand.capacity == max(needs)
        out = images(gaussians, cameras, COMPAT.replace(pair_capacity=max(needs)))
        assert not out.overflowed
        assert out.demand.pairs == sum(needs)
        for place, i in enumerate(order):
            one = out._replace(**{name: getattr(out, name)[place] for name in ALL})
            assert largest_difference(one, alone[i]) <= 1e-6


@pytest.mark.new_emitters
def test_render_exact_regrows():
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    wanted = images(gaussians, camera)
    tiny = COMPAT.replace(pair_capacity=1, visible_capacity=1)
    background = jnp.float32(BACKGROUND)
    assert render(gaussians, camera, tiny, background).overflowed
    out = gsjax.render_exact(gaussians, camera, tiny, background)
    assert not out.overflowed
    assert_same(out, wanted)
    fitted = gsjax.exact_config(gaussians, camera, tiny)
    assert fitted.replace(pair_capacity=1, visible_capacity=1) == tiny
    assert_same(images(gaussians, camera, fitted), wanted)
    with pytest.raises(CapacityError, match="wants a pair capacity"):
        gsjax.render_exact(gaussians, camera, tiny, background, max_capacity=100)


@pytest.mark.new_emitters
def test_empty_slots_take_no_room(monkeypatch):
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    grown = gsjax.grow(gaussians, 4096)
    open_ = COMPAT.replace(pair_capacity=None)
    assert _for_active(grown, open_) == open_.replace(visible_capacity=1024)
    many = gsjax.grow(gaussians, 2**20)
    assert _for_active(many, open_).visible_capacity == 1024
    assert _for_active(gaussians, open_) == open_
    said = open_.replace(visible_capacity=4096)
    assert _for_active(grown, said) == said
    taken = []

    def recorded(call):
        def one(gaussians, camera, config, **more):
            taken.append(config.visible_capacity)
            return call(gaussians, camera, config, **more)

        return one

    module = import_module("gsjax.raster.render")
    for name in ("_render_jit", "_demand_jit"):
        monkeypatch.setattr(module, name, recorded(getattr(module, name)))
    found = gsjax.render_exact(grown, camera, COMPAT, jnp.float32(BACKGROUND))
    assert_same(found, images(gaussians, camera))
    assert gsjax.exact_config(grown, camera, COMPAT).visible_capacity == 1024
    assert taken == [1024, 1024]


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
    out = render(*cast((scene, camera), jnp.float32), config)
    assert out.overflowed
    assert out.demand.pairs == out.demand.capacity == 2**31 - 1
    with pytest.raises(CapacityError, match="2,147,483,647 or more"):
        gsjax.render_exact(*cast((scene, camera), jnp.float32), config)


@pytest.mark.parametrize(
    ("counts", "wanted"),
    [
        ([3, 0, 4], 7),
        ([2**30 - 2**12, 5], 2**30 - 2**12 + 5),
        ([2**30, 2**10], 2**31 - 1),
        ([2**30, 2**30, 1], 2**31 - 1),  # wraps to -2^31 + 1
        ([2**30] * 4, 2**31 - 1),  # wraps to 0
        ([2**30] * 4 + [100], 2**31 - 1),  # wraps to 100
    ],
)
def test_total_count_saturates(counts, wanted):
    total, safe = total_count(jnp.asarray(counts, jnp.int32))
    assert total.dtype == jnp.int32
    assert total == wanted
    assert safe == (wanted < 2**30)


TRANSFORMED = {
    "jit": lambda function, value: jax.jit(function)(value),
    "vmap": lambda function, value: jax.vmap(function)(batch_of_one(value)),
    "scan": lambda function, value: jax.lax.scan(
        lambda _, one: (None, function(one)), None, batch_of_one(value)
    ),
}


def batch_of_one(tree):
    return jax.tree.map(lambda a: jnp.asarray(a)[None], tree)


@pytest.mark.parametrize("call", [gsjax.render_exact, gsjax.exact_config, gsjax.plan])
@pytest.mark.parametrize("name", TRANSFORMED)
def test_what_decides_by_numbers_is_refused_where_they_are_not_known(name, call):
    gaussians, camera = scene_of("random")
    told = r"decide by numbers, .* call them before"
    with pytest.raises(InputError, match=told):
        TRANSFORMED[name](lambda value: call(value, camera), gaussians)
    if name != "vmap":  # for which a render is compiled before it is refused
        with pytest.raises(InputError, match=told):
            TRANSFORMED[name](lambda value: call(gaussians, value), camera)
