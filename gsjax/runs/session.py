"""One session of a run: its data, logs, checkpoints and results."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple

import numpy as np

from gsjax.data.extent import extent_of
from gsjax.data.photos import load_photos
from gsjax.data.types import Dataset, Photo
from gsjax.errors import InputError
from gsjax.raster.tile_render import device_count
from gsjax.runs.checkpoint import latest_step, save_checkpoint
from gsjax.runs.evaluation import (
    PREVIEWED,
    evaluate_views,
    write_evaluation,
    write_preview,
)
from gsjax.runs.folder import RunFiles, SplitDataset, save_scene
from gsjax.runs.history import JsonlLog
from gsjax.runs.moving import save_moving
from gsjax.runs.refined_cameras import refine_dataset, refine_photos, save_cameras
from gsjax.runs.report import Reporter
from gsjax.runtime.console import decibels, deferred_interrupt, note
from gsjax.runtime.files import remove_leftovers
from gsjax.train.config import TrainConfig
from gsjax.train.evaluation import Summary, summarise
from gsjax.train.health import has_valid_pixels
from gsjax.train.loop import FitResult, Hooks, Progress, subset
from gsjax.train.motion.scene import MovingScene
from gsjax.train.state import TrainState, shown_gaussians, shown_scene

_TRAINING = 16  # training views that are measured at the end


class ResumePoint(NamedTuple):
    """The point of a run at which a session starts: step 0 or the last checkpoint.

    Attributes:
      state: state to start from; None to initialise from points.
      pair_capacity, visible_capacity: capacities at that step.
      step: steps done.
      seconds: seconds of training so far.
      devices: number of devices that wrote the checkpoint, if known.
    """

    state: TrainState | None = None
    pair_capacity: int | None = None
    visible_capacity: int | None = None
    step: int = 0
    seconds: float = 0.0
    devices: int | None = None


class Session:
    """One session of a run: its data, and the files it writes while training.

    Held-out photographs are loaded at the first evaluation.
    """

    def __init__(
        self,
        config: TrainConfig,
        split: SplitDataset,
        files: RunFiles,
        resume_point: ResumePoint,
    ):
        self.config, self.split, self.files = config, split, files
        self.resume_point = resume_point
        self.dataset = subset(split.dataset, split.train)
        self.metrics = JsonlLog(files.metrics)
        self.measured = JsonlLog(files.held_out)
        self._held_out: list[Photo] | None = None

    def seconds(self, progress: Progress | None) -> float:
        """Return the seconds of training, over all sessions."""
        return self.resume_point.seconds + (progress.seconds if progress else 0.0)

    def save(
        self, state: TrainState, pair_capacity: int, progress: Progress | None
    ) -> None:
        """Write the logs, then a checkpoint, and remove leftovers of killed processes.

        Logs go first: a run resumed from the checkpoint does not log earlier steps.
        """
        self.metrics.write()
        self.measured.write()
        meta = {"pair_capacity": pair_capacity, "seconds": self.seconds(progress)}
        visible = progress.visible_capacity if progress else None
        meta["visible_capacity"] = visible
        meta["devices"] = device_count(self.config.raster)
        path = save_checkpoint(self.files.checkpoints, state, meta)
        for folder in (path.parent, self.files.config.parent):
            remove_leftovers(folder, path)

    def cameras(self, state: TrainState) -> Dataset:
        """Return all views with the cameras refined so far."""
        dataset, refinement = self.split.dataset, state.refinement
        parts = refinement.turns, refinement.intrinsics, refinement.twists
        if all(part is None for part in parts):
            return dataset
        extent = extent_of(self.dataset)
        trained = self.split.train
        return refine_dataset(dataset, trained, refinement, extent, self.config)

    def held_out(self, cameras: Dataset) -> tuple[Dataset, list[Photo]]:
        """Return the held-out views with the given cameras, and their photographs."""
        given, dataset = self.split.views("test"), subset(cameras, self.split.test)
        if self._held_out is None:
            self._held_out = load_photos(
                given, self.config.max_size, undistort=self.config.undistort
            )
        return dataset, refine_photos(self._held_out, given, dataset.views)

    def log_held_out(self, state: TrainState, summary: Summary, seconds: float) -> None:
        """Log the metrics of the held-out views."""
        record = {"step": int(state.step), "seconds": round(seconds, 3)}
        record |= {"psnr": summary.psnr, "ssim": summary.ssim}
        record["gaussians"] = int(np.sum(state.gaussians.active))
        self.measured.add(record)

    def save_result(self, state: TrainState) -> None:
        """Write the current scene, and its cameras if they are refined."""
        files, dataset = self.files, self.split.dataset
        scene = shown_gaussians(state, self.config)
        save_scene(files.splat, scene, dataset, self.config)
        moving = shown_scene(state, self.config)
        if isinstance(moving, MovingScene):
            save_moving(files.motion, moving, dataset.origin)
        if (cameras := self.cameras(state)) is not dataset:
            save_cameras(files.cameras, cameras)

    def evaluate(self, result: FitResult, photos: list[Photo]) -> Summary | None:
        """Evaluate the held-out views; without any, write only the preview."""
        config, split, files = self.config, self.split, self.files
        cameras = self.cameras(result.state)
        scene = shown_scene(result.state, config)
        dataset, held_out = self.held_out(cameras)
        if not any(map(has_valid_pixels, held_out)):
            if held_out:
                note("warning: all held-out views are fully masked: none is evaluated")
            dataset = subset(cameras, split.train[:PREVIEWED])
            given = self.dataset.views[:PREVIEWED]
            few = refine_photos(photos[:PREVIEWED], given, dataset.views)
            write_preview(files, list(evaluate_views(scene, dataset, few, config)))
            return None
        summary = write_evaluation(files, config, scene, dataset, held_out, "test")
        if config.every_eval:
            self.log_held_out(result.state, summary, self.seconds(result.progress))
        return summary

    def training_psnr(self, result: FitResult, photos: list[Photo]) -> float:
        """Return the mean PSNR of some training views, evenly chosen, in dB."""
        cameras, train = self.cameras(result.state), self.split.train
        few = np.unique(np.linspace(0, len(train) - 1, _TRAINING).astype(int))
        dataset = subset(cameras, [train[i] for i in few])
        given = [self.dataset.views[i] for i in few]
        some = refine_photos([photos[i] for i in few], given, dataset.views)
        scene = shown_scene(result.state, self.config)
        return summarise(evaluate_views(scene, dataset, some, self.config)).psnr

    @contextmanager
    def hooks(self) -> Iterator[Hooks]:
        """Return the hooks that report, log and save a run; flush the logs at exit.

        Inside the context, Ctrl-C stops the run after the current step.
        """
        reporter = Reporter(self.config, self.resume_point.step)

        def step(progress: Progress) -> None:
            reporter.step(progress)
            record = progress.record()
            record["seconds"] = round(self.seconds(progress), 3)
            self.metrics.add(record)

        def checkpoint(
            state: TrainState, pair_capacity: int, progress: Progress
        ) -> None:
            try:
                self.save(state, pair_capacity, progress)
            except InputError as error:
                # A full disk costs the checkpoint, not the run; older ones are kept.
                note(f"warning: {error}; continuing without this checkpoint")

        def measure(state: TrainState, progress: Progress) -> None:
            dataset, photos = self.held_out(self.cameras(state))
            if any(map(has_valid_pixels, photos)):
                scene = shown_scene(state, self.config)
                results = evaluate_views(scene, dataset, photos, self.config)
                summary = summarise(list(results))
                self.log_held_out(state, summary, self.seconds(progress))
                quality = f"PSNR {decibels(summary.psnr)}, SSIM {summary.ssim:.4f}"
                note(f"step {int(state.step)}: {len(photos)} held-out views: {quality}")

        try:
            with deferred_interrupt() as stopped:
                yield Hooks(step, note, checkpoint, measure=measure, stop=stopped)
        finally:
            reporter.close()
            for log in (self.metrics, self.measured):
                with suppress(InputError):  # the next file to be saved reports it
                    log.write()


def resume_hint(files: RunFiles) -> str:
    """Return how to resume a run that was interrupted."""
    step = latest_step(files.checkpoints)
    if step is not None:
        return f"step {step} is saved; resume with --resume"
    if files.config.exists():
        return "no step is saved yet; --resume starts again"
    return "nothing is saved yet"
