"""Gaussians in slots, and cameras, as values: laws, and which arguments are refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import camera_of, gaussians_at

import gsjax
from gsjax import InputError
from gsjax.cameras.camera import camera_centre


def some(count=5, degree=1, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) + [0, 0, 4]
    return gaussians_at(points, 0.1, 0.5, seed=seed, degree=degree)


def three(**changes) -> gsjax.Gaussians:
    """Return three Gaussians in five slots."""
    fields = {
        "means": np.arange(9.0).reshape(3, 3),
        "quats": np.tile([1.0, 0, 0, 0], (3, 1)),
        "log_scales": np.full((3, 3), -1.0),
        "logit_opacities": np.zeros(3),
        "sh": np.zeros((3, 4, 3)),
    }
    return gsjax.make_gaussians(**{**fields, "capacity": 5, **changes})


def active_rows(gaussians):
    keep = np.asarray(gaussians.active)
    return [np.asarray(leaf)[keep] for leaf in jax.tree.leaves(gaussians.params)]


def assert_same_rows(one, other):
    for a, b in zip(active_rows(one), active_rows(other), strict=True):
        np.testing.assert_array_equal(a, b)


def test_growing_selecting_and_compacting_keep_the_active_rows():
    scene = gsjax.grow(some(6), 11)
    assert scene.capacity == 11
    assert int(gsjax.num_active(scene)) == 6
    assert_same_rows(scene, some(6))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(scene.params))
    assert gsjax.make_gaussians(**vars(some(5).params), capacity=9).capacity == 9
    keep = np.array([1, 0, 1, 1, 0, 1] + [1] * 5, bool)
    picked = gsjax.select(scene, jnp.asarray(keep))  # activates no empty slot
    packed = gsjax.compact(picked, 4)
    assert packed.capacity == 4
    assert bool(packed.active.all())
    jitted = jax.jit(gsjax.compact, static_argnums=1)(picked, 7)
    for one in (picked, packed, jitted, gsjax.compact(picked, 20)):
        for found, wanted in zip(active_rows(one), active_rows(some(6)), strict=True):
            np.testing.assert_array_equal(found, wanted[keep[:6]])
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
    raised = gsjax.with_sh_degree(some(degree=1), 3)
    assert raised.sh_degree == 3
    assert not raised.params.sh[:, 4:].any()
    assert_same_rows(gsjax.with_sh_degree(raised, 1), some(degree=1))


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


def test_opacities_may_be_a_column_and_scenes_empty():
    column = three(logit_opacities=np.arange(3.0)[:, None], capacity=None)
    np.testing.assert_array_equal(column.params.logit_opacities, np.arange(3.0))
    empty = {name: array[:0] for name, array in vars(column.params).items()}
    none = gsjax.make_gaussians(**empty)
    assert none.capacity == 1
    assert gsjax.num_active(none) == 0


def test_a_repr_is_short_and_computes_nothing_under_tracing():
    one = three()
    dtype = one.params.means.dtype
    assert repr(one) == f"Gaussians(active=3/5, sh_degree=1, {dtype})"
    batch = jax.tree.map(lambda a: jnp.stack([a, a]), one)
    assert repr(batch) == f"Gaussians(batch=(2,), active=6/10, sh_degree=1, {dtype})"
    seen = [repr(jax.eval_shape(lambda x: x, one))]

    def look(gaussians):
        seen.append(repr(gaussians))
        return gaussians.params.means

    assert len(jax.make_jaxpr(look)(one).eqns) == 0
    jax.vmap(look)(jax.tree.map(lambda a: a[None], one))
    for leaf in (None, 0, "x", object()):  # not arrays
        odd = jax.tree.map(lambda _, leaf=leaf: leaf, one)
        assert repr(odd).startswith("Gaussians(params=")
    jax.tree.map(lambda a: a.delete(), one)
    assert {*seen, repr(one)} == {f"Gaussians(capacity=5, sh_degree=1, {dtype})"}


def test_arrays_are_placed_where_results_are():
    """On all devices, or on the one that is chosen."""
    count, first = jax.local_device_count(), jax.local_devices()[0]
    assert all(len(a.devices()) == count for a in jax.tree.leaves(three()))
    with jax.default_device(first):
        assert all(a.devices() == {first} for a in jax.tree.leaves(three()))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda g: [g, g], "list; merge them with gsjax.concatenate"),
        (lambda g: vars(g.params), r"dict; call gsjax.make_gaussians\(\*\*fields\)"),
        (lambda g: g.params, r"GaussianParams; call gsjax.Gaussians\("),
        (lambda _: "a.ply", r"str; call gsjax.load\(path\)"),
        (lambda _: 3, "int; make them with gsjax.make_gaussians"),
    ],
)
def test_other_types_are_named(make, message):
    wrong = make(three())
    for call in (
        gsjax.num_active,
        gsjax.compact,
        lambda g: gsjax.grow(g, 9),
        lambda g: gsjax.select(g, np.ones(5, bool)),
        lambda g: gsjax.with_sh_degree(g, 2),
        lambda g: gsjax.concatenate(three(), g),
    ):
        with pytest.raises(InputError, match=f"expected Gaussians, got {message}"):
            call(wrong)


@pytest.mark.parametrize(
    ("name", "value", "named"),
    [
        ("means", np.zeros((3, 2)), "means"),
        ("means", np.zeros(3), "means"),
        ("means", np.zeros((4, 3)), "quats"),  # the others are one short
        ("means", np.zeros((3, 3), complex), "means"),
        ("quats", np.zeros((3, 3)), "quats"),
        ("log_scales", np.zeros((3, 1)), "log_scales"),
        ("logit_opacities", np.zeros((3, 2)), "logit_opacities"),
        ("sh", np.zeros((3, 3)), "sh"),
        ("sh", np.zeros((2, 1, 3)), "sh"),
        ("sh", np.zeros((3, 5, 3)), "5"),
        *(("capacity", v, "capacity") for v in (2, 100.5, "100", True)),
    ],
    ids=str,
)
def test_gaussians_are_checked(name, value, named):
    with pytest.raises(InputError, match=named):
        three(**{name: value})


def test_slots_are_checked():
    gaussians = three()
    unseen = gsjax.select(gaussians, np.zeros(5, bool))
    wrong = [
        *(("keep", gsjax.select, k) for k in (np.ones((5, 1), bool), np.ones(1, bool))),
        ("keep", gsjax.select, np.ones(5, int)),
        *(("0 to 4", gsjax.with_sh_degree, degree) for degree in (-1, 5)),
        *(("capacity", gsjax.compact, size) for size in (0, -1, 100.5)),
        *(("capacity", gsjax.grow, size) for size in (0, -1, 100.5)),
    ]
    for named, change, value in wrong:
        with pytest.raises(InputError, match=named):
            change(unseen, value)
    assert gsjax.compact(unseen, 1).capacity == 1
    assert gsjax.grow(gaussians, np.int64(6)).capacity == 6


def test_resizing_keeps_directions():
    directions = np.random.default_rng(0).normal(size=(20, 3)) * 0.2 + [0, 0, 1]
    camera = camera_of()
    smaller = gsjax.resize_camera(camera, 20, 33)
    assert (smaller.width, smaller.height) == (20, 33)
    found, wanted = (
        np.divide(one.project(tuple(directions.T)), [[one.width], [one.height]])
        for one in (smaller, camera)
    )
    np.testing.assert_allclose(found, wanted, rtol=1e-12)


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
    np.testing.assert_array_equal(batch.viewmat, [one.viewmat for one in cameras])
    assert (batch.batched, batch.lens) == (True, cameras[0].lens)


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


def test_fields_may_be_lists_of_tracers():
    def focal(f):
        K = [[f, 0, 4], [0, f, 3], [0, 0, 1]]
        camera = gsjax.make_camera(viewmat=np.eye(4), K=K, width=8, height=6)
        one = gsjax.make_gaussians(
            means=[[0, 0, f]], quats=[[1, 0, 0, 0]], log_scales=[[0, 0, 0]],
            logit_opacities=[0], sh=[[[0, 0, 0]]], capacity=3,
        )  # fmt: skip
        return camera.K[1, 1] ** 2 + one.params.means[0, 2]

    assert jax.jit(jax.grad(focal))(3.0) == 7
