"""Laws of the training loop: equal bits if interrupted, grown or resumed.

In float32. Runs share their programs (`shared_programs`).
"""

import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import on_cpu
from training import (
    EXTENT,
    POINTS,
    RASTER,
    VIEWS,
    bits,
    changed,
    dataset,
    photos,
    rough_start,
)

import gsjax
import gsjax.train.loop as fit_module
from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.densify.mcmc import McmcSettings
from gsjax.densify.schedule import EditSchedule
from gsjax.errors import CapacityError, InputError
from gsjax.raster.exact import count_demand
from gsjax.train.capacity_policy import (
    as_spheres,
    expected_pairs,
    grow_state,
    slots_for,
    visible_room,
    with_margin,
)
from gsjax.train.config import Level, TrainConfig
from gsjax.train.frames import make_frames
from gsjax.train.initialisation import initial_state, resolve_initial
from gsjax.train.loop import Hooks, fit, subset
from gsjax.train.state import init_state, make_setup
from gsjax.train.visibility_pruning import prune_invisible

STEPS, FINER = 60, 30
_PAUSE = 2.0  # s
EDITS = {"start": 0, "stop": 50, "every": 7, "max_gaussians": 200}
CONFIG = TrainConfig(
    steps=STEPS,
    levels=(Level(0.0, 2), Level(0.5, 1)),
    sh_degree=1,
    sh_every=10,
    every_checkpoint=7,
    every_eval=25,
    adaptive=AdaptiveSettings(
        **EDITS, threshold=1e-5, reset_every=0, initial_opacity=0.5
    ),
    mcmc=McmcSettings(**EDITS, growth=1.2, initial_scale=1.0),
    exposure=True,
    raster=RASTER.replace(pair_capacity=None),
)
CONFIGS = {
    "adaptive": CONFIG,
    "mcmc": CONFIG.replace(strategy="mcmc", levels=(Level(0.0, 2),)),
}


pytestmark = pytest.mark.usefixtures("float32", "shared_programs")


class Log:
    """Records of a run, and the step at which it is stopped."""

    def __init__(self, stop_at=None):
        self.records, self.phases, self.saved, self.measured = [], [], [], []
        self.stop_at = stop_at

    def hooks(self):
        return Hooks(
            step=lambda progress: self.records.append(progress.record()),
            phase=self.phases.append,
            checkpoint=self.checkpoint,
            measure=self.measure,
            stop=lambda: self.records[-1]["step"] == self.stop_at,
        )

    def checkpoint(self, state, _, progress):
        assert progress.metrics.step == state.step
        self.saved.append(int(state.step))

    def measure(self, state, progress):
        assert progress.metrics.step == state.step
        self.measured.append(int(state.step))
        time.sleep(_PAUSE)

    def told(self, *names):
        return [tuple(record[name] for name in names) for record in self.records]


def run(config, log=None, **kwargs):
    log = log or Log()
    return fit(dataset(), photos(), config, hooks=log.hooks(), **kwargs), log


@pytest.fixture(scope="module")
def whole(shared_programs):
    """The uninterrupted run of each strategy."""
    shared_programs.clear()
    return {name: run(config) for name, config in CONFIGS.items()}


@pytest.mark.parametrize("strategy", CONFIGS)
def test_the_loss_falls(whole, strategy):
    result, log = whole[strategy]
    assert [r["step"] for r in log.records] == list(range(1, STEPS + 1))
    losses = np.asarray(log.told("loss"))[:, 0]
    assert losses[-8:].mean() < 0.85 * losses[:8].mean()
    counts = np.asarray(log.told("gaussians"))[:, 0]
    assert counts[0] == POINTS
    assert counts[-1] == int(result.gaussians.active.sum()) + result.dropped
    assert POINTS < counts[-1] <= 200
    assert all(r["finite"] and not r["overflowed"] for r in log.records)
    assert log.saved == list(range(7, STEPS, 7))
    # The time of measurements is not counted.
    assert log.measured == [25, 50]
    seconds, compiling = np.asarray(log.told("seconds", "compile_seconds")).T
    gone = np.diff(seconds - compiling)
    assert gone[[24, 49]].max() < _PAUSE
    # Spare capacity: one program per resolution, though Gaussians and pairs grow.
    assert log.records[-1]["compilations"] == len(CONFIGS[strategy].levels)
    pairs = np.asarray(log.told("pair_capacity"))[:FINER, 0]
    assert pairs.max() > 1.2 * pairs[0]
    divisors = np.asarray(log.told("divisor"))[:, 0]
    finer = len(CONFIGS[strategy].levels) > 1
    wanted = np.where(finer & (np.arange(STEPS) >= FINER), 1, 2)
    np.testing.assert_array_equal(divisors, wanted)
    assert result.state.gaussians.params.means.dtype == np.float32
    for leaf in jax.tree.leaves(result.gaussians.params):
        assert np.isfinite(leaf).all()


@on_cpu
def test_a_resumed_run_is_bit_equal(whole):
    """Across changes of resolution, edits and checkpoints."""
    config, (wanted, full) = CONFIGS["adaptive"], whole["adaptive"]
    first, log = run(config, Log(stop_at=FINER))
    assert int(first.state.step) == FINER
    second, rest = run(config, state=first.state, pair_capacity=first.pair_capacity)
    assert changed(second.state, wanted.state) == []
    names = ("step", "loss", "psnr", "gaussians", "wanted", "pairs", "capacity")
    assert log.told(*names) + rest.told(*names) == full.told(*names)
    assert second.pair_capacity == wanted.pair_capacity


@on_cpu
def test_capacities_grow_without_changing_bits():
    """Until the first edit; from then on random draws depend on the slots."""
    config = CONFIGS["adaptive"]
    state = init_state(rough_start(1, 64), config, EXTENT, VIEWS)
    before = bits(state)
    limited = config.replace(raster=config.raster.replace(visible_capacity=2))
    least = {"pair_capacity": 7, "visible_capacity": 2}
    small, log = run(limited, Log(stop_at=6), state=state, **least)
    large, other = run(
        config, Log(stop_at=6), state=grow_state(state, 1024), pair_capacity=4096
    )
    assert changed(grow_state(small.state, 1024), large.state) == []
    assert log.told("step", "loss", "pairs") == other.told("step", "loss", "pairs")
    assert len(log.records) == 6
    pairs = small.pair_capacity
    assert 7 < pairs < large.pair_capacity
    assert small.gaussians.capacity == 1024  # recompiled anyway
    cramped, _ = run(config, Log(stop_at=6), state=state, pair_capacity=pairs)
    result, log = run(limited, Log(stop_at=7), state=cramped.state, pair_capacity=pairs)
    (record,) = log.records
    assert record["wanted"] > 70
    assert record["gaussians"] == record["capacity"] == 64
    assert result.gaussians.capacity == 1024
    assert int(result.gaussians.active.sum()) == 64
    assert bits(state) == before  # not donated


@on_cpu
def test_a_failed_state_is_not_saved_before_a_capacity_error(monkeypatch):
    config, log = CONFIGS["adaptive"], Log()
    begun, _ = run(config, Log(stop_at=FINER - 1))

    def too_many(*_):
        raise CapacityError("too many")

    def fail(health, _):
        health.bad = 1

    monkeypatch.setattr(fit_module, "capacities_for", too_many)
    monkeypatch.setattr(fit_module.Health, "check", fail)
    with pytest.raises(CapacityError, match="too many"):
        run(config, log, state=begun.state, pair_capacity=begun.pair_capacity)
    assert log.told("step") == [(FINER,)]
    assert log.saved == []


@on_cpu
def test_pruning_invisible_gaussians_keeps_the_views_bit_equal():
    """Gaussians behind all cameras, beside all views, or below the α threshold."""
    config = CONFIGS["mcmc"]
    state = init_state(rough_start(1, 64), config, EXTENT, VIEWS)
    params = state.gaussians.params
    unseen = [3, 17, 40]
    params = params.replace(
        means=params.means.at[3].set([0.0, 0, 60]).at[17].set([50.0, 50, 0]),
        logit_opacities=params.logit_opacities.at[40].set(-6.0),
        log_scales=params.log_scales.at[jnp.asarray(unseen)].set(-4.0),
    )
    state = state.replace(gaussians=state.gaussians.replace(params=params))
    frames = make_frames(dataset().views, photos(), 1)
    after, count = prune_invisible(state, frames, make_setup(config, EXTENT))
    gone = np.asarray(state.gaussians.active & ~after.gaussians.active)
    raster = config.raster.replace(outputs=("rgb", "alpha"))
    whole = gsjax.render_exact(state.gaussians, frames.camera, raster)
    some = gsjax.render_exact(after.gaussians, frames.camera, raster)
    shown = (np.asarray(whole.radii) > 0).any(0)
    np.testing.assert_array_equal(gone, np.asarray(state.gaussians.active) & ~shown)
    assert set(unseen) <= set(np.flatnonzero(gone))
    assert count == gone.sum() < POINTS / 2
    np.testing.assert_array_equal(whole.rgb, some.rgb)
    np.testing.assert_array_equal(whole.alpha, some.alpha)
    assert changed(state.replace(gaussians=after.gaussians), after) == []
    # Cameras are corrected.
    turned = config.replace(refine_poses=True)
    away = init_state(state.gaussians, turned, EXTENT, VIEWS)
    shifts = jnp.full((VIEWS, 3), 1e4)
    away = away.replace(refinement=replace(away.refinement, shifts=shifts))
    _, count = prune_invisible(away, frames, make_setup(turned, EXTENT))
    assert count == POINTS


def test_initial_points():
    """Non-finite points do not count. A finished run makes no step."""
    config, points = CONFIGS["mcmc"], CONFIGS["mcmc"].replace(initial="points")
    assert resolve_initial(dataset(), config) == points
    random = config.replace(initial="random")
    for given in (points, random):
        assert resolve_initial(dataset(), given) == given
    for points_of in (np.zeros((0, 3)), np.full((POINTS, 3), np.nan)):
        without = replace(dataset(), points=points_of)
        assert resolve_initial(without, config) == random
        first, second = (initial_state(without, c) for c in (config, random))
        assert changed(first, second) == []
        with pytest.raises(InputError, match="points"):
            resolve_initial(without, points)
    state = first.replace(step=jnp.int32(STEPS))
    result, log = run(config, state=state, pair_capacity=99)
    assert (result.progress, result.pair_capacity) == (None, 99)
    assert log.records == log.phases == []
    assert changed(result.state, state) == []


def test_photographs_must_match_the_views():
    few = subset(dataset(), [2, 0])
    assert [view.name for view in few.views] == ["view_2.png", "view_0.png"]
    with pytest.raises(InputError, match="each of 2 views, got 4"):
        fit(few, photos(), CONFIG)
    with pytest.raises(InputError, match="each of 0 views, got 0"):
        fit(subset(dataset(), []), [], CONFIG)


@on_cpu
def test_the_slots_minimise_the_cost():
    """To a tenth; compiling a program costs as much as 10⁷ idle slots in a step."""
    first, last = 20_000, 200_000
    for steps in (1000, 4000, 30_000):
        schedule = EditSchedule(0, steps, 1, 2.0, last)
        chosen = slots_for(first, 0, TrainConfig(steps=steps), schedule) - first
        cost = [
            (last - first) / lot * 1e7 + steps * lot / 2
            for lot in (chosen, *range(1000, last - first, 1000))
        ]
        assert cost[0] < 1.1 * min(cost)
    # Limited by the growth, which ends with the last edit; in eighths of a power of 2.
    few = replace(CONFIG.adaptive, max_gaussians=50_000).schedule
    assert slots_for(40_000, 0, CONFIG, few) == 53_248
    assert slots_for(40_000, 60, CONFIG, few) == 40_960


def test_estimate_of_the_initial_pairs():
    frames, raster = make_frames(dataset().views, photos()), CONFIG.raster
    cameras = [jax.tree.map(lambda a, i=i: a[i], frames.camera) for i in range(VIEWS)]
    for initial in ("points", "random"):
        config = CONFIG.replace(initial=initial, initial_count=500)
        state = initial_state(dataset(), config)
        start = as_spheres(state.gaussians)
        for camera in cameras:
            counted = int(count_demand(state.gaussians, camera, raster).capacity)
            found = expected_pairs(start, camera, raster)
            assert found == pytest.approx(counted, rel=0.25)
        flipped = np.diag([-1.0, 1, -1, 1]) @ cameras[0].viewmat
        aside = cameras[0].replace(viewmat=flipped)
        assert expected_pairs(start, aside, raster) < 0.2 * counted


@pytest.mark.parametrize("strategy", ["adaptive", "mcmc"])
def test_the_last_step_is_not_followed_by_an_edit(strategy):
    for stop in (99, 100, 1000):
        settings = replace(getattr(CONFIG, strategy), start=0, every=10, stop=stop)
        config = TrainConfig(steps=100, strategy=strategy, **{strategy: settings})
        due = config.make_strategy(EXTENT).due
        assert [step for step in range(200) if due(step)] == [*range(10, 100, 10)]
        assert config.replace(steps=5000).strategy_settings.stop == stop


@on_cpu
def test_pair_capacities_have_a_margin_and_a_limit():
    """The margin is wider while Gaussians are added."""
    state, schedule = initial_state(dataset(), CONFIG), CONFIG.schedule
    settled = state.replace(step=jnp.int32(schedule.stop))
    most, least = (with_margin(3e5, x, CONFIG, schedule) for x in (state, settled))
    assert 3e5 < least < 6e5 < most
    assert with_margin(2**30 - 9, settled, CONFIG, schedule) == 2**30 - 1
    with pytest.raises(CapacityError, match="2,147,483,647 or more"):
        with_margin(2**31 - 1, settled, CONFIG, schedule)


def test_room_for_visible_gaussians_follows_what_is_seen():
    """It is limited where a view shows few of the slots, and grows as pairs do."""
    assert visible_room(1000, 2000) is None
    assert visible_room(100, 100_000) == 1024
    assert visible_room(10_000, 100_000) == 16384
