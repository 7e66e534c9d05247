"""Laws of adaptive density control, on scenes of one size."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gsjax
from gsjax.densify.adaptive import AdaptiveSettings, AdaptiveStats, adaptive
from gsjax.densify.slots import assign
from gsjax.densify.types import Observation, apply_edit
from gsjax.math.rotations import covariance
from gsjax.train.optimiser import Rates, gaussian_rates, make_optimiser

SLOTS, EXTENT = 24, 10.0
SETTINGS = AdaptiveSettings(start=0, stop=1000, every=10, reset_every=0)
GARBAGE = (np.nan, np.inf, -1e30)

jitted_assign = jax.jit(assign)


@st.composite
def requests(draw):
    """Draw candidates, priorities (with ties), free slots and a limit."""
    flags = st.lists(st.booleans(), min_size=SLOTS, max_size=SLOTS)
    numbers = st.sampled_from([0.0, 1.0, 2.5, -1.0, np.inf, -np.inf, np.nan])
    priority = st.lists(numbers, min_size=SLOTS, max_size=SLOTS)
    limit = st.integers(0, SLOTS + 3)
    return tuple(np.asarray(draw(s)) for s in (flags, priority, flags, limit))


@settings(max_examples=100, deadline=None)
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


def scene_with(seed=0, count=16, scales=0.05, opacities=0.5, garbage=0.0):
    """Return ``count`` Gaussians in random slots, with garbage in the others."""
    rng = np.random.default_rng(seed)
    live = np.sort(rng.permutation(SLOTS)[:count])
    active = np.isin(np.arange(SLOTS), live)
    opacities = np.broadcast_to(opacities, SLOTS)
    fields = {
        "means": rng.normal(size=(SLOTS, 3)),
        "quats": rng.normal(size=(SLOTS, 4)),
        "log_scales": np.log(np.broadcast_to(scales, (SLOTS, 3)))
        + 0.1 * rng.normal(size=(SLOTS, 3)),
        "logit_opacities": np.log(opacities) - np.log1p(-opacities),
        "sh": rng.normal(size=(SLOTS, 4, 3)),
    }
    for value in fields.values():
        value[~active] = garbage
    made = gsjax.make_gaussians(**fields)
    return made.replace(active=jnp.asarray(active)), live


def stats_with(hot, value=1e-3):
    """Return statistics of three views in which ``hot`` had this gradient."""
    gradient = np.zeros(SLOTS)
    gradient[np.asarray(hot, int)] = 3 * np.broadcast_to(value, len(hot))
    return AdaptiveStats(
        *map(jnp.asarray, (gradient, np.full(SLOTS, 3.0), np.zeros(SLOTS)))
    )


def planned(config, key, step, gaussians, stats):
    return adaptive(config, EXTENT).plan(key, step, gaussians, stats)[0]


jitted_planned = jax.jit(planned, static_argnums=0)


def plan(gaussians, stats, step=10, seed=0, **changes):
    config = AdaptiveSettings(**{**vars(SETTINGS), **changes})
    return planned(config, jax.random.key(seed), jnp.int32(step), gaussians, stats)


def rows(params, slots):
    return jax.tree.map(lambda a: np.asarray(a)[np.asarray(slots)], params)


def assert_rows_equal(first, slots, second, others, leave_out=()):
    for name, a in vars(rows(first, slots)).items():
        if name not in leave_out:
            np.testing.assert_array_equal(a, getattr(rows(second, others), name), name)


def new_slots(edit, gaussians):
    return np.flatnonzero(np.asarray(edit.active) & ~np.asarray(gaussians.active))


def test_small_gaussians_are_cloned():
    gaussians, live = scene_with()
    hot = live[[2, 5, 6]]
    edit = plan(gaussians, stats_with(hot, [2e-3, 1e-3, 3e-3]))
    born = new_slots(edit, gaussians)
    free = np.flatnonzero(~np.asarray(gaussians.active))
    np.testing.assert_array_equal(born, free[:3])
    assert_rows_equal(edit.params, live, gaussians.params, live)
    assert_rows_equal(edit.params, born, gaussians.params, hot[[2, 0, 1]])
    np.testing.assert_array_equal(np.flatnonzero(edit.cleared), np.sort(free))
    np.testing.assert_array_equal(edit.source[born], hot[[2, 0, 1]])
    assert (np.delete(edit.source, born) == SLOTS).all()
    assert edit.wanted == 19
    assert not edit.opacities_reset


def test_large_gaussians_are_split():
    gaussians, live = scene_with(scales=0.3)
    hot = live[4]
    cov = np.asarray(
        covariance(gaussians.params.quats, jnp.exp(gaussians.params.log_scales))
    )[hot]
    shifts = []
    for seed in range(300):
        given = jax.random.key(seed), jnp.int32(10), gaussians, stats_with([hot])
        edit = jitted_planned(SETTINGS, *given)
        (born,) = new_slots(edit, gaussians)
        pair = [hot, born]
        found, parent = rows(edit.params, pair), rows(gaussians.params, [hot, hot])
        shifts += list(found.means - parent.means)
    shifts = np.asarray(shifts)
    np.testing.assert_allclose(
        found.log_scales, parent.log_scales - np.log(1.6), rtol=1e-12
    )
    same = ("quats", "logit_opacities", "sh")
    for name in same:
        np.testing.assert_array_equal(getattr(found, name), getattr(parent, name))
    assert edit.cleared[hot]
    assert edit.cleared[born]
    others = live[live != hot]
    assert_rows_equal(edit.params, others, gaussians.params, others)
    assert not np.asarray(edit.cleared)[others].any()
    assert edit.wanted == 17
    # The shifts have mean zero and the covariance of the parent; 600 samples.
    whitened = shifts @ np.linalg.inv(np.linalg.cholesky(cov)).T
    assert np.abs(whitened.mean(0)).max() < 4 / np.sqrt(600)
    assert np.abs(np.cov(whitened.T) - np.eye(3)).max() < 4 * np.sqrt(2 / 600)
    assert (shifts[::2] != shifts[1::2]).all()


def test_the_threshold_applies_to_the_mean_over_views():
    gaussians, live = scene_with()
    at, below = live[:2]
    stats = stats_with([at, below], [2e-4 * (1 + 1e-9), 2e-4 * (1 - 1e-9)])
    edit = plan(gaussians, stats)
    assert edit.wanted == 17
    (born,) = new_slots(edit, gaussians)
    assert_rows_equal(edit.params, [born], gaussians.params, [at])
    unseen = AdaptiveStats(stats.gradient * 0, stats.views * 0, stats.radius)
    assert plan(gaussians, unseen).wanted == 16


def test_transparent_and_non_finite_gaussians_are_removed():
    opacities = np.full(SLOTS, 0.5)
    opacities[::3] = 0.0049
    gaussians, live = scene_with(opacities=opacities, garbage=np.nan)
    gone = live[live % 3 == 0]
    kept = live[live % 3 != 0]
    logits = gaussians.params.logit_opacities.at[kept[3]].set(np.nan)
    params = gaussians.params.replace(logit_opacities=logits)
    gone, kept = [*gone, kept[3]], np.delete(kept, 3)
    edit = plan(gaussians.replace(params=params), stats_with(gone))
    np.testing.assert_array_equal(np.flatnonzero(edit.active), kept)
    assert_rows_equal(edit.params, kept, gaussians.params, kept)
    assert np.asarray(edit.cleared)[gone].all()
    assert edit.wanted == len(kept)
    assert 3 < len(kept) < 16


def test_large_gaussians_are_removed_after_the_first_reset():
    scales = np.full((SLOTS, 1), 0.05)
    scales[::4] = 3.0
    gaussians, live = scene_with(scales=scales)
    large = live[live % 4 == 0]
    assert 2 < len(large) < 10
    for step, every, expected in ((100, 100, 0), (110, 100, 1), (500, 0, 0)):
        edit = plan(gaussians, stats_with([]), step, reset_every=every)
        assert edit.wanted == 16 - expected * len(large)
        assert np.asarray(edit.active)[large].all() == (not expected)
    wide = stats_with([])._replace(radius=jnp.where(jnp.arange(SLOTS) == live[1], 1, 0))
    kwargs = {"prune_scale": 100.0, "prune_radius": 0.5, "reset_every": 100}
    assert plan(gaussians, wide, 100, **kwargs).wanted == 16
    edit = plan(gaussians, wide, 110, **kwargs)
    np.testing.assert_array_equal(np.flatnonzero(edit.active), np.delete(live, 1))


@pytest.mark.parametrize("by", ["scale", "radius"])
def test_gaussians_are_pruned_by_their_size_after_the_split(by):
    """Densification precedes pruning, as in the code of Kerbl et al."""
    limit = 0.5
    sizes = np.full(SLOTS, 0.2)
    gaussians, live = scene_with()
    hot, cold, huge = live[:3]
    sizes[[hot, cold, huge]] = 1.2 * limit, 1.2 * limit, 2 * limit
    stats, kwargs = stats_with([hot, huge]), {"reset_every": 100}
    if by == "scale":
        kwargs |= {"prune_scale": limit / EXTENT}
        params = gaussians.params.replace(
            log_scales=jnp.log(sizes)[:, None].repeat(3, 1)
        )
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
    assert not edit.active[cold]
    assert not edit.active[huge]
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
    assert plan(gaussians, stats_with(live, values), max_gaussians=30).wanted == 40
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


def test_reset_lowers_opacities_and_clears_their_moments_only():
    opacities = np.where(np.arange(SLOTS) % 2 == 0, 0.9, 0.007)
    gaussians, live = scene_with(opacities=opacities)
    edit = plan(gaussians, stats_with([]), 200, reset_every=100)
    after = np.asarray(jax.nn.sigmoid(edit.params.logit_opacities))[live]
    np.testing.assert_allclose(after, np.minimum(opacities[live], 0.01), rtol=1e-9)
    low = live[live % 2 == 1]
    assert_rows_equal(edit.params, low, gaussians.params, low)
    assert_rows_equal(edit.params, live, gaussians.params, live, ["logit_opacities"])
    assert edit.opacities_reset
    moments = some_moments(gaussians)
    _, found = apply_edit(edit, moments)
    moments, found = moments[0], found[0]
    for before, moment in ((moments.mu, found.mu), (moments.nu, found.nu)):
        assert_rows_equal(moment, live, before, live, ["logit_opacities"])
        assert (moment.logit_opacities == 0).all()


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
    gaussians, _ = scene_with()
    config = AdaptiveSettings(start=0, stop=200, every=every, reset_every=reset_every)
    due = adaptive(config, EXTENT).due
    found = [
        step
        for step in range(1, 201)
        if due(step)
        and planned(
            config, jax.random.key(0), jnp.int32(step), gaussians, stats_with([])
        ).opacities_reset
    ]
    assert found == resets


def some_moments(gaussians):
    rng = np.random.default_rng(9)

    def fill(leaf):
        return jnp.asarray(rng.uniform(0.1, 1, leaf.shape))

    optimiser = make_optimiser(gaussian_rates(Rates(), EXTENT))
    adam, rates = optimiser.init(gaussians.params)
    mu, nu = (jax.tree.map(fill, tree) for tree in (adam.mu, adam.nu))
    return adam._replace(mu=mu, nu=nu), rates


def test_cleared_slots_reset_their_moments():
    opacities = np.full(SLOTS, 0.5)
    gaussians, live = scene_with(opacities=opacities, scales=0.3)
    large = np.array(gaussians.params.log_scales)
    large[live[0]] = np.log(0.05)  # clones the first, splits the next; removes the last
    logits = np.array(gaussians.params.logit_opacities)
    logits[live[-1]] = -9.0
    params = gaussians.params.replace(
        log_scales=jnp.asarray(large), logit_opacities=jnp.asarray(logits)
    )
    gaussians = gaussians.replace(params=params)
    edit = plan(gaussians, stats_with(live[:2]))
    moments = some_moments(gaussians)
    after, found = apply_edit(edit, moments)
    born = new_slots(edit, gaussians)
    assert len(born) == 2
    zero = np.concatenate([born, live[[1, -1]]])
    kept = np.setdiff1d(live, zero)
    assert live[0] in kept
    moments, found = moments[0], found[0]
    for before, moment in ((moments.mu, found.mu), (moments.nu, found.nu)):
        assert_rows_equal(moment, kept, before, kept)
        for leaf in jax.tree.leaves(rows(moment, zero)):
            assert (leaf == 0).all()
    assert found.count == moments.count
    np.testing.assert_array_equal(after.active, edit.active)


@pytest.mark.parametrize("garbage", GARBAGE)
def test_inactive_slots_have_no_effect(garbage):
    for scales in (0.05, 0.3):
        clean, live = scene_with(scales=scales)
        dirty, _ = scene_with(scales=scales, garbage=garbage)
        stats = stats_with(live[::3])
        bad = jnp.where(clean.active, stats.gradient, garbage)
        first = plan(clean, stats, 100, reset_every=100)
        second = plan(dirty, stats._replace(gradient=bad), 100, reset_every=100)
        for name in ("active", "cleared", "wanted", "opacities_reset"):
            np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
        slots = np.flatnonzero(first.active)
        assert len(slots) == 22
        assert_rows_equal(first.params, slots, second.params, slots)


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
