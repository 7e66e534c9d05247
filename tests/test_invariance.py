"""What must not change an image does not: not by one bit.

Bit-equal: capacities, order of the slots, contents of dead slots, number of devices,
repeated runs, tiles side by side, size of the ladder, `jax.vmap` over cameras.

Capacity is never silent: one too few is reported, exactly enough is exact.

Within rounding, and why: *tile and chunk sizes*, because positions are relative to
the tile's corner, and products and sums are taken chunk by chunk, so they associate
differently (≤ 2e-5 in float32); a *batch* of cameras and the *occlusion* switch,
because XLA fuses the projection of another program differently (a few units in the
last place).
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
    assert_not_empty,
    camera_of,
    cast,
    loss_and_gradients,
    needs_two_devices,
    on_cpu,
    render,
    scene_of,
)

import gsjax
from gsjax.errors import CapacityError
from gsjax.raster.counts import total_count

KINDS = ("random", "wall", "equal_depths")
DTYPES = (jnp.float32, jnp.float64)


def images(gaussians, camera, config=COMPAT, dtype=jnp.float32):
    given = cast((gaussians, camera, BACKGROUND), dtype)
    out = render(given[0], given[1], config, given[2])
    assert not out.overflowed
    assert_not_empty(out.alpha)
    assert np.std(out.rgb) > 1e-3
    return out


def assert_same(first, second, names=ALL):
    for name in names:
        a, b = np.asarray(getattr(first, name)), np.asarray(getattr(second, name))
        np.testing.assert_array_equal(a, b, err_msg=name)


def largest_difference(first, second):
    return max(
        np.max(
            np.abs(getattr(first, name) - getattr(second, name))
            / np.maximum(1, np.abs(getattr(first, name)))
        )
        for name in ("rgb", "alpha", "depth")
    )


@on_cpu
@pytest.mark.parametrize(
    ("changes", "dtype"),
    [
        ({"pair_capacity": 5000, "tiles_per_step": 5}, jnp.float32),
        ({"pair_capacity": 20000, "visible_capacity": 192}, jnp.float64),
        ({"rungs": 3}, jnp.float32),
        pytest.param({"devices": 2}, jnp.float32, marks=needs_two_devices),
        pytest.param({"devices": 2}, jnp.float64, marks=needs_two_devices),
    ],
    ids=str,
)
def test_settings_are_bit_equal(changes, dtype):
    for kind in KINDS:
        scene = scene_of(kind)
        wanted = images(*scene, dtype=dtype)
        assert_same(images(*scene, COMPAT.replace(**changes), dtype), wanted)


@on_cpu
def test_slots_are_bit_equal():
    capacity = COUNT + 9
    for kind in KINDS:
        gaussians, camera = scene_of(kind)
        grown = gsjax.grow(gaussians, capacity)
        out, wanted = images(grown, camera), images(gaussians, camera)
        assert_same(out, wanted)
        np.testing.assert_array_equal(out.radii[:COUNT], wanted.radii)
        assert (out.radii[COUNT:] == 0).all()
        assert out.demand == wanted.demand


@on_cpu
def test_repeated_runs_are_bit_equal():
    scene = scene_of("random")
    first = images(*scene)
    for _ in range(3):
        assert_same(images(*scene), first, (*ALL, "radii"))


def shuffled(kind, seed):
    """An order of the slots that keeps the order among equal depths."""
    order = np.random.default_rng(seed).permutation(COUNT)
    if kind == "equal_depths":
        z = np.asarray(scene_of(kind)[0].params.means[:, 2])
        for depth in np.unique(z):
            places = np.flatnonzero(z[order] == depth)
            order[places] = np.sort(order[places])
    return order


@on_cpu
@pytest.mark.parametrize("kind", KINDS)
def test_order_of_slots_is_bit_equal(kind):
    gaussians, camera = scene_of(kind)
    wanted = images(gaussians, camera)
    for seed in range(3):
        order = shuffled(kind, seed)
        assert (order != np.arange(COUNT)).mean() > 0.5
        out = images(jax.tree.map(lambda a, o=order: a[o], gaussians), camera)
        assert_same(out, wanted)
        np.testing.assert_array_equal(out.radii, wanted.radii[order])


@on_cpu
def test_equal_depths_are_ordered_by_slot():
    """The other order of the ties is another image: the permutations above matter."""
    gaussians, camera = scene_of("equal_depths")
    flipped = jax.tree.map(lambda a: a[::-1], gaussians)
    difference = images(gaussians, camera).rgb - images(flipped, camera).rgb
    assert np.abs(difference).max() > 0.01


GARBAGE = (0.0, np.nan, np.inf, -np.inf, 1e30, -1e30)


def with_garbage(gaussians: gsjax.Gaussians, value: float):
    """Two slots in three dead, holding ``value`` everywhere."""
    dead = np.ones(3 * COUNT, bool)
    live = np.sort(np.random.default_rng(0).permutation(3 * COUNT)[:COUNT])
    dead[live] = False
    params = jax.tree.map(
        lambda a: jnp.full((3 * COUNT, *a.shape[1:]), value, a.dtype).at[live].set(a),
        gaussians.params,
    )
    return gsjax.Gaussians(params=params, active=jnp.asarray(~dead)), live


@on_cpu
@pytest.mark.parametrize("dtype", DTYPES)
def test_contents_of_dead_slots_are_bit_equal(dtype):
    gaussians, camera = cast(scene_of("random"), dtype)
    wanted = images(gaussians, camera, dtype=dtype)
    first = None
    for value in GARBAGE:
        scene, live = with_garbage(gaussians, value)
        out, (by_params, by_camera) = loss_and_gradients(scene, camera)
        assert_same(out, wanted, ("alpha", "depth", "median_depth"))
        np.testing.assert_array_equal(out.radii[live], wanted.radii)
        for leaf in jax.tree.leaves(by_params):
            assert (leaf[~scene.active] == 0).all(), value
            assert np.isfinite(leaf).all(), value
        kept = jax.tree.map(lambda a, keep=live: a[keep], by_params)
        found = jax.tree.leaves((out.rgb, kept, by_camera))
        first = found if first is None else first
        for a, b in zip(found, first):
            np.testing.assert_array_equal(a, b)
    assert all(np.any(leaf != 0) for leaf in jax.tree.leaves(by_params))


@on_cpu
def test_the_same_without_x64():
    """float32 is the default of users, who leave `jax_enable_x64` alone."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    wanted = images(gaussians, camera)
    with jax.enable_x64(False):
        out = render(gaussians, camera, COMPAT, jnp.float32(BACKGROUND))
        assert_same(out, wanted, (*ALL, "radii"))
    assert out.demand == wanted.demand


def test_single_batch_and_vmap(report):
    for dtype, bar in ((jnp.float32, 1e-6), (jnp.float64, 4e-15)):
        gaussians, first = cast(scene_of("random"), dtype)
        second = cast(camera_of(centre=(30.0, 8.0)), dtype)
        cameras = gsjax.stack_cameras([first, second])
        background = jnp.asarray(BACKGROUND, dtype)
        batch = render(gaussians, cameras, COMPAT, background)
        mapped = jax.jit(
            jax.vmap(lambda c, g, b: gsjax.render(g, c, COMPAT, b), (0, None, None))
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


@pytest.mark.parametrize(
    "changes",
    [
        {"tile_size": 16},
        {"tile_size": 32},
        {"tile_size": 4, "chunk_size": 8},
        {"chunk_size": 128},
    ],
    ids=str,
)
def test_tile_and_chunk_sizes(changes, report):
    for kind in KINDS:
        scene = scene_of(kind)
        found = images(*scene, COMPAT.replace(**changes))
        error = largest_difference(found, images(*scene))
        report(f"{kind}, {changes}", error, 2e-5)
        assert error <= 2e-5, kind


def test_occlusion(report):
    """It drops work, and only what does not show; also with many in front."""
    for dtype, bar in ((jnp.float32, 5e-7), (jnp.float64, 1e-15)):
        for kind in ("wall", "random", "saturated"):
            scene = scene_of(kind)
            plain = images(*scene, COMPAT.replace(occlusion=False), dtype)
            found = images(*scene, dtype=dtype)
            error = largest_difference(found, plain)
            report(f"occlusion, {kind}, {dtype.__name__}", error, bar)
            assert error <= bar, kind
            assert found.demand.pairs <= plain.demand.pairs
            if kind == "wall":
                assert found.demand.pairs < 0.4 * plain.demand.pairs


def test_capacity_of_exactly_the_need():
    gaussians, camera = scene_of("random")
    wanted = images(gaussians, camera)
    need, visible = int(wanted.demand.capacity), int(wanted.demand.visible)
    assert need == wanted.demand.pairs > 100
    exact = COMPAT.replace(pair_capacity=need, visible_capacity=visible)
    assert_same(images(gaussians, camera, exact), wanted)
    given = cast((gaussians, camera), jnp.float32)
    for name, size in (("pair_capacity", need), ("visible_capacity", visible)):
        out = render(*given, exact.replace(**{name: size - 1}), np.float32(BACKGROUND))
        assert out.overflowed
        found = {
            "pair_capacity": out.demand.capacity,
            "visible_capacity": out.demand.visible,
        }
        assert found[name] == size


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
        occlusion=False,
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
