"""The loop of training: the same bits however it is interrupted, grown or resumed.

In float32, as users have it. Runs share their programs (`shared_programs`), for each
call of `fit` compiles its own.
"""

import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import as_compiled, on_cpu
from training import (
    EXTENT,
    HEIGHT,
    POINTS,
    RASTER,
    VIEWS,
    WIDTH,
    bits,
    changed,
    photos,
    rough_start,
    scene,
)

import gsjax
import gsjax.train.loop as fit_module
from gsjax.cameras.camera import make_camera
from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.densify.mcmc import McmcSettings
from gsjax.errors import CapacityError, DivergedError, InputError
from gsjax.gaussians import num_active
from gsjax.raster.render import count_demand
from gsjax.runs.checkpoint import load_latest, restore, save_checkpoint
from gsjax.train.capacity_policy import (
    expected_pairs,
    grow_state,
    roomy_pairs,
    round_ones,
    slots_for,
    with_slots,
)
from gsjax.train.config import Level, TrainConfig
from gsjax.train.frames import make_frames
from gsjax.train.initialisation import empty_state, initial_state, resolve_initial
from gsjax.train.loop import Hooks, fit, subset
from gsjax.train.state import init_state
from gsjax.train.visibility_pruning import prune_invisible

STEPS, FINER = 60, 30
_PAUSE = 2.0  # s
CONFIG = TrainConfig(
    steps=STEPS,
    levels=(Level(0.0, 2), Level(0.5, 1)),
    sh_degree=1,
    sh_every=10,
    every_checkpoint=7,
    every_eval=25,
    adaptive=AdaptiveSettings(
        start=0,
        stop=50,
        every=7,
        threshold=1e-5,
        reset_every=0,
        max_gaussians=200,
        initial_opacity=0.5,
    ),
    mcmc=McmcSettings(
        start=0, stop=50, every=7, growth=1.2, max_gaussians=200, initial_scale=1.0
    ),
    exposure=True,
    raster=RASTER.replace(pair_capacity=None),
)
# One resolution for the other: what changes it asks for no strategy.
CONFIGS = {
    "adaptive": CONFIG,
    "mcmc": CONFIG.replace(strategy="mcmc", levels=(Level(0.0, 2),)),
}


pytestmark = pytest.mark.usefixtures("float32", "shared_programs")


class Log:
    """What a run told, and what it was asked to do."""

    def __init__(self, stop_at=None, folder=None):
        self.records, self.phases, self.saved, self.measured = [], [], [], []
        self.stop_at, self.folder = stop_at, folder

    def hooks(self):
        return Hooks(
            step=self.step,
            phase=self.phases.append,
            checkpoint=self.checkpoint,
            measure=self.measure,
            stop=self.stop,
        )

    def step(self, progress):
        self.records.append(progress.record())

    def stop(self):
        return self.records[-1]["step"] == self.stop_at

    def checkpoint(self, state, pair_capacity, progress):
        assert progress.metrics.step == state.step
        self.saved.append(int(state.step))
        if self.folder:
            save_checkpoint(
                self.folder, state, {"pair_capacity": pair_capacity, "seconds": 0.0}
            )

    def measure(self, state, progress):
        assert progress.metrics.step == state.step
        self.measured.append(int(state.step))
        time.sleep(_PAUSE)

    def told(self, *names):
        return [tuple(record[name] for name in names) for record in self.records]


def run(config, log=None, **kwargs):
    log = log or Log()
    return fit(scene(), photos(), config, hooks=log.hooks(), **kwargs), log


@pytest.fixture(scope="module")
def whole(shared_programs):
    """The uninterrupted run of each strategy; they compile what they run."""
    shared_programs.clear()
    return {name: run(config) for name, config in CONFIGS.items()}


@pytest.mark.parametrize("strategy", CONFIGS)
def test_it_learns(whole, strategy):
    result, log = whole[strategy]
    assert [r["step"] for r in log.records] == list(range(1, STEPS + 1))
    losses = np.asarray(log.told("loss"))[:, 0]
    # Of small pictures at first, and blurred ones: large ones are harder.
    assert losses[-8:].mean() < 0.85 * losses[:8].mean()
    counts = np.asarray(log.told("gaussians"))[:, 0]
    assert counts[0] == POINTS
    assert counts[-1] == int(result.gaussians.active.sum()) + result.dropped
    assert POINTS < counts[-1] <= 200
    assert all(r["finite"] and not r["overflowed"] for r in log.records)
    assert log.saved == list(range(7, STEPS, 7))
    # Measuring is no training: at its steps, and its time does not count.
    assert log.measured == [25, 50]
    seconds, compiling = np.asarray(log.told("seconds", "compile_seconds")).T
    gone = np.diff(seconds - compiling)
    assert gone[[24, 49]].max() < _PAUSE
    divisors = np.asarray(log.told("divisor"))[:, 0]
    finer = len(CONFIGS[strategy].levels) > 1
    wanted = np.where(finer & (np.arange(STEPS) >= FINER), 1, 2)
    np.testing.assert_array_equal(divisors, wanted)
    assert f"{WIDTH // 2} × {HEIGHT // 2} px" in log.phases[0]
    assert result.state.gaussians.params.means.dtype == np.float32
    for leaf in jax.tree.leaves(result.gaussians.params):
        assert np.isfinite(leaf).all()


@on_cpu
@pytest.mark.parametrize(
    ("strategy", "stop_at"),
    [("adaptive", FINER), ("adaptive", FINER - 1), ("mcmc", 17)],
)
def test_stopped_and_taken_up_again(whole, strategy, stop_at, tmp_path):
    """Across a change of resolution, edits and checkpoints: bit for bit."""
    config, (wanted, full) = CONFIGS[strategy], whole[strategy]
    first, log = run(config, Log(stop_at))
    assert int(first.state.step) == stop_at
    saved = save_checkpoint(
        tmp_path, first.state, {"pair_capacity": first.pair_capacity, "seconds": 0.0}
    )
    found = load_latest(saved.parent)
    template = empty_state(config, EXTENT, VIEWS, found.meta["capacity"])
    state = restore(found, template)
    assert changed(state, first.state) == []
    second, rest = run(config, state=state, pair_capacity=found.meta["pair_capacity"])
    assert changed(second.state, wanted.state) == []
    names = ("step", "loss", "psnr", "gaussians", "wanted", "pairs", "capacity")
    assert log.told(*names) + rest.told(*names) == full.told(*names)
    assert second.pair_capacity == wanted.pair_capacity


@on_cpu
def test_killed_and_taken_up_from_the_last_checkpoint(whole, tmp_path):
    config = CONFIGS["adaptive"]
    run(config, Log(stop_at=22, folder=tmp_path))
    found = load_latest(tmp_path)
    assert found.step == 21
    template = empty_state(config, EXTENT, VIEWS, found.meta["capacity"])
    pairs = found.meta["pair_capacity"]
    again, _ = run(config, state=restore(found, template), pair_capacity=pairs)
    assert changed(again.state, whole["adaptive"][0].state) == []


@pytest.mark.new_emitters
@on_cpu
def test_too_few_pairs_and_slots_are_grown(shared_programs):
    """Until the first edit no size matters; it tells how many slots it wants.

    From then on slots do: draws are made for all of them at once.
    """
    config = CONFIGS["adaptive"]
    state = init_state(rough_start(1, 64), config, EXTENT, VIEWS)
    before = bits(state)
    # Nor does it matter what the caller says may be visible.
    limited = config.replace(raster=config.raster.replace(visible_capacity=2))
    small, log = run(limited, Log(stop_at=6), state=state, pair_capacity=7)
    large, other = run(
        config, Log(stop_at=6), state=grow_state(state, 1024), pair_capacity=4096
    )
    assert changed(grow_state(small.state, 1024), large.state) == []
    assert log.told("step", "loss", "pairs") == other.told("step", "loss", "pairs")
    assert len(log.records) == 6
    assert ["7 pairs" in phase for phase in log.phases] == [True, False]
    pairs = small.pair_capacity
    assert 7 < pairs < large.pair_capacity
    assert small.gaussians.capacity == 1024  # a program was due anyway
    cramped, _ = run(config, Log(stop_at=6), state=state, pair_capacity=pairs)
    result, log = run(limited, Log(stop_at=7), state=cramped.state, pair_capacity=pairs)
    (record,) = log.records
    assert record["wanted"] > 70
    assert record["gaussians"] == record["capacity"] == 64
    assert result.gaussians.capacity == 1024
    assert int(result.gaussians.active.sum()) == 64
    assert bits(state) == before  # the caller's is still there
    # What does not look at the pairs is compiled once for all of them.
    (compiled,) = [v for k, v in shared_programs.items() if as_compiled(limited) in k]
    assert [len(programs) for programs in compiled] == [3, 2]


@on_cpu
@pytest.mark.parametrize("bad", [0, 1])
def test_what_was_learnt_is_saved_when_pairs_become_too_many(bad, monkeypatch):
    """As pictures become finer; not where it had just come to nothing."""
    config = CONFIGS["adaptive"]
    begun, _ = run(config, Log(stop_at=FINER - 1))
    log = Log()

    def too_many(*_):
        raise CapacityError("too many")

    monkeypatch.setattr(fit_module, "pairs_for", too_many)
    monkeypatch.setattr(
        fit_module.Health, "look", lambda self, _: setattr(self, "bad", bad)
    )
    with pytest.raises(CapacityError, match="too many"):
        run(config, log, state=begun.state, pair_capacity=begun.pair_capacity)
    assert [record["step"] for record in log.records] == [FINER]
    assert log.saved == ([] if bad else [FINER])


def test_growing_adds_empty_slots():
    state = init_state(rough_start(1, 64), CONFIGS["adaptive"], EXTENT, VIEWS)
    moments = jax.tree.map(lambda a: a + 1, state.moments)
    state = state.replace(
        moments=moments, stats=jax.tree.map(jnp.ones_like, state.stats)
    )
    grown = grow_state(state, 100)
    names = ("moments", "stats")
    for name in names:
        pairs = zip(
            jax.tree.leaves(getattr(state, name)), jax.tree.leaves(getattr(grown, name))
        )
        for old, new in pairs:
            if old.ndim:
                assert new.shape == (100, *old.shape[1:])
                np.testing.assert_array_equal(new[:64], old)
                assert (new[64:] == 0).all()
    assert not grown.gaussians.active[64:].any()
    template = empty_state(CONFIGS["adaptive"], EXTENT, VIEWS, 100)
    for a, b in zip(jax.tree.leaves(grown), jax.tree.leaves(template), strict=True):
        assert (a.shape, a.dtype) == (b.shape, b.dtype)


def test_leaving_the_numbers_is_told():
    config = CONFIGS["mcmc"]
    state = initial_state(scene(), config)
    refinement = replace(
        state.refinement, exposures=state.refinement.exposures * jnp.nan
    )
    log = Log()
    with pytest.raises(
        DivergedError, match="in 30 of the last 30 steps, up to step 30"
    ):
        run(config, log, state=state.replace(refinement=refinement))
    assert [r["finite"] for r in log.records] == [False] * 29


@on_cpu
def test_what_no_photograph_shows_is_dropped_in_the_end():
    """Behind all cameras, far to the side, or fainter than the cut: not a bit of a view
    that is trained on changes. What one view alone shows stays."""
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
    frames = make_frames(scene().views, photos(), 1)
    after, count = prune_invisible(state, frames, config, EXTENT)
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
    # Whatever the caller's settings of sizes and derivatives are.
    own = config.raster.replace(visible_capacity=4, absgrad=True)
    same, found = prune_invisible(state, frames, config.replace(raster=own), EXTENT)
    assert (changed(same, after), found) == ([], count)
    again, none = prune_invisible(after, frames, config, EXTENT)
    assert (changed(again, after), none) == ([], 0)
    # Cameras are where they have been corrected to.
    turned = config.replace(refine_poses=True)
    away = init_state(state.gaussians, turned, EXTENT, VIEWS)
    shifts = jnp.full((VIEWS, 3), 1e4)
    away = away.replace(refinement=replace(away.refinement, shifts=shifts))
    _, count = prune_invisible(away, frames, turned, EXTENT)
    assert count == POINTS


@on_cpu
def test_they_are_dropped_when_a_run_ends_and_not_before(monkeypatch):
    config = CONFIGS["mcmc"]
    asked = []

    def drop(state, *_):
        asked.append(int(state.step))
        return state, 7

    monkeypatch.setattr(fit_module, "prune_invisible", drop)
    stopped, _ = run(config, Log(stop_at=3))
    assert (stopped.dropped, asked) == (0, [])
    ending = stopped.state.replace(step=jnp.int32(STEPS - 1))
    done, _ = run(config, state=ending, pair_capacity=stopped.pair_capacity)
    assert (done.dropped, asked) == (7, [STEPS])
    kept, _ = run(
        config.replace(prune_invisible=False), state=ending,
        pair_capacity=stopped.pair_capacity,
    )  # fmt: skip
    assert (kept.dropped, asked) == (0, [STEPS])


def test_a_finished_run_has_nothing_to_do():
    config = CONFIGS["adaptive"]
    state = initial_state(scene(), config).replace(step=jnp.int32(STEPS))
    result, log = run(config, state=state, pair_capacity=99)
    assert (result.progress, result.pair_capacity) == (None, 99)
    assert log.records == log.phases == []
    assert changed(result.state, state) == []


def test_first_states():
    for name, config in CONFIGS.items():
        state = initial_state(scene(), config)
        assert int(state.gaussians.active.sum()) == POINTS
        assert state.gaussians.capacity == 1024
        many = config.replace(initial="random", initial_count=500)
        state = initial_state(scene(), many)
        assert int(state.gaussians.active.sum()) == 200, name


def test_what_a_run_starts_from():
    """Points that are no numbers are none."""
    config, bare = CONFIGS["mcmc"], replace(scene(), points=np.zeros((0, 3)))
    wild = replace(scene(), points=np.full((POINTS, 3), np.nan))
    assert config.initial == "auto"
    assert resolve_initial(scene(), config).initial == "points"
    for initial in ("points", "random"):
        told = config.replace(initial=initial)
        assert resolve_initial(scene(), told) == told
    for without in (bare, wild):
        random = resolve_initial(without, config)
        assert random == config.replace(initial="random")
        first, second = (initial_state(without, c) for c in (config, random))
        assert changed(first, second) == []
        with pytest.raises(InputError, match="no points to start from"):
            resolve_initial(without, config.replace(initial="points"))


def test_a_photograph_for_each_view():
    few = subset(scene(), [2, 0])
    assert [view.name for view in few.views] == ["view_2.png", "view_0.png"]
    with pytest.raises(InputError, match="4 photos for 2 views"):
        fit(few, photos(), CONFIG)
    with pytest.raises(InputError, match="0 photos for 0 views"):
        fit(subset(scene(), []), [], CONFIG)


def test_more_room_while_gaussians_are_added(monkeypatch):
    """Fewer programs then: each lasts longer. Not for more than may come, nor, where
    there are many steps ahead, so much that it costs more than a program."""
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    many = 100 * int(num_active(initial_state(scene(), CONFIG).gaussians))

    def margin(pairs, step, most, steps, stop=5000, batch=1):
        chosen = replace(CONFIG.chosen, max_gaussians=most, stop=stop)
        config = CONFIG.replace(
            **{CONFIG.strategy: chosen},
            steps=steps,
            batch=batch,
            levels=(Level(0.0, 1),),
        )
        state = initial_state(scene(), config).replace(step=jnp.int32(step))
        return roomy_pairs(pairs, state, config) / pairs

    roomy = margin(300_000, 0, many, 100)
    assert roomy == pytest.approx(4, rel=0.4)
    assert margin(300_000, 0, many, 10_000) == pytest.approx(2.5, rel=0.2)
    between = margin(60_000, 0, many, 1500)  # 1 + 1.8e8 / 1500 / 60_000
    assert between == pytest.approx(3, rel=0.2)
    # What is empty costs something in each view of a step.
    assert margin(30_000, 0, many, 1500, batch=2) == pytest.approx(3, rel=0.2)
    assert margin(300_000, 20, many, 100) > 2
    settled = margin(300_000, 60, many, 100, stop=60)
    assert settled == margin(300_000, 1, many // 100, 100) < 2
    assert settled == margin(300_000, 99, many, 100)  # nothing comes any more
    # Before the first step they are narrower than they will be.
    assert 1.1 * settled < margin(300_000, 0, many // 100, 100) < roomy


@pytest.mark.parametrize("steps", [1000, 4000, 30_000])
def test_slots_cost_least(monkeypatch, steps):
    """Of all lots in which a growing run could add slots, no other costs a tenth less:
    a program is 10⁷ empty slots in a step."""
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    first, last = 20_000, 200_000
    mcmc = McmcSettings(start=0, stop=steps, every=1, growth=2, max_gaussians=last)
    config = CONFIG.replace(strategy="mcmc", mcmc=mcmc, steps=steps)
    config = config.replace(levels=(Level(0.0, 1),))

    def cost(lot):
        programs = (last - first) / lot
        return programs * 1e7 + steps * lot / 2

    chosen = slots_for(first, 0, config) - first
    assert cost(chosen) < 1.1 * min(map(cost, range(1000, last - first, 1000)))


def test_slots_are_no_more_than_will_be_used():
    few = CONFIG.replace(adaptive=replace(CONFIG.adaptive, max_gaussians=50_000))
    known = replace(CONFIG.mcmc, max_gaussians=50_000, growth=1.05)
    grows = CONFIG.replace(strategy="mcmc", mcmc=known)
    assert slots_for(40_000, 0, few) == 53_248  # 50,000, in eighths of 32,768
    assert slots_for(40_000, 60, few) == 40_960  # none come any more
    # As many as four edits make, after which pictures become finer.
    assert slots_for(20_000, 0, grows) == 24_576
    assert slots_for(24_310, FINER, grows) == 28_672
    assert slots_for(60_000, 0, few) == 61_440  # those that there are fit


def test_an_accelerator_grows_once_for_each_size_of_the_photographs(monkeypatch):
    """What is empty costs it next to nothing: room for all that may come until a
    program is due anyway."""
    steps, finer, first, most = 40_000, 4000, 50_000, 190_000
    known = McmcSettings(
        start=0, stop=steps, every=1, growth=1.0003, max_gaussians=most
    )
    config = CONFIG.replace(strategy="mcmc", mcmc=known, steps=steps)
    config = config.replace(levels=(Level(0.0, 2), Level(finer / steps, 1)))
    state = initial_state(scene(), config)

    def room():
        slots = [slots_for(first, step, config) for step in (0, finer, steps)]
        return *slots, roomy_pairs(300_000, state, config)

    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    coarse, fine, last, pairs = room()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    coarse_there, fine_there, last_there, pairs_there = room()
    assert coarse < known.likely(first, 0, finer) <= coarse_there < most
    assert fine < most <= fine_there
    assert pairs < pairs_there
    assert last == last_there
    # But for the sake of memory no more than four times those that there are.
    assert slots_for(most // 10, finer, config) <= 4.5 * most / 10


@pytest.mark.parametrize(("step", "slots"), [(7, 1024), (49, 64), (50, 64), (60, 64)])
def test_slots_are_grown_for_edits_to_come(step, slots):
    config = CONFIGS["adaptive"].replace(levels=(Level(0.0, 1),))
    state = init_state(rough_start(1, 64), config, EXTENT, VIEWS)
    state = state.replace(step=jnp.int32(step))
    assert with_slots(state, 70, config).gaussians.capacity == slots
    assert with_slots(state, 50, config).gaussians.capacity == 64


@pytest.mark.parametrize("initial", ["points", "random"])
def test_pairs_are_estimated_before_the_first_step(initial):
    """To a few per cent, and here, where edges are much of the picture, a fifth."""
    config = CONFIG.replace(initial=initial, initial_count=500)
    state = initial_state(scene(), config)
    frames, start = make_frames(scene().views, photos()), round_ones(state.gaussians)
    for index in range(VIEWS):
        camera = jax.tree.map(lambda a, i=index: a[i], frames.camera)
        counted = int(count_demand(state.gaussians, camera, config.raster).capacity)
        found = expected_pairs(start, camera, config.raster)
        assert found == pytest.approx(counted, rel=0.25)
    aside = make_camera(
        viewmat=np.diag([-1.0, 1, -1, 1]) @ scene().views[0].viewmat,
        K=scene().views[0].K, width=WIDTH, height=HEIGHT,
    )  # fmt: skip
    assert expected_pairs(start, aside, config.raster) < 0.2 * counted


def test_a_view_of_nothing_wants_little_room():
    """As one that is masked altogether, at a step that grows the slots."""
    state = initial_state(scene(), CONFIG)
    for step in (0, 1, CONFIG.chosen.stop):
        at = state.replace(step=jnp.int32(step))
        assert roomy_pairs(0, at, CONFIG) == roomy_pairs(1, at, CONFIG) > 0


@pytest.mark.parametrize("strategy", ["adaptive", "mcmc"])
@pytest.mark.parametrize("stop", [99, 100, 1000])
def test_nothing_is_edited_behind_the_last_step(strategy, stop):
    """What an edit makes, and what a reset takes away, is still to be learnt."""
    edits = {"start": 0, "every": 10, "stop": stop}
    config = TrainConfig(
        steps=100,
        strategy=strategy,
        adaptive=AdaptiveSettings(**edits, reset_every=50),
        mcmc=McmcSettings(**edits),
    )
    strategy = config.densifier(EXTENT)
    due = [step for step in range(200) if strategy.due(jnp.int32(step))]
    assert due == [*range(10, 100, 10)]
    assert config.chosen.stop == 99
    assert config.replace(steps=5000).chosen.stop == stop
    if isinstance(config.chosen, AdaptiveSettings):  # nor reset, which edits follow
        gaussians = rough_start(1, 64)
        stats = strategy.init(gaussians)
        reset = [
            bool(strategy.plan(jax.random.key(0), step, gaussians, stats)[0][3])
            for step in map(jnp.int32, (50, 80, 90))
        ]
        assert reset == [True, False, False]


def test_more_pairs_than_can_be_addressed():
    state = initial_state(scene(), CONFIG)
    done = state.replace(step=jnp.int32(CONFIG.chosen.stop))
    assert roomy_pairs(1000, done, CONFIG) == 1536
    assert roomy_pairs(2**30 - 9, done, CONFIG) == 2**30 - 1
    with pytest.raises(CapacityError, match="wants 2,147,483,647 or more pairs"):
        roomy_pairs(2**31 - 1, done, CONFIG)
