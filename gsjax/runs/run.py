"""A training run from a dataset to its folder: started, gone on with, saved."""

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
from gsjax.raster.render import device_count
from gsjax.runs.checkpoint import latest_step, load_latest, restore
from gsjax.runs.folder import (
    RunFiles,
    RunSettings,
    load_data,
    load_settings,
    run_files,
    save_settings,
    with_views,
)
from gsjax.runs.history import keep_steps, read_metrics, write_curves
from gsjax.runs.initialisation import (
    first_state,
    load_initial_state,
    resolve_initialisation,
)
from gsjax.runs.session import (
    Session,
    Start,
    evaluate,
    save_result,
    saved_text,
    session_hooks,
)
from gsjax.runtime.console import note
from gsjax.runtime.files import alone_in, make_folder, writing
from gsjax.train.config import TrainConfig
from gsjax.train.evaluation import Summary
from gsjax.train.initialisation import empty_state
from gsjax.train.loop import Progress, fit, subset
from gsjax.train.memory_estimate import check_memory
from gsjax.train.state import TrainState


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


# Given what a training begins with, what is to be done after each step.
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
      settings: of the run.
      folder: where it is kept; created if missing.
      overwrite: whether a run in it may be replaced; it is once the new one can begin.
      watch: gives `Hooks.state`.

    Raises:
      InputError: if the folder holds a run and ``overwrite`` is not set, or files that
        are not a run's, or is the dataset's or a file, or another process trains in it,
        or what is read or written fails.
      DivergedError: as `fit`; the last good checkpoint is kept, and its scene.
    """
    _replaced(folder, overwrite)
    dataset = settings.dataset.resolve()
    if folder.resolve() == (dataset if dataset.is_dir() else dataset.parent):
        raise InputError(
            f"{folder}: is the dataset's own folder; pass another one with -o"
        )
    data = load_data(settings)
    settings = resolve_initialisation(with_views(settings, data), data)
    start = Start(load_initial_state(settings, data))
    session = Session(settings.config, data, run_files(folder), start)
    photos = _photographs(session)
    state = start.state or first_state(session, photos)
    make_folder(folder)
    with alone_in(folder):
        # By now another may have been here.
        for path in _replaced(folder, overwrite):
            _remove(path)
        save_settings(folder, settings)
        return _train(session, photos, state, watch)


def _replaced(folder: Path, overwrite: bool) -> list[Path]:
    """The files of the run that a new one takes the place of.

    What says that it is a run goes last: where something stays, it still is one.

    Raises:
      InputError: if there are any, and it may not, or they are no run's.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file; pass a folder with -o")
    files = run_files(folder)
    names = dict.fromkeys((*files, *run_files(folder, "train")))
    ours = [path for path in names if path.exists() or path.is_symlink()]
    if ours and not overwrite:
        raise InputError(
            f"{ours[0]}: exists; pass --resume to go on, --overwrite to start again, "
            "or another folder with -o"
        )
    if ours:
        load_settings(folder)  # refuses what is no run
    return sorted(ours, key=lambda path: path == files.config)


def _remove(path: Path) -> None:
    """A file, a folder with all that is in it, or a link, but not what it leads to."""
    with writing(path, "removed"):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def resume_run(
    folder: Path, *, dataset: Path | None = None, watch: Watch | None = None
) -> RunResult:
    """Go on where a run stopped, with as many devices bit for bit as if it had not; see
    `start_run`.

    Args:
      folder: of the run.
      dataset: where its dataset is now, if that was moved.
      watch: gives `Hooks.state`.

    Raises:
      InputError: if there is no run, its files are damaged, another process trains in
        it, or the dataset holds other views than it did.
    """
    with alone_in(folder):
        return _resumed(folder, dataset, watch)


def _resumed(folder: Path, dataset: Path | None, watch: Watch | None) -> RunResult:
    settings, files = load_settings(folder), run_files(folder)
    if dataset is not None:
        settings = replace(settings, dataset=dataset)
    data, start = load_data(settings), Start()
    if dataset is not None:
        save_settings(folder, settings)
        note(f"the run's dataset is now {dataset}")
    if any(files.checkpoints.glob("*.npz")):
        start = _last_checkpoint(files, settings.config, subset(data.scene, data.train))
        if start.step < settings.config.steps:
            note(f"going on from step {start.step:,}")
            _tell_other_devices(start.devices, settings.config)
        else:
            note(
                f"finished before, with step {start.step:,}: nothing is left to train; "
                "its results are made anew. For more steps, start another run from it "
                f"(--initial {folder})"
            )
    else:
        start = Start(load_initial_state(settings, data))
    session = Session(settings.config, data, files, start)
    photos = _photographs(session)
    state = start.state or first_state(session, photos)
    return _train(session, photos, state, watch)


def _last_checkpoint(files: RunFiles, config: TrainConfig, scene: Dataset) -> Start:
    found = load_latest(files.checkpoints, config.steps)
    capacity = int(found.meta["capacity"])
    template = empty_state(config, extent_of(scene), len(scene.views), capacity)
    return Start(
        restore(found, template),
        int(found.meta["pair_capacity"]),
        found.step,
        float(found.meta["seconds"]),
        found.meta.get("devices"),
    )


def _tell_other_devices(before: int | None, config: TrainConfig) -> None:
    """Sums are made device by device, and round by how many there are."""
    now = device_count(config.raster)
    if before not in (None, now):
        note(
            f"with {now} {'device' if now == 1 else 'devices'} (cores), and {before} "
            "before: the same training to rounding, not the same bits"
        )


def _photographs(session: Session) -> list[Photo]:
    """Those that are trained on, if there is memory enough for the training."""
    data, config = session.data, session.config
    note(
        f"{len(data.scene.views)} views ({len(data.test)} held out), "
        f"{len(data.scene.points):,} points; loading the photographs"
    )
    check_memory(session.scene, config, session.start.state)
    return load_photos(session.scene.views, config.max_size)


def _train(
    session: Session, photos: list[Photo], state: TrainState, watch: Watch | None
) -> RunResult:
    try:
        return _trained(session, photos, state, watch)
    except Exception as error:
        _keep_last(session, error)
        raise


def _keep_last(session: Session, error: Exception) -> None:
    """Of a run that an error cut short, leave the scene of the last checkpoint."""
    files = session.files
    with suppress(Exception):  # the error that is told is the first
        start = _last_checkpoint(files, session.config, session.scene)
        assert start.state is not None
        save_result(session, start.state)
        note(f"the scene of step {start.step} is kept: {files.splat}")
    if not isinstance(error, DivergedError):  # else it would only do so again
        note(saved_text(files))
    elif latest_step(files.checkpoints) is None:
        note("no checkpoint was due before that (--checkpoint-every): nothing is kept")


def _trained(
    session: Session, photos: list[Photo], state: TrainState, watch: Watch | None
) -> RunResult:
    config, files, scene = session.config, session.files, session.scene
    start = session.start
    keep_steps(files.metrics, start.step)
    # The end is measured anew, also of a run that had come to it.
    keep_steps(files.held_out, min(start.step, config.steps - 1))
    with session_hooks(session) as hooks:
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
        if result.dropped:
            left = int(np.sum(result.gaussians.active))
            note(
                f"{result.dropped:,} Gaussians that no photograph shows are dropped; "
                f"{left:,} are left"
            )
        # Within, so that Ctrl-C does not cut it in two either.
        session.save(result.state, result.pair_capacity, result.progress)
        save_result(session, result.state)
        finished = int(result.state.step) >= config.steps and not hooks.stop()
    summary = evaluate(session, result, photos) if finished else None
    session.measured.write()
    metrics, held_out = (read_metrics(p) for p in (files.metrics, files.held_out))
    write_curves(files.curves, metrics, len(photos), held_out)
    return RunResult(
        files=files,
        finished=finished,
        step=int(result.state.step),
        seconds=session.seconds(result.progress),
        gaussians=int(np.sum(result.gaussians.active)),
        summary=summary,
    )
