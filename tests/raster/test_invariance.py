"""Changes that must not alter one bit of an image.

Capacities, tiles per step, size buckets, devices, order of the slots, contents
of dead slots, repeated runs and `jax_enable_x64`.
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
    camera_of,
    cast,
    gaussians_at,
    loss_and_gradients,
    needs_two_devices,
    on_cpu,
    pose,
    render,
    scene_of,
)
from pictures import KINDS, assert_same, images

import gsjax
from gsjax.raster.lists.blocks import BLOCK

pytestmark = [on_cpu, pytest.mark.as_users]


@pytest.mark.parametrize(
    "changes",
    [
        {"pair_capacity": 20000, "visible_capacity": 200, "tiles_per_step": 5},
        # With so much capacity there are several sizes of the arrays to sort.
        {"num_size_buckets": 4, "pair_capacity": 2**18},
        pytest.param({"devices": 2}, marks=needs_two_devices),
    ],
    ids=str,
)
def test_settings_and_slots_are_bit_equal(changes):
    """Also with empty slots, whose number no two devices can share equally."""
    for kind in KINDS:
        scene, camera = scene_of(kind)
        wanted, grown = images(scene, camera), gsjax.grow(scene, COUNT + 9)
        out = images(grown, camera, WHOLE.replace(**changes))
        assert_same(out, wanted)
        np.testing.assert_array_equal(out.radii[:COUNT], wanted.radii)
        assert (out.radii[COUNT:] == 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_order_of_slots_and_repetition_are_bit_equal(kind):
    gaussians, camera = scene_of(kind)
    wanted = images(gaussians, camera)
    assert_same(images(gaussians, camera), wanted, (*ALL, "radii"))
    if kind == "equal_depths":  # slots order the ties, so another order shows
        flipped = images(jax.tree.map(lambda a: a[::-1], gaussians), camera)
        assert np.abs(wanted.rgb - flipped.rgb).max() > 0.01
        return
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(COUNT)
        out = images(jax.tree.map(lambda a, o=order: a[o], gaussians), camera)
        assert_same(out, wanted)
        np.testing.assert_array_equal(out.radii, wanted.radii[order])


def with_garbage(gaussians: gsjax.Gaussians, value: float):
    """Spread Gaussians over the outer of three blocks; dead slots hold ``value``."""
    size = 3 * BLOCK + 9
    outer = np.r_[0:BLOCK, 2 * BLOCK : size]
    live = np.sort(np.random.default_rng(0).permutation(outer)[:COUNT])
    params = jax.tree.map(
        lambda a: jnp.full((size, *a.shape[1:]), value, a.dtype).at[live].set(a),
        gaussians.params,
    )
    active = jnp.zeros(size, bool).at[live].set(True)
    return gsjax.Gaussians(params=params, active=active), live


def test_dead_slots_and_x64_are_bit_equal():
    """float32 is the default of users, who leave `jax_enable_x64` alone."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    wanted, first = images(gaussians, camera), None
    with jax.enable_x64(False):
        out = render(gaussians, camera, WHOLE, jnp.float32(BACKGROUND))
        assert_same(out, wanted, (*ALL, "radii"))
    assert out.demand == wanted.demand
    for value in (0.0, np.nan, -np.inf, 1e30):
        scene, live = with_garbage(gaussians, value)
        plain = images(scene, camera)
        assert_same(plain, wanted)
        assert plain.demand == wanted.demand
        np.testing.assert_array_equal(plain.radii[live], wanted.radii)
        out, grads = loss_and_gradients(scene, camera)
        assert (out.radii[~scene.active] == 0).all()
        for leaf in jax.tree.leaves(grads[0]):
            assert (leaf[~scene.active] == 0).all(), value
            assert np.isfinite(leaf).all(), value
            assert np.any(leaf != 0)
        first = (out, grads) if first is None else first
        chex.assert_trees_all_equal((out, grads), first)


def test_depths_that_differ_by_less_than_a_step_of_float32(report):
    """Slots are ordered by the depths of the stored numbers, not by float32 depths.

    The Gaussians are far from the origin, and in any order of slots.
    """
    shift = np.eye(4)
    shift[:3, 3] = 9, -7, 5
    camera = camera_of(viewmat=pose() @ shift)
    depths = 3 + 2e-8 * np.random.default_rng(0).permutation(64)
    points, at = np.c_[np.zeros((64, 2)), depths], {"viewmat": camera.viewmat}
    scene = gaussians_at(points, np.exp(-2), 0.7, degree=0, **at)
    means, row = np.asarray(scene.params.means), np.asarray(camera.viewmat)[2]
    narrow = cast((scene, camera), jnp.float32)
    config = WHOLE.replace(occlusion=False, outputs=("rgb",))
    with jax.enable_x64(False):
        found = render(*narrow, config).rgb
    parts = (np.float32(row) * np.float32(np.c_[means, np.ones(64)])).T
    as_computed = parts[0] + parts[1] + parts[2] + parts[3]
    true = np.argsort(means @ row[:3])
    assert (true != np.argsort(as_computed, kind="stable")).any()
    error = float(jnp.abs(found - render(scene, camera, config).rgb).max())
    report("order within a step of float32", error, 1e-5)
    assert error <= 1e-5
