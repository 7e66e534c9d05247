"""The loop around the step: resolution, and what is compiled when.

Runs on the host and in memory; files are the business of `gsjax.runs.run`.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.data.extent import extent_of
from gsjax.data.types import Dataset, Photo
from gsjax.errors import CapacityError
from gsjax.gaussians import Gaussians
from gsjax.raster.types import RasterConfig
from gsjax.train.capacity_policy import (
    pairs_for,
    roomy_pairs,
    with_slots,
    with_slots_ahead,
)
from gsjax.train.config import TrainConfig
from gsjax.train.frames import Frames, make_frames, views_of_step
from gsjax.train.health import Health, check_photos
from gsjax.train.initialisation import add_dense_points, initial_state
from gsjax.train.state import Metrics, TrainState
from gsjax.train.step_compiler import CompiledStep, StepCompiler
from gsjax.train.visibility_pruning import prune_invisible


class Progress(NamedTuple):
    """What the loop tells after each step.

    Attributes:
      metrics: of the step, on the host.
      seconds: since the start of this call, compilation included.
      compile_seconds: of those, spent compiling before a step could begin.
      compilations: sizes that a step was compiled for so far.
      divisor: how much smaller the images are.
      capacity: slots.
    """

    metrics: Metrics
    seconds: float
    compile_seconds: float
    compilations: int
    divisor: int
    capacity: int

    def record(self) -> dict[str, float | int | bool]:
        """As plain numbers, for a line of `metrics.jsonl`."""
        out = {k: np.asarray(v).item() for k, v in self.metrics._asdict().items()}
        rest = {k: v for k, v in self._asdict().items() if k != "metrics"}
        rounded = {
            k: round(v, 3) if isinstance(v, float) else v for k, v in rest.items()
        }
        return {**out, **rounded}


@dataclass
class Hooks:
    """What a caller may want to know or do; each is called on the host.

    Attributes:
      step: after each step.
      phase: before something that takes a while, with what it is.
      checkpoint: every ``config.every_checkpoint`` steps, unless something is wrong
        just then: state, pair capacity, and the record of that step.
      measure: every ``config.every_eval`` steps, before the checkpoint where both are
        due: state and record; the time that it takes does not count.
      stop: asked after each step; True ends the run there.
      state: after each step, with the state, whose memory the next step takes over:
        copy what is to last.
    """

    step: Callable[[Progress], None] = lambda _: None
    phase: Callable[[str], None] = lambda _: None
    checkpoint: Callable[[TrainState, int, Progress], None] = lambda *_: None
    measure: Callable[[TrainState, Progress], None] = lambda *_: None
    stop: Callable[[], bool] = lambda: False
    state: Callable[[TrainState, Progress], None] = lambda *_: None


@dataclass
class FitResult:
    """What a run came to.

    Attributes:
      state: after the last step.
      pair_capacity: what the last step used.
      progress: of the last step, or None if there was none to do.
      dropped: Gaussians removed after it, as `TrainConfig.prune_invisible` says.
    """

    state: TrainState
    pair_capacity: int
    progress: Progress | None = None
    dropped: int = 0

    @property
    def gaussians(self) -> Gaussians:
        """The scene."""
        return self.state.gaussians


def fit(
    scene: Dataset,
    photos: Sequence[Photo],
    config: TrainConfig,
    *,
    state: TrainState | None = None,
    pair_capacity: int | None = None,
    hooks: Hooks | None = None,
) -> FitResult:
    """Train.

    The same arguments give the same bits on a CPU with as many devices, also when a run
    is taken up again from the state and pair capacity that a checkpoint kept.

    Args:
      scene: its views are trained on, all of them.
      photos: one for each view, as `load_photo` gives them.
      config: the settings.
      state: go on from there; default `initial_state`.
      pair_capacity: of that state's run.
      hooks: see `Hooks`.

    Returns:
      The state after the last step, and what it needed; the scene is ``.gaussians``.

    Raises:
      InputError: if photos and views do not match, or there is nothing to start from,
        or to learn from.
      CapacityError: if a view wants more pairs than can be addressed, or a step more
        memory than there is (see `gsjax.runtime.memory`); what was learnt until then has gone
        to ``hooks.checkpoint``.
      DivergedError: if in 50 of the last 100 steps, or half of a short run, numbers
        are not finite or pictures worse than any can be; or in 50 running nothing is
        in view.
    """
    check_photos(scene, photos)
    run = _Run(scene, photos, config, hooks or Hooks())
    if state is None:
        if config.initial == "dense":
            run.hooks.phase("looking for points on which the photographs agree")
        state = initial_state(add_dense_points(scene, photos, config), config)
    else:  # a step takes the state's memory over: not the caller's
        state = _copied(state)
    own: TrainState = run.compiler.place(state)
    try:
        return run.loop(own, pair_capacity)
    finally:
        run.compiler.close()


@jax.jit
def _copied(state: TrainState) -> TrainState:
    return jax.tree.map(jnp.copy, state)


@dataclass
class _Run:
    """One call of `fit`."""

    scene: Dataset
    photos: Sequence[Photo]
    config: TrainConfig
    hooks: Hooks
    start: float = field(default_factory=time.perf_counter)
    compile_seconds: float = 0.0

    def __post_init__(self):
        extent, phase = extent_of(self.scene), self.hooks.phase
        self.compiler = StepCompiler(self.config, extent, phase)

    def loop(self, state: TrainState, pair_capacity: int | None) -> FitResult:
        config, hooks = self.config, self.hooks
        step, health = int(state.step), Health(config.steps)
        divisor = config.divisor(max(step - 1, 0))  # of the step before
        frames, progress = None, None
        while step < config.steps:
            finer = config.divisor(step) != divisor
            if frames is None or finer:
                divisor = config.divisor(step)
                frames = make_frames(self.scene.views, self.photos, divisor)
                frames = self.compiler.place(frames)
            try:
                if pair_capacity is None or finer:
                    begun = time.perf_counter()
                    if finer:
                        state = with_slots_ahead(state, config)
                    pair_capacity = pairs_for(state, frames, config)
                    self.compile_seconds += time.perf_counter() - begun
                raster = config.raster.replace(pair_capacity=pair_capacity)
                program = self.program(state, frames, raster)
                view = views_of_step(config.seed, step, config.batch, frames.count)
                state, metrics = program(state, frames, view)
                if metrics.overflowed:
                    state = with_slots_ahead(state, config)
                    wanted = int(metrics.pair_capacity)
                    pair_capacity = roomy_pairs(wanted, state, config)
                    continue
            except CapacityError:
                # Nothing that was learnt is lost, unless it is worth nothing.
                if progress is not None and not health.bad:
                    hooks.checkpoint(state, pair_capacity or 0, progress)
                raise
            step = int(metrics.step)
            progress = self.progress(metrics, divisor, state)
            health.look(metrics)
            hooks.step(progress)
            hooks.state(state, progress)
            slots = state.gaussians.capacity
            state = with_slots(state, int(metrics.wanted), config)
            if state.gaussians.capacity > slots:  # a new program: with more pairs too
                wanted = int(metrics.pair_capacity)
                roomy = roomy_pairs(wanted, state, config)
                pair_capacity = max(pair_capacity, roomy)
            # The last is measured and saved by the caller, with what else ends a run.
            every = config.every_eval
            if every and step % every == 0 and step < config.steps:
                begun = time.perf_counter()
                hooks.measure(state, progress)
                self.start += time.perf_counter() - begun
            # After it: a run that goes on from there does not measure that step again.
            every = config.every_checkpoint
            due = every and step % every == 0 and step < config.steps
            if due and not health.bad:  # what is lost is not to push out what is not
                hooks.checkpoint(state, pair_capacity, progress)
            if hooks.stop():
                break
        dropped = 0
        if step >= config.steps and frames is not None and config.prune_invisible:
            extent = extent_of(self.scene)
            state, dropped = prune_invisible(state, frames, config, extent)
        return FitResult(state, pair_capacity or 0, progress, dropped)

    def progress(self, metrics: Metrics, divisor: int, state: TrainState) -> Progress:
        return Progress(
            metrics=metrics,
            seconds=time.perf_counter() - self.start,
            compile_seconds=self.compile_seconds,
            compilations=len(self.compiler.by_sizes),
            divisor=divisor,
            capacity=state.gaussians.capacity,
        )

    def program(
        self, state: TrainState, frames: Frames, raster: RasterConfig
    ) -> CompiledStep:
        """The compiled step for these sizes."""
        begun = time.perf_counter()
        step = self.compiler.step(state, frames, raster)
        self.compile_seconds += time.perf_counter() - begun
        return step


def subset(scene: Dataset, indices: Sequence[int]) -> Dataset:
    """The scene with some of its views, by their indices, in this order."""
    return replace(scene, views=tuple(scene.views[i] for i in indices))
