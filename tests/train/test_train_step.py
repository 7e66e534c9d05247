"""The train step as a function: pure, safe, and learning what it says it learns.

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
    photos,
    rough_start,
    scene,
    true_gaussians,
)

import gsjax
import gsjax.train.step as step_module
from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.densify.mcmc import McmcSettings
from gsjax.math.sh import num_bases
from gsjax.train.camera_refinement import CameraRefinement, exposed, refine_camera
from gsjax.train.config import TrainConfig
from gsjax.train.frames import Batch, draw, make_frames, views_of_step
from gsjax.train.losses import photometric
from gsjax.train.optimiser import Rates
from gsjax.train.state import gradients_like, init_state
from gsjax.train.step import background_of, make_stages, make_train_step, targets

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
    return make_frames(scene().views, [p._replace(alpha=opaque) for p in photos()])


def plain_batch(step=0):
    return draw(plain_frames(), views_of_step(0, step, 1, VIEWS))


def plain_state(seed=0):
    gaussians = rough_start(PLAIN.sh_degree, SLOTS)
    state = init_state(gaussians, PLAIN, EXTENT, VIEWS)
    return state.replace(key=jax.random.key(seed))


def run_plain(state, steps):
    """State and metrics after so many, from copies: each call is given its own."""
    state, told = copy(state), []
    for _ in range(steps):
        state, metrics = plain_step(state, plain_batch(state.step))
        told.append(metrics)
    return state, told


def test_is_a_function():
    start = plain_state()
    first, second = (run_plain(start, 3) for _ in range(2))
    assert bits(first) == bits(second)
    moved = changed(start, first[0])
    for name in (".means", ".quats", ".log_scales", ".logit_opacities", ".sh", ".step"):
        assert any(m.endswith(name) for m in moved), name
    assert ".key" not in moved
    assert int(first[0].step) == 3
    # The edit after the second step: everything is hot, until slots run out.
    assert [int(m.wanted) for m in first[1]] == [0, 120, 0]
    assert [int(m.gaussians) for m in first[1]] == [60, SLOTS, SLOTS]


def test_all_that_is_visible_has_room():
    """Metrics tell of pairs alone, so a room for what is visible is not used."""
    state, batch = plain_state(), plain_batch()
    few = PLAIN.raster.replace(visible_capacity=3)
    wanted = jax.make_jaxpr(make_train_step(PLAIN, EXTENT))(state, batch)
    for step in (
        make_train_step(PLAIN, EXTENT, few),
        make_train_step(PLAIN.replace(raster=few), EXTENT),
    ):
        assert str(jax.make_jaxpr(step)(state, batch)) == str(wanted)


def test_stages_one_by_one_are_the_step():
    """As a run takes them, over two edits; none is due where nothing was learnt."""
    stages = make_stages(PLAIN, EXTENT)
    differentiate, advance, edit = map(jax.jit, stages)

    def one_by_one(state, batch):
        found = differentiate(state, batch)
        like = gradients_like(state, 1)
        assert jax.tree.map(lambda a: (a.shape, a.dtype), found) == jax.tree.map(
            lambda a: (a.shape, a.dtype), like
        )
        state, metrics, due = advance(state, found)
        return edit(state, metrics) if due else (state, metrics)

    state, edits = plain_state(), 0
    for step in range(5):
        batch = plain_batch(step)
        wanted = plain_step(copy(state), batch)
        found = one_by_one(state, batch)
        for a, b in zip(*map(jax.tree.leaves, (found, wanted)), strict=True):
            if not jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
                np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
        state, metrics = found
        edits += int(metrics.wanted) > 0
    assert edits == 2
    gradients = differentiate(state, batch)  # step 5: behind it an edit is due
    nan, full = jnp.asarray(jnp.nan), jnp.asarray(True)
    skipped, metrics, due = advance(state, gradients._replace(loss=nan))
    assert (changed(state, skipped), bool(due)) == ([".step"], False)
    assert not metrics.finite
    kept, metrics, due = advance(state, gradients._replace(overflowed=full))
    assert (changed(state, kept), bool(due)) == ([], False)
    assert metrics.overflowed
    *_, due = advance(state, gradients)
    assert due


@pytest.mark.parametrize("strategy", ["adaptive", "mcmc"])
@pytest.mark.parametrize("batch", [1, 2])
def test_shapes_of_gradients(strategy, batch):
    """Also where cameras are wider than what is learnt, and pictures of all sizes."""
    config = TUNED.replace(strategy=strategy, batch=batch)
    config = config.replace(adaptive=replace(config.adaptive, absgrad=True))
    state = init_state(rough_start(0, SLOTS), config, EXTENT, VIEWS)
    narrow = jax.tree.map(
        lambda a: a.astype(jnp.float32) if a.dtype == jnp.float64 else a, state
    )
    stages = make_stages(config, EXTENT)
    views = jnp.zeros(batch, jnp.int32)
    sizes = jnp.full((batch, 2), 8, jnp.int32)
    for begun in (state, narrow):
        seen = draw(plain_frames(), views)._replace(size=sizes)
        found = jax.eval_shape(stages.differentiate, begun, seen)
        assert found == gradients_like(begun, batch)
        after, *_ = jax.eval_shape(stages.advance, begun, found)
        assert after == jax.eval_shape(lambda s: s, begun)


def test_its_state_may_be_donated():
    """None of its arrays is in it twice; what was given is gone afterwards."""
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
        held = [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(
            replace(state, key=jax.random.key_data(state.key))
        )]  # fmt: skip
        assert len(set(held)) == len(held)


def test_bands_join_one_by_one():
    state = plain_state()
    wanted = np.asarray([1, 1, 1, 4, 4, 4, 9])
    for bands in wanted:
        state, _ = plain_step(copy(state), plain_batch(state.step))
        sh = np.asarray(state.gaussians.params.sh[np.asarray(state.gaussians.active)])
        np.testing.assert_array_equal(sh[:, bands:], 0)
        assert (sh[:, :bands] != 0).any((0, 2)).all()
        for moment in (state.moments.mu.sh, state.moments.nu.sh):
            np.testing.assert_array_equal(moment[:, bands:], 0)
    assert bands == num_bases(PLAIN.sh_degree)


def test_mapped_over_seeds_and_scanned_equals_the_loop():
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
            # Adam makes full steps of gradients that are nothing but rounding.
            assert np.isclose(a, b, rtol=1e-4, atol=1e-6).mean() > 0.98
        np.testing.assert_allclose(metrics.loss, [m.loss for m in told], rtol=1e-6)
        means.append(np.asarray(found.gaussians.params.means))
    assert np.abs(means[0] - means[1]).max() > 0.01  # splits draw from the seed


def test_what_is_not_finite_changes_only_the_step():
    start = tuned_state()
    # Of a scene and its cameras the renderer leaves out what is not finite.
    exposures = start.refinement.exposures.at[:, 0, 3].set(jnp.inf)
    start = start.replace(refinement=replace(start.refinement, exposures=exposures))
    after, metrics = tuned_step(start, tuned_batch())
    assert not metrics.finite
    assert not metrics.overflowed
    assert changed(start, after) == [".step"]
    assert int(after.step) == int(metrics.step) == 1
    assert metrics.wanted == 0


def test_a_step_out_of_the_numbers_is_not_made():
    """By what it would take out alone; and it is told."""
    start = plain_state()
    mu = start.moments.mu
    mu = mu.replace(means=mu.means.at[:7, 1].set(1e308))
    after, told = plain_step(
        copy(start.replace(moments=start.moments._replace(mu=mu))), plain_batch()
    )
    assert not told.finite
    assert int(told.step) == 1
    wanted, _ = run_plain(start, 1)
    before, found, wanted = (
        np.asarray(s.gaussians.params.means) for s in (start, after, wanted)
    )
    np.testing.assert_array_equal(found[:7, 1], before[:7, 1])
    held = np.zeros_like(before, bool)
    held[:7, 1] = True
    np.testing.assert_array_equal(found[~held], wanted[~held])
    assert (found[~held] != before[~held]).sum() > 100


@pytest.mark.new_emitters
def test_guards_change_no_bit_where_nothing_is_wrong(monkeypatch):
    start = plain_state()
    wanted, told = run_plain(start, 3)
    assert all(m.finite for m in told)
    monkeypatch.setattr(step_module, "all_within", lambda *_: jnp.asarray(True))
    monkeypatch.setattr(
        step_module, "_still_numbers", lambda _, params: (jnp.asarray(True), params)
    )
    unguarded = jax.jit(make_train_step(PLAIN, EXTENT), donate_argnums=0)
    state = copy(start)
    for _ in range(3):
        state, metrics = unguarded(state, plain_batch(state.step))
    assert changed(state, wanted) == []
    assert bits(metrics) == bits(told[-1])


def test_the_statistic_is_the_slope_by_a_shift_of_the_projection(report):
    start, batch = plain_state(), plain_batch()
    after, _ = run_plain(start, 1)
    # As the step derives it.
    key = jax.random.split(jax.random.fold_in(start.key, 0), 3)[0]
    behind = background_of(PLAIN, False, key, jnp.float64)
    target, _ = targets(batch, behind, jnp.float64)
    config = SMOOTH.replace(outputs=("rgb",))

    @jax.jit
    def slopes(gaussians, camera):
        def value(shift):
            view = gsjax.render(gaussians, camera, config, behind, probe=shift)
            return photometric(view.rgb[0], target[0]), view.radii[0]

        def slope(index):
            one = jnp.zeros((1, SLOTS, 2)).at[0, index // 2, index % 2].set(1e-6)
            # Both ends in a map, so that the renderer is compiled once.
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
    """Photographs of views, some pixels padding, of cameras as told."""
    views = [scene().views[i] for i in index]
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


def test_padding_does_not_matter():
    start = tuned_state()
    first, second, third = (
        tuned_step(start, tuned_batch(gain=0.7, seed=seed)) for seed in (None, 1, 2)
    )
    assert bits(first) == bits(second) == bits(third)
    assert first[1].loss > 0.01


def test_a_padded_view_gives_the_statistic_of_the_view_alone():
    """In units of its own size; what the padding alone would show is not seen."""
    size = width, height = 20, 15
    config = TUNED.replace(
        strategy="adaptive", adaptive=AdaptiveSettings(), raster=RASTER
    )
    views = scene().views[:2]
    taken = [p._replace(pixels=255 - p.pixels) for p in photos()[:2]]
    taken[1] = taken[1]._replace(pixels=taken[1].pixels[:height, :width])
    params = exact_gaussians().params
    params = params.replace(log_scales=params.log_scales - 1.5)
    state = init_state(exact_gaussians().replace(params=params), config, EXTENT, VIEWS)
    step = jax.jit(make_train_step(config, EXTENT))

    def stats(batch):
        after, metrics = step(state, batch)
        assert metrics.finite
        return after.stats

    frames = make_frames(views, taken)
    assert frames.size.tolist() == [[WIDTH, HEIGHT], [*size]]
    second = jax.tree.map(lambda a: a[1:], frames)
    index = jnp.ones(1, jnp.int32)
    batch = Batch(second.pixels, second.valid, second.camera, index, second.size)
    alone = make_frames(views[1:], taken[1:])
    assert alone.size is None
    wanted = stats(Batch(alone.pixels, alone.valid, alone.camera, index))
    found, frame = stats(batch), stats(batch._replace(size=None))
    assert (frame.views != wanted.views).any(), "some are in the padding alone"
    np.testing.assert_array_equal(found.views, wanted.views)
    np.testing.assert_allclose(found.radius, wanted.radius, rtol=1e-9)
    np.testing.assert_allclose(found.gradient, wanted.gradient, rtol=1e-6, atol=1e-15)
    assert (wanted.gradient > 1e-4).sum() > 15
    assert (frame.gradient > 1.05 * wanted.gradient).sum() > 15


def test_masked_tiles_are_skipped_and_nothing_else_changes(report):
    """All that was gathered in the moments: Adam's step itself makes much of little."""
    config = TUNED.replace(rates=Rates())
    batch = tuned_batch(gain=0.7)
    valid = np.asarray(batch.valid) & (np.arange(batch.valid.shape[2]) < 20)
    batch = batch._replace(valid=jnp.asarray(valid))
    start = tuned_state(rough_start(0, 64))
    (one, told), (other, more) = (
        jax.jit(make_train_step(config.replace(skip_masked=skip), EXTENT))(start, batch)
        for skip in (True, False)
    )
    assert int(told.pairs) < 0.9 * int(more.pairs)
    assert float(jnp.abs(one.moments.mu.means).max()) > 0
    worst = abs(float(told.loss / more.loss) - 1)
    gathered = ((s.moments.mu, s.refinement_moments.mu) for s in (one, other))
    for a, b in zip(*map(jax.tree.leaves, gathered), strict=True):
        scale = float(jnp.abs(b).max()) or 1.0
        worst = max(worst, float(jnp.abs(a - b).max()) / scale)
    report("gradients with masked tiles and without", worst, 1e-10)
    assert worst < 1e-10


def test_a_step_of_each_correction():
    """Adam's first step is the rate: wherever a gradient is, and nowhere else."""
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
    at = scene().points @ viewmat[:3, :3].T + viewmat[:3, 3]
    return at[:, :2] / at[:, 2:] * np.diag(K)[:2] + K[:2, 2]


def off_by(start, batch):
    """px, root mean square, between where points fall and where they did truly."""
    camera = refine_camera(batch.camera, start.refinement, batch.view, EXTENT)
    errors = []
    for at, index in enumerate(batch.view):
        view = scene().views[int(index)]
        found = projected(np.asarray(camera.viewmat[at]), np.asarray(camera.K[at]))
        errors.append(found - projected(view.viewmat, view.K))
    return np.sqrt(np.mean(np.square(errors)))


@pytest.mark.parametrize("wrong", ["poses", "intrinsics", "exposures"])
def test_corrections_go_the_right_way(wrong, report):
    rng = np.random.default_rng(0)
    viewmats, K, gain = [scene().views[i].viewmat for i in (0, 2)], None, 1.0
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
        K = scene().views[0].K * [[1.06, 1, 1], [1, 0.95, 1], [1, 1, 1]]
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


def test_what_shows_through_a_photograph_has_no_exposure():
    """It is ours, and the same behind the picture: where both are nothing, a random
    background tells nothing of the exposure."""
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
    differentiate = jax.jit(make_stages(config, EXTENT).differentiate)
    found = differentiate(state, empty)
    assert float(found.loss) < 1e-12
    by = found.by_refinement.exposures
    assert float(jnp.abs(by).max()) == 0
    assert float(differentiate(state, batch).loss) > 0.01


def test_exposures_of_what_is_half_there():
    """An affine map of its colour, whatever share of it shows."""
    rng = np.random.default_rng(0)
    affine, colours = rng.normal(size=(2, 3, 4)), rng.uniform(size=(1, 5, 4, 3))
    alphas = rng.uniform(size=(1, 5, 4))
    refinement, index = (
        CameraRefinement(exposures=jnp.asarray(affine)),
        jnp.asarray([1]),
    )
    found = exposed(jnp.asarray(colours * alphas[..., None]), refinement, index, alphas)
    mapped = colours + colours @ affine[1, :, :3].T + affine[1, :, 3]
    np.testing.assert_allclose(found, mapped * alphas[..., None], atol=1e-12)
    whole = exposed(jnp.asarray(colours), refinement, index)
    np.testing.assert_allclose(whole, mapped, atol=1e-12)


def test_an_overflow_changes_nothing_and_says_so():
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
    batch = tuned_batch()._replace(pixels=jnp.asarray(pixels), valid=None)
    found, weight = targets(batch, behind, jnp.float64)
    rgb, alpha = pixels[..., :3] / 255, pixels[..., 3:] / 255
    np.testing.assert_allclose(found, rgb * alpha + behind * (1 - alpha), rtol=1e-12)
    assert weight is None
    opaque = batch._replace(pixels=jnp.asarray(pixels[..., :3]))
    np.testing.assert_allclose(targets(opaque, behind, jnp.float64)[0], rgb)
    valid = pixels[..., 0] > 99
    _, weight = targets(batch._replace(valid=jnp.asarray(valid)), behind, jnp.float32)
    np.testing.assert_array_equal(weight, valid.astype(np.float32))


def test_backgrounds():
    def behind(name, transparent, key):
        config = TUNED.replace(background=name)
        return background_of(config, transparent, key, jnp.float32)

    key = jax.random.key(0)
    for name, value in (("black", 0.0), ("white", 1.0)):
        for transparent in (False, True):
            found = behind(name, transparent, key)
            assert found.tolist() == [value] * 3
            assert found.dtype == jnp.float32
    drawn = jax.vmap(lambda k: behind("random", False, k))(jax.random.split(key, 500))
    assert drawn[0].tolist() != drawn[1].tolist()
    # A photograph that can tell nothing from black is put over what cannot be learnt.
    assert behind("auto", False, key).tolist() == [0] * 3
    for name in ("auto", "random"):
        assert behind(name, True, key).tolist() == behind("random", False, key).tolist()
    assert drawn.min() >= 0
    assert drawn.max() <= 1
    np.testing.assert_allclose(drawn.mean(0), 0.5, atol=0.06)
    assert (np.abs(np.corrcoef(drawn.T)[~np.eye(3, dtype=bool)]) < 0.2).all()


def test_the_random_background_is_behind_photographs_too():
    """Where a photograph is transparent and nothing is, every colour is right."""
    batch = plain_batch()
    clear = batch._replace(pixels=batch.pixels.at[..., 3].set(0))
    losses = []
    for seed in range(3):
        state = plain_state(seed)
        gaussians = state.gaussians.replace(active=state.gaussians.active & False)
        state = state.replace(gaussians=gaussians)
        assert plain_step(copy(state), clear)[1].loss < 1e-12
        losses.append(float(plain_step(state, batch)[1].loss))
    assert len(set(losses)) == 3
    assert min(losses) > 0.05


@pytest.mark.parametrize("strategy", ["adaptive", "mcmc"])
@pytest.mark.parametrize("absgrad", [False, True])
def test_float32_stays_with_x64(strategy, absgrad):
    """Traced only: the step gives back what it was given, leaf by leaf."""
    config = PLAIN.replace(
        strategy=strategy, adaptive=replace(PLAIN.adaptive, absgrad=absgrad)
    )
    for dtype in (jnp.float32, jnp.float64):
        gaussians = cast(rough_start(2, SLOTS), dtype)
        state = init_state(gaussians, config, EXTENT, VIEWS)
        after, _ = jax.eval_shape(make_train_step(config, EXTENT), state, plain_batch())
        for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(after)):
            assert (a.shape, a.dtype) == (b.shape, b.dtype)


def test_every_view_once_an_epoch():
    frames = plain_frames()
    for batch in (1, 3):
        order = []
        for step in range(8):
            drawn = draw(frames, views_of_step(5, step, batch, VIEWS))
            order += drawn.view.tolist()
            np.testing.assert_array_equal(drawn.pixels, frames.pixels[drawn.view])
            np.testing.assert_array_equal(
                drawn.camera.viewmat, frames.camera.viewmat[drawn.view]
            )
        epochs = np.asarray(order[: len(order) // VIEWS * VIEWS]).reshape(-1, VIEWS)
        assert (np.sort(epochs, axis=1) == np.arange(VIEWS)).all()
        assert len({tuple(e) for e in epochs}) > 1


def test_frames_of_several_sizes_are_padded():
    first, second = photos()[:2]
    K = np.asarray([[30.0, 0, 10], [0, 31, 8], [0, 0, 1]])
    small = second._replace(pixels=second.pixels[:20, :30], K=K)
    views = scene().views[:2]
    frames = make_frames(views, [first, small])
    assert frames.pixels.shape == (2, HEIGHT, WIDTH, 3)
    np.testing.assert_array_equal(frames.pixels[1, :20, :30], small.pixels)
    assert frames.valid[0].all()
    assert frames.valid[1].sum() == 20 * 30
    np.testing.assert_allclose(frames.camera.K[1], K)
    half = make_frames(views, [first, small], 2)
    assert half.pixels.shape == (2, 12, 16, 3)
    assert half.valid[1].sum() == 10 * 15
    np.testing.assert_allclose(half.camera.K[1], np.diag([0.5, 0.5, 1]) @ K)
    wanted = first.pixels.reshape(12, 2, 16, 2, 3).mean((1, 3))
    assert np.abs(half.pixels[0] - wanted).max() <= 0.76  # OpenCV rounds
    clear = small._replace(alpha=np.full((20, 30), 9, np.uint8))
    mixed = make_frames(views, [first, clear])
    assert mixed.pixels.shape[-1] == 4
    assert (mixed.pixels[0, ..., 3] == 255).all()
    assert (mixed.pixels[1, :20, :30, 3] == 9).all()
    assert make_frames(views, [first, second]).valid is None
