"""Initial state of a run: from a given scene, or from points.

The points are those of the dataset, denser ones found in its photographs, or random.
"""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsjax.data.extent import has_points
from gsjax.data.types import Photo
from gsjax.errors import InputError
from gsjax.runs import folder as run_folder
from gsjax.runs.folder import RunSettings, SplitDataset
from gsjax.runs.session import Session
from gsjax.runtime.console import note
from gsjax.train.health import check_in_view
from gsjax.train.initialisation import add_dense_points, initial_state, resolve_initial
from gsjax.train.loop import subset
from gsjax.train.memory_estimate import check_memory, check_state_memory
from gsjax.train.state import TrainState


def resolve_initialisation(settings: RunSettings, split: SplitDataset) -> RunSettings:
    """Resolve the initialisation "auto" and store it, so that resuming repeats it."""
    config = settings.config
    if settings.start is not None:
        return settings
    resolved = resolve_initial(subset(split.dataset, split.train), config)
    if config.initial == "auto" and resolved.initial == "random":
        note("the dataset has no points: initialising at random (--initial random)")
    return replace(settings, config=resolved)


def load_initial_state(settings: RunSettings, split: SplitDataset) -> TrainState | None:
    """Return the first state of a run that starts from ``settings.start``, if it does.

    Raises:
      InputError: if the scene is missing, damaged, of another dataset, or has more
        Gaussians than allowed.
    """
    path, config = settings.start, settings.config
    if path is None:
        return None
    dataset = subset(split.dataset, split.train)
    gaussians = run_folder.load_scene(path, dataset.origin)
    active = np.asarray(gaussians.active)
    check_state_memory(int(active.sum()), config)
    note(f"starting from the scene of {path}")
    if gaussians.sh_degree > config.sh_degree:
        degree = f"{gaussians.sh_degree} is reduced to {config.sh_degree}"
        note(f"its SH degree {degree} (--sh-degree)")
    try:
        state = initial_state(dataset, config, gaussians)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    check_in_view(dataset, np.asarray(gaussians.params.means)[active], str(path))
    warn_of_trained_views(path, run_folder.with_views(settings, split).held_out)
    return state


def warn_of_trained_views(start: Path, held_out: tuple[str, ...]) -> None:
    """Warn if the run that made the scene ``start`` trained on held-out views."""
    folder = start.parent
    files = run_folder.run_files(folder)
    if files.splat != start or not files.config.exists():
        return
    trained = set(run_folder.load_settings(folder).trained) & set(held_out)
    if trained:
        seen = f"{len(trained)} of the {len(held_out)} held-out views"
        remedy = "hold out the views that it did (--test-images, --test-every)"
        note(f"warning: {folder} was trained on {seen}: metrics too high; {remedy}")


def first_state(session: Session, photos: list[Photo]) -> TrainState:
    """Return the state before the first step; its time counts as training."""
    dataset, config, start = session.dataset, session.config, time.perf_counter()
    if config.initial == "dense":
        note("matching photographs for dense initial points (--initial dense)")
    dense = add_dense_points(dataset, photos, config)
    if config.initial == "dense":
        found = len(dense.points) - len(dataset.points)
        note(f"{found:,} points added in {time.perf_counter() - start:.1f} s")
        if not has_points(dense):
            note("too few points, and the dataset has none: initialising at random")
            check_memory(dataset, config.replace(initial="random"), None)
    state = initial_state(dense, config)
    seconds = time.perf_counter() - start
    session.resume_point = session.resume_point._replace(seconds=seconds)
    return state
