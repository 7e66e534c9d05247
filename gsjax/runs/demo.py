"""The built-in demo: synthetic photographs, training on them, and a turntable movie.

It takes the same path as `gsjax train` on real photographs.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from gsjax.data import camera_paths
from gsjax.io import images
from gsjax.runs.folder import RunSettings, load_split, run_files
from gsjax.runs.run import RunResult, start_run
from gsjax.runs.scene_source import open_scene_source
from gsjax.runs.trajectories import path_entries, render_movie
from gsjax.runtime.console import note
from gsjax.runtime.files import reject_existing
from gsjax.synthetic.raycaster import DemoDatasetSettings, write_demo_dataset
from gsjax.train.config import TrainConfig, preset, scaled

STEPS = 600
_TURN_FRAMES, _TURN_SECONDS = 48, 4.0
_MAX_GAUSSIANS = 16_384


class DemoFiles(NamedTuple):
    """Output paths of the demo."""

    dataset: Path
    run: Path
    movie: Path


class DemoSettings(NamedTuple):
    """Size of the demo.

    Attributes:
      photos: number of photographs.
      width, height: size of a photograph in px.
      steps: training steps.
      seed: seed of the initial points and of the training.
    """

    photos: int = 40
    width: int = 256
    height: int = 192
    steps: int = STEPS
    seed: int = 0


def demo_files(folder: Path) -> DemoFiles:
    """Return the output paths inside ``folder``."""
    return DemoFiles(folder / "dataset", folder / "run", folder / "turntable.webp")


def demo_config(steps: int = STEPS, seed: int = 0) -> TrainConfig:
    """Return the preset "fast" with fewer Gaussians, initialised from the points."""
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
    """Write the dataset, train on it, evaluate, and render a turntable.

    Ctrl-C stops it after training; the result is then not ``finished``.

    Raises:
      InputError: if an output exists and ``overwrite`` is not set, or cannot be
        written.
      MissingExtraError: if OpenCV is absent.
    """
    images.opencv()
    files = demo_files(folder)
    photos = files.dataset / "transforms.json"
    outputs = [photos, run_files(files.run).config, files.movie]
    reject_existing(outputs, overwrite, "another folder with -o")
    size = f"{settings.width} × {settings.height} px"
    note(f"rendering {settings.photos} photographs of {size}")
    sizes = settings._asdict()
    config = demo_config(sizes.pop("steps"), settings.seed)
    photographs = DemoDatasetSettings(**sizes, points=5000)
    write_demo_dataset(files.dataset, photographs, overwrite=overwrite)
    run = RunSettings(dataset=files.dataset, config=config)
    result = start_run(run, files.run, overwrite=overwrite)
    if result.finished:
        dataset = load_split(run).dataset
        source = open_scene_source(files.run, origin=dataset.origin)
        entries = path_entries(dataset, camera_paths.orbit, frames=_TURN_FRAMES)
        fps = _TURN_FRAMES / _TURN_SECONDS
        render_movie(source, entries, files.movie, fps=fps, overwrite=overwrite)
    return files, result
