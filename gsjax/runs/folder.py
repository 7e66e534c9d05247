"""The folder of a run: what it was made from, and where it keeps what.

RUN/config.json       settings, and which dataset and views
RUN/metrics.jsonl     one line a step: loss, PSNR, counts, seconds, compilations
RUN/checkpoints/      the two latest
RUN/splat.ply         the scene, in the coordinates of the dataset
RUN/cameras.json      its cameras, where they were refined
RUN/eval.json         PSNR and SSIM of the held-out views
RUN/held_out.jsonl    the same by step, where that was asked for
RUN/renders/          those views
RUN/preview.png       photograph, render, error and depth of some of them
RUN/curves.png        PSNR by step

and eval_train.json, renders_train/ and preview_train.png, where the training views were
measured too.
"""

import json
import shlex
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.data.dataset import is_dataset, load_dataset
from gsjax.data.splits import split_views
from gsjax.data.types import Dataset
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.io import load, save
from gsjax.runs.config_json import check_kinds, from_json, to_json
from gsjax.runs.history import read_metrics
from gsjax.runs.refined_cameras import with_cameras
from gsjax.runtime.files import read_json, write_json
from gsjax.train.config import TrainConfig

_FORMAT = 1


@dataclass(frozen=True)
class RunSettings:
    """What a run is made from.

    Attributes:
      dataset: folder or file.
      config: of the training.
      images, factor, skip_missing: as for `load_dataset`.
      every: hold out every so many-th view; 0 for none, None as the dataset says.
      test_images: hold out these instead.
      start: a file of Gaussians in the dataset's coordinates to start from, instead of
        what the config says.
      trained, held_out: names of the views, once they were split; they stay so, and
        what a dataset holds later is held against them.
    """

    dataset: Path
    config: TrainConfig = field(default_factory=TrainConfig)
    images: str | None = None
    factor: int | None = None
    skip_missing: bool = False
    every: int | None = None
    test_images: tuple[str, ...] = ()
    start: Path | None = None
    trained: tuple[str, ...] = ()
    held_out: tuple[str, ...] = ()


class RunFiles(NamedTuple):
    """Where a run keeps what."""

    config: Path
    metrics: Path
    checkpoints: Path
    splat: Path
    cameras: Path
    eval: Path
    held_out: Path
    renders: Path
    preview: Path
    curves: Path


class Data(NamedTuple):
    """A dataset, ready to train on.

    Attributes:
      scene: all of it.
      train, test: indices of its views.
    """

    scene: Dataset
    train: list[int]
    test: list[int]


def run_files(folder: Path, which: str = "test") -> RunFiles:
    """Names inside ``folder``, of the held-out views or those that were trained on."""
    of_views = "" if which == "test" else f"_{which}"
    return RunFiles(
        config=folder / "config.json",
        metrics=folder / "metrics.jsonl",
        checkpoints=folder / "checkpoints",
        splat=folder / "splat.ply",
        cameras=folder / "cameras.json",
        eval=folder / f"eval{of_views}.json",
        held_out=folder / "held_out.jsonl",
        renders=folder / f"renders{of_views}",
        preview=folder / f"preview{of_views}.png",
        curves=folder / "curves.png",
    )


def load_data(settings: RunSettings) -> Data:
    """The dataset of a run as it was given, and which views are for what.

    Raises:
      InputError: as `load_dataset` and `split_views`; if the dataset is not where it
        was, or holds other views than those that the run was made from.
    """
    if settings.trained and not settings.dataset.exists():
        raise InputError(
            f"{settings.dataset}: does not exist, and the run was made from it; if it "
            "was moved, tell the run once: gsjax train NEW_PLACE -o RUN --resume"
        )
    scene = load_dataset(
        settings.dataset,
        images=settings.images,
        skip_missing=settings.skip_missing,
        factor=settings.factor,
    )
    if not settings.trained:
        split = split_views(scene.views, settings.every, settings.test_images)
        return Data(scene, *split)
    data, held_out = Data(scene, [], []), set(settings.held_out)
    for index, view in enumerate(scene.views):
        (data.test if view.name in held_out else data.train).append(index)
    _check_same(settings, with_views(settings, data))
    return data


def with_views(settings: RunSettings, data: Data) -> RunSettings:
    """The same, with the names of the views and what they are for."""
    trained, held_out = (
        tuple(data.scene.views[index].name for index in some)
        for some in (data.train, data.test)
    )
    return replace(settings, trained=trained, held_out=held_out)


def _check_same(then: RunSettings, now: RunSettings) -> None:
    """See that a run's views are what they were."""
    names = {"trained on": (then.trained, now.trained),
             "held out": (then.held_out, now.held_out)}  # fmt: skip
    told = []
    for what, (old, new) in names.items():
        changes = [f"+{name}" for name in sorted(set(new) - set(old))]
        changes += [f"-{name}" for name in sorted(set(old) - set(new))]
        if changes:
            few = changes[:5] + ["…"] * (len(changes) > 5)
            told.append(f"{' '.join(few)} ({what})")
    if told or then != now:
        raise InputError(
            f"{then.dataset}: no longer the views that the run was made from: "
            f"{', '.join(told) or 'their order is another'}; put it back as it was, or "
            "train again"
        )


def refined_data(data: Data, files: RunFiles) -> Data:
    """The same with its cameras as the run left them.

    Raises:
      InputError: if their file is damaged.
    """
    if not files.cameras.exists():
        return data
    return data._replace(scene=with_cameras(data.scene, files.cameras))


def background_of(config: TrainConfig) -> tuple[float, float, float]:
    """Behind the scene where it is looked at."""
    return (1.0, 1.0, 1.0) if config.background == "white" else (0.0, 0.0, 0.0)


def load_settings(folder: Path) -> RunSettings:
    """The settings of a run.

    Raises:
      InputError: if the folder holds none, or they are damaged.
    """
    path, wanted = run_files(folder).config, "what `gsjax train -o` made"
    if not path.exists():
        raise InputError(f"{folder}: {_no_run(folder)}; pass {wanted}")
    data = read_json(path, wanted)
    try:
        if data["format"] != _FORMAT:
            raise ValueError(f"format {data['format']!r}; {_FORMAT} is wanted")
        rest = {k: v for k, v in data.items() if k not in ("format", "train")}
        check_kinds(RunSettings, rest)
        rest["dataset"] = Path(rest["dataset"])
        if rest.get("start") is not None:
            rest["start"] = Path(rest["start"])
        if "trained" not in rest and rest.get("every") == 8:
            rest["every"] = None  # an old run: the dataset's own split went before
        for name in ("test_images", "trained", "held_out"):
            rest[name] = tuple(rest.get(name, ()))
        config = from_json(json.dumps(data["train"]))
        return RunSettings(config=config, **rest)
    except KeyError as error:
        raise InputError(
            f"{path}: damaged: {error} is missing; pass {wanted}"
        ) from error
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: damaged: {error}; pass {wanted}") from error


def _no_run(path: Path) -> str:
    """What is there in place of a run's folder."""
    if not path.exists():
        return "does not exist"
    if not path.is_dir():
        return "a file, where the folder of a run is wanted"
    if is_dataset(path):
        call = shlex.join(["gsjax", "train", str(path)])
        return f"a dataset; train on it first ({call} -o RUN)"
    if run_files(path / "run").config.exists():  # as `gsjax demo` makes it
        return f"no run is here, but one is in {path / 'run'}"
    return "no run is here (config.json is missing)"


def save_settings(folder: Path, settings: RunSettings) -> None:
    """Write what `load_settings` reads.

    Raises:
      InputError: if it cannot be written.
    """
    data = {k: v for k, v in vars(settings).items() if k != "config"}
    for name in ("dataset", "start"):
        if data[name] is not None:
            data[name] = str(data[name].resolve())
    train = json.loads(to_json(settings.config))
    told = {"format": _FORMAT, **data, "train": train}
    write_json(run_files(folder).config, told, indent=2)


def save_scene(
    path: Path, gaussians: Gaussians, scene: Dataset, *, overwrite: bool = False
) -> None:
    """Write Gaussians in the coordinates of the dataset's files.

    Raises:
      InputError: as `gsjax.save`.
    """
    if not np.any(scene.origin):
        save(path, gaussians, overwrite=overwrite)
        return
    with jax.enable_x64(True):
        means = np.asarray(gaussians.params.means, np.float64) + scene.origin
        params = gaussians.params.replace(means=means)  # pyright: ignore
        save(path, gaussians.replace(params=params), overwrite=overwrite)  # pyright: ignore


def saved_splat(folder: Path) -> Path:
    """The Gaussians that a run has left: of its end, or of where it was stopped.

    Raises:
      InputError: if it has left none yet, with how far it is.
    """
    files = run_files(folder)
    if not files.splat.exists():
        settings = load_settings(folder)
        lines = read_metrics(files.metrics)
        done = lines[-1]["step"] if lines else 0
        words = ["gsjax", "train", settings.dataset, "-o", folder, "--resume"]
        raise InputError(
            f"{folder}: no scene yet, at step {done:,} of {settings.config.steps:,}: "
            "wait for its end; or, if it was stopped, go on with "
            f"{shlex.join(map(str, words))}"
        )
    return files.splat


def load_scene(path: Path, origin: np.ndarray) -> Gaussians:
    """Gaussians of a file, in coordinates from which ``origin`` [3] is subtracted: of
    one that `save_scene` wrote, those of its dataset.

    Raises:
      InputError: as `gsjax.load`.
    """
    if not np.any(origin):
        return load(path)
    with jax.enable_x64(True):
        wide = load(path)
        means = np.asarray(wide.params.means, np.float64) - origin
        params = wide.params.replace(means=means)  # pyright: ignore
    narrow = jax.tree.map(lambda a: np.asarray(a, np.float32), params)
    return jax.tree.map(jnp.asarray, wide.replace(params=narrow))  # pyright: ignore
