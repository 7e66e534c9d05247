"""Gaussians as a value: how they print, where they lie, and which types are refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsjax


def scene(**changes) -> gsjax.Gaussians:
    fields = {
        "means": np.arange(9.0).reshape(3, 3),
        "quats": np.tile([1.0, 0, 0, 0], (3, 1)),
        "log_scales": np.full((3, 3), -1.0),
        "logit_opacities": np.zeros(3),
        "sh": np.zeros((3, 4, 3)),
    }
    return gsjax.make_gaussians(**{**fields, "capacity": 5, **changes})


def test_repr_is_short():
    one = scene()
    dtype = one.params.means.dtype
    assert repr(one) == f"Gaussians(active=3/5, sh_degree=1, {dtype})"
    batch = jax.tree.map(lambda a: jnp.stack([a, a]), one)
    assert repr(batch) == f"Gaussians(batch=(2,), active=6/10, sh_degree=1, {dtype})"


def test_repr_computes_nothing_under_tracing():
    one, seen = scene(), []
    told = f"Gaussians(capacity=5, sh_degree=1, {one.params.means.dtype})"

    def look(gaussians):
        seen.append(repr(gaussians))
        return gaussians.params.means

    assert len(jax.make_jaxpr(look)(one).eqns) == 0
    jax.vmap(look)(jax.tree.map(lambda a: a[None], one))
    shapes = jax.eval_shape(lambda x: x, one)
    assert {*seen, repr(shapes)} == {told}
    deleted = jax.tree.map(jnp.copy, one)
    jax.tree.map(lambda a: a.delete(), deleted)
    assert repr(deleted) == told


@pytest.mark.parametrize("leaf", [None, 0, "x", object()])
def test_repr_survives_leaves_that_are_not_arrays(leaf):
    assert repr(jax.tree.map(lambda _: leaf, scene())).startswith("Gaussians(params=")


def test_arrays_are_placed_where_results_are():
    """A jitted step in a loop compiles once."""
    one, count = scene(), jax.local_device_count()
    assert all(len(a.devices()) == count for a in jax.tree.leaves(one))
    mesh = jax.sharding.Mesh(np.array(jax.local_devices()), ("devices",))
    everywhere = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
    step = jax.jit(
        lambda g: jax.tree.map(lambda a: a if a.dtype == bool else a + 1, g),
        out_shardings=everywhere,
    )
    for _ in range(3):
        one = step(one)
    assert step._cache_size() == 1
    first = jax.local_devices()[0]
    with jax.default_device(first):
        assert all(a.devices() == {first} for a in jax.tree.leaves(scene()))


def test_make_gaussians_is_differentiable():
    def total(x):
        return jnp.sum(scene(means=x * np.ones((3, 3))).params.means)

    assert jax.jit(jax.grad(total))(2.0) == 9.0


WRONG = [
    (lambda g: [g, g], "got list; merge them with gsjax.concatenate"),
    (lambda g: vars(g.params), r"got dict; call gsjax.make_gaussians\(\*\*fields\)"),
    (lambda g: g.params, r"got GaussianParams; call gsjax.Gaussians\("),
    (lambda _: "a.ply", r"got str; call gsjax.load\(path\)"),
    (lambda _: 3, "got int; make them with gsjax.make_gaussians"),
]


@pytest.mark.parametrize("row", range(len(WRONG)))
def test_other_types_are_named(row):
    make, message = WRONG[row]
    wrong = make(scene())
    for call in (
        gsjax.num_active,
        gsjax.compact,
        lambda g: gsjax.grow(g, 9),
        lambda g: gsjax.select(g, np.ones(5, bool)),
        lambda g: gsjax.with_sh_degree(g, 2),
        lambda g: gsjax.concatenate(scene(), g),
    ):
        with pytest.raises(gsjax.InputError, match=rf"expected Gaussians, {message}"):
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
    with pytest.raises(gsjax.InputError, match=named):
        scene(**{name: value})


def test_opacities_may_be_a_column_and_scenes_empty():
    column = scene(logit_opacities=np.arange(3.0)[:, None], capacity=None)
    np.testing.assert_array_equal(column.params.logit_opacities, np.arange(3.0))
    empty = {name: array[:0] for name, array in vars(column.params).items()}
    none = gsjax.make_gaussians(**empty)
    assert none.capacity == 1
    assert gsjax.num_active(none) == 0


def test_slots_are_checked():
    gaussians, count = scene(), 5
    for keep in (np.ones((count, 1), bool), np.ones(1, bool), np.ones(count, int)):
        with pytest.raises(gsjax.InputError, match="keep"):
            gsjax.select(gaussians, keep)
    for degree in (-1, 5):
        with pytest.raises(gsjax.InputError, match="0 to 4"):
            gsjax.with_sh_degree(gaussians, degree)
    unseen = gsjax.select(gaussians, np.zeros(count, bool))
    for change in (gsjax.compact, gsjax.grow):
        for capacity in (0, -1, 100.5):
            with pytest.raises(gsjax.InputError, match="capacity"):
                change(unseen, capacity)
    assert gsjax.compact(unseen, 1).capacity == 1
    assert gsjax.grow(gaussians, np.int64(count + 1)).capacity == count + 1
