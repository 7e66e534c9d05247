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
    loss_and_gradients,
    needs_two_devices,
    on_cpu,
    pose,
    render,
    scene_of,
)
from pictures import KINDS, assert_same, images

import gsjax
from gsjax.math.numerics import in_float64

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
    """Add two dead slots for each live one, holding ``value`` everywhere."""
    dead = np.ones(3 * COUNT, bool)
    live = np.sort(np.random.default_rng(0).permutation(3 * COUNT)[:COUNT])
    dead[live] = False
    params = jax.tree.map(
        lambda a: jnp.full((3 * COUNT, *a.shape[1:]), value, a.dtype).at[live].set(a),
        gaussians.params,
    )
    return gsjax.Gaussians(params=params, active=jnp.asarray(~dead)), live


def test_contents_of_dead_slots_are_bit_equal():
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    wanted, first = images(gaussians, camera), None
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


def test_the_same_without_x64():
    """float32 is the default of users, who leave `jax_enable_x64` alone."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    wanted = images(gaussians, camera)
    with jax.enable_x64(False):
        out = render(gaussians, camera, WHOLE, jnp.float32(BACKGROUND))
        assert_same(out, wanted, (*ALL, "radii"))
    assert out.demand == wanted.demand


def test_depths_that_differ_by_less_than_a_step_of_float32(report):
    """Slots are ordered by the depths of the stored numbers, not by float32 depths.

    The Gaussians are opaque, far from the origin, and in any order of slots.
    """
    rng, count = np.random.default_rng(0), 64
    shift = np.eye(4)
    shift[:3, 3] = 9, -7, 5
    camera = camera_of(viewmat=pose() @ shift)
    to_world = np.linalg.inv(np.asarray(camera.viewmat, np.float64))
    seen = np.c_[np.zeros((count, 2)), 3 + 2e-8 * np.arange(count), np.ones(count)]
    fields = {
        "means": (seen @ to_world.T)[:, :3],
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "log_scales": np.full((count, 3), -2.0),
        "logit_opacities": np.full(count, 1.0),
        "sh": rng.uniform(-1, 2, (count, 1, 3)),
    }
    mixed = rng.permutation(count)
    config = WHOLE.replace(occlusion=False, outputs=("rgb",))
    with jax.enable_x64(False):
        fields = {name: np.asarray(v[mixed], np.float32) for name, v in fields.items()}
        scene = gsjax.make_gaussians(**fields)
        narrow = jax.tree.map(jnp.float32, camera)
        found = render(scene, narrow, config).rgb
        row, means = np.asarray(narrow.viewmat)[2], fields["means"]
        as_computed = sum(row[i] * means[:, i] for i in range(3)) + row[3]
    wide, camera = in_float64((scene, narrow))
    z = np.asarray(wide.params.means) @ np.asarray(camera.viewmat)[2, :3]
    assert (np.argsort(z) != np.argsort(as_computed, kind="stable")).any()
    wanted = render(wide, camera, config).rgb
    error = float(jnp.abs(found - wanted).max())
    report("order within a step of float32", error, 1e-5)
    assert error <= 1e-5
