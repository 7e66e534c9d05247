"""A training run from a dataset to its folder: start, resume, save."""

import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.data.extent import extent_of
from gsjax.data.photos import load_photos
from gsjax.data.types import Dataset, Photo
from gsjax.errors import DivergedError, InputError
from gsjax.raster.tile_render import device_count
from gsjax.runs import folder as run_folder
from gsjax.runs.checkpoint import latest_step, load_latest, restore
from gsjax.runs.folder import RunFiles, RunSettings
from gsjax.runs.history import plot_curves, read_metrics, truncate_log
from gsjax.runs.initialisation import (
    first_state,
    load_initial_state,
    resolve_initialisation,
)
from gsjax.runs.session import ResumePoint, Session, resume_hint
from gsjax.runtime.console import note
from gsjax.runtime.files import locked_folder, make_folder, writing
from gsjax.train.config import TrainConfig
from gsjax.train.evaluation import Summary
from gsjax.train.initialisation import empty_state
from gsjax.train.loop import Progress, fit, subset
from gsjax.train.memory_estimate import check_memory
from gsjax.train.state import TrainState


class RunResult(NamedTuple):
    """Result of a run.

    Attributes:
      files: paths of its files.
      finished: False if it was interrupted.
      step: steps done.
      seconds: seconds of training, over all sessions.
      gaussians: number of active Gaussians.
      summary: metrics of the held-out views; None if there are none, or if the run was
        interrupted.
      training_psnr: of some training views, in dB; None without a summary. Where it is
        far above that of the held-out views, there are too few photographs.
    """

    files: RunFiles
    finished: bool
    step: int
    seconds: float
    gaussians: int
    summary: Summary | None
    training_psnr: float | None = None


# Receives the training data, and returns a hook to call after each step.
Watch = Callable[
    [Dataset, list[Photo], TrainConfig], Callable[[TrainState, Progress], None]
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
      settings, folder: settings and folder of the run; it is created if missing.
      overwrite: replace a run in the folder. It is removed only when the new run can
        start.
      watch: returns `Hooks.state`.

    Raises:
      InputError: if the folder is a file or the dataset's own folder, holds a run (and
        ``overwrite`` is not set) or files of something else; if another process trains
        in it; or if a file cannot be read or written.
      DivergedError: as `fit`; the last checkpoint and its scene are kept.
    """
    _files_to_replace(folder, overwrite)
    dataset = settings.dataset.resolve()
    if folder.resolve() == (dataset if dataset.is_dir() else dataset.parent):
        raise InputError(f"{folder}: is the dataset's own folder; pass another with -o")
    split = run_folder.load_split(settings)
    settings = resolve_initialisation(run_folder.with_views(settings, split), split)
    start = ResumePoint(load_initial_state(settings, split))
    session = Session(settings.config, split, run_folder.run_files(folder), start)
    photos, state = _load_photos_and_state(session)
    make_folder(folder)
    with locked_folder(folder):
        # Checked again: another process may have written here meanwhile.
        for path in _files_to_replace(folder, overwrite):
            with writing(path, "removed"):  # the target of a link stays
                folders = path.is_dir() and not path.is_symlink()
                shutil.rmtree(path) if folders else path.unlink()
        run_folder.save_settings(folder, settings)
        return _train(session, photos, state, watch)


def _files_to_replace(folder: Path, overwrite: bool) -> list[Path]:
    """Return the files of the run in ``folder``, config.json, which marks it, last.

    Raises:
      InputError: if there are any without ``overwrite``, or they are not a run's.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; pass a folder with -o")
    files = run_folder.run_files(folder)
    names = dict.fromkeys((*files, *run_folder.run_files(folder, "train")))
    found = [path for path in names if path.exists() or path.is_symlink()]
    if found and not overwrite:
        raise InputError(
            f"{found[0]}: exists; pass --resume to resume, --overwrite to start again, "
            "or another folder with -o"
        )
    if found:
        run_folder.load_settings(folder)  # raises if the folder is not a run
    return sorted(found, key=lambda path: path == files.config)


def resume_run(
    folder: Path, *, dataset: Path | None = None, watch: Watch | None = None
) -> RunResult:
    """Resume a stopped run; see `start_run`.

    With the same number of devices, the result is bit-equal to an uninterrupted run.

    ``dataset`` is the new place of the dataset, if it was moved.

    Raises:
      InputError: if the folder is not a run, its files are damaged, another process
        trains in it, or the dataset holds other views.
    """
    with locked_folder(folder):
        session = _resumed_session(folder, dataset)
        return _train(session, *_load_photos_and_state(session), watch)


def _resumed_session(folder: Path, dataset: Path | None) -> Session:
    settings, files = run_folder.load_settings(folder), run_folder.run_files(folder)
    if dataset is not None:
        settings = replace(settings, dataset=dataset)
    split = run_folder.load_split(settings)
    if dataset is not None:
        run_folder.save_settings(folder, settings)
        note(f"the run's dataset is now {dataset}")
    if any(files.checkpoints.glob("*.npz")):
        training = subset(split.dataset, split.train)
        start = _last_checkpoint(files, settings.config, training)
        if start.step < settings.config.steps:
            note(f"resuming from step {start.step:,}")
            now, before = device_count(settings.config.raster), start.devices
            if before not in (None, now):  # sums per device then round differently
                note(
                    f"{now} devices (cores) instead of {before}: the result is equal "
                    "up to rounding, not bit-equal"
                )
        else:
            done = f"the run finished before, at step {start.step:,}: only its results"
            more = f"to train on, start a run with --initial {folder}"
            note(f"{done} are written again; {more}")
    else:
        start = ResumePoint(load_initial_state(settings, split))
    return Session(settings.config, split, files, start)


def _last_checkpoint(
    files: RunFiles, config: TrainConfig, dataset: Dataset
) -> ResumePoint:
    found = load_latest(files.checkpoints, config.steps)
    capacity = int(found.meta["capacity"])
    template = empty_state(config, extent_of(dataset), len(dataset.views), capacity)
    return ResumePoint(
        state=restore(found, template),
        pair_capacity=int(found.meta["pair_capacity"]),
        visible_capacity=found.meta.get("visible_capacity"),
        step=found.step,
        seconds=float(found.meta["seconds"]),
        devices=found.meta.get("devices"),
    )


def _load_photos_and_state(session: Session) -> tuple[list[Photo], TrainState]:
    """Check the memory for training; return the photographs and the state to start."""
    config, split = session.config, session.split
    note(
        f"{len(split.dataset.views)} views ({len(split.test)} held out), "
        f"{len(split.dataset.points):,} points; loading the photographs"
    )
    state = session.resume_point.state
    check_memory(session.dataset, config, state)
    photos = load_photos(
        session.dataset.views, config.max_size, undistort=config.undistort
    )
    return photos, state or first_state(session, photos)


def _train(
    session: Session, photos: list[Photo], state: TrainState, watch: Watch | None
) -> RunResult:
    """Fit and save; after an error, write the scene of the last checkpoint."""
    try:
        return _fit_and_save(session, photos, state, watch)
    except Exception as error:
        files = session.files
        with suppress(Exception):  # the first error is the one to report
            start = _last_checkpoint(files, session.config, session.dataset)
            assert start.state is not None
            session.save_result(start.state)
            note(f"the scene of step {start.step} is kept: {files.splat}")
        if not isinstance(error, DivergedError):  # resuming would diverge again
            note(resume_hint(files))
        elif latest_step(files.checkpoints) is None:
            note("no checkpoint was written (--checkpoint-every): nothing is kept")
        raise


def _fit_and_save(
    session: Session, photos: list[Photo], state: TrainState, watch: Watch | None
) -> RunResult:
    config, files, dataset = session.config, session.files, session.dataset
    start = session.resume_point
    truncate_log(files.metrics, start.step)
    # The last step is evaluated again, also if the run had finished.
    truncate_log(files.held_out, min(start.step, config.steps - 1))
    with session.hooks() as hooks:
        if watch is not None:
            hooks.state = watch(dataset, photos, config)
        result = fit(
            dataset,
            photos,
            config,
            state=state,
            pair_capacity=start.pair_capacity,
            visible_capacity=start.visible_capacity,
            hooks=hooks,
        )
        gaussians = int(np.sum(result.gaussians.active))
        if result.dropped:
            dropped = f"{result.dropped:,} Gaussians visible in no photograph"
            note(f"{dropped} are removed; {gaussians:,} are left")
        # Inside the hooks, so that Ctrl-C does not interrupt saving.
        session.save(result.state, result.pair_capacity, result.progress)
        session.save_result(result.state)
        finished = int(result.state.step) >= config.steps and not hooks.stop()
    summary = session.evaluate(result, photos) if finished else None
    training = None if summary is None else session.training_psnr(result, photos)
    session.measured.write()
    metrics, held_out = (read_metrics(p) for p in (files.metrics, files.held_out))
    plot_curves(files.curves, metrics, len(photos), held_out)
    step, seconds = int(result.state.step), session.seconds(result.progress)
    return RunResult(files, finished, step, seconds, gaussians, summary, training)
