"""Laws of the training step: pure, guarded, with correct gradients.

Two steps are compiled, by their stages: "plain" (adaptive, photographs with an alpha
channel over random backgrounds, no threshold within reach) and "tuned" (MCMC, two views
a step, padding, corrections of all kinds). The Gaussians of the latter have rates of
zero, so that only the corrections move.
"""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import cast
from training import (
    EXTENT,
    HEIGHT,
    RASTER,
    SMOOTH,
    VIEWS,
    WIDTH,
    changed,
    copy,
    dataset,
    photos,
    rough_start,
    true_gaussians,
)

import gsjax
from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.densify.mcmc import McmcSettings
from gsjax.math.sh import num_bases
from gsjax.train.camera_refinement import refine_camera
from gsjax.train.config import TrainConfig
from gsjax.train.frames import Batch, draw, make_frames, targets, views_of_step
from gsjax.train.losses import photometric
from gsjax.train.optimiser import Rates
from gsjax.train.state import init_state, make_setup
from gsjax.train.step import background_of, make_stages, make_train_step

SLOTS = 96
PLAIN = TrainConfig(
    steps=100,
    sh_degree=2,
    sh_every=3,
    background="random",
    exposure=True,
    adaptive=AdaptiveSettings(start=0, every=2, threshold=1e-9, clone_below=0.05),
    raster=SMOOTH,
)
TUNED = TrainConfig(
    steps=100,
    batch=2,
    sh_degree=0,
    strategy="mcmc",
    mcmc=McmcSettings(start=1000),
    rates=Rates((0.0, 0.0), 0.0, 0.0, 0.0, 0.0, 0.0),
    refine_poses=True,
    refine_intrinsics=True,
    exposure=True,
    pose_rate=1e-3,
    intrinsics_rate=1e-3,
    exposure_rate=5e-3,
    raster=RASTER.replace(pair_capacity=512),
)


def by_stages(config):
    """Return the compiled differentiation, and the step; it donates the state."""
    stages = make_stages(make_setup(config, EXTENT))
    differentiate = jax.jit(stages.differentiate)
    advance = jax.jit(stages.advance, donate_argnums=0)
    edit = jax.jit(stages.edit, donate_argnums=0)

    def step(state, batch):
        state, metrics, due = advance(state, differentiate(state, batch))
        return edit(state, metrics) if due else (state, metrics)

    return differentiate, advance, step


plain_gradients, plain_advance, plain_step = by_stages(PLAIN)
tuned_gradients, _, donating_step = by_stages(TUNED)
alone_gradients, *_ = by_stages(TUNED.replace(skip_masked=False))


def tuned_step(state, batch):
    return donating_step(copy(state), batch)


@cache
def plain_frames():
    opaque = np.full((HEIGHT, WIDTH), 255, np.uint8)
    return make_frames(dataset().views, [p._replace(alpha=opaque) for p in photos()])


def plain_batch(step=0):
    return draw(plain_frames(), views_of_step(0, step, 1, VIEWS))


def plain_state(seed=0):
    gaussians = rough_start(PLAIN.sh_degree, SLOTS)
    state = init_state(gaussians, PLAIN, EXTENT, VIEWS)
    return state.replace(key=jax.random.key(seed))


def run_plain(state, steps):
    """Return state and metrics after a number of steps; the state is kept."""
    state, told = copy(state), []
    for _ in range(steps):
        state, metrics = plain_step(state, plain_batch(state.step))
        told.append(metrics)
    return state, told


def test_the_state_can_be_donated():
    """It holds no buffer twice."""
    state = plain_state()
    plain_step(state, plain_batch())
    assert state.gaussians.params.means.is_deleted()
    for strategy in ("adaptive", "mcmc"):
        config = PLAIN.replace(
            strategy=strategy, refine_poses=True, refine_intrinsics=True
        )
        state = init_state(rough_start(2, SLOTS), config, EXTENT, VIEWS)
        arrays = jax.tree.leaves(replace(state, key=jax.random.key_data(state.key)))
        shards = [s.data for array in arrays for s in array.addressable_shards]
        pointers = [(s.device, s.unsafe_buffer_pointer()) for s in shards]
        assert len(set(pointers)) == len(pointers)


def test_sh_degrees_are_enabled_one_by_one():
    state = plain_state()
    wanted = np.asarray([1, 1, 1, 4, 4, 4, 9])
    for bands in wanted:
        state, _ = plain_step(copy(state), plain_batch(state.step))
        sh = np.asarray(state.gaussians.params.sh[np.asarray(state.gaussians.active)])
        np.testing.assert_array_equal(sh[:, bands:], 0)
        assert (sh[:, :bands] != 0).any((0, 2)).all()
        for moment in (state.moments[0].mu, state.moments[0].nu):
            np.testing.assert_array_equal(moment.gaussians.sh[:, bands:], 0)
    assert bands == num_bases(PLAIN.sh_degree)


def test_the_stages_compose_to_the_step():
    """Which scan and vmap take too; over two edits."""
    steps = 5
    starts = [plain_state(seed) for seed in (3, 4)]
    batches, seeds = (
        jax.tree.map(lambda *a: jnp.stack(a), *trees)
        for trees in (map(plain_batch, range(steps)), starts)
    )
    step = make_train_step(PLAIN, EXTENT)
    both = jax.jit(jax.vmap(lambda state: jax.lax.scan(step, state, batches)))(seeds)
    means = []
    for index, start in enumerate(starts):
        wanted, told = run_plain(start, steps)
        found, metrics = jax.tree.map(lambda a, i=index: a[i], both)
        np.testing.assert_array_equal(found.gaussians.active, wanted.gaussians.active)
        np.testing.assert_array_equal(metrics.wanted, [m.wanted for m in told])
        assert (metrics.wanted > 0).sum() == 2
        for a, b in zip(
            jax.tree.leaves((found.gaussians.params, found.moments, found.stats)),
            jax.tree.leaves((wanted.gaussians.params, wanted.moments, wanted.stats)),
        ):
            # Adam amplifies gradients that are rounding errors.
            assert np.isclose(a, b, rtol=1e-4, atol=1e-6).mean() > 0.98
        np.testing.assert_allclose(metrics.loss, [m.loss for m in told], rtol=1e-6)
        means.append(np.asarray(found.gaussians.params.means))
        assert len(changed(start.gaussians.params, wanted.gaussians.params)) == 5
    assert np.abs(means[0] - means[1]).max() > 0.01  # splits draw from the seed


def test_no_edit_is_due_after_a_step_that_does_not_count():
    state = plain_state().replace(step=jnp.int32(1))
    found = plain_gradients(state, plain_batch())
    for changes, due, moved in (
        ({}, True, None),
        ({"loss": jnp.asarray(jnp.nan)}, False, [".step"]),
        ({"overflowed": jnp.asarray(True)}, False, []),
    ):
        after, metrics, edit = plain_advance(copy(state), found._replace(**changes))
        assert bool(edit) == due
        assert moved is None or changed(state, after) == moved
        assert bool(metrics.finite) == ("loss" not in changes)


def test_numbers_that_would_become_non_finite_are_kept():
    start = plain_state()
    adam, *rest = start.moments
    means = adam.mu.gaussians.means.at[:7, 1].set(1e308)
    gaussians = adam.mu.gaussians.replace(means=means)
    adam = adam._replace(mu=adam.mu._replace(gaussians=gaussians))
    after, (told,) = run_plain(start.replace(moments=(adam, *rest)), 1)
    assert not told.finite
    assert int(told.step) == 1
    states = start, after, run_plain(start, 1)[0]
    before, found, wanted = (np.asarray(s.gaussians.params.means) for s in states)
    np.testing.assert_array_equal(found[:7, 1], before[:7, 1])
    kept = np.zeros_like(before, bool)
    kept[:7, 1] = True
    np.testing.assert_array_equal(found[~kept], wanted[~kept])
    assert (found[~kept] != before[~kept]).sum() > 100


def test_the_statistic_is_the_derivative_by_the_projected_means(report):
    start, batch = plain_state(), plain_batch()
    after, _ = run_plain(start, 1)
    key = jax.random.split(jax.random.fold_in(start.key, 0), 3)[0]
    behind = background_of(PLAIN, False, key, jnp.float64)
    target, _ = targets(batch._replace(background=behind), jnp.float64)
    config = SMOOTH.replace(outputs=("rgb",))

    @jax.jit
    def slopes(gaussians, camera):
        def value(shift):
            view = gsjax.render(gaussians, camera, config, behind, probe=shift)
            return photometric(view.rgb[0], target[0]), view.radii[0]

        def slope(index):
            one = jnp.zeros((1, SLOTS, 2)).at[0, index // 2, index % 2].set(1e-6)
            # A map compiles the renderer once.
            ends, radii = jax.lax.map(lambda s: value(s * one), jnp.array([1.0, -1.0]))
            return (ends[0] - ends[1]) / 2e-6, radii[0]

        return jax.lax.map(slope, jnp.arange(2 * 24))

    found, radii = slopes(start.gaussians, batch.camera)
    found = np.asarray(found).reshape(-1, 2) * (WIDTH / 2, HEIGHT / 2)
    wanted = np.linalg.norm(found, axis=1)
    statistic = np.asarray(after.stats.gradient)[:24]
    assert (wanted > 1e-5).sum() > 15
    error = np.abs(statistic - wanted).max() / wanted.max()
    report("statistic against slopes", error, 1e-4)
    assert error < 1e-4
    np.testing.assert_array_equal(after.stats.views, radii[0] > 0)
    np.testing.assert_allclose(after.stats.radius, radii[0] / WIDTH)


# The tuned program.


@cache
def exact_gaussians():
    return cast(true_gaussians(), jnp.float64)


def tuned_batch(gain=1.0, viewmats=None, K=None):
    """Return two views, with some padding."""
    index = (0, 2)
    views = [dataset().views[i] for i in index]
    taken = [photos()[i].pixels for i in index]
    pixels = np.rint(gain * np.stack(taken)).astype(np.uint8)
    valid = np.ones(pixels.shape[:3], bool)
    valid[:, -3:] = valid[1, :, -5:] = False
    camera = gsjax.make_camera(
        viewmat=np.stack([v.viewmat for v in views] if viewmats is None else viewmats),
        K=views[0].K if K is None else K,
        width=WIDTH,
        height=HEIGHT,
    )
    size = jnp.full((2, 2), jnp.asarray([WIDTH, HEIGHT], jnp.int32))
    return Batch(*map(jnp.asarray, (pixels, valid)), camera, jnp.asarray(index), size)


def tuned_state(gaussians=None):
    gaussians = exact_gaussians() if gaussians is None else gaussians
    return init_state(gaussians, TUNED, EXTENT, VIEWS)


@pytest.mark.parametrize("masked", [False, True])
def test_a_padded_view_is_as_the_view_alone(masked, report):
    """In its gradients and statistics; what is outside has no effect."""
    width, height = 20, 15
    batch = tuned_batch(gain=0.7)
    rows, columns = np.arange(HEIGHT)[:, None] < height, np.arange(WIDTH) < width
    valid = np.broadcast_to(rows & columns & (np.arange(WIDTH) < 14 + 9 * (not masked)),
                            (2, HEIGHT, WIDTH))  # fmt: skip
    size = jnp.full((2, 2), jnp.asarray([width, height], jnp.int32))
    padded = batch._replace(valid=jnp.asarray(valid), size=size)
    alone = batch._replace(
        pixels=batch.pixels[:, :height, :width],
        valid=padded.valid[:, :height, :width],
        camera=batch.camera.replace(width=width, height=height),
        size=None,
    )
    gaussians = exact_gaussians()
    params = gaussians.params.replace(log_scales=gaussians.params.log_scales - 0.5)
    state = tuned_state(gaussians.replace(params=params))
    found, wanted = tuned_gradients(state, padded), alone_gradients(state, alone)
    assert masked == (int(found.pairs) < 0.9 * int(wanted.pairs))
    worst = abs(float(found.loss / wanted.loss) - 1)
    for name in ("by_slots", "by_shared", "by_probe"):
        trees = getattr(found, name), getattr(wanted, name)
        for a, b in zip(*map(jax.tree.leaves, trees), strict=True):
            scale = float(jnp.abs(b).max()) or 1.0
            worst = max(worst, float(jnp.abs(a - b).max()) / scale)
    report(f"padded view, masked {masked}", worst, 1e-10)
    assert worst < 1e-10
    np.testing.assert_array_equal(found.size, wanted.size)
    if not masked:
        np.testing.assert_allclose(found.radii, wanted.radii, rtol=1e-6)
        assert (wanted.radii == 0).any(0).sum() > 10


def test_the_first_step_of_each_correction_is_its_rate():
    start = tuned_state()
    after, metrics = tuned_step(start, tuned_batch(gain=0.7))
    assert metrics.finite
    assert changed(start.gaussians, after.gaussians) == []
    seen, unseen = np.asarray([0, 2]), np.asarray([1, 3])
    for name, rate in (("turns", 1e-3), ("shifts", 1e-3), ("exposures", 5e-3)):
        moved = np.abs(getattr(after.refinement, name))
        np.testing.assert_allclose(moved[seen], rate, rtol=1e-3)
        np.testing.assert_array_equal(moved[unseen], 0)
    np.testing.assert_allclose(np.abs(after.refinement.intrinsics), 1e-3, rtol=1e-3)


def off_by(state, batch):
    """Return the RMS reprojection error of the points in px."""
    camera = refine_camera(batch.camera, state.refinement, batch.view, EXTENT)

    def project(viewmat, K):
        at = dataset().points @ viewmat[:3, :3].T + viewmat[:3, 3]
        return at[:, :2] / at[:, 2:] * np.diag(K)[:2] + K[:2, 2]

    views = [dataset().views[int(i)] for i in batch.view]
    found = map(project, np.asarray(camera.viewmat), np.asarray(camera.K))
    errors = [at - project(v.viewmat, v.K) for at, v in zip(found, views)]
    return np.sqrt(np.mean(np.square(errors)))


@pytest.mark.parametrize("wrong", ["poses", "intrinsics", "exposures"])
def test_corrections_reduce_the_error(wrong, report):
    viewmats = np.stack([dataset().views[i].viewmat for i in (0, 2)])
    K, gain = np.array(dataset().views[0].K), 1.0
    if wrong == "poses":
        error = [[1, 0.02, -0.01], [-0.02, 1, 0.02], [0.01, -0.02, 1]]
        turn, _ = np.linalg.qr(error)
        viewmats[:, :3] = turn * np.sign(np.diag(turn)) @ viewmats[:, :3]
        viewmats[:, :3, 3] += [-0.03, 0.02, 0.04]
    elif wrong == "intrinsics":
        K = K * [[1.06, 1, 1], [1, 0.95, 1], [1, 1, 1]]
        K[0, 2] += 0.5
    else:
        gain = 0.7
    batch = tuned_batch(gain=gain, viewmats=viewmats, K=K)
    state = copy(tuned_state())  # donated
    before, losses = off_by(state, batch), []
    for _ in range(90):
        state, metrics = donating_step(state, batch)
        assert not metrics.overflowed
        losses.append(float(metrics.loss))
    left = np.mean(losses[-5:]) / losses[0]
    report(f"{wrong}, loss left", left, 0.4)
    assert left < 0.4
    if wrong == "exposures":
        affine = np.asarray(state.refinement.exposures)[[0, 2]]
        shown = affine[..., :3] @ np.full(3, 0.5) + 0.5 + affine[..., 3]
        np.testing.assert_allclose(shown, 0.35, atol=0.04)
        return
    after = off_by(state, batch)
    report(f"{wrong}, error left", after / before, 0.4)
    assert before > 0.4
    assert after < 0.4 * before


def test_the_background_has_no_exposure():
    """If photograph and scene are empty, the loss and its gradient are zero."""
    state = plain_state()
    nothing = state.gaussians.replace(active=jnp.zeros(SLOTS, bool))
    rng = np.random.default_rng(0)
    exposures = 0.3 * jnp.asarray(rng.normal(size=(VIEWS, 3, 4)))
    state = state.replace(
        gaussians=nothing, refinement=replace(state.refinement, exposures=exposures)
    )
    batch = plain_batch()
    empty = batch._replace(pixels=batch.pixels.at[..., 3].set(0))
    found = plain_gradients(state, empty)
    assert abs(float(found.loss)) < 1e-12
    assert float(jnp.abs(found.by_shared.refinement.exposures).max()) < 1e-12
    assert float(plain_gradients(state, batch).loss) > 0.01


def test_a_step_that_does_not_count_changes_only_its_number():
    """An overflow changes nothing at all."""
    start = tuned_state()
    # The renderer ignores non-finite Gaussians and cameras.
    exposures = start.refinement.exposures.at[:, 0, 3].set(jnp.inf)
    start = start.replace(refinement=replace(start.refinement, exposures=exposures))
    after, metrics = tuned_step(start, tuned_batch())
    assert (metrics.finite, metrics.overflowed) == (False, False)
    assert changed(start, after) == [".step"]
    assert int(after.step) == int(metrics.step) == 1
    assert metrics.wanted == 0
    gaussians = exact_gaussians()
    params = gaussians.params.replace(log_scales=gaussians.params.log_scales + 4)
    start = tuned_state(gaussians.replace(params=params))
    after, metrics = tuned_step(start, tuned_batch())
    assert metrics.overflowed
    assert metrics.pair_capacity > 512
    assert metrics.step == metrics.wanted == 0
    assert changed(start, after) == []


def test_targets():
    pixels = np.random.default_rng(0).integers(0, 256, (2, 3, 4, 4)).astype(np.uint8)
    behind, valid = jnp.asarray([0.1, 0.5, 0.9]), pixels[..., 0] > 99
    batch = tuned_batch()._replace(pixels=pixels, valid=valid, background=behind)
    found, weight = targets(batch, jnp.float64)
    rgb, alpha = pixels[..., :3] / 255, pixels[..., 3:] / 255
    np.testing.assert_allclose(found, rgb * alpha + behind * (1 - alpha), rtol=1e-12)
    np.testing.assert_array_equal(weight, valid.astype(float))
    opaque = batch._replace(pixels=pixels[..., :3], valid=None)
    found, weight = targets(opaque, jnp.float64)
    np.testing.assert_allclose(found, rgb)
    assert weight is None
