"""Laws of the training step: pure, guarded, with correct gradients.

Two programs are compiled: "plain" (adaptive, photographs with an alpha channel over
random backgrounds, no threshold within reach) and "tuned" (MCMC, two views a step,
padding, corrections of all kinds). The Gaussians of the latter have rates of zero, so
that only the corrections move.
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
    bits,
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
from gsjax.train.setup import make_setup
from gsjax.train.state import init_state
from gsjax.train.step import background_of, make_stages, make_train_step

SLOTS = 96
PLAIN = TrainConfig(
    steps=100,
    sh_degree=2,
    sh_every=3,
    background="random",
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

plain_step = jax.jit(make_train_step(PLAIN, EXTENT), donate_argnums=0)
tuned_step = jax.jit(make_train_step(TUNED, EXTENT))


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


def test_the_step_is_pure():
    start = plain_state()
    first, second = (run_plain(start, 3) for _ in range(2))
    assert bits(first) == bits(second)
    moved = changed(start, first[0])
    for name in (".means", ".quats", ".log_scales", ".logit_opacities", ".sh", ".step"):
        assert any(m.endswith(name) for m in moved), name
    assert ".key" not in moved
    assert int(first[0].step) == 3
    # The edit after the second step densifies until slots run out.
    assert [int(m.wanted) for m in first[1]] == [0, 120, 0]
    assert [int(m.gaussians) for m in first[1]] == [60, SLOTS, SLOTS]


def test_the_state_can_be_donated():
    """It holds no buffer twice."""
    state = plain_state()
    after, metrics = plain_step(state, plain_batch())
    assert state.gaussians.params.means.is_deleted()
    jax.block_until_ready((after, metrics))
    kinds = {
        "refine_poses": True, "refine_intrinsics": True, "exposure": True
    }  # fmt: skip
    for strategy in ("adaptive", "mcmc"):
        config = PLAIN.replace(strategy=strategy, **kinds)
        state = init_state(rough_start(2, SLOTS), config, EXTENT, VIEWS)
        arrays = jax.tree.leaves(replace(state, key=jax.random.key_data(state.key)))
        pointers = [
            (shard.device, shard.data.unsafe_buffer_pointer())
            for array in arrays
            for shard in array.addressable_shards
        ]
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


def test_vmap_and_scan_equal_the_loop():
    steps = 3
    starts = [plain_state(seed) for seed in (3, 4)]
    batches = jax.tree.map(
        lambda *a: jnp.stack(a), *(plain_batch(step) for step in range(steps))
    )
    step = make_train_step(PLAIN, EXTENT)
    seeds = jax.tree.map(lambda *a: jnp.stack(a), *starts)
    mapped = jax.vmap(lambda state: jax.lax.scan(step, state, batches))
    both = jax.jit(mapped)(seeds)
    means = []
    for index, start in enumerate(starts):
        wanted, told = run_plain(start, steps)
        found, metrics = jax.tree.map(lambda a, i=index: a[i], both)
        np.testing.assert_array_equal(found.gaussians.active, wanted.gaussians.active)
        for a, b in zip(
            jax.tree.leaves((found.gaussians.params, found.moments, found.stats)),
            jax.tree.leaves((wanted.gaussians.params, wanted.moments, wanted.stats)),
        ):
            # Adam amplifies gradients that are rounding errors.
            assert np.isclose(a, b, rtol=1e-4, atol=1e-6).mean() > 0.98
        np.testing.assert_allclose(metrics.loss, [m.loss for m in told], rtol=1e-6)
        means.append(np.asarray(found.gaussians.params.means))
    assert np.abs(means[0] - means[1]).max() > 0.01  # splits draw from the seed


def test_a_non_finite_loss_changes_only_the_step():
    start = tuned_state()
    # The renderer ignores non-finite Gaussians and cameras.
    exposures = start.refinement.exposures.at[:, 0, 3].set(jnp.inf)
    start = start.replace(refinement=replace(start.refinement, exposures=exposures))
    after, metrics = tuned_step(start, tuned_batch())
    assert not metrics.finite
    assert not metrics.overflowed
    assert changed(start, after) == [".step"]
    assert int(after.step) == int(metrics.step) == 1
    assert metrics.wanted == 0


def test_numbers_that_would_become_non_finite_are_kept():
    start = plain_state()
    adam, *rest = start.moments
    means = adam.mu.gaussians.means.at[:7, 1].set(1e308)
    gaussians = adam.mu.gaussians.replace(means=means)
    adam = adam._replace(mu=adam.mu._replace(gaussians=gaussians))
    moments = (adam, *rest)
    after, told = plain_step(copy(start.replace(moments=moments)), plain_batch())
    assert not told.finite
    assert int(told.step) == 1
    wanted, _ = run_plain(start, 1)
    before, found, wanted = (
        np.asarray(s.gaussians.params.means) for s in (start, after, wanted)
    )
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


def tuned_batch(index=(0, 2), gain=1.0, viewmats=None, K=None, seed=None):
    """Return a batch with some padding."""
    views = [dataset().views[i] for i in index]
    taken = [photos()[i].pixels for i in index]
    pixels = np.rint(gain * np.stack(taken)).astype(np.uint8)
    valid = np.ones(pixels.shape[:3], bool)
    valid[:, -3:] = valid[1, :, -5:] = False
    if seed is not None:
        garbage = np.random.default_rng(seed).integers(0, 256, pixels.shape)
        pixels = np.where(valid[..., None], pixels, garbage).astype(np.uint8)
    camera = gsjax.make_camera(
        viewmat=np.stack([v.viewmat for v in views] if viewmats is None else viewmats),
        K=views[0].K if K is None else K,
        width=WIDTH,
        height=HEIGHT,
    )
    return Batch(*map(jnp.asarray, (pixels, valid)), camera, jnp.asarray(index))


def tuned_state(gaussians=None):
    gaussians = exact_gaussians() if gaussians is None else gaussians
    return init_state(gaussians, TUNED, EXTENT, VIEWS)


def test_padding_has_no_effect():
    start = tuned_state()
    first, second, third = (
        tuned_step(start, tuned_batch(gain=0.7, seed=seed)) for seed in (None, 1, 2)
    )
    assert bits(first) == bits(second) == bits(third)
    assert first[1].loss > 0.01


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


def projected(viewmat, K):
    at = dataset().points @ viewmat[:3, :3].T + viewmat[:3, 3]
    return at[:, :2] / at[:, 2:] * np.diag(K)[:2] + K[:2, 2]


def off_by(start, batch):
    """Return the RMS reprojection error in px."""
    camera = refine_camera(batch.camera, start.refinement, batch.view, EXTENT)
    errors = []
    for at, index in enumerate(batch.view):
        view = dataset().views[int(index)]
        found = projected(np.asarray(camera.viewmat[at]), np.asarray(camera.K[at]))
        errors.append(found - projected(view.viewmat, view.K))
    return np.sqrt(np.mean(np.square(errors)))


@pytest.mark.parametrize("wrong", ["poses", "intrinsics", "exposures"])
def test_corrections_reduce_the_error(wrong, report):
    rng = np.random.default_rng(0)
    viewmats, K, gain = [dataset().views[i].viewmat for i in (0, 2)], None, 1.0
    if wrong == "poses":
        moved = []
        for viewmat in viewmats:
            matrix, _ = np.linalg.qr(np.eye(3) + 0.02 * rng.normal(size=(3, 3)))
            error = np.eye(4)
            error[:3, :3] = matrix * np.sign(np.diag(matrix))
            error[:3, 3] = 0.03 * rng.normal(size=3)
            moved.append(error @ viewmat)
        viewmats = moved
    elif wrong == "intrinsics":
        K = dataset().views[0].K * [[1.06, 1, 1], [1, 0.95, 1], [1, 1, 1]]
        K[0, 2] += 0.5
    else:
        gain = 0.7
    batch = tuned_batch(gain=gain, viewmats=viewmats, K=K)
    state = tuned_state()
    before, told = off_by(state, batch), []
    for _ in range(90):
        state, metrics = tuned_step(state, batch)
        told.append(metrics)
    assert not any(m.overflowed for m in told)
    losses = np.asarray([m.loss for m in told])
    report(f"{wrong}, loss left", losses[-5:].mean() / losses[0], 0.4)
    assert losses[-5:].mean() < 0.4 * losses[0]
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
    config = PLAIN.replace(exposure=True, ssim_weight=0.0)
    state = init_state(rough_start(2, SLOTS), config, EXTENT, VIEWS)
    nothing = state.gaussians.replace(active=jnp.zeros(SLOTS, bool))
    rng = np.random.default_rng(0)
    exposures = 0.3 * jnp.asarray(rng.normal(size=(VIEWS, 3, 4)))
    state = state.replace(
        gaussians=nothing, refinement=replace(state.refinement, exposures=exposures)
    )
    batch = plain_batch()
    empty = batch._replace(pixels=batch.pixels.at[..., 3].set(0))
    differentiate = jax.jit(make_stages(make_setup(config, EXTENT)).differentiate)
    found = differentiate(state, empty)
    assert float(found.loss) < 1e-12
    by = found.by_shared.refinement.exposures
    assert float(jnp.abs(by).max()) == 0
    assert float(differentiate(state, batch).loss) > 0.01


def test_an_overflow_changes_nothing():
    gaussians = exact_gaussians()
    params = gaussians.params.replace(log_scales=gaussians.params.log_scales + 4)
    start = tuned_state(gaussians.replace(params=params))
    batch = tuned_batch()
    after, metrics = tuned_step(start, batch)
    assert metrics.overflowed
    assert metrics.pair_capacity > 512
    assert metrics.step == metrics.wanted == 0
    assert changed(start, after) == []


def test_targets():
    pixels = np.random.default_rng(0).integers(0, 256, (2, 3, 4, 4)).astype(np.uint8)
    behind = jnp.asarray([0.1, 0.5, 0.9])
    batch = tuned_batch()._replace(
        pixels=jnp.asarray(pixels), valid=None, background=behind
    )
    found, weight = targets(batch, jnp.float64)
    rgb, alpha = pixels[..., :3] / 255, pixels[..., 3:] / 255
    np.testing.assert_allclose(found, rgb * alpha + behind * (1 - alpha), rtol=1e-12)
    assert weight is None
    opaque = batch._replace(pixels=jnp.asarray(pixels[..., :3]))
    np.testing.assert_allclose(targets(opaque, jnp.float64)[0], rgb)
    valid = pixels[..., 0] > 99
    _, weight = targets(batch._replace(valid=jnp.asarray(valid)), jnp.float32)
    np.testing.assert_array_equal(weight, valid.astype(np.float32))


@pytest.mark.parametrize("strategy", ["adaptive", "mcmc"])
@pytest.mark.parametrize("absgrad", [False, True])
def test_dtypes_are_kept(strategy, absgrad):
    config = PLAIN.replace(
        strategy=strategy, adaptive=replace(PLAIN.adaptive, absgrad=absgrad)
    )
    for dtype in (jnp.float32, jnp.float64):
        gaussians = cast(rough_start(2, SLOTS), dtype)
        state = init_state(gaussians, config, EXTENT, VIEWS)
        after, _ = jax.eval_shape(make_train_step(config, EXTENT), state, plain_batch())
        for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(after)):
            assert (a.shape, a.dtype) == (b.shape, b.dtype)
