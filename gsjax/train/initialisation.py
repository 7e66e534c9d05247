"""Initial points, Gaussians and state of a run."""

from collections.abc import Sequence
from dataclasses import replace

import jax
import numpy as np

from gsjax.data.extent import extent_of, has_points
from gsjax.data.types import Dataset, Photo
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, compact, make_gaussians, with_sh_degree
from gsjax.init.dense import find_points
from gsjax.init.gaussians import init_gaussians
from gsjax.init.surfels import laid_on_points
from gsjax.math.sh import num_bases
from gsjax.train.capacity_policy import slots_for
from gsjax.train.config import TrainConfig
from gsjax.train.health import check_points
from gsjax.train.state import Setup, TrainState, make_setup, setup_state

_MIN_FOUND = 1000


def resolve_initial(dataset: Dataset, config: TrainConfig) -> TrainConfig:
    """Return the settings with "auto" of `TrainConfig.initial` resolved.

    Raises:
      InputError: if the run is to start from points and the dataset has none, or none
        in front of a camera.
    """
    if config.initial == "auto":
        config = config.replace(initial="points" if has_points(dataset) else "random")
    dense = config.initial == "dense" and has_points(dataset)
    if config.initial == "points" or dense:
        check_points(dataset)
    return config


def add_dense_points(
    dataset: Dataset, photos: Sequence[Photo], config: TrainConfig
) -> Dataset:
    """Return the dataset with matched points if `TrainConfig.initial` is "dense".

    If fewer than 1000 points are found and the dataset has none of its own, it is
    returned unchanged, since random points are then the better start.

    Raises:
      InputError: if the number of photographs is not that of the views.
      MissingExtraError: if OpenCV is not installed.
    """
    if config.initial != "dense" or config.dense_count == 0:
        return dataset
    found = find_points(dataset, photos, config.dense_count, seed=config.seed)
    too_few = len(found.points) < min(_MIN_FOUND, config.dense_count)
    if too_few and not has_points(dataset):
        return dataset
    points = np.concatenate([dataset.points, found.points])
    colors = np.concatenate([dataset.colors, found.colors])
    return replace(dataset, points=points, colors=colors)


def initial_state(
    dataset: Dataset,
    config: TrainConfig,
    gaussians: Gaussians | None = None,
    setup: Setup | None = None,
) -> TrainState:
    """Return the state of a run before its first step.

    Args:
      dataset: from `add_dense_points`, to start from dense points.
      config: settings; for trained Gaussians, see
        `gsjax.train.config.continuation_config`.
      gaussians: initial Gaussians in the coordinates of the dataset, instead of those
        of `TrainConfig.initial`. Their SH degree is adapted to the settings.
      setup: parts of the training step; default those of ``config``.

    Raises:
      InputError: as `resolve_initial`; if ``gaussians`` holds none, or more than the
        maximum.
    """
    setup = setup or make_setup(config, extent_of(dataset))
    views = len(dataset.views)
    if gaussians is not None:
        return _jitted_state(setup, _with_slots(gaussians, setup), views)
    config = resolve_initial(dataset, config)
    drawn = config.initial == "random" or not has_points(dataset)
    gaussians = init_gaussians(
        dataset,
        sh_degree=config.sh_degree,
        opacity=config.strategy_settings.initial_opacity,
        scale=config.strategy_settings.initial_scale,
        max_count=min(config.max_initial, setup.schedule.max_gaussians),
        random_count=config.initial_count if drawn else None,
        capacity=lambda count: slots_for(count, 0, config, setup.schedule),
        seed=config.seed,
    )
    if config.raster.draws_surfels:
        gaussians = laid_on_points(gaussians)
    return _jitted_state(setup, gaussians, views)


def _with_slots(gaussians: Gaussians, setup: Setup) -> Gaussians:
    """Return Gaussians with the SH degree and the initial capacity of a run."""
    config, schedule = setup.config, setup.schedule
    count, most = int(np.sum(gaussians.active)), schedule.max_gaussians
    if not 1 <= count <= most:
        raise InputError(
            f"initial Gaussians: expected 1 to {most:,}, got {count:,}; raise the "
            "maximum (max_gaussians, --max-gaussians), or remove some"
        )
    gaussians = with_sh_degree(gaussians, config.sh_degree)
    return compact(gaussians, slots_for(count, 0, config, schedule))


def _jitted_state(setup: Setup, gaussians: Gaussians, views: int) -> TrainState:
    """Return `setup_state`, compiled as one program instead of one per array."""
    return jax.jit(lambda scene: setup_state(setup, scene, views))(gaussians)


def blank_gaussians(capacity: int, sh_degree: int) -> Gaussians:
    """Return inactive slots, as a template."""
    numbers = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacities": 1}
    fields = {name: np.zeros((0, count)) for name, count in numbers.items()}
    sh = np.zeros((0, num_bases(sh_degree), 3))
    return make_gaussians(**fields, sh=sh, capacity=capacity)


def empty_state(
    config: TrainConfig, extent: float, views: int, capacity: int
) -> TrainState:
    """Return a state of the given capacity, as a template for reading a checkpoint."""
    gaussians = blank_gaussians(capacity, config.sh_degree)
    return _jitted_state(make_setup(config, extent), gaussians, views)
