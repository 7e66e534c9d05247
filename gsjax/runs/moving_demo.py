"""The demo of a moving scene: the animated still life, trained and shown in a movie."""

from pathlib import Path

from gsjax.data import camera_paths
from gsjax.io import images
from gsjax.runs.demo import DemoFiles, demo_files
from gsjax.runs.folder import RunSettings, load_split, run_files
from gsjax.runs.run import RunResult, start_run
from gsjax.runs.scene_source import open_scene_source
from gsjax.runs.trajectories import path_entries, render_movie, with_times
from gsjax.runtime.console import note
from gsjax.runtime.files import reject_existing
from gsjax.synthetic.moving import MovingDemoSettings, write_moving_dataset
from gsjax.train.config import TrainConfig, preset, scaled

STEPS = 3000
_FRAMES, _SECONDS = 72, 6.0


def moving_demo_config(motion: str, steps: int = STEPS, seed: int = 0) -> TrainConfig:
    """Return the preset "fast" for a scene that moves, initialised from the points."""
    config = scaled(preset("fast"), steps)
    return config.replace(seed=seed, max_size=None, initial="points", motion=motion)


def run_moving_demo(
    folder: Path,
    settings: MovingDemoSettings,
    *,
    motion: str,
    steps: int = STEPS,
    overwrite: bool = False,
) -> tuple[DemoFiles, RunResult]:
    """Write the dataset, train on it, evaluate, and render an orbit as time runs.

    Args:
      folder: for the outputs, as of `gsjax.runs.demo.run_demo`.
      settings: the photographs.
      motion: "field" or "trajectories".
      steps: of the training.
      overwrite: replace existing outputs.

    Raises:
      InputError: if an output exists and ``overwrite`` is not set, or cannot be
        written.
      MissingExtraError: if OpenCV is absent.
    """
    images.opencv()
    files = demo_files(folder)
    lists = files.dataset / "transforms_train.json"
    outputs = [lists, run_files(files.run).config, files.movie]
    reject_existing(outputs, overwrite, "another folder with -o")
    size = f"{settings.width} × {settings.height} px"
    taken = settings.cameras * settings.times + settings.photos
    note(f"rendering {taken} photographs of {size}")
    write_moving_dataset(files.dataset, settings, overwrite=overwrite)
    config = moving_demo_config(motion, steps, settings.seed)
    run = RunSettings(dataset=files.dataset, config=config)
    result = start_run(run, files.run, overwrite=overwrite)
    if result.finished:
        dataset = load_split(run).dataset
        source = open_scene_source(files.run, origin=dataset.origin)
        orbit = path_entries(dataset, camera_paths.orbit, frames=_FRAMES)
        entries, fps = with_times(orbit, (0.0, 1.0)), _FRAMES / _SECONDS
        render_movie(source, entries, files.movie, fps=fps, overwrite=overwrite)
    return files, result
