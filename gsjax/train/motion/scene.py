"""Trained scenes that move, in memory and as files.

Axis legend: N Gaussians (capacity).
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from gsjax.gaussians import Gaussians
from gsjax.train.models import SceneParams
from gsjax.train.motion.registry import compiled_motion


@dataclass(frozen=True)
class MovingScene:
    """Gaussians that move.

    Attributes:
      motion: name of the motion model, "field" or "trajectories".
      params: its parameters; N slots.
    """

    motion: str
    params: SceneParams

    @property
    def capacity(self) -> int:
        """Number of slots N, active or not."""
        return self.params.gaussians.capacity

    def at(self, time: float | jax.Array) -> Gaussians:
        """Return the Gaussians at a time from 0 to 1; N slots in the same order."""
        dtype = self.params.gaussians.params.means.dtype
        return compiled_motion(self.motion)(self.params, jnp.asarray(time, dtype))


Scene = Gaussians | MovingScene


def gaussians_at(scene: Scene, time: float | None) -> Gaussians:
    """Return the Gaussians of a scene at a time, by default 0."""
    return scene.at(time or 0.0) if isinstance(scene, MovingScene) else scene
