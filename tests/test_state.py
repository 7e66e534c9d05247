"""Laws of the containers: Gaussians in slots, and cameras."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import camera_of, gaussians_at

import gsjax
from gsjax import InputError
from gsjax.cameras import PINHOLE, camera_centre


def some(count=5, degree=1, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) + [0, 0, 4]
    return gaussians_at(points, 0.1, 0.5, seed=seed, degree=degree)


def active_rows(gaussians):
    keep = np.asarray(gaussians.active)
    return [np.asarray(leaf)[keep] for leaf in jax.tree.leaves(gaussians.params)]


def assert_same_rows(one, other):
    for a, b in zip(active_rows(one), active_rows(other), strict=True):
        np.testing.assert_array_equal(a, b)


def test_fifty_nine_numbers():
    params = some(1, degree=3).params
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) == 59


def test_growing_keeps_and_adds_inactive_finite_slots():
    grown = gsjax.grow(some(5), 9)
    assert grown.capacity == 9
    assert int(gsjax.num_active(grown)) == 5
    assert_same_rows(grown, some(5))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grown.params))
    assert gsjax.make_gaussians(**vars(some(5).params), capacity=9).capacity == 9


def test_compact_reverses_select_and_grow():
    scene = gsjax.grow(some(6), 11)
    keep = np.array([1, 0, 1, 1, 0, 1] + [0] * 5, bool)
    picked = gsjax.select(scene, jnp.asarray(keep))
    packed = gsjax.compact(picked, 4)
    assert packed.capacity == 4
    assert bool(packed.active.all())
    assert_same_rows(packed, picked)
    assert gsjax.compact(picked, 20).capacity == 20
    jitted = jax.jit(gsjax.compact, static_argnums=1)(picked, 7)
    assert_same_rows(jitted, picked)
    with pytest.raises(InputError, match="4 Gaussians are active"):
        gsjax.compact(picked, 3)


def test_select_never_activates():
    scene = gsjax.grow(some(2), 4)
    assert int(gsjax.num_active(gsjax.select(scene, jnp.ones(4, bool)))) == 2


def test_concatenate_keeps_both():
    one, other = some(3), gsjax.grow(some(2, seed=1), 4)
    both = gsjax.concatenate(one, other)
    assert both.capacity == 7
    for joined, a, b in zip(active_rows(both), active_rows(one), active_rows(other)):
        np.testing.assert_array_equal(joined, np.concatenate([a, b]))
    with pytest.raises(InputError, match="degrees 1 and 2"):
        gsjax.concatenate(one, some(2, degree=2))


def test_degree_up_and_down_is_the_identity():
    scene = some(degree=1)
    raised = gsjax.with_sh_degree(scene, 3)
    assert raised.sh_degree == 3
    assert float(jnp.abs(raised.params.sh[:, 4:]).max()) == 0
    assert_same_rows(gsjax.with_sh_degree(raised, 1), scene)


def test_buckets_hold_and_are_few():
    sizes = {gsjax.capacity_bucket(n) for n in range(1, 100_000, 7)}
    assert len(sizes) < 16
    for count in (1, 1023, 1024, 1025, 1536, 1537, 10**6):
        bucket = gsjax.capacity_bucket(count)
        assert count <= bucket <= max(1024, 1.5 * count)
        assert gsjax.capacity_bucket(bucket) == bucket


def project_directions(camera, directions):
    """Pixels, in units of the image, of camera directions [N, 3]."""
    u, v = camera.model.project_point(camera.K, tuple(directions.T))
    return np.stack([u / camera.width, v / camera.height], -1)


def test_resizing_keeps_directions():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20, 3)) * 0.2 + [0, 0, 1]
    camera = camera_of()
    smaller = gsjax.resize_camera(camera, 20, 33)
    assert (smaller.width, smaller.height) == (20, 33)
    np.testing.assert_allclose(
        project_directions(smaller, directions),
        project_directions(camera, directions),
        rtol=1e-12,
    )


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (1, 2, 3)])
def test_look_at_looks_there(up):
    eye, target = np.array([1.0, -2, 3]), np.array([0.5, 0.5, 0.5])
    view = gsjax.look_at(eye, target, up)
    np.testing.assert_allclose(view[:3, :3] @ view[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view[:3, :3]) > 0
    np.testing.assert_allclose(camera_centre(jnp.asarray(view)), eye, atol=1e-12)
    at = view @ [*target, 1]
    np.testing.assert_allclose(at[:3], [0, 0, np.linalg.norm(target - eye)], atol=1e-12)
    above = view[:3, :3] @ np.asarray(up, float)
    assert above[1] < 0  # y points down in the image


def test_look_along_up_is_still_a_rotation():
    view = gsjax.look_at((0, 0, 5), (0, 0, 0), (0, 0, 1))
    np.testing.assert_allclose(view[:3, :3] @ view[:3, :3].T, np.eye(3), atol=1e-12)


def test_stacking_is_a_leading_axis():
    cameras = [camera_of(viewmat=gsjax.look_at((i, 1, 2), (0, 0, 0))) for i in range(3)]
    batch = gsjax.stack_cameras(cameras)
    assert batch.batched
    assert batch.viewmat.shape == (3, 4, 4)
    np.testing.assert_array_equal(batch.viewmat[1], cameras[1].viewmat)
    assert batch.model is PINHOLE
    with pytest.raises(InputError, match="one image size"):
        gsjax.stack_cameras([cameras[0], camera_of(width=9)])
