"""Motion models by name."""

from collections.abc import Callable

import jax

from gsjax.gaussians import Gaussians
from gsjax.raster.tile_render import device_count
from gsjax.train.config import TrainConfig
from gsjax.train.models import Model, SceneParams
from gsjax.train.motion import field, trajectories

# Gaussians at a time, compiled once for all scenes of one shape.
_AT: dict[str, Callable[[SceneParams, jax.Array], Gaussians]] = {
    "field": jax.jit(field.moved),
    "trajectories": jax.jit(trajectories.moved),
}


def motion_model(config: TrainConfig, extent: float) -> Model | None:
    """Return the motion model of settings; None if the scene stands still.

    The scene extent is in world units.
    """
    if config.motion == "field":
        return field.field_model(config.field, device_count(config.raster))
    if config.motion == "trajectories":
        return trajectories.trajectory_model(config.trajectories, config.rates, extent)
    return None


def compiled_motion(name: str) -> Callable[[SceneParams, jax.Array], Gaussians]:
    """Return the compiled ``(SceneParams, time []) → Gaussians`` of a motion."""
    return _AT[name]
