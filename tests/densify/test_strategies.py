"""Strategies in a training loop of one's own, their schedules, their settings."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from slot_scenes import scene_in
from training import EXTENT, HEIGHT, RASTER, WIDTH, dataset, photos, rough_start

import gsjax
from gsjax.densify.adaptive import AdaptiveSettings, adaptive
from gsjax.densify.mcmc import McmcSettings, mcmc
from gsjax.densify.schedule import EditSchedule, schedule_of
from gsjax.densify.types import Observation, apply_edit
from gsjax.errors import InputError

EDITS = {"start": 0, "stop": 12, "every": 4}
ADAPTIVE = adaptive(AdaptiveSettings(**EDITS, threshold=1e-6, reset_every=0), EXTENT)
MCMC = mcmc(McmcSettings(**EDITS, growth=1.3), EXTENT)


@pytest.mark.parametrize("strategy", [ADAPTIVE, MCMC], ids=["adaptive", "mcmc"])
def test_loop(strategy):
    """The loop of the docstring of `Strategy`, with optax.adam."""
    view, target = dataset().views[0], jnp.asarray(photos()[0].pixels / 255)
    size = {"width": WIDTH, "height": HEIGHT}
    camera = gsjax.make_camera(viewmat=view.viewmat, K=view.K, **size)
    optimiser, raster = optax.adam(1e-2), RASTER.replace(outputs=("rgb",))

    @jax.jit
    def update(gaussians, optimiser_state, stats, key):
        def loss(params, probe):
            scene = gaussians.replace(params=params)
            image = gsjax.render(scene, camera, raster, probe=probe)
            return jnp.mean((image.rgb - target) ** 2), image.radii

        probe = jnp.zeros((gaussians.capacity, 2))
        by, radii = jax.grad(loss, (0, 1), has_aux=True)(gaussians.params, probe)
        updates, optimiser_state = optimiser.update(by[0], optimiser_state)
        params = optax.apply_updates(gaussians.params, updates)
        gaussians = gaussians.replace(params=params)
        if strategy.perturb is not None:
            params = strategy.perturb(key, gaussians, jnp.asarray(1e-6))
            gaussians = gaussians.replace(params=params)
        seen = Observation(by[1][None], radii[None], WIDTH, HEIGHT)
        return gaussians, optimiser_state, strategy.observe(stats, seen)

    gaussians = rough_start(0, 96)
    stats, state = strategy.init(gaussians), optimiser.init(gaussians.params)
    counts = []
    for step in range(1, 13):
        key = jax.random.key(step)
        gaussians, state, stats = update(gaussians, state, stats, key)
        if strategy.due(step):
            edit, stats = strategy.plan(key, jnp.int32(step), gaussians, stats)
            gaussians, state = apply_edit(edit, state)
            counts.append(int(gsjax.num_active(gaussians)))
            cleared = np.asarray(edit.cleared)
            assert (state[0].mu.means[cleared] == 0).all()
            assert (state[0].mu.means[~cleared] != 0).any()
    assert len(counts) == 3
    assert 60 < counts[0] <= counts[-1] <= 96
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(gaussians.params))


PENALTIES = {"opacity_penalty": 0.3, "scale_penalty": 0.7}


@pytest.mark.parametrize("garbage", [np.nan, np.inf, -1e30])
@pytest.mark.parametrize(
    ("strategy", "count"),
    [
        (adaptive(AdaptiveSettings(start=0, reset_every=100, **PENALTIES), 10.0), 22),
        (mcmc(McmcSettings(growth=1.2, **PENALTIES)), 28),
    ],
    ids=["adaptive", "mcmc"],
)
def test_inactive_slots_have_no_effect(strategy, count, garbage):
    """Some Gaussians are to be cloned or split, and some are to be removed or moved."""
    slots, key = np.arange(36), jax.random.key(2)
    live = jnp.asarray(slots % 3 != 1)
    opacities = np.where(slots % 5 == 0, 0.004, 0.5)
    scales = np.where(slots[:, None] % 8 == 0, 0.3, 0.05)

    def penalty(params, gaussians):
        return strategy.penalty(gaussians.replace(params=params))

    def results(garbage):
        """Return all results that do not hold garbage."""
        gaussians = scene_in(live, opacities, scales, garbage=garbage)
        hot = np.where(slots[None, :, None] % 4 == 0, [1.0, 2.0], 0)
        seen = Observation(hot, np.ones((1, 36)), 40, 30)
        stats = strategy.observe(strategy.init(gaussians), seen)
        stats = jax.tree.map(lambda a: jnp.where(live, a, garbage), stats)
        edit, _ = strategy.plan(key, jnp.int32(100), gaussians, stats)
        params = [(edit.params, edit.active)]
        if strategy.perturb is not None:
            moved = strategy.perturb(key, gaussians, jnp.asarray(1e-4))
            params.append((moved, live))
            kept = gaussians.params.means[~live]
            np.testing.assert_array_equal(moved.means[~live], kept)
        rows = [jax.tree.map(lambda a, s=s: a[s], p) for p, s in params]
        slopes = jax.value_and_grad(penalty)(gaussians.params, gaussians)
        assert all(np.isfinite(a).all() for a in jax.tree.leaves(slopes))
        return rows, slopes, edit._replace(params=None)

    found, clean = results(garbage), results(0.0)
    assert clean[-1].active.sum() == count
    jax.tree.map(np.testing.assert_array_equal, found, clean)


@pytest.mark.parametrize(
    ("start", "stop", "every"), [(20, 50, 10), (3, 9, 2), (0, 7, 7)]
)
def test_edits_are_the_due_steps(start, stop, every):
    schedule = EditSchedule(start, stop, every)
    due = np.flatnonzero(schedule.due(jnp.arange(100)))
    wanted = [step for step in range(start + 1, stop + 1) if step % every == 0]
    assert due.tolist() == wanted
    for since in (0, start, 8, 40):
        for until in (since, 9, 40, 99):
            count = np.sum((due > since) & (due <= until))
            assert schedule.edits_between(since, until) == count
    found = schedule_of(schedule.due, 100)
    assert np.flatnonzero(found.due(np.arange(100))).tolist() == wanted
    assert schedule_of(lambda step: step < 0, 100).edits_between(0, 100) == 0


def test_expected_growth_compounds():
    schedule = EditSchedule(3, 9, 2, growth=1.5, max_gaussians=100)
    steps = [(0, 3), (0, 4), (4, 5), (4, 8), (4, 9), (4, 99), (8, 99)]
    found = [schedule.expected(10, *pair) for pair in steps]
    assert found == [10, 15, 10, 22, 22, 22, 10]
    assert schedule.expected(40, 0, 99) == 100
    assert schedule.expected(400, 0, 99) == 400
    unknown = EditSchedule(3, 9, 2, max_gaussians=100)
    found = [unknown.expected(n, 0, 9) for n in (0, 10, 90, 200)]
    assert found == [0, 15, 100, 200]


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        (AdaptiveSettings, {"every": 0}),
        (AdaptiveSettings, {"start": -1}),
        (AdaptiveSettings, {"reset_opacity": 1.0}),
        (AdaptiveSettings, {"opacity_penalty": -0.1}),
        (AdaptiveSettings, {"max_gaussians": 0}),
        (McmcSettings, {"every": 0}),
        (McmcSettings, {"growth": 0.9}),
        (McmcSettings, {"dead_opacity": 0.0}),
        (McmcSettings, {"noise": -1.0}),
    ],
    ids=str,
)
def test_settings_out_of_range(kind, changes):
    with pytest.raises(InputError, match=rf"{kind.__name__}.{next(iter(changes))}"):
        kind(**changes)
