"""Laws of adaptive density control, on scenes of one size."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from slot_scenes import scene_in

from gsjax.densify.adaptive import AdaptiveSettings, AdaptiveStats, adaptive
from gsjax.densify.slots import assign
from gsjax.densify.types import Observation, apply_edit
from gsjax.math.rotations import covariance
from gsjax.train.optimiser import Rates, gaussian_rates, make_optimiser

SLOTS, EXTENT = 24, 10.0
RATES = gaussian_rates(Rates(), EXTENT)
SETTINGS = AdaptiveSettings(start=0, stop=1000, every=10, reset_every=0)

jitted_assign = jax.jit(assign)


@st.composite
def requests(draw):
    """Draw candidates, priorities (with ties), free slots and a limit."""
    flags = st.lists(st.booleans(), min_size=SLOTS, max_size=SLOTS)
    numbers = st.sampled_from([0.0, 1.0, 2.5, -1.0, np.inf, -np.inf, np.nan])
    priority = st.lists(numbers, min_size=SLOTS, max_size=SLOTS)
    limit = st.integers(0, SLOTS + 3)
    return tuple(np.asarray(draw(s)) for s in (flags, priority, flags, limit))


@settings(max_examples=100)
@given(requests())
def test_slots_go_to_the_highest_priority(request):
    """Ties go to the lower slot; NaN comes last."""
    candidates, priority, free, limit = request
    source, chosen = (np.asarray(a) for a in jitted_assign(*request))
    places = np.flatnonzero(candidates)
    ranked = places[np.argsort(-priority[places], kind="stable")]
    count = min(len(ranked), free.sum(), limit)
    got = np.flatnonzero(source < SLOTS)
    assert free[got].all()
    np.testing.assert_array_equal(got, np.flatnonzero(free)[:count])
    np.testing.assert_array_equal(source[got], ranked[:count])
    assert (source[source >= SLOTS] == SLOTS).all()
    np.testing.assert_array_equal(np.flatnonzero(chosen), np.sort(ranked[:count]))


def scene_with(count=16, scales=0.05, opacities=0.5, garbage=0.0):
    """Return ``count`` Gaussians in random slots, with garbage in the others."""
    live = np.sort(np.random.default_rng(0).permutation(SLOTS)[:count])
    active = np.isin(np.arange(SLOTS), live)
    scene = scene_in(active, opacities, scales, spread=0.1, garbage=garbage)
    return scene, live


def stats_with(hot, value=1e-3):
    """Return statistics of three views in which ``hot`` had this gradient."""
    gradient = np.zeros(SLOTS)
    gradient[np.asarray(hot, int)] = 3 * np.broadcast_to(value, len(hot))
    return AdaptiveStats(
        *map(jnp.asarray, (gradient, np.full(SLOTS, 3.0), np.zeros(SLOTS)))
    )


@partial(jax.jit, static_argnums=0)
def planned(config, seed, step, *scene):
    return adaptive(config, EXTENT).plan(jax.random.key(seed), step, *scene)[0]


def plan(gaussians, stats, step=10, seed=0, **changes):
    return planned(replace(SETTINGS, **changes), seed, step, gaussians, stats)


def rows(params, slots):
    return jax.tree.map(lambda a: np.asarray(a)[np.asarray(slots)], params)


def assert_rows_equal(first, slots, second, others, leave_out=()):
    for name, a in vars(rows(first, slots)).items():
        if name not in leave_out:
            np.testing.assert_array_equal(a, getattr(rows(second, others), name), name)


def new_slots(edit, gaussians):
    return np.flatnonzero(np.asarray(edit.active) & ~np.asarray(gaussians.active))


def test_small_gaussians_are_cloned():
    """From a threshold of the mean over the views on, the largest gradient first."""
    gaussians, live = scene_with()
    hot, at, below = live[[2, 5, 6]], live[0], live[1]
    limits = 2e-4 * (1 + 1e-9), 2e-4 * (1 - 1e-9)
    stats = stats_with([*hot, at, below], [2e-3, 1e-3, 3e-3, *limits])
    edit = plan(gaussians, stats)
    born = new_slots(edit, gaussians)
    parents = [*hot[[2, 0, 1]], at]
    free = np.flatnonzero(~np.asarray(gaussians.active))
    np.testing.assert_array_equal(born, free[:4])
    assert_rows_equal(edit.params, live, gaussians.params, live)
    assert_rows_equal(edit.params, born, gaussians.params, parents)
    np.testing.assert_array_equal(np.flatnonzero(edit.cleared), free)
    np.testing.assert_array_equal(edit.source[born], parents)
    assert (np.delete(edit.source, born) == SLOTS).all()
    assert edit.wanted == 20
    assert not edit.opacities_reset
    unseen = AdaptiveStats(stats.gradient * 0, stats.views * 0, stats.radius)
    assert plan(gaussians, unseen).wanted == 16


def test_large_gaussians_are_split():
    gaussians, live = scene_with(scales=0.3)
    hot, params, shifts = live[4], gaussians.params, []
    cov = np.asarray(covariance(params.quats, jnp.exp(params.log_scales)))[hot]
    for seed in range(300):
        edit = plan(gaussians, stats_with([hot]), seed=seed)
        pair = [hot, *new_slots(edit, gaussians)]
        assert len(pair) == 2
        found, parent = rows(edit.params, pair), rows(params, [hot, hot])
        shifts += list(found.means - parent.means)
    shifts = np.asarray(shifts)
    smaller = parent.log_scales - np.log(1.6)
    np.testing.assert_allclose(found.log_scales, smaller, rtol=1e-12)
    assert_rows_equal(edit.params, pair, params, [hot, hot], ["means", "log_scales"])
    assert np.asarray(edit.cleared)[pair].all()
    others = live[live != hot]
    assert_rows_equal(edit.params, others, params, others)
    assert not np.asarray(edit.cleared)[others].any()
    assert edit.wanted == 17
    # The shifts have mean zero and the covariance of the parent; 600 samples.
    whitened = shifts @ np.linalg.inv(np.linalg.cholesky(cov)).T
    assert np.abs(whitened.mean(0)).max() < 4 / np.sqrt(600)
    assert np.abs(np.cov(whitened.T) - np.eye(3)).max() < 4 * np.sqrt(2 / 600)
    assert (shifts[::2] != shifts[1::2]).all()


def test_transparent_and_non_finite_gaussians_are_removed():
    _, live = scene_with()
    gone, opacities = live[[0, 3, 7, 8]], np.full(SLOTS, 0.5)
    opacities[gone] = 0.0049, np.nan, 0.0049, 1e-9
    gaussians, _ = scene_with(opacities=opacities, garbage=np.nan)
    edit = plan(gaussians, stats_with(gone))
    kept = np.setdiff1d(live, gone)
    np.testing.assert_array_equal(np.flatnonzero(edit.active), kept)
    assert_rows_equal(edit.params, kept, gaussians.params, kept)
    assert np.asarray(edit.cleared)[gone].all()
    assert edit.wanted == len(kept)


@pytest.mark.parametrize("by", ["scale", "radius"])
def test_gaussians_are_pruned_by_their_size_after_the_split(by):
    """After the first reset. Densification precedes pruning, as in the paper's code."""
    limit = 0.5
    sizes = np.full(SLOTS, 0.2)
    gaussians, live = scene_with()
    hot, cold, huge = live[:3]
    sizes[[hot, cold, huge]] = 1.2 * limit, 1.2 * limit, 2 * limit
    stats, kwargs = stats_with([hot, huge]), {"reset_every": 100}
    if by == "scale":
        kwargs |= {"prune_scale": limit / EXTENT}
        log_scales = jnp.log(sizes)[:, None].repeat(3, 1)
        params = gaussians.params.replace(log_scales=log_scales)
        gaussians = gaussians.replace(params=params)
    else:
        kwargs |= {"prune_scale": 100.0, "prune_radius": limit, "clone_below": 1e-6}
        stats = stats._replace(radius=jnp.asarray(sizes))
    edit = plan(gaussians, stats, 110, **kwargs)
    born = new_slots(edit, gaussians)
    wanted = gaussians.params.log_scales[hot] - np.log(SETTINGS.shrink)
    assert len(born) == 1
    for slot in (hot, born[0]):
        assert edit.active[slot]
        np.testing.assert_allclose(edit.params.log_scales[slot], wanted, rtol=1e-12)
    assert not edit.active[jnp.asarray([cold, huge])].any()
    for every in (110, 0):  # up to the first reset, and without resets
        early = plan(gaussians, stats, 110, **kwargs | {"reset_every": every})
        assert early.active[live].all()
    # Without a free slot for the split it is too large.
    full = plan(gaussians, stats, 110, max_gaussians=14, **kwargs)
    assert not full.active[hot]
    assert full.wanted == edit.wanted == 15


def test_slots_that_run_out_go_to_the_largest_gradients():
    gaussians, live = scene_with(count=20)
    free = np.flatnonzero(~np.asarray(gaussians.active))
    values = np.linspace(1e-3, 2e-3, 20)[np.random.default_rng(0).permutation(20)]
    edit = plan(gaussians, stats_with(live, values))
    assert edit.active.all()
    best = live[np.argsort(-values)[:4]]
    assert_rows_equal(edit.params, free, gaussians.params, best)
    assert edit.wanted == 40
    gaussians, live = scene_with()
    for most, count in ((18, 18), (16, 16), (7, 16)):
        edit = plan(gaussians, stats_with(live), max_gaussians=most)
        assert edit.active.sum() == count
        assert edit.wanted == 32


def test_revised_opacity_preserves_the_opacity_of_the_pair():
    for scales in (0.05, 0.3):
        opacities = np.linspace(0.02, 0.999, SLOTS)
        gaussians, live = scene_with(scales=scales, opacities=opacities)
        hot = live[[0, 7, 15]]
        edit = plan(gaussians, stats_with(hot), revised_opacity=True)
        born = new_slots(edit, gaussians)
        after = jax.nn.sigmoid(edit.params.logit_opacities)
        np.testing.assert_allclose(
            1 - (1 - after[hot]) * (1 - after[born]), opacities[hot], rtol=1e-9
        )
        others = np.setdiff1d(live, hot)
        assert_rows_equal(edit.params, others, gaussians.params, others)


def test_resets_lower_opacities_and_edits_clear_their_moments_only():
    """One Gaussian is cloned, one is split, and one is removed."""
    _, live = scene_with()
    opacities = np.where(np.arange(SLOTS) % 2 == 0, 0.9, 0.007)
    scales = np.full((SLOTS, 1), 0.05)
    scales[live[1]], opacities[live[2]] = 0.3, 0.001
    gaussians, _ = scene_with(scales=scales, opacities=opacities)
    params, kept = gaussians.params, np.delete(live, [1, 2])
    rng, state = np.random.default_rng(9), make_optimiser(RATES).init(params)
    before = jax.tree.map(lambda a: 0.1 + rng.random(np.shape(a)), state)
    for step, most, lowered in ((190, 1, []), (200, 0.01, ["logit_opacities"])):
        edit = plan(gaussians, stats_with(live[:2]), step, reset_every=100)
        assert edit.opacities_reset == bool(lowered)
        after = np.asarray(jax.nn.sigmoid(edit.params.logit_opacities))[kept]
        np.testing.assert_allclose(after, np.minimum(opacities[kept], most), rtol=1e-9)
        low = kept[kept % 2 == 1]
        assert_rows_equal(edit.params, low, params, low)
        assert_rows_equal(edit.params, kept, params, kept, lowered)
        np.testing.assert_array_equal(np.flatnonzero(~edit.cleared), kept)
        scene, found = apply_edit(edit, before)
        np.testing.assert_array_equal(scene.active, edit.active)
        assert found[0].count == before[0].count
        for name in ("mu", "nu"):
            moment, old = getattr(found[0], name), getattr(before[0], name)
            assert_rows_equal(moment, kept, old, kept, lowered)
            for leaf in jax.tree.leaves(moment):
                assert (leaf[edit.cleared] == 0).all()
            assert (moment.logit_opacities == 0).all() == bool(lowered)


@pytest.mark.parametrize(
    ("every", "reset_every", "resets"),
    [
        (10, 50, [50, 100, 150]),
        # Edits that miss the multiples of reset_every.
        (7, 50, [56, 105, 154]),
        (10, 0, []),
        (60, 50, [60, 120]),  # not at 180, the last edit
    ],
)
def test_steps_of_resets(every, reset_every, resets):
    scene = scene_with()[0], stats_with([])
    config = replace(SETTINGS, stop=200, every=every, reset_every=reset_every)
    due = filter(config.schedule.due, range(1, 201))
    edits = {step: planned(config, 0, step, *scene) for step in due}
    assert [step for step in edits if edits[step].opacities_reset] == resets


def test_statistics_count_visible_views_in_units_of_each_image():
    gaussians, _ = scene_with()
    strategy = adaptive(SETTINGS, EXTENT)
    stats, alone = strategy.init(gaussians), strategy.init(gaussians)
    rng = np.random.default_rng(0)
    sizes = np.asarray([[40, 30], [30, 40]])
    wanted = np.zeros((3, SLOTS))
    for _ in range(3):
        gradient = rng.normal(size=(2, SLOTS, 2))
        radii = np.maximum(rng.normal(size=(2, SLOTS)), 0) * 5
        stats = strategy.observe(stats, Observation(gradient, radii, *sizes.T))
        for one, radius, size in zip(gradient, radii, sizes):
            seen = Observation(one[None], radius[None], *size.tolist())
            alone = strategy.observe(alone, seen)
            wanted[0] += np.hypot(*(one * size / 2).T) * (radius > 0)
            wanted[1] += radius > 0
            wanted[2] = np.maximum(wanted[2], radius / 40)
    for found, one, values in zip(stats, alone, wanted):
        np.testing.assert_allclose(found, values, rtol=1e-12)
        np.testing.assert_allclose(one, values, rtol=1e-12)
    _, fresh = strategy.plan(jax.random.key(0), jnp.int32(10), gaussians, stats)
    assert all((leaf == 0).all() for leaf in fresh)
