"""The built-in demonstration: photographs from nothing, and a scene trained on them.

It goes the whole way that `gsjax train` goes with photographs of one's own.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from gsjax.io import images
from gsjax.runs.folder import RunSettings, load_data, run_files
from gsjax.runs.run import RunResult, start_run
from gsjax.runs.scene_source import open_scene_source
from gsjax.runs.trajectories import path_entries, write_flight
from gsjax.runtime.console import note
from gsjax.runtime.files import refuse_existing
from gsjax.synthetic.raycaster import DemoDatasetSettings, write_demo_dataset
from gsjax.train.config import TrainConfig, preset, scaled

STEPS = 600
_TURN_FRAMES, _TURN_SECONDS = 48, 4.0
_MAX_GAUSSIANS = 16_384


class DemoFiles(NamedTuple):
    """Where the demonstration writes."""

    dataset: Path
    run: Path
    turntable: Path


class DemoSettings(NamedTuple):
    """How much there is to do."""

    photos: int = 40
    width: int = 256
    height: int = 192
    steps: int = STEPS
    seed: int = 0


def demo_files(folder: Path) -> DemoFiles:
    """Names inside ``folder``."""
    return DemoFiles(folder / "dataset", folder / "run", folder / "turntable.webp")


def demo_config(steps: int = STEPS, seed: int = 0) -> TrainConfig:
    """The preset "fast", smaller still: for few Gaussians, and from the points of the
    dataset, which are many here.
    """
    config = scaled(preset("fast"), steps)
    return config.replace(
        seed=seed,
        strategy="adaptive",
        max_size=None,
        initial="points",
        adaptive=replace(config.adaptive, max_gaussians=_MAX_GAUSSIANS),
    )


def run_demo(
    folder: Path, settings: DemoSettings, *, overwrite: bool
) -> tuple[DemoFiles, RunResult]:
    """Take the photographs, train on them, evaluate, and turn the scene around.

    Interrupted, it stops after training; the result then says so.

    Raises:
      InputError: if something of it exists and ``overwrite`` is not set, or cannot be
        written.
      MissingExtraError: if OpenCV is absent.
    """
    images.opencv()
    files = demo_files(folder)
    _refuse_existing(files, overwrite)
    size = f"{settings.width} × {settings.height} px"
    note(f"taking {settings.photos} photographs of {size} of a still life")
    taken = DemoDatasetSettings(
        photos=settings.photos,
        width=settings.width,
        height=settings.height,
        points=5000,
        seed=settings.seed,
    )
    write_demo_dataset(files.dataset, taken, overwrite=overwrite)
    config = demo_config(settings.steps, settings.seed)
    run = RunSettings(dataset=files.dataset, config=config)
    result = start_run(run, files.run, overwrite=overwrite)
    if result.finished:
        _turn(files, run, overwrite)
    return files, result


def _refuse_existing(files: DemoFiles, overwrite: bool) -> None:
    photos = files.dataset / "transforms.json"
    made = [photos, run_files(files.run).config, files.turntable]
    refuse_existing(made, overwrite, "another folder with -o")


def _turn(files: DemoFiles, run: RunSettings, overwrite: bool) -> None:
    data = load_data(run)
    entries = path_entries(data, "orbit", frames=_TURN_FRAMES)
    write_flight(
        open_scene_source(files.run, origin=data.scene.origin),
        entries,
        files.turntable,
        fps=_TURN_FRAMES / _TURN_SECONDS,
        overwrite=overwrite,
    )
