"""How much memory a run takes: before it starts, and whenever it grows.

Held against the peak of whole processes; see `render_estimate` for what a step takes
beside its state and its photographs.
"""

import math

import jax

from gsjax.gaussians import capacity_bucket
from gsjax.memory import Estimate
from gsjax.raster.render import render_estimate
from gsjax.raster.types import RasterConfig
from gsjax.scene.types import Scene
from gsjax.sh import num_bases
from gsjax.train.config import TrainConfig

# Compiling a step: 0.9 GB for two CPU devices, most of which stays with the process.
_COMPILING = 900_000_000
# Pairs of a Gaussian before they are counted: four to five in trained scenes, with the
# room that `fit` leaves beyond them.
_PAIRS = 7.5


def state_bytes(slots: int, config: TrainConfig) -> int:
    """Of parameters, both moments, statistics and mask, once."""
    numbers = 11 + 3 * num_bases(config.sh_degree)
    return slots * (4 * (3 * numbers + 3) + 1)


def step_estimate(
    slots: int,
    size: tuple[int, int],
    config: TrainConfig,
    raster: RasterConfig,
    frame_bytes: int,
) -> Estimate:
    """What a step takes beyond its state and its photographs, compiling included.

    Args:
      slots: capacity of the Gaussians.
      size: (width, height) of the photographs.
      config: of the run.
      raster: with the pair capacity.
      frame_bytes: of the photographs on the device.
    """
    devices = raster.devices or jax.local_device_count()
    inside = render_estimate(
        slots,
        num_bases(config.sh_degree),
        size,
        raster.replace(outputs=("rgb",)),
        cameras=config.batch,
        gradients=True,
    )
    shared = (devices - 1) * (state_bytes(slots, config) + frame_bytes)
    more = {"to share them among devices": shared, "to compile": _COMPILING}
    return Estimate({**inside.parts, **more})


def run_estimate(scene: Scene, config: TrainConfig, count: int, slots: int) -> Estimate:
    """What a run takes in all, from its photographs on.

    Args:
      scene: the views to train on.
      config: of the run.
      count: Gaussians, and ``slots`` for them.
    """
    sizes = [_scaled(view.width, view.height, config.max_size) for view in scene.views]
    size = max(w for w, _ in sizes), max(h for _, h in sizes)
    photos = 3 * sum(w * h for w, h in sizes)
    frames = 3 * size[0] * size[1] * len(sizes)
    pairs = min(capacity_bucket(math.ceil(_PAIRS * count)), 2**30 - 1)
    step = step_estimate(
        slots, size, config, config.raster.replace(pair_capacity=pairs), frames
    )
    # Photographs as loaded, as put together, and as they are on the device.
    held = {
        "of photographs": photos + 2 * frames,
        "of Gaussians and their moments": state_bytes(slots, config),
    }
    return Estimate({**held, **step.parts})


def _scaled(width: int, height: int, longest: int | None) -> tuple[int, int]:
    ratio = 1.0 if longest is None else min(1.0, longest / max(width, height))
    return max(1, round(width * ratio)), max(1, round(height * ratio))
