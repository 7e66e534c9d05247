"""A training run from a dataset to its folder: started, gone on with, saved."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.console import decibels, note, stopping_on_ctrl_c
from gsjax.errors import InputError
from gsjax.evaluation import Summary, summarise
from gsjax.files import make_folder
from gsjax.scene.photos import load_photos
from gsjax.scene.types import Photo, Scene
from gsjax.train.checkpoint import load_latest, restore, save_checkpoint
from gsjax.train.config import TrainConfig
from gsjax.train.fit import (
    FitResult,
    Hooks,
    Progress,
    empty_state,
    extent_of,
    fit,
    initial_state,
    subset,
)
from gsjax.train.folder import (
    Data,
    RunFiles,
    RunSettings,
    load_data,
    load_settings,
    run_files,
    save_scene,
    save_settings,
    with_views,
)
from gsjax.train.footprint import check_memory
from gsjax.train.health import is_seen
from gsjax.train.held_out import results_of, write_evaluation, write_preview
from gsjax.train.history import Journal, keep_steps, read_metrics, write_curves
from gsjax.train.refined import refined_photos, refined_scene, save_cameras
from gsjax.train.report import Reporter
from gsjax.train.step import TrainState


class RunResult(NamedTuple):
    """What a run came to.

    Attributes:
      files: where everything is.
      finished: False if it was interrupted.
      step: steps done, of all.
      seconds: of training, all sittings together.
      gaussians: active ones.
      summary: of the held-out views; None if there are none or it was interrupted.
    """

    files: RunFiles
    finished: bool
    step: int
    seconds: float
    gaussians: int
    summary: Summary | None


class _Start(NamedTuple):
    """Where a sitting takes the run up: the beginning, or its last checkpoint."""

    state: TrainState | None = None
    pair_capacity: int | None = None
    step: int = 0
    seconds: float = 0.0


class _Sitting:
    """One sitting of a run: its data, and what is written as it goes.

    Photographs of the held-out views are loaded when they are first measured with.
    """

    def __init__(self, config: TrainConfig, data: Data, files: RunFiles, start: _Start):
        self.config, self.data, self.files, self.start = config, data, files, start
        self.scene = subset(data.scene, data.train)
        self.metrics, self.measured = Journal(files.metrics), Journal(files.held_out)
        self._held_out: list[Photo] | None = None

    def seconds(self, progress: Progress | None) -> float:
        """Of training, all sittings together."""
        return self.start.seconds + (progress.seconds if progress else 0.0)

    def save(
        self, state: TrainState, pair_capacity: int, progress: Progress | None
    ) -> None:
        """A checkpoint, and before it what was logged: a run that is taken up there
        logs no step before it again.
        """
        self.metrics.write()
        self.measured.write()
        meta = {"pair_capacity": pair_capacity, "seconds": self.seconds(progress)}
        save_checkpoint(self.files.checkpoints, state, meta)

    def cameras(self, state: TrainState) -> Scene:
        """All views, with their cameras as they are by now."""
        data, tuning = self.data, state.tuning
        if tuning.turns is None and tuning.intrinsics is None:
            return data.scene
        return refined_scene(data.scene, data.train, tuning, extent_of(self.scene))

    def held_out(self, cameras: Scene) -> tuple[Scene, list[Photo]]:
        """The held-out views, with these cameras, and their photographs."""
        given, scene = (subset(s, self.data.test) for s in (self.data.scene, cameras))
        if self._held_out is None:
            self._held_out = load_photos(given.views, self.config.max_size)
        return scene, refined_photos(self._held_out, given.views, scene.views)

    def log_held_out(self, state: TrainState, summary: Summary, seconds: float) -> None:
        """A line of how well the held-out views are shown."""
        record = {
            "step": int(state.step),
            "seconds": round(seconds, 3),
            "psnr": summary.psnr,
            "ssim": summary.ssim,
            "gaussians": int(np.sum(state.gaussians.active)),
        }
        self.measured.add(record)


# Given what a training begins with, what is to be done after each step.
Watch = Callable[
    [Scene, list[Photo], TrainConfig], Callable[[TrainState, Progress], None]
]


def start_run(
    settings: RunSettings,
    folder: Path,
    *,
    overwrite: bool = False,
    watch: Watch | None = None,
) -> RunResult:
    """Train, save and evaluate.

    Args:
      settings: of the run.
      folder: where it is kept; created if missing.
      overwrite: whether a run in it may be replaced; it is once the new one can begin.
      watch: gives `Hooks.state`.

    Raises:
      InputError: if the folder holds a run and ``overwrite`` is not set, or files that
        are not a run's, or what is read or written fails.
      DivergedError: as `fit`; the last checkpoint is kept.
    """
    files = run_files(folder)
    names = dict.fromkeys((*files, *run_files(folder, "train")))
    ours = [path for path in names if path.exists()]
    if ours and not overwrite:
        raise InputError(
            f"{ours[0]}: exists; pass --resume to go on, --overwrite to start again, "
            "or another folder with -o"
        )
    if ours:
        load_settings(folder)  # refuses what is no run
    data = load_data(settings)
    settings = with_views(settings, data)
    sitting = _Sitting(settings.config, data, files, _Start())
    photos = _photographs(sitting)
    state = initial_state(sitting.scene, settings.config)
    for path in ours:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    make_folder(folder)
    save_settings(folder, settings)
    return _train(sitting, photos, state, watch)


def resume_run(
    folder: Path, *, dataset: Path | None = None, watch: Watch | None = None
) -> RunResult:
    """Go on where a run stopped, bit for bit as if it had not; see `start_run`.

    Args:
      folder: of the run.
      dataset: where its dataset is now, if that was moved.
      watch: gives `Hooks.state`.

    Raises:
      InputError: if there is no run, its files are damaged, or the dataset holds other
        views than it did.
    """
    settings, files = load_settings(folder), run_files(folder)
    if dataset is not None:
        settings = replace(settings, dataset=dataset)
    data, start = load_data(settings), _Start()
    if dataset is not None:
        save_settings(folder, settings)
        note(f"the run's dataset is now {dataset}")
    if any(files.checkpoints.glob("*.npz")):
        start = _last_checkpoint(files, settings.config, subset(data.scene, data.train))
        note(f"going on from step {start.step}")
    sitting = _Sitting(settings.config, data, files, start)
    photos = _photographs(sitting)
    state = start.state or initial_state(sitting.scene, settings.config)
    return _train(sitting, photos, state, watch)


def _last_checkpoint(files: RunFiles, config: TrainConfig, scene: Scene) -> _Start:
    found = load_latest(files.checkpoints)
    capacity = int(found.meta["capacity"])
    template = empty_state(config, extent_of(scene), len(scene.views), capacity)
    return _Start(
        restore(found, template),
        int(found.meta["pair_capacity"]),
        found.step,
        float(found.meta["seconds"]),
    )


def _photographs(sitting: _Sitting) -> list[Photo]:
    """Those that are trained on, if there is memory enough for the training."""
    data, config = sitting.data, sitting.config
    note(
        f"{len(data.scene.views)} views ({len(data.test)} held out), "
        f"{len(data.scene.points):,} points; loading the photographs"
    )
    check_memory(sitting.scene, config, sitting.start.state)
    return load_photos(sitting.scene.views, config.max_size)


def _train(
    sitting: _Sitting, photos: list[Photo], state: TrainState, watch: Watch | None
) -> RunResult:
    config, files, scene = sitting.config, sitting.files, sitting.scene
    start = sitting.start
    for path in (files.metrics, files.held_out):
        keep_steps(path, start.step)
    with _hooks(sitting) as hooks:
        if watch is not None:
            hooks.state = watch(scene, photos, config)
        result = fit(
            scene,
            photos,
            config,
            state=state,
            pair_capacity=start.pair_capacity,
            hooks=hooks,
        )
        # Within, so that Ctrl-C does not cut it in two either.
        _save(sitting, result)
        finished = int(result.state.step) >= config.steps and not hooks.stop()
    summary = _evaluate(sitting, result, photos) if finished else None
    sitting.measured.write()
    metrics, held_out = (read_metrics(p) for p in (files.metrics, files.held_out))
    write_curves(files.curves, metrics, len(photos), held_out)
    return RunResult(
        files=files,
        finished=finished,
        step=int(result.state.step),
        seconds=sitting.seconds(result.progress),
        gaussians=int(np.sum(result.gaussians.active)),
        summary=summary,
    )


@contextmanager
def _hooks(sitting: _Sitting) -> Iterator[Hooks]:
    """What is told and written while a run goes on."""
    config = sitting.config
    reporter = Reporter(config.steps, sitting.start.step)

    def step(progress: Progress) -> None:
        reporter.step(progress)
        record = progress.record()
        record["seconds"] = round(sitting.seconds(progress), 3)
        sitting.metrics.add(record)

    def checkpoint(state: TrainState, pair_capacity: int, progress: Progress) -> None:
        try:
            sitting.save(state, pair_capacity, progress)
        except InputError as error:
            # A full disk costs the checkpoint, not the run; the older ones are kept.
            note(f"warning: {error}; going on without this checkpoint")

    def measure(state: TrainState, progress: Progress) -> None:
        scene, photos = sitting.held_out(sitting.cameras(state))
        if any(map(is_seen, photos)):
            found = results_of(state.gaussians, scene, photos, config)
            summary = summarise(list(found))
            sitting.log_held_out(state, summary, sitting.seconds(progress))
            note(
                f"step {int(state.step)}: {len(photos)} held-out views: PSNR "
                f"{decibels(summary.psnr)}, SSIM {summary.ssim:.4f}"
            )

    try:
        with stopping_on_ctrl_c() as stopped:
            yield Hooks(
                step=step,
                phase=reporter.phase,
                checkpoint=checkpoint,
                measure=measure,
                stop=stopped,
            )
    finally:
        reporter.close()
        with suppress(InputError):  # told of by whatever is to be saved next
            sitting.metrics.write()


def _save(sitting: _Sitting, result: FitResult) -> None:
    """What a run leaves behind whether or not it came to its end."""
    files, scene = sitting.files, sitting.data.scene
    try:
        sitting.save(result.state, result.pair_capacity, result.progress)
        save_scene(files.splat, result.gaussians, scene, overwrite=True)
        cameras = sitting.cameras(result.state)
        if cameras is not scene:
            save_cameras(files.cameras, cameras)
    except InputError as error:
        raise InputError(f"{error}: {saved_text(files)}") from error


def saved_text(files: RunFiles) -> str:
    """From where a run that was cut short can be gone on with."""
    kept = sorted(files.checkpoints.glob("step_*.npz"))
    if kept:
        step = int(kept[-1].stem.removeprefix("step_"))
        return f"step {step} is saved; go on with --resume"
    if files.config.exists():
        return "no step is saved yet; --resume starts from the beginning"
    return "nothing is saved yet"


def _any_to_measure(sitting: _Sitting) -> bool:
    if not sitting.data.test:
        return False
    _, photos = sitting.held_out(sitting.data.scene)
    if any(map(is_seen, photos)):
        return True
    note("warning: all held-out views are masked altogether: nothing is measured")
    return False


def _evaluate(
    sitting: _Sitting, result: FitResult, photos: list[Photo]
) -> Summary | None:
    """Of the held-out views; where there are none, only the preview is written."""
    config, data, files = sitting.config, sitting.data, sitting.files
    cameras = sitting.cameras(result.state)
    if not _any_to_measure(sitting):
        scene = subset(cameras, data.train)
        photos = refined_photos(photos, sitting.scene.views, scene.views)
        write_preview(files, config, result.gaussians, scene, photos)
        return None
    scene, held_out = sitting.held_out(cameras)
    summary = write_evaluation(files, config, result.gaussians, scene, held_out, "test")
    if config.every_eval:
        sitting.log_held_out(result.state, summary, sitting.seconds(result.progress))
    return summary
