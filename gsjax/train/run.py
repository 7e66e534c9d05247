"""A training run and its folder: what is read, what is left behind, how it goes on.

RUN/config.json       settings, and which dataset and views
RUN/metrics.jsonl     one line a step: loss, PSNR, counts, seconds, compilations
RUN/checkpoints/      the two latest
RUN/splat.ply         the scene, in the coordinates of the dataset
RUN/eval.json         PSNR and SSIM of the held-out views
RUN/renders/          those views
RUN/preview.png       photograph, render, error and depth of some of them
RUN/curves.png        PSNR by step
"""

import json
import math
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, NamedTuple

import jax
import numpy as np

from gsjax import images
from gsjax.console import note
from gsjax.errors import InputError
from gsjax.evaluate import Summary, ViewResult, evaluate, summarise
from gsjax.gaussians import Gaussians
from gsjax.io import load, save
from gsjax.scene.dataset import load_dataset
from gsjax.scene.photos import load_photos
from gsjax.scene.splits import split_views
from gsjax.scene.types import Photo, Scene
from gsjax.sheets import SheetRow, comparison
from gsjax.train.checkpoint import load_latest, restore, save_checkpoint
from gsjax.train.config import TrainConfig, from_json, to_json
from gsjax.train.fit import (
    FitResult,
    Hooks,
    Progress,
    empty_state,
    extent_of,
    fit,
    subset,
)
from gsjax.train.history import read_metrics, write_curves
from gsjax.train.report import Reporter
from gsjax.train.step import TrainState

_FORMAT = 1
_PREVIEWED = 4


@dataclass(frozen=True)
class RunSettings:
    """What a run is made from.

    Attributes:
      dataset: folder or file.
      config: of the training.
      images, factor, skip_missing: as for `load_dataset`.
      every: hold out every so many-th view; 0 for none.
      test_images: hold out these instead.
    """

    dataset: Path
    config: TrainConfig = field(default_factory=TrainConfig)
    images: str | None = None
    factor: int | None = None
    skip_missing: bool = False
    every: int = 8
    test_images: tuple[str, ...] = ()


class RunFiles(NamedTuple):
    """Where a run keeps what."""

    config: Path
    metrics: Path
    checkpoints: Path
    splat: Path
    eval: Path
    renders: Path
    preview: Path
    curves: Path


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


class Data(NamedTuple):
    """A dataset, ready to train on.

    Attributes:
      scene: all of it.
      train, test: indices of its views.
    """

    scene: Scene
    train: list[int]
    test: list[int]


def run_files(folder: Path) -> RunFiles:
    """Names inside ``folder``."""
    return RunFiles(
        config=folder / "config.json",
        metrics=folder / "metrics.jsonl",
        checkpoints=folder / "checkpoints",
        splat=folder / "splat.ply",
        eval=folder / "eval.json",
        renders=folder / "renders",
        preview=folder / "preview.png",
        curves=folder / "curves.png",
    )


def load_data(settings: RunSettings) -> Data:
    """The dataset of a run, and which views are for what.

    Raises:
      InputError: as `load_dataset` and `split_views`.
    """
    scene = load_dataset(
        settings.dataset,
        images=settings.images,
        skip_missing=settings.skip_missing,
        factor=settings.factor,
    )
    return Data(scene, *split_views(scene.views, settings.every, settings.test_images))


def background_of(config: TrainConfig) -> tuple[float, float, float]:
    """Behind the scene where it is looked at."""
    return (1.0, 1.0, 1.0) if config.background == "white" else (0.0, 0.0, 0.0)


def start_run(
    settings: RunSettings, folder: Path, *, overwrite: bool = False
) -> RunResult:
    """Train, save and evaluate.

    Raises:
      InputError: if the folder holds a run and ``overwrite`` is not set, or what is
        read or written fails.
      DivergedError: as `fit`; the last checkpoint is kept.
    """
    files = run_files(folder)
    ours = [path for path in files if path.exists()]
    if ours and not overwrite:
        raise InputError(
            f"{ours[0]}: exists; pass --resume to go on, --overwrite to start again, "
            "or another folder with -o"
        )
    data = load_data(settings)
    for path in ours:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    images.make_folder(folder)
    images.write_file(files.config, _settings_json(settings).encode())
    return _train(settings, data, files, None)


def resume_run(folder: Path) -> RunResult:
    """Go on where a run stopped, bit for bit as if it had not.

    Raises:
      InputError: if there is no run, or its files are damaged.
    """
    settings = load_settings(folder)
    files = run_files(folder)
    return _train(settings, load_data(settings), files, folder)


def load_settings(folder: Path) -> RunSettings:
    """The settings of a run.

    Raises:
      InputError: if the folder holds none, or they are damaged.
    """
    path = run_files(folder).config
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["format"] != _FORMAT:
            raise ValueError(f"format {data['format']}; {_FORMAT} is wanted")
        rest = {k: v for k, v in data.items() if k not in ("format", "gsjax", "train")}
        rest["dataset"] = Path(rest["dataset"])
        rest["test_images"] = tuple(rest["test_images"])
        config = from_json(json.dumps(data["train"]))
        return RunSettings(config=config, **rest)
    except OSError as error:
        raise InputError(
            f"{folder}: no run is here ({path.name}: {error.strerror or error}); pass "
            "the folder that `gsjax train -o` made"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: damaged: {error}") from error


def _settings_json(settings: RunSettings) -> str:
    data = {k: v for k, v in vars(settings).items() if k != "config"}
    data["dataset"] = str(settings.dataset.resolve())
    train = json.loads(to_json(settings.config))
    text = json.dumps({"format": _FORMAT, **data, "train": train}, indent=2)
    return text + "\n"


def _train(
    settings: RunSettings, data: Data, files: RunFiles, resumed: Path | None
) -> RunResult:
    config, scene = settings.config, subset(data.scene, data.train)
    note(
        f"{len(data.scene.views)} views ({len(data.test)} held out), "
        f"{len(data.scene.points):,} points; loading the photographs"
    )
    photos = load_photos(scene.views, config.max_size)
    state, pairs, before = None, None, 0.0
    if resumed is not None and any(files.checkpoints.glob("*.npz")):
        checkpoint = load_latest(files.checkpoints)
        capacity = int(checkpoint.meta["capacity"])
        template = empty_state(config, extent_of(scene), len(scene.views), capacity)
        state = restore(checkpoint, template)
        pairs = int(checkpoint.meta["pair_capacity"])
        before = float(checkpoint.meta["seconds"])
        note(f"going on from step {checkpoint.step}")
    done = 0 if state is None else int(state.step)
    _keep_lines(files.metrics, done)
    reporter = Reporter(config.steps, done)
    try:
        with (
            files.metrics.open("a", encoding="utf-8") as log,
            stopping_on_ctrl_c() as stopped,
        ):
            hooks = _hooks(reporter, log, files, before, stopped)
            result = fit(
                scene, photos, config, state=state, pair_capacity=pairs, hooks=hooks
            )
    finally:
        reporter.close()
    seconds = before + (result.progress.seconds if result.progress else 0.0)
    _save_state(files, result.state, result.pair_capacity, seconds)
    save_scene(files.splat, result.gaussians, data.scene, overwrite=True)
    write_curves(files.curves, read_metrics(files.metrics), len(scene.views))
    finished = int(result.state.step) >= config.steps
    summary = _evaluated(settings, data, photos, result, files) if finished else None
    return RunResult(
        files=files,
        finished=finished,
        step=int(result.state.step),
        seconds=seconds,
        gaussians=int(np.sum(result.gaussians.active)),
        summary=summary,
    )


def _hooks(
    reporter: Reporter, log: IO[str], files: RunFiles, before: float, stopped
) -> Hooks:
    """What is written while a run goes on."""

    def step(progress: Progress) -> None:
        reporter.step(progress)
        record = progress.record()
        record["seconds"] = round(before + progress.seconds, 3)
        log.write(json.dumps(_plain(record)) + "\n")

    def checkpoint(state: TrainState, pair_capacity: int, progress: Progress) -> None:
        log.flush()
        try:
            _save_state(files, state, pair_capacity, before + progress.seconds)
        except InputError as error:
            # A full disk costs the checkpoint, not the run; the older ones are kept.
            note(f"warning: {error}; going on without this checkpoint")

    return Hooks(step, reporter.phase, checkpoint, stopped)


def _plain(record: dict) -> dict:
    """With null for what JSON has no number for."""
    return {k: v if math.isfinite(v) else None for k, v in record.items()}


def _save_state(
    files: RunFiles, state: TrainState, pair_capacity: int, seconds: float
) -> None:
    meta = {"pair_capacity": pair_capacity, "seconds": seconds}
    save_checkpoint(files.checkpoints, state, meta)


def _keep_lines(path: Path, steps: int) -> None:
    """Drop what was logged after the checkpoint that a run goes on from."""
    if not path.exists():
        return
    kept = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            if json.loads(line)["step"] <= steps:
                kept.append(line + "\n")
        except (ValueError, KeyError, TypeError):
            continue  # cut short by a kill
    images.write_file(path, "".join(kept).encode())


@contextmanager
def stopping_on_ctrl_c() -> Iterator[Callable[[], bool]]:
    """Within, Ctrl-C only sets a flag, so that a step is never cut in two.

    A second one raises `KeyboardInterrupt` as usual. Off the main thread, where
    signals cannot be caught, nothing changes.
    """
    asked = False
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    previous = signal.getsignal(signal.SIGINT)

    def handle(*_):
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        note("stopping after this step; once more to stop at once")

    signal.signal(signal.SIGINT, handle)
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, previous)


def save_scene(
    path: Path, gaussians: Gaussians, scene: Scene, *, overwrite: bool = False
) -> None:
    """Write Gaussians in the coordinates of the dataset's files.

    Raises:
      InputError: as `gsjax.save`.
    """
    moved = gaussians
    if np.any(scene.origin):
        with jax.enable_x64(True):
            means = np.asarray(gaussians.params.means, np.float64) + scene.origin
            params = gaussians.params.replace(means=means)  # pyright: ignore
            moved = gaussians.replace(params=params)  # pyright: ignore
            save(path, moved, overwrite=overwrite)
        return
    save(path, moved, overwrite=overwrite)


def evaluate_run(folder: Path, *, which: str = "test") -> Summary:
    """Evaluate a run anew from its `splat.ply`, and write what `RunFiles` lists.

    Args:
      folder: of the run.
      which: "test", or "train" where nothing was held out.

    Raises:
      InputError: if there is no run or no such view.
    """
    settings, files = load_settings(folder), run_files(folder)
    data = load_data(settings)
    gaussians = load_scene(files.splat, data.scene)
    return _write_evaluation(settings, data, gaussians, files, which)


def load_scene(path: Path, scene: Scene) -> Gaussians:
    """Gaussians of a file that `save_scene` wrote, in the scene's coordinates.

    Raises:
      InputError: as `gsjax.load`.
    """
    if not np.any(scene.origin):
        return load(path)
    with jax.enable_x64(True):
        wide = load(path)
        means = np.asarray(wide.params.means, np.float64) - scene.origin
        params = wide.params.replace(means=means)  # pyright: ignore
    narrow = jax.tree.map(lambda a: np.asarray(a, np.float32), params)
    return jax.tree.map(jax.numpy.asarray, wide.replace(params=narrow))  # pyright: ignore


def _evaluated(
    settings: RunSettings,
    data: Data,
    photos: list[Photo],
    result: FitResult,
    files: RunFiles,
) -> Summary | None:
    if not data.test:
        few = [data.train.index(i) for i in data.train[:_PREVIEWED]]
        scene = subset(data.scene, [data.train[i] for i in few])
        shown = [photos[i] for i in few]
        rows = evaluate(
            result.gaussians, scene.views, shown,
            config=settings.config.raster, background=background_of(settings.config),
        )  # fmt: skip
        _write_preview(files, list(rows))
        return None
    return _write_evaluation(settings, data, result.gaussians, files, "test")


def _write_evaluation(
    settings: RunSettings, data: Data, gaussians: Gaussians, files: RunFiles, which: str
) -> Summary:
    chosen = data.test if which == "test" else data.train
    if not chosen:
        raise InputError(
            f"no {which} views in this run; evaluate the others with --views "
            f"{'train' if which == 'test' else 'test'}"
        )
    scene = subset(data.scene, chosen)
    photos = load_photos(scene.views, settings.config.max_size)
    images.make_folder(files.renders)
    begun, results = time.perf_counter(), []
    for result in evaluate(
        gaussians, scene.views, photos,
        config=settings.config.raster, background=background_of(settings.config),
    ):  # fmt: skip
        path = files.renders / f"{Path(result.name).with_suffix('')}.png"
        images.make_folder(path.parent)
        images.write_file(path, images.encode_png(images.to_8_bit(result.render)))
        results.append(result)
    summary = summarise(results)
    told = {
        "which": which,
        **summary._asdict(),
        "seconds": round(time.perf_counter() - begun, 3),
        "gaussians": int(np.sum(gaussians.active)),
        "each": [
            {
                "name": r.name,
                "psnr": r.psnr,
                "ssim": r.ssim,
                "size": r.depth.shape[::-1],
            }
            for r in results
        ],
    }
    images.write_file(files.eval, (json.dumps(told, indent=2) + "\n").encode())
    _write_preview(files, results)
    return summary


def _write_preview(files: RunFiles, results: list[ViewResult]) -> None:
    few = np.unique(np.linspace(0, len(results) - 1, _PREVIEWED).astype(int))
    rows = [
        SheetRow(results[i].name, results[i].truth, results[i].render, results[i].depth)
        for i in few
    ]
    images.write_file(files.preview, images.encode_png(comparison(rows)))
