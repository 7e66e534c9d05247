"""What a run starts from: a scene that it is given, or points, of the dataset or found
in its photographs, or random ones.
"""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsjax.data.extent import has_points
from gsjax.data.types import Photo
from gsjax.errors import InputError
from gsjax.runs.folder import (
    Data,
    RunSettings,
    load_scene,
    load_settings,
    run_files,
    with_views,
)
from gsjax.runs.session import Session
from gsjax.runtime.console import note
from gsjax.train.health import check_in_view
from gsjax.train.initialisation import add_dense_points, initial_state, resolve_initial
from gsjax.train.loop import subset
from gsjax.train.memory_estimate import check_memory, check_state_memory
from gsjax.train.state import TrainState


def resolve_initialisation(settings: RunSettings, data: Data) -> RunSettings:
    """With what the run starts from, which it keeps when it is gone on with."""
    config = settings.config
    if settings.start is not None:
        return settings
    decided = resolve_initial(subset(data.scene, data.train), config)
    if config.initial == "auto" and decided.initial == "random":
        note("the dataset has no points: starting from random ones (--initial random)")
    return replace(settings, config=decided)


def load_initial_state(settings: RunSettings, data: Data) -> TrainState | None:
    """A run before its first step, where it starts from a scene.

    Raises:
      InputError: if that is not there, or damaged, or of another dataset, or more than
        there may be.
    """
    path, config = settings.start, settings.config
    if path is None:
        return None
    scene = subset(data.scene, data.train)
    gaussians = load_scene(path, scene.origin)
    active = np.asarray(gaussians.active)
    check_state_memory(int(active.sum()), config)
    had, has = gaussians.sh_degree, config.sh_degree
    cut = f", of whose SH degree {had} the run has {has} (--sh-degree)"
    note(f"starting from the scene of {path}{cut if had > has else ''}")
    try:
        state = initial_state(scene, config, gaussians)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    check_in_view(scene, np.asarray(gaussians.params.means)[active], str(path))
    _tell_seen(path, with_views(settings, data).held_out)
    return state


def _tell_seen(start: Path, held_out: tuple[str, ...]) -> None:
    """Of held-out views that the scene to start from has learnt from, if a run made
    it."""
    folder = start.parent
    if run_files(folder).splat != start or not run_files(folder).config.exists():
        return
    seen = set(load_settings(folder).trained) & set(held_out)
    if seen:
        note(
            f"warning: {len(seen)} of the {len(held_out)} views held out were trained "
            f"on by {folder}: what is measured on them is too good; hold out those "
            "that it did (--test-images, --test-every)"
        )


def first_state(session: Session, photos: list[Photo]) -> TrainState:
    """The run before its first step; what it takes counts as training."""
    scene, config, begun = session.scene, session.config, time.perf_counter()
    if config.initial == "dense":
        note("looking for points on which the photographs agree (--initial dense)")
    dense = add_dense_points(scene, photos, config)
    if config.initial == "dense":
        found = len(dense.points) - len(scene.points)
        note(f"{found:,} more points, after {time.perf_counter() - begun:.1f} s")
        if not has_points(dense):
            note("too few, and the dataset has no points: starting from random ones")
            check_memory(scene, config.replace(initial="random"), None)
    state = initial_state(dense, config)
    seconds = time.perf_counter() - begun
    session.start = session.start._replace(seconds=seconds)
    return state
