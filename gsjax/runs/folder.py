"""The folder of a run: its files and settings.

RUN/config.json       settings, dataset and split
RUN/metrics.jsonl     one line per step: loss, PSNR, counts, seconds, compilations
RUN/checkpoints/      the two latest
RUN/splat.ply         the scene, in the coordinates of the dataset
RUN/motion.npz        with a motion: the scene at all times; splat.ply is that at time 0
RUN/cameras.json      refined cameras, if any
RUN/eval.json         PSNR and SSIM of the held-out views
RUN/held_out.jsonl    the same by step, with --eval-every
RUN/renders/          renders of the held-out views
RUN/preview.png       photograph, render, error and depth of some of them
RUN/curves.png        PSNR by step

Evaluating the training views adds eval_train.json, renders_train/ and
preview_train.png.
"""

import shlex
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.data.dataset import is_dataset, load_dataset
from gsjax.data.splits import split_views
from gsjax.data.times import require_times
from gsjax.data.types import Dataset, View
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.io.formats import load
from gsjax.io.ply import write_ply
from gsjax.runs.config_json import check_types, config_from_json
from gsjax.runs.history import read_metrics
from gsjax.runs.refined_cameras import load_cameras
from gsjax.runtime.files import read_json, write_json
from gsjax.train.config import TrainConfig, render_mode_of

_FORMAT = 1


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run.

    Attributes:
      dataset: folder or file of the dataset.
      config: training settings.
      images, factor, skip_missing: arguments of `load_dataset`.
      every: hold out every Nth view; 0 for none, None for the split of the dataset.
      test_images: names of the views to hold out instead.
      start: a file of Gaussians in the dataset's coordinates to initialise from,
        instead of ``config.initial``.
      trained, held_out: names of the views once split. They are fixed from then on, and
        a dataset with other views is rejected.
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
    """Paths of the files of a run; see the module's docstring."""

    config: Path
    metrics: Path
    checkpoints: Path
    splat: Path
    motion: Path
    cameras: Path
    eval: Path
    held_out: Path
    renders: Path
    preview: Path
    curves: Path


class SplitDataset(NamedTuple):
    """A dataset with its split into training and held-out views.

    Attributes:
      dataset: all views.
      train, test: indices of the views.
    """

    dataset: Dataset
    train: list[int]
    test: list[int]

    def views(self, which: str) -> list[View]:
        """Return the "train" or "test" views."""
        chosen = self.test if which == "test" else self.train
        return [self.dataset.views[index] for index in chosen]


def run_files(folder: Path, which: str = "test") -> RunFiles:
    """Return the paths inside ``folder``; ``which`` views were evaluated."""
    suffix = "" if which == "test" else f"_{which}"
    names = ("config.json", "metrics.jsonl", "checkpoints", "splat.ply")
    names += ("motion.npz", "cameras.json")
    names += (f"eval{suffix}.json", "held_out.jsonl", f"renders{suffix}")
    names += (f"preview{suffix}.png", "curves.png")
    return RunFiles(*(folder / name for name in names))


def load_split(settings: RunSettings) -> SplitDataset:
    """Load the dataset of a run with its original cameras, and split it.

    Raises:
      InputError: as `load_dataset` and `split_views`; if the dataset has moved, or has
        other views than the run.
    """
    if settings.trained and not settings.dataset.exists():
        raise InputError(
            f"{settings.dataset}: the run was trained on it, but it does not exist; if "
            "you moved it, pass its new place once: gsjax train NEW_PLACE -o RUN "
            "--resume"
        )
    images, factor, skip = settings.images, settings.factor, settings.skip_missing
    dataset = load_dataset(
        settings.dataset, images=images, skip_missing=skip, factor=factor
    )
    if settings.config.motion != "none":
        dataset = require_times(dataset)
    if not settings.trained:
        split = split_views(dataset.views, settings.every, settings.test_images)
        return SplitDataset(dataset, *split)
    split, held_out = SplitDataset(dataset, [], []), set(settings.held_out)
    for index, view in enumerate(dataset.views):
        (split.test if view.name in held_out else split.train).append(index)
    _check_same_views(settings, with_views(settings, split))
    return split


def with_views(settings: RunSettings, split: SplitDataset) -> RunSettings:
    """Return the settings with the names of the views of a split."""
    trained, held_out = (
        tuple(view.name for view in split.views(which)) for which in ("train", "test")
    )
    return replace(settings, trained=trained, held_out=held_out)


def _check_same_views(then: RunSettings, now: RunSettings) -> None:
    differences = []
    for role, field_name in (("trained on", "trained"), ("held out", "held_out")):
        old, new = (set(getattr(each, field_name)) for each in (then, now))
        changes = [f"+{name}" for name in sorted(new - old)]
        changes += [f"-{name}" for name in sorted(old - new)]
        if changes:
            few = changes[:5] + ["…"] * (len(changes) > 5)
            differences.append(f"{' '.join(few)} ({role})")
    if differences or then != now:
        fault = ", ".join(differences) or "their order differs"
        raise InputError(
            f"{then.dataset}: its views are not those of the run: {fault}; restore the "
            "dataset, or train again"
        )


def with_refined_cameras(split: SplitDataset, files: RunFiles) -> SplitDataset:
    """Replace the cameras by those that the run refined, if it did.

    Raises:
      InputError: if their file is damaged.
    """
    if not files.cameras.exists():
        return split
    return split._replace(dataset=load_cameras(split.dataset, files.cameras))


def background_color(config: TrainConfig) -> tuple[float, float, float]:
    """Return the RGB background to evaluate and view a scene with."""
    return (1.0, 1.0, 1.0) if config.background == "white" else (0.0, 0.0, 0.0)


def load_settings(folder: Path) -> RunSettings:
    """Return the settings of a run.

    Raises:
      InputError: if the folder is not that of a run, or its config.json is damaged.
    """
    path, expected = run_files(folder).config, "a folder made by `gsjax train -o`"
    if not path.exists():
        raise InputError(f"{folder}: {_why_not_a_run(folder)}; pass {expected}")
    data = read_json(path, expected)
    try:
        if data["format"] != _FORMAT:
            raise ValueError(f"format: expected {_FORMAT}, got {data['format']!r}")
        rest = {k: v for k, v in data.items() if k not in ("format", "train")}
        check_types(RunSettings, rest)
        rest["dataset"] = Path(rest["dataset"])
        if rest.get("start") is not None:
            rest["start"] = Path(rest["start"])
        if "trained" not in rest and rest.get("every") == 8:
            rest["every"] = None  # older versions wrote their default
        for name in ("test_images", "trained", "held_out"):
            rest[name] = tuple(rest.get(name, ()))
        return RunSettings(config=config_from_json(data["train"]), **rest)
    except (KeyError, ValueError, TypeError) as error:
        missing = " is missing" * isinstance(error, KeyError)
        message = f"{path}: damaged: {error}{missing}; pass {expected}"
        raise InputError(message) from error


def _why_not_a_run(path: Path) -> str:
    if not path.exists():
        return "does not exist"
    if not path.is_dir():
        return "expected the folder of a run, got a file"
    if is_dataset(path):
        call = shlex.join(["gsjax", "train", str(path)])
        return f"is a dataset; train on it first ({call} -o RUN)"
    if run_files(path / "run").config.exists():  # as `gsjax demo` writes it
        return f"is not a run, but {path / 'run'} is"
    return "is not a run (config.json is missing)"


def save_settings(folder: Path, settings: RunSettings) -> None:
    """Write the config.json of `load_settings`; raise `InputError` if that fails."""
    data = {k: v for k, v in vars(settings).items() if k != "config"}
    for name in ("dataset", "start"):
        if data[name] is not None:
            data[name] = str(data[name].resolve())
    content = {"format": _FORMAT, **data, "train": asdict(settings.config)}
    write_json(run_files(folder).config, content, indent=2)


def save_scene(
    path: Path, gaussians: Gaussians, dataset: Dataset, config: TrainConfig
) -> None:
    """Write Gaussians as a PLY in the coordinates of the dataset's files.

    Replaces an existing file.
    """
    options: dict = {"overwrite": True, "mode": render_mode_of(config.raster)}
    if not np.any(dataset.origin):
        return write_ply(path, gaussians, **options)
    with jax.enable_x64(True):
        write_ply(path, _moved(gaussians, dataset.origin), **options)


def _moved(gaussians: Gaussians, offset: np.ndarray) -> Gaussians:
    """Add an offset [3] to the means, in float64."""
    means = np.asarray(gaussians.params.means, np.float64) + offset
    params = gaussians.params.replace(means=means)  # pyright: ignore
    return gaussians.replace(params=params)  # pyright: ignore


def require_splat(folder: Path) -> Path:
    """Return the file of the Gaussians of a run, finished or stopped.

    Raises:
      InputError: if there is none yet; reports how far the run is.
    """
    files = run_files(folder)
    if not files.splat.exists():
        settings = load_settings(folder)
        lines = read_metrics(files.metrics)
        done = lines[-1]["step"] if lines else 0
        words = ["gsjax", "train", settings.dataset, "-o", folder, "--resume"]
        raise InputError(
            f"{folder}: no scene yet, at step {done:,} of {settings.config.steps:,}; "
            f"wait until the run ends, or resume it: {shlex.join(map(str, words))}"
        )
    return files.splat


def load_scene(path: Path, origin: np.ndarray) -> Gaussians:
    """Load Gaussians and subtract ``origin`` [3] from their means, in float64.

    This inverts `save_scene` for the origin of its dataset; it raises as `gsjax.load`.
    """
    if not np.any(origin):
        return load(path)
    with jax.enable_x64(True):
        wide = _moved(load(path), -origin)
    narrow = jax.tree.map(lambda a: np.asarray(a, np.float32), wide.params)
    return jax.tree.map(jnp.asarray, wide.replace(params=narrow))  # pyright: ignore
