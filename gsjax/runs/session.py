"""One session of a run: its data, and what is told and written as it goes."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple

import numpy as np

from gsjax.data.extent import extent_of
from gsjax.data.photos import load_photos
from gsjax.data.types import Dataset, Photo
from gsjax.errors import InputError
from gsjax.raster.render import device_count
from gsjax.runs.checkpoint import latest_step, save_checkpoint
from gsjax.runs.folder import Data, RunFiles, save_scene
from gsjax.runs.held_out import results_of, write_evaluation, write_preview
from gsjax.runs.history import Journal
from gsjax.runs.refined_cameras import refined_photos, refined_scene, save_cameras
from gsjax.runs.report import Reporter
from gsjax.runtime.console import decibels, note, stopping_on_ctrl_c
from gsjax.runtime.files import remove_leftovers
from gsjax.train.config import TrainConfig
from gsjax.train.evaluation import Summary, summarise
from gsjax.train.health import is_seen
from gsjax.train.loop import FitResult, Hooks, Progress, subset
from gsjax.train.state import TrainState


class Start(NamedTuple):
    """Where a session takes the run up: the beginning, or its last checkpoint, and with
    how many devices that was written, if it says so."""

    state: TrainState | None = None
    pair_capacity: int | None = None
    step: int = 0
    seconds: float = 0.0
    devices: int | None = None


class Session:
    """One session of a run: its data, and what is written as it goes.

    Photographs of the held-out views are loaded when they are first measured with.
    """

    def __init__(self, config: TrainConfig, data: Data, files: RunFiles, start: Start):
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
        logs no step before it again. After it, what a kill had left goes.
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
        """All views, with their cameras as they are by now."""
        data, refinement = self.data, state.refinement
        if refinement.turns is None and refinement.intrinsics is None:
            return data.scene
        return refined_scene(data.scene, data.train, refinement, extent_of(self.scene))

    def held_out(self, cameras: Dataset) -> tuple[Dataset, list[Photo]]:
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


@contextmanager
def session_hooks(session: Session) -> Iterator[Hooks]:
    """What is told and written while a run goes on."""
    config = session.config
    reporter = Reporter(config, session.start.step)

    def step(progress: Progress) -> None:
        reporter.step(progress)
        record = progress.record()
        record["seconds"] = round(session.seconds(progress), 3)
        session.metrics.add(record)

    def checkpoint(state: TrainState, pair_capacity: int, progress: Progress) -> None:
        try:
            session.save(state, pair_capacity, progress)
        except InputError as error:
            # A full disk costs the checkpoint, not the run; the older ones are kept.
            note(f"warning: {error}; going on without this checkpoint")

    def measure(state: TrainState, progress: Progress) -> None:
        scene, photos = session.held_out(session.cameras(state))
        if any(map(is_seen, photos)):
            found = results_of(state.gaussians, scene, photos, config)
            summary = summarise(list(found))
            session.log_held_out(state, summary, session.seconds(progress))
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
        for journal in (session.metrics, session.measured):
            with suppress(InputError):  # told of by whatever is to be saved next
                journal.write()


def save_result(session: Session, state: TrainState) -> None:
    """The scene of a run as it is by now, and its cameras where they were learnt."""
    files, scene = session.files, session.data.scene
    save_scene(files.splat, state.gaussians, scene, overwrite=True)
    cameras = session.cameras(state)
    if cameras is not scene:
        save_cameras(files.cameras, cameras)


def _any_to_measure(session: Session) -> bool:
    if not session.data.test:
        return False
    _, photos = session.held_out(session.data.scene)
    if any(map(is_seen, photos)):
        return True
    note("warning: all held-out views are masked altogether: nothing is measured")
    return False


def evaluate(
    session: Session, result: FitResult, photos: list[Photo]
) -> Summary | None:
    """Of the held-out views; where there are none, only the preview is written."""
    config, data, files = session.config, session.data, session.files
    cameras = session.cameras(result.state)
    if not _any_to_measure(session):
        scene = subset(cameras, data.train)
        photos = refined_photos(photos, session.scene.views, scene.views)
        write_preview(files, config, result.gaussians, scene, photos)
        return None
    scene, held_out = session.held_out(cameras)
    summary = write_evaluation(files, config, result.gaussians, scene, held_out, "test")
    if config.every_eval:
        session.log_held_out(result.state, summary, session.seconds(result.progress))
    return summary


def saved_text(files: RunFiles) -> str:
    """From where a run that was cut short can be gone on with."""
    step = latest_step(files.checkpoints)
    if step is not None:
        return f"step {step} is saved; go on with --resume"
    if files.config.exists():
        return "no step is saved yet; --resume starts from the beginning"
    return "nothing is saved yet"
