"""Motion models against polynomials and interpolations of other libraries."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import frustum_points, gaussians_at
from numpy.polynomial import chebyshev
from scipy.interpolate import RegularGridInterpolator
from scipy.special import expit

from gsjax.cameras.camera import look_at, make_camera
from gsjax.errors import InputError
from gsjax.train.config import TrainConfig
from gsjax.train.frames import views_until
from gsjax.train.memory_estimate import state_bytes
from gsjax.train.models import SceneParams, ViewInfo, init_model, scene_of
from gsjax.train.motion import field, trajectories
from gsjax.train.motion.interpolation import weighted_rows
from gsjax.train.motion.neighbours import neighbours
from gsjax.train.motion.settings import FieldSettings, TrajectorySettings
from gsjax.train.motion.stillness import find_moving, refreshed
from gsjax.train.optimiser import Rates, make_optimiser, scale_by_rate
from gsjax.train.state import make_setup, setup_state

SLOTS = 12
FIELD = FieldSettings(channels=3, cells=12, times=4, width=7)
MODELS = {
    "trajectories": trajectories.trajectory_model(TrajectorySettings(), Rates(), 5.0),
    "field": field.field_model(FIELD),
}
MOVED = {"trajectories": trajectories.moved, "field": field.moved}
both = pytest.mark.parametrize("name", MODELS)


def still(dtype=np.float64, slots=SLOTS):
    """Return Gaussians of SH degree 1."""
    points = frustum_points(np.random.default_rng(3), slots)
    scene = gaussians_at(points, 0.1, 0.6, seed=5, degree=1)
    return jax.tree.map(lambda a: a if a.dtype == bool else a.astype(dtype), scene)


def params_of(name, *, at_rest=False, dtype=np.float64) -> SceneParams:
    """Return parameters of a model, random ones unless at rest."""
    gaussians = still(dtype)
    model = init_model(MODELS[name], gaussians)
    if at_rest:
        return SceneParams(gaussians, model)
    rng = np.random.default_rng(8)

    def shaken(leaf):
        return leaf + jnp.asarray(rng.normal(0, 0.2, leaf.shape), leaf.dtype)

    slots, shared = jax.tree.map(shaken, (model.slots, model.shared))
    if shared is not None:
        shared["box"] = model.shared["box"]
    if slots is not None:
        slots["fades"] = slots["fades"] + 1
    return SceneParams(gaussians, model._replace(slots=slots, shared=shared))


@both
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_at_rest_every_bit_is_that_of_the_still_scene(name, dtype):
    params = params_of(name, at_rest=True, dtype=dtype)
    if dtype == np.float64 and name == "trajectories":
        # The initial lifetime is finite: too long for float32 only.
        slots = {**params.model.slots, "fades": jnp.zeros(SLOTS)}
        params = params._replace(model=params.model._replace(slots=slots))
    for time in (0.0, 0.37, 1.0):
        found = jax.jit(MOVED[name])(params, time)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(params.gaussians)):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)


@both
def test_derivatives_by_time_and_all_parameters_are_finite_differences(name):
    params, rng = params_of(name), np.random.default_rng(2)
    weights = jax.tree.map(lambda a: rng.normal(size=a.shape), params.gaussians.params)

    @jax.jit
    def value(floats, time):
        changed = params._replace(
            gaussians=params.gaussians.replace(params=floats[0]),
            model=params.model._replace(slots=floats[1], shared=floats[2]),
        )
        found = MOVED[name](changed, time).params
        parts = jax.tree.map(lambda a, w: jnp.sum(a * w), found, weights)
        return sum(jax.tree.leaves(parts))

    floats = params.gaussians.params, params.model.slots, params.model.shared
    time, step = jnp.float64(0.41), 1e-6
    by, by_time = jax.grad(value, (0, 1))(floats, time)
    slope = (value(floats, time + step) - value(floats, time - step)) / (2 * step)
    np.testing.assert_allclose(by_time, slope, rtol=1e-7)
    leaves, tree = jax.tree.flatten(floats)
    names = [
        jax.tree_util.keystr(p) for p, _ in jax.tree_util.tree_leaves_with_path(floats)
    ]
    grads = jax.tree.leaves(by)
    for index, (leaf, grad) in enumerate(zip(leaves, grads)):
        if "box" in names[index]:
            continue
        toward = rng.normal(size=leaf.shape)
        offsets = {index: toward}
        if name == "field" and "means" in names[index]:
            # The field is read at a place that is held fixed: the box moves along.
            toward = np.tile(rng.normal(size=3), (SLOTS, 1))
            box = next(i for i, n in enumerate(names) if "box" in n)
            offsets = {index: toward, box: np.tile(toward[0], (2, 1))}

        def along(length, offsets=offsets):
            moved = [
                leaf + length * offsets[i] if i in offsets else leaf
                for i, leaf in enumerate(leaves)
            ]
            return value(jax.tree.unflatten(tree, moved), time)

        expected = (along(step) - along(-step)) / (2 * step)
        found = float(np.sum(grad * toward))
        np.testing.assert_allclose(found, expected, rtol=2e-6, atol=1e-8)
        assert found != 0, names[index]


def test_trajectories_are_chebyshev_series_with_a_gaussian_lifetime():
    params, time = params_of("trajectories"), 0.83
    slots, p = params.model.slots, params.gaussians.params
    found = trajectories.moved(params, jnp.asarray(time)).params

    def series(name):
        rows = [np.asarray(c) / (k + 1) for k, c in enumerate(slots[name])]
        whole = np.stack([np.zeros_like(rows[0]), *rows])
        return chebyshev.chebval(2 * time - 1, whole)

    np.testing.assert_allclose(found.means, p.means + series("paths"), atol=1e-13)
    np.testing.assert_allclose(found.quats, p.quats + series("turns"), atol=1e-13)
    np.testing.assert_allclose(
        found.sh[:, 0], p.sh[:, 0] + series("shades"), atol=1e-13
    )
    np.testing.assert_array_equal(found.sh[:, 1:], p.sh[:, 1:])
    z = (time - np.asarray(slots["centres"])) * np.asarray(slots["fades"])
    expected = expit(np.asarray(p.logit_opacities)) * np.exp(-(z**2) / 2)
    np.testing.assert_allclose(
        expit(np.asarray(found.logit_opacities)), expected, 1e-12
    )


def test_an_opacity_fades_at_both_ends_of_its_range():
    logits = jnp.asarray([-80.0, -3.0, 0.0, 5.0, 20.0, 300.0], jnp.float32)
    for loss in (1e-6, 0.5, 30.0):
        found = trajectories.faded(logits, jnp.full(6, loss, jnp.float32))
        exact = expit(np.asarray(logits, float)) * np.exp(-loss)
        np.testing.assert_allclose(expit(np.asarray(found, float)), exact, 2e-6, 1e-36)
    whole = trajectories.faded(logits, jnp.full(6, 1e-9, jnp.float32))
    np.testing.assert_array_equal(whole, logits)
    slope = jax.grad(lambda x: trajectories.faded(jnp.float32(2.0), x))(
        jnp.float32(1e-9)
    )
    assert slope < -1  # a lifetime can be learned from none


def test_a_field_interpolates_its_planes_linearly():
    params, time = params_of("field"), 0.62
    shared = jax.device_get(params.model.shared)
    low, high = shared["box"]
    unit = np.clip(
        (np.asarray(params.gaussians.params.means) - low) / (high - low), 0, 1
    )
    found = []
    for planes, times, cells in zip(shared["planes"], shared["times"], (12, 3, 3)):
        clock = np.linspace(0, 1, times.shape[1])
        space, product = np.linspace(0, 1, cells), np.ones((SLOTS, FIELD.channels))
        for plane, axes in zip(planes, ([0, 1], [0, 2], [1, 2])):
            product *= RegularGridInterpolator((space, space), plane)(unit[:, axes])
        for axis, plane in enumerate(times):
            at = np.stack([np.full(SLOTS, time), unit[:, axis]], -1)
            product *= 1 + RegularGridInterpolator((clock, space), plane)(at)
        found.append(product)
    product = np.concatenate(found, 1)
    d = shared["decoder"]
    hidden = np.maximum(product @ d["first"] + d["first_bias"], 0)
    hidden = np.maximum(hidden @ d["second"] + d["second_bias"], 0)
    change = hidden @ d["last"]
    found, p = field.moved(params, jnp.asarray(time)).params, params.gaussians.params
    means = p.means + 0.25 * change[:, :3] * (high - low).mean()
    np.testing.assert_allclose(found.means, means, atol=1e-12)
    np.testing.assert_allclose(
        found.log_scales, p.log_scales + change[:, 7:10], atol=1e-12
    )
    np.testing.assert_allclose(found.sh[:, 0], p.sh[:, 0] + change[:, 11:], atol=1e-12)


def test_rows_are_summed_alike_by_loops_and_by_scatters():
    rng = np.random.default_rng(0)
    table = jnp.asarray(rng.normal(size=(20, 4)))
    first = jnp.asarray(rng.integers(0, 19, (50, 2)), jnp.int32)
    weights = jnp.asarray(rng.uniform(size=(50, 2, 2)))
    out = jnp.asarray(rng.normal(size=(50, 4)))

    def direct(table):
        rows = table[jnp.stack([first, first + 1], -1)]
        return jnp.sum(rows * weights[..., None], (1, 2))

    loops = partial(weighted_rows, first=first, weights=weights)
    np.testing.assert_allclose(loops(table), direct(table), rtol=1e-13)
    found, expected = (
        jax.grad(lambda t, f=f: jnp.sum(f(t) * out))(table) for f in (loops, direct)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13)
    batch = jax.vmap(loops)(jnp.stack([table, 2 * table]))
    np.testing.assert_allclose(batch[1], 2 * batch[0])


@both
def test_what_is_kept_still_does_not_move_and_the_rest_does(name):
    """Compaction brings each change to its own slot."""
    params = params_of(name)
    moving = jnp.asarray(np.arange(SLOTS) % 3 == 1, float)
    buffers = {**params.model.buffers, "moving": moving}
    held = params._replace(model=params.model._replace(buffers=buffers))
    free, some = (MOVED[name](p, jnp.asarray(0.9)) for p in (params, held))
    rest = params.gaussians
    for a, b, c in zip(*(jax.tree.leaves(x.params) for x in (free, some, rest))):
        np.testing.assert_allclose(a[moving > 0], b[moving > 0], rtol=1e-12)
        np.testing.assert_array_equal(b[moving == 0], c[moving == 0])
    shift = np.abs(free.params.means - rest.params.means)[moving > 0]
    assert shift.max(1).min() > 1e-3


def test_a_field_keeps_what_is_still_where_it_came_to_rest():
    """The changes that still Gaussians get are those at time 0 of the last refresh."""
    params = params_of("field")
    K = np.asarray([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    near = look_at((0, -5.0, 0.0), (0, 0, 0))
    cameras = make_camera(viewmat=near[None], K=K[None], width=64, height=48)
    times = jax.tree.map(jnp.zeros_like, params.model.shared["times"])
    shared = {**params.model.shared, "times": times}
    constant = params._replace(model=params.model._replace(shared=shared))
    refresh = MODELS["field"].refresh
    assert refresh is not None
    buffers = refresh.update(constant, cameras, jnp.asarray(0.9))
    np.testing.assert_array_equal(buffers["moving"], 0)
    held = constant._replace(model=constant.model._replace(buffers=buffers))
    for time in (0.0, 0.8):
        found, wanted = (field.moved(p, jnp.asarray(time)) for p in (held, constant))
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted)):
            np.testing.assert_allclose(a, b, rtol=1e-12)
    assert np.abs(found.params.means - params.gaussians.params.means).max() > 0.01


def test_devices_share_the_work_of_a_field():
    params = params_of("field")
    one, two = (jax.jit(partial(field.moved, devices=d))(params, 0.3) for d in (1, 2))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two)):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_gaussians_that_visibly_change_are_found():
    """A quarter of a pixel of the nearer camera decides, and a 64th of opacity."""
    scene = still(slots=4)
    means = jnp.asarray([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]])
    scene = scene.replace(params=scene.params.replace(means=means))
    K = np.asarray([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    near, far = look_at((0, -5.0, 0.0), (0, 0, 0)), look_at((0, -20.0, 0), (0, 0, 0))
    cameras = make_camera(viewmat=np.stack([near, far]), K=K, width=64, height=48)
    shift = 5 / 50 * jnp.asarray([0.0, 0.2, 0.3, 0.0])  # px of the nearer one
    dim = jnp.asarray([0.01, 0.0, 0.0, 0.5])

    def at(time):
        p = scene.params
        means = p.means.at[:, 2].add(time * shift)
        moved = p.replace(means=means, logit_opacities=p.logit_opacities - time * dim)
        return scene.replace(params=moved)

    found = find_moving(at, scene, cameras)
    np.testing.assert_array_equal(found, [False, False, True, True])
    # Not before the share of the run from which the others are kept still.
    params = params_of("trajectories", at_rest=True)
    for fraction, expected in ((0.4, 1.0), (0.6, 0.0)):
        args = params, cameras, jnp.asarray(fraction)
        moving = refreshed(trajectories.moved, 0.5, *args)
        np.testing.assert_array_equal(moving, expected)


def test_neighbours_are_near():
    rng = np.random.default_rng(1)
    means = jnp.asarray(rng.uniform(size=(400, 3)))
    active = jnp.asarray(np.arange(400) < 350)
    order, near = neighbours(jax.random.key(0), means, active)
    assert sorted(np.asarray(order).tolist()) == list(range(400))
    assert np.asarray(active)[np.asarray(order)][:350].all()
    placed = np.asarray(means)[np.asarray(order)[:350]]
    gaps = np.linalg.norm(np.diff(placed, axis=0), axis=1)
    assert np.median(gaps) < 0.2  # random pairs: 0.66
    assert (near[:349] > 0).all()
    assert (near[349:] == 0).all()
    other, _ = neighbours(jax.random.key(1), means, active)
    assert (order != other).any()


@both
def test_models_of_settings_come_with_their_regularisers(name):
    config = TrainConfig(motion=name, sh_degree=1)
    with pytest.raises(InputError, match="motion"):
        config.replace(mip=True)
    with pytest.raises(InputError, match="one of none"):
        TrainConfig(motion="other")
    model, view = MODELS[name], ViewInfo(jnp.int32(0), jnp.asarray(0.3))
    params, rest = params_of(name), params_of(name, at_rest=True)
    assert scene_of(model, rest).params.means.shape == (SLOTS, 3)
    if name == "trajectories":
        buffers = {**params.model.buffers, "near": jnp.ones(SLOTS)}
        params = params._replace(model=params.model._replace(buffers=buffers))
        slots = params.model.slots
        offsets = [
            np.asarray(trajectories.series(slots[n], view.time)) / unit
            for n, unit in (("paths", 5.0), ("turns", 1), ("shades", 1))
        ]
        gaps = np.abs(np.diff(np.concatenate(offsets, 1), axis=0)).sum()
        wanted = TrajectorySettings().rigidity * gaps / SLOTS
    else:
        planes, times = (params.model.shared[n] for n in ("planes", "times"))
        across = [np.diff(a, axis=k) for a in planes for k in (1, 2)]
        across += [np.diff(a, axis=2) for a in times]
        bend = [np.diff(a, 2, axis=1) for a in times]
        wanted = 1e-4 * sum(np.square(a).mean() for a in across)
        wanted += 0.01 * sum(np.square(a).mean() for a in bend)
    assert model.penalty is not None
    np.testing.assert_allclose(model.penalty(params, view), wanted, rtol=1e-10)
    if name == "trajectories":
        assert float(model.penalty(rest, view)) == 0


def test_shrinkage_keeps_numbers_at_0_unless_their_gradient_is_steady():
    """Adam's update is about the mean over the spread: here 1, and a tenth of that."""
    optimiser = make_optimiser({"x": scale_by_rate(0.01, 0.3)})
    params = {"x": jnp.asarray([0.0, 0.0, 0.5])}
    state = optimiser.init(params)
    rng = np.random.default_rng(0)
    for _ in range(300):
        noise = rng.normal(size=3)
        gradients = {"x": jnp.asarray([-1.0, 0.0, 0.0]) + noise * [0.0, 1.0, 1.0]}
        updates, state = optimiser.update(gradients, state, params, fraction=0.0)
        params = jax.tree.map(lambda p, u: p + u, params, updates)
    steady, noisy, begun = params["x"].tolist()
    assert steady > 1.5
    assert abs(noisy) < 0.15
    assert abs(begun) < 0.15


@both
def test_the_memory_of_a_state_is_estimated_with_its_motion(name):
    config = TrainConfig(motion=name, sh_degree=1)
    setup = make_setup(config, 5.0)
    state = jax.eval_shape(lambda scene: setup_state(setup, scene, 4), still(slots=512))
    numbers = sum(
        leaf.size
        for leaf in jax.tree.leaves(state)
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    )
    assert abs(state_bytes(512, config) / (4 * numbers) - 1) < 0.05


def test_views_are_drawn_up_to_a_time():
    times = np.asarray([0.2, 0.9, 0.5, 0.3, 0.2])
    drawn = np.concatenate([views_until(7, s, 2, times, 0.35) for s in range(99)])
    assert set(drawn.tolist()) == {0, 3, 4}
    assert set(views_until(7, 3, 9, times, 0.0).tolist()) <= {0, 4}
    again = views_until(7, 5, 2, times, 0.35)
    np.testing.assert_array_equal(again, views_until(7, 5, 2, times, 0.35))
    until = MODELS["field"].until
    assert until is not None
    assert until(0.0) < 0.1
    assert until(FIELD.unroll) >= 1
    assert MODELS["trajectories"].until is None
