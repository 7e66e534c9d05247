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
from gsjax.runs.evaluation import evaluate_views, write_evaluation, write_preview
from gsjax.runs.folder import RunFiles, SplitDataset, save_scene
from gsjax.runs.history import JsonlLog
from gsjax.runs.refined_cameras import refine_dataset, refine_photos, save_cameras
from gsjax.runs.report import Reporter
from gsjax.runtime.console import decibels, note, stopping_on_ctrl_c
from gsjax.runtime.files import remove_leftovers
from gsjax.train.config import TrainConfig
from gsjax.train.evaluation import Summary, summarise
from gsjax.train.health import has_valid_pixels
from gsjax.train.loop import FitResult, Hooks, Progress, subset
from gsjax.train.state import TrainState


class ResumePoint(NamedTuple):
    """The point of a run at which a session starts: step 0 or the last checkpoint.

    Attributes:
      state: state to start from; None to initialise from points.
      pair_capacity: pair capacity at that step.
      step: steps done.
      seconds: seconds of training so far.
      devices: number of devices that wrote the checkpoint, if known.
    """

    state: TrainState | None = None
    pair_capacity: int | None = None
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
        meta = {
            "pair_capacity": pair_capacity,
            "seconds": self.seconds(progress),
            "devices": device_count(self.config.raster),
        }
        path = save_checkpoint(self.files.checkpoints, state, meta)
        for folder in (path.parent, self.files.config.parent):
            remove_leftovers(folder, path)

    def cameras(self, state: TrainState) -> Dataset:
        """Return all views with the cameras refined so far."""
        dataset, refinement = self.split.dataset, state.refinement
        if refinement.turns is None and refinement.intrinsics is None:
            return dataset
        extent = extent_of(self.dataset)
        return refine_dataset(dataset, self.split.train, refinement, extent)

    def held_out(self, cameras: Dataset) -> tuple[Dataset, list[Photo]]:
        """Return the held-out views with the given cameras, and their photographs."""
        given = subset(self.split.dataset, self.split.test)
        dataset = subset(cameras, self.split.test)
        if self._held_out is None:
            self._held_out = load_photos(given.views, self.config.max_size)
        return dataset, refine_photos(self._held_out, given.views, dataset.views)

    def log_held_out(self, state: TrainState, summary: Summary, seconds: float) -> None:
        """Log the metrics of the held-out views."""
        record = {
            "step": int(state.step),
            "seconds": round(seconds, 3),
            "psnr": summary.psnr,
            "ssim": summary.ssim,
            "gaussians": int(np.sum(state.gaussians.active)),
        }
        self.measured.add(record)


@contextmanager
def session_hooks(session: Session) -> Iterator[Hooks]:
    """Return the hooks that report, log and checkpoint a run; flush the logs at exit.

    Inside the context, Ctrl-C stops the run after the current step.
    """
    config = session.config
    reporter = Reporter(config, session.resume_point.step)

    def step(progress: Progress) -> None:
        reporter.step(progress)
        record = progress.record()
        record["seconds"] = round(session.seconds(progress), 3)
        session.metrics.add(record)

    def checkpoint(state: TrainState, pair_capacity: int, progress: Progress) -> None:
        try:
            session.save(state, pair_capacity, progress)
        except InputError as error:
            # A full disk costs the checkpoint, not the run; older ones are kept.
            note(f"warning: {error}; continuing without this checkpoint")

    def measure(state: TrainState, progress: Progress) -> None:
        dataset, photos = session.held_out(session.cameras(state))
        if any(map(has_valid_pixels, photos)):
            results = evaluate_views(state.gaussians, dataset, photos, config)
            summary = summarise(list(results))
            session.log_held_out(state, summary, session.seconds(progress))
            note(
                f"step {int(state.step)}: {len(photos)} held-out views: PSNR "
                f"{decibels(summary.psnr)}, SSIM {summary.ssim:.4f}"
            )

    try:
        with stopping_on_ctrl_c() as stopped:
            yield Hooks(
                step=step,
                phase=note,
                checkpoint=checkpoint,
                measure=measure,
                stop=stopped,
            )
    finally:
        reporter.close()
        for log in (session.metrics, session.measured):
            with suppress(InputError):  # the next file to be saved reports it
                log.write()


def save_result(session: Session, state: TrainState) -> None:
    """Write the current scene, and its cameras if they are refined."""
    files, dataset = session.files, session.split.dataset
    save_scene(files.splat, state.gaussians, dataset, overwrite=True)
    cameras = session.cameras(state)
    if cameras is not dataset:
        save_cameras(files.cameras, cameras)


def _can_evaluate(session: Session) -> bool:
    if not session.split.test:
        return False
    _, photos = session.held_out(session.split.dataset)
    if any(map(has_valid_pixels, photos)):
        return True
    note("warning: all held-out views are fully masked; nothing is evaluated")
    return False


def evaluate(
    session: Session, result: FitResult, photos: list[Photo]
) -> Summary | None:
    """Evaluate the held-out views; without any, write only the preview."""
    config, split, files = session.config, session.split, session.files
    cameras = session.cameras(result.state)
    if not _can_evaluate(session):
        dataset = subset(cameras, split.train)
        photos = refine_photos(photos, session.dataset.views, dataset.views)
        write_preview(files, config, result.gaussians, dataset, photos)
        return None
    dataset, held_out = session.held_out(cameras)
    summary = write_evaluation(
        files, config, result.gaussians, dataset, held_out, "test"
    )
    if config.every_eval:
        session.log_held_out(result.state, summary, session.seconds(result.progress))
    return summary


def resume_hint(files: RunFiles) -> str:
    """Return how to resume a run that was interrupted."""
    step = latest_step(files.checkpoints)
    if step is not None:
        return f"step {step} is saved; resume with --resume"
    if files.config.exists():
        return "no step is saved yet; --resume starts again"
    return "nothing is saved yet"
