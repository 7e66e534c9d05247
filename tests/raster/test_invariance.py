"""What must not change an image does not: not by one bit.

Bit-equal: capacities, order of the slots, contents of dead slots, number of devices,
repeated runs, tiles side by side, size of the ladder.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    ALL,
    BACKGROUND,
    COUNT,
    WHOLE,
    cast,
    loss_and_gradients,
    needs_two_devices,
    on_cpu,
    render,
    scene_of,
)
from pictures import KINDS, assert_same, images

import gsjax
from gsjax.raster import render_camera

pytestmark = pytest.mark.as_users


@on_cpu
@pytest.mark.parametrize(
    ("changes", "dtype"),
    [
        ({"pair_capacity": 5000, "tiles_per_step": 5}, jnp.float32),
        pytest.param(
            {"pair_capacity": 20000, "visible_capacity": 192},
            jnp.float64,
            marks=pytest.mark.new_emitters,
        ),
        # Room for so many pairs that there are sizes of what sorts them.
        ({"num_size_buckets": 4, "pair_capacity": 2**18}, jnp.float32),
        pytest.param({"devices": 2}, jnp.float32, marks=needs_two_devices),
        pytest.param(
            {"devices": 2},
            jnp.float64,
            marks=[needs_two_devices, pytest.mark.new_emitters],
        ),
    ],
    ids=str,
)
def test_settings_are_bit_equal(changes, dtype):
    for kind in KINDS:
        scene = scene_of(kind)
        wanted = images(*scene, dtype=dtype)
        assert_same(images(*scene, WHOLE.replace(**changes), dtype), wanted)


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
@needs_two_devices
@pytest.mark.new_emitters
def test_a_projection_in_parts_is_bit_equal(monkeypatch):
    """Slots that two devices cannot share equally; pictures, and gradients."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    gaussians = gsjax.grow(gaussians, COUNT + 9)
    assert gaussians.sh_degree > 0
    config = WHOLE.replace(outputs=("rgb",), devices=2)
    calls, usual = [], render_camera.shard_rows

    def total(params):
        view = gsjax.render(gaussians.replace(params=params), camera, config)
        return jnp.sum(jnp.sin(view.rgb)), (view.rgb, view.radii)

    def found(shared: bool):
        def shard_rows(values, count, fill):
            calls.append(count)
            return usual(values, count, fill) if shared else values

        monkeypatch.setattr(render_camera, "shard_rows", shard_rows)
        traced_anew = jax.value_and_grad(lambda params: total(params), has_aux=True)
        return jax.jit(traced_anew)(gaussians.params)

    shared, whole = found(True), found(False)
    assert calls == [2, 2]
    chex.assert_trees_all_equal(shared, whole)
    assert np.abs(shared[1].sh[:, 1:]).max() > 0


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
@pytest.mark.parametrize(
    "dtype",
    [jnp.float32, pytest.param(jnp.float64, marks=pytest.mark.new_emitters)],
)
def test_contents_of_dead_slots_are_bit_equal(dtype):
    gaussians, camera = cast(scene_of("random"), dtype)
    wanted = images(gaussians, camera, dtype=dtype)
    learnt, _ = loss_and_gradients(gaussians, camera)  # by chunks: to rounding the same
    first = None
    for value in GARBAGE:
        scene, live = with_garbage(gaussians, value)
        assert_same(images(scene, camera, dtype=dtype), wanted)
        out, (by_params, by_camera) = loss_and_gradients(scene, camera)
        assert_same(out, learnt)
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
        out = render(gaussians, camera, WHOLE, jnp.float32(BACKGROUND))
        assert_same(out, wanted, (*ALL, "radii"))
    assert out.demand == wanted.demand
