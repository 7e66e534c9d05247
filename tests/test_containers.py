"""Laws of the containers: Gaussians in slots, and cameras."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import camera_of, gaussians_at

import gsjax
from gsjax import InputError
from gsjax.cameras.camera import camera_centre
from gsjax.cameras.lenses import PINHOLE


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
    keep = np.array([1, 0, 1, 1, 0, 1] + [1] * 5, bool)
    picked = gsjax.select(scene, jnp.asarray(keep))  # activates no empty slot
    packed = gsjax.compact(picked, 4)
    assert packed.capacity == 4
    assert bool(packed.active.all())
    assert_same_rows(packed, picked)
    assert gsjax.compact(picked, 20).capacity == 20
    jitted = jax.jit(gsjax.compact, static_argnums=1)(picked, 7)
    assert_same_rows(jitted, picked)
    with pytest.raises(InputError, match="expected at least 4"):
        gsjax.compact(picked, 3)


def test_concatenate_keeps_both():
    one, other = some(3), gsjax.grow(some(2, seed=1), 4)
    both = gsjax.concatenate(one, other)
    assert both.capacity == 7
    for joined, a, b in zip(active_rows(both), active_rows(one), active_rows(other)):
        np.testing.assert_array_equal(joined, np.concatenate([a, b]))
    with pytest.raises(InputError, match="got 1 and 2"):
        gsjax.concatenate(one, some(2, degree=2))


def test_degree_up_and_down_is_the_identity():
    scene = some(degree=1)
    raised = gsjax.with_sh_degree(scene, 3)
    assert raised.sh_degree == 3
    assert float(jnp.abs(raised.params.sh[:, 4:]).max()) == 0
    assert_same_rows(gsjax.with_sh_degree(raised, 1), scene)


def test_capacity_buckets():
    sizes = {gsjax.capacity_bucket(n) for n in range(1, 100_000, 7)}
    assert len(sizes) < 16
    for count in (1, 1023, 1024, 1025, 1536, 1537, 10**6):
        bucket = gsjax.capacity_bucket(count)
        assert count <= bucket <= max(1024, 1.5 * count)
        assert gsjax.capacity_bucket(bucket) == bucket
    found = [gsjax.capacity_bucket(n, minimum=1) for n in (0, 1, 3, 5, 7, 9, 13, 17)]
    assert found == [1, 1, 3, 6, 8, 12, 16, 24]
    for minimum in (0, 5, 1.5, "1"):
        with pytest.raises(InputError, match="minimum"):
            gsjax.capacity_bucket(100, minimum)


def project_directions(camera, directions):
    """Return image coordinates in units of the image of directions [N, 3]."""
    u, v = camera.project(tuple(directions.T))
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
def test_look_at(up):
    eye, target = np.array([1.0, -2, 3]), np.array([0.5, 0.5, 0.5])
    view = gsjax.look_at(eye, target, up)
    np.testing.assert_allclose(view[:3, :3] @ view[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view[:3, :3]) > 0
    np.testing.assert_allclose(camera_centre(jnp.asarray(view)), eye, atol=1e-12)
    at = view @ [*target, 1]
    np.testing.assert_allclose(at[:3], [0, 0, np.linalg.norm(target - eye)], atol=1e-12)
    above = view[:3, :3] @ np.asarray(up, float)
    assert above[1] < 0  # y points down in the image


def test_stacked_cameras_have_a_leading_axis():
    cameras = [camera_of(viewmat=gsjax.look_at((i, 1, 2), (0, 0, 0))) for i in range(3)]
    batch = gsjax.stack_cameras(cameras)
    assert batch.batched
    assert batch.viewmat.shape == (3, 4, 4)
    np.testing.assert_array_equal(batch.viewmat[1], cameras[1].viewmat)
    assert batch.lens is PINHOLE
    with pytest.raises(InputError, match="one size and lens"):
        gsjax.stack_cameras([cameras[0], camera_of(width=9)])


@pytest.mark.parametrize("capacity", [None, 99])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_no_memory_is_shared_with_the_caller(dtype, capacity):
    """JAX may alias an aligned NumPy array."""

    def aligned(shape):
        size = int(np.prod(shape)) * dtype(0).nbytes
        memory = np.zeros(size + 64, np.uint8)
        start = -memory.ctypes.data % 64
        return memory[start : start + size].view(dtype).reshape(shape)

    shapes = {"means": (64, 3), "quats": (64, 4), "log_scales": (64, 3)}
    arrays = {name: aligned(shape) for name, shape in shapes.items()}
    arrays |= {"logit_opacities": aligned((64,)), "sh": aligned((64, 1, 3))}
    viewmat, K = aligned((4, 4)), aligned((3, 3))
    viewmat[:], K[:] = np.eye(4), np.diag([9, 9, 1])
    scene = gsjax.make_gaussians(**arrays, capacity=capacity)
    camera = gsjax.make_camera(viewmat=viewmat, K=K, width=8, height=8)
    before = [np.array(a) for a in jax.tree.leaves((scene, camera))]
    for array in (*arrays.values(), viewmat, K):
        array[...] = 7
    for a, b in zip(before, jax.tree.leaves((scene, camera)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_lists_may_contain_tracers():

    def focal(f):
        K = [[f, 0, 4], [0, f, 3], [0, 0, 1]]
        camera = gsjax.make_camera(viewmat=np.eye(4), K=K, width=8, height=6)
        one = gsjax.make_gaussians(
            means=[[0, 0, f]], quats=[[1, 0, 0, 0]], log_scales=[[0, 0, 0]],
            logit_opacities=[0], sh=[[[0, 0, 0]]], capacity=3,
        )  # fmt: skip
        return camera.K[1, 1] ** 2 + one.params.means[0, 2]

    assert jax.jit(jax.grad(focal))(3.0) == 7
