"""What a run starts from: points, Gaussians, and a state before the first step."""

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
from gsjax.math.sh import num_bases
from gsjax.train.capacity_policy import slots_for
from gsjax.train.config import TrainConfig
from gsjax.train.health import check_points
from gsjax.train.state import TrainState, init_state

_LEAST_FOUND = 1000


def resolve_initial(scene: Dataset, config: TrainConfig) -> TrainConfig:
    """The same settings, with "auto" of `TrainConfig.initial` decided for this scene.

    Raises:
      InputError: if it is to start from its points, and has none, or none before any
        camera.
    """
    if config.initial == "auto":
        config = config.replace(initial="points" if has_points(scene) else "random")
    dense = config.initial == "dense" and has_points(scene)
    if config.initial == "points" or dense:
        check_points(scene)
    return config


def add_dense_points(
    scene: Dataset, photos: Sequence[Photo], config: TrainConfig
) -> Dataset:
    """The scene with more points, where `TrainConfig.initial` is "dense".

    Fewer than a thousand, where so many are wanted, are left out if the scene has none
    of its own: random ones are the better start then.

    Raises:
      InputError: if there is not one photo for each view.
      MissingExtraError: if OpenCV is absent.
    """
    if config.initial != "dense" or config.dense_count == 0:
        return scene
    found = find_points(scene, photos, config.dense_count, seed=config.seed)
    too_few = len(found.points) < min(_LEAST_FOUND, config.dense_count)
    if too_few and not has_points(scene):
        return scene
    return replace(
        scene,
        points=np.concatenate([scene.points, found.points]),
        colors=np.concatenate([scene.colors, found.colors]),
    )


def initial_state(
    scene: Dataset, config: TrainConfig, gaussians: Gaussians | None = None
) -> TrainState:
    """A run on this scene before its first step.

    Args:
      scene: from `add_dense_points`, if more points than the dataset's are wanted.
      config: the settings; for Gaussians that were trained before, see
        `gsjax.train.config.continuation_config`.
      gaussians: to start from, in the scene's coordinates, instead of what
        `TrainConfig.initial` says. Bands of their harmonics are cut, or added as zeros.

    Raises:
      InputError: as `resolve_initial`; if there are no such Gaussians, or more than there
        may be.
    """
    extent, views = extent_of(scene), len(scene.views)
    if gaussians is not None:
        return _begun(_with_slots(gaussians, config), config, extent, views)
    config = resolve_initial(scene, config)
    drawn = config.initial == "random" or not has_points(scene)
    gaussians = init_gaussians(
        scene,
        sh_degree=config.sh_degree,
        opacity=config.chosen.initial_opacity,
        scale=config.chosen.initial_scale,
        max_count=min(config.max_initial, config.max_gaussians),
        random_count=config.initial_count if drawn else None,
        capacity=lambda count: slots_for(count, 0, config),
        seed=config.seed,
    )
    return _begun(gaussians, config, extent, views)


def _with_slots(gaussians: Gaussians, config: TrainConfig) -> Gaussians:
    """The same, of the run's degree, in as many slots as it begins with."""
    count, most = int(np.sum(gaussians.active)), config.max_gaussians
    if not 1 <= count <= most:
        raise InputError(
            f"{count:,} Gaussians to start from; 1 to {most:,} are wanted "
            "(max_gaussians, --max-gaussians)"
        )
    gaussians = with_sh_degree(gaussians, config.sh_degree)
    return compact(gaussians, slots_for(count, 0, config))


def _begun(
    gaussians: Gaussians, config: TrainConfig, extent: float, views: int
) -> TrainState:
    """`init_state` by one program, instead of one for each kind of array."""
    return jax.jit(lambda scene: init_state(scene, config, extent, views))(gaussians)


def empty_state(
    config: TrainConfig, extent: float, views: int, capacity: int
) -> TrainState:
    """The shapes of a run with this many slots, for reading a checkpoint into."""
    numbers = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacities": 1}
    gaussians = make_gaussians(
        **{name: np.zeros((0, count)) for name, count in numbers.items()},
        sh=np.zeros((0, num_bases(config.sh_degree), 3)),
        capacity=capacity,
    )
    return _begun(gaussians, config, extent, views)
