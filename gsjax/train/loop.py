"""Training loop on the host: resolutions, capacities and compilation."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.data.extent import extent_of
from gsjax.data.times import require_times
from gsjax.data.types import Dataset, Photo
from gsjax.densify.types import Strategy
from gsjax.errors import CapacityError
from gsjax.gaussians import Gaussians
from gsjax.raster.types import RasterConfig
from gsjax.train.capacity_policy import (
    capacities_for,
    visible_room,
    with_margin,
    with_slots,
    with_slots_ahead,
)
from gsjax.train.config import TrainConfig
from gsjax.train.frames import Frames, make_frames, views_of_step, views_until
from gsjax.train.health import Health, check_photos
from gsjax.train.initialisation import add_dense_points, initial_state
from gsjax.train.losses import LossTerm
from gsjax.train.models import IDENTITY, Model, scene_of
from gsjax.train.state import Metrics, Setup, TrainState, make_setup
from gsjax.train.step import refresh_table
from gsjax.train.step_compiler import CompiledStep, StepCompiler
from gsjax.train.visibility_pruning import prune_invisible


class Progress(NamedTuple):
    """Progress of a run after a step.

    Attributes:
      metrics: metrics of the step, on the host.
      seconds: time since the call of `fit`, including compilation.
      compile_seconds: part of it that was spent waiting for compilation.
      compilations: number of sizes that a step was compiled for.
      divisor: divisor of the image size.
      capacity: number of slots.
      visible_capacity: room for visible Gaussians; None for all slots.
    """

    metrics: Metrics
    seconds: float
    compile_seconds: float
    compilations: int
    divisor: int
    capacity: int
    visible_capacity: int | None = None

    def record(self) -> dict[str, float | int | bool]:
        """Return plain numbers, for a line of `metrics.jsonl`."""
        out = {k: np.asarray(v).item() for k, v in self.metrics._asdict().items()}
        rest = self._replace(
            seconds=round(self.seconds, 3),
            compile_seconds=round(self.compile_seconds, 3),
        )._asdict()
        del rest["metrics"], rest["visible_capacity"]
        return {**out, **rest}


@dataclass
class Hooks:
    """Callbacks of a run, called on the host.

    Attributes:
      step: called after each step.
      phase: called before long operations, with a description.
      checkpoint: called every ``config.every_checkpoint`` steps, unless the last step
        failed, with state, pair capacity and progress.
      measure: called every ``config.every_eval`` steps, before a checkpoint of the same
        step, with state and progress; its time is not counted.
      stop: called after each step; True ends the run.
      state: called after each step, with state and progress. The next step donates the
        state: copy what is kept.
    """

    step: Callable[[Progress], None] = lambda _: None
    phase: Callable[[str], None] = lambda _: None
    checkpoint: Callable[[TrainState, int, Progress], None] = lambda *_: None
    measure: Callable[[TrainState, Progress], None] = lambda *_: None
    stop: Callable[[], bool] = lambda: False
    state: Callable[[TrainState, Progress], None] = lambda *_: None


@dataclass
class FitResult:
    """Result of a run.

    Attributes:
      state: state after the last step.
      pair_capacity: pair capacity of the last step.
      progress: of the last step; None if no step was made.
      dropped: number of Gaussians removed afterwards by `TrainConfig.prune_invisible`.
      scene: the Gaussians to render, if a scene model makes them from the canonical
        ones of the state; of a scene that moves, those at time 0.
      model: the scene model.
    """

    state: TrainState
    pair_capacity: int
    progress: Progress | None = None
    dropped: int = 0
    scene: Gaussians | None = None
    model: Model = IDENTITY

    @property
    def gaussians(self) -> Gaussians:
        """The scene to render; with a model that depends on the view, canonical."""
        return self.state.gaussians if self.scene is None else self.scene

    def at(self, time: float) -> Gaussians:
        """Return the scene at a time, as of the views; for a model that moves."""
        return scene_of(self.model, self.state.params, time)


def fit(
    dataset: Dataset,
    photos: Sequence[Photo],
    config: TrainConfig,
    *,
    state: TrainState | None = None,
    pair_capacity: int | None = None,
    visible_capacity: int | None = None,
    hooks: Hooks | None = None,
    strategy: Strategy | None = None,
    loss_terms: Sequence[LossTerm] = (),
    model: Model | None = None,
) -> FitResult:
    """Train Gaussians on the photographs of a dataset.

    On a CPU, equal arguments and an equal number of devices give equal bits, also if
    the run is resumed from a state and pair capacity that a checkpoint kept. Warns once
    if no Gaussian is in view of a photograph that is not empty.

    Args:
      dataset: views to train on; all of them are used.
      photos: one for each view, from `load_photos`.
      config: settings.
      state: state to resume from, of the same settings, strategy and model; default
        `initial_state`.
      pair_capacity, visible_capacity: of the run that ``state`` is from.
      hooks: callbacks.
      strategy: density control; default that of ``config``.
      loss_terms: terms added to the photometric loss and the strategy's penalty.
      model: scene model; by default the Gaussians are rendered as they are.

    Returns:
      The state after the last step; the scene is ``.gaussians``.

    Raises:
      InputError: if photographs and views do not match, all pixels are masked, or there
        are no initial Gaussians; or if the scene is to move and the views have no
        times.
      CapacityError: if a view needs more pairs than can be addressed, or a step more
        memory than is available. Before, the state is passed to ``hooks.checkpoint``.
      DivergedError: if 50 of the last 100 steps, or half of a short run, had non-finite
        numbers or a PSNR below 0 dB; or if no Gaussian was in view for 50 steps.
    """
    check_photos(dataset, photos)
    if config.motion != "none":
        dataset = require_times(dataset)
    parts = {"strategy": strategy, "loss_terms": loss_terms, "model": model}
    setup = make_setup(config, extent_of(dataset), **parts)
    run = _Run(dataset, photos, setup, hooks or Hooks())
    if state is None:
        if config.initial == "dense":
            run.hooks.phase("matching points between the photographs")
        dense = add_dense_points(dataset, photos, config)
        state = initial_state(dense, config, setup=setup)
    else:
        state = _copied(state)  # steps donate their state, not that of the caller
    try:
        capacities = pair_capacity, visible_capacity
        return run.loop(run.compiler.place(state), *capacities)
    finally:
        run.compiler.close()


_copied = jax.jit(partial(jax.tree.map, jnp.copy))


@dataclass
class _Run:
    """A call of `fit`."""

    dataset: Dataset
    photos: Sequence[Photo]
    setup: Setup
    hooks: Hooks

    def __post_init__(self):
        self.start, self.compile_seconds = time.perf_counter(), 0.0
        self.config = self.setup.config
        self.health = Health(self.config.steps)
        self.compiler = StepCompiler(self.setup, self.hooks.phase)
        self.refreshes = refresh_table(self.setup)

    def loop(
        self, state: TrainState, pair_capacity: int | None, visible: int | None
    ) -> FitResult:
        """Run all remaining steps."""
        config, schedule = self.config, self.setup.schedule
        step, pairs = int(state.step), pair_capacity
        divisor = config.divisor(max(step - 1, 0))  # of the previous step
        frames, progress = None, None
        while step < config.steps:
            finer = config.divisor(step) != divisor
            if frames is None or finer:
                divisor = config.divisor(step)
                frames = self.frames(divisor)
            try:
                if finer:
                    state = with_slots_ahead(state, config, schedule)
                begun = time.perf_counter()
                if self.refreshes[step]:
                    state = self.compiler.refresh(state, frames)
                if pairs is None or finer:
                    shown = state.replace(gaussians=self.scene(state))
                    pairs, visible = capacities_for(shown, frames, config, schedule)
                raster = config.raster.replace(
                    pair_capacity=pairs, visible_capacity=visible
                )
                program = self.program(state, frames, raster)
                self.compile_seconds += time.perf_counter() - begun
                view = self.views(step)
                state, metrics = program(state, frames, view)
                if metrics.overflowed:
                    state = with_slots_ahead(state, config, schedule)
                    pairs, visible = self.room(state, metrics, pairs)
                    continue
            except CapacityError:
                if progress is not None and not self.health.bad:
                    self.hooks.checkpoint(state, pairs or 0, progress)
                raise
            step = int(metrics.step)
            progress = Progress(
                metrics=metrics,
                seconds=time.perf_counter() - self.start,
                compile_seconds=self.compile_seconds,
                compilations=len(self.compiler.by_sizes),
                divisor=divisor,
                capacity=state.gaussians.capacity,
                visible_capacity=visible,
            )
            self.health.check(metrics)
            self.hooks.step(progress)
            self.hooks.state(state, progress)
            slots = state.gaussians.capacity
            state = with_slots(state, int(metrics.wanted), config, schedule)
            if state.gaussians.capacity > slots:  # recompiles: with more pairs too
                pairs, visible = self.room(state, metrics, pairs)
                progress = progress._replace(visible_capacity=visible)
            self.report(state, pairs, progress)
            if self.hooks.stop():
                break
        dropped = 0
        if step >= config.steps and frames is not None and config.prune_invisible:
            state, dropped = prune_invisible(state, frames, self.setup)
        scene = self.scene(state)
        model = self.setup.model
        return FitResult(state, pairs or 0, progress, dropped, scene, model)

    def views(self, step: int) -> np.ndarray:
        """Return the views [B] of a step."""
        config, until = self.config, self.setup.model.until
        last = 1.0 if until is None else until(step / config.steps)
        views = self.dataset.views
        if last >= 1:
            return views_of_step(config.seed, step, config.batch, len(views))
        times = np.asarray([view.time or 0.0 for view in views])
        return views_until(config.seed, step, config.batch, times, last)

    def frames(self, divisor: int) -> Frames:
        """Return the photographs, downscaled by a divisor, on the devices."""
        frames = make_frames(
            self.dataset.views,
            self.photos,
            divisor,
            shutter=self.config.shutter,
            distorting=self.config.refine_intrinsics,
        )
        return self.compiler.place(frames)

    def room(
        self, state: TrainState, metrics: Metrics, pairs: int
    ) -> tuple[int, int | None]:
        """Return pair and visible capacities for what a step needed; pairs only grow.

        Raises:
          CapacityError: as `with_margin`.
        """
        config, schedule = self.config, self.setup.schedule
        wanted, seen = int(metrics.pair_capacity), int(metrics.visible)
        pairs = max(pairs, with_margin(wanted, state, config, schedule))
        return pairs, visible_room(seen, state.gaussians.capacity)

    def scene(self, state: TrainState) -> Gaussians:
        """Return the Gaussians that files and viewers show."""
        return scene_of(self.setup.model, state.params)

    def report(self, state: TrainState, pairs: int, progress: Progress) -> None:
        """Call the hooks that are due after a step; the caller handles the last one."""
        step, config = int(progress.metrics.step), self.config
        if step >= config.steps:
            return
        if config.every_eval and step % config.every_eval == 0:
            begun = time.perf_counter()
            self.hooks.measure(state, progress)
            self.start += time.perf_counter() - begun
        # After the measurement: a resumed run does not repeat it. A failed state is not
        # saved, since it would displace a good one.
        every = config.every_checkpoint
        if every and step % every == 0 and not self.health.bad:
            self.hooks.checkpoint(state, pairs, progress)

    def program(
        self, state: TrainState, frames: Frames, raster: RasterConfig
    ) -> CompiledStep:
        """Return the compiled step for these sizes."""
        return self.compiler.step(state, frames, raster)


def subset(dataset: Dataset, indices: Sequence[int]) -> Dataset:
    """Return the dataset with the views of the given indices, in that order."""
    return replace(dataset, views=tuple(dataset.views[i] for i in indices))
