"""How much memory a run takes: before it starts, and whenever it grows.

Held against the peak of whole processes; see `render_estimate` for what a step takes
beside its state and its photographs.
"""

import math
from collections.abc import Sequence

import jax
import numpy as np

from gsjax.data.photos import size_within, stored_size
from gsjax.data.types import Dataset, View
from gsjax.errors import InputError
from gsjax.gaussians import capacity_bucket
from gsjax.math.sh import num_bases
from gsjax.raster.render import render_estimate
from gsjax.raster.types import RasterConfig
from gsjax.runtime.console import note
from gsjax.runtime.memory import Estimate, available, require, size_text
from gsjax.train.capacity_policy import slots_for
from gsjax.train.config import TrainConfig
from gsjax.train.state import TrainState

# Compiling a step for two CPU devices, most of which stays with the process; and each
# further size of the pictures.
_COMPILING, _COMPILING_MORE = 900_000_000, 150_000_000
# Pairs of a Gaussian before a run begins: four to five in trained scenes, with the
# room that `gsjax.train.capacity_policy` leaves beyond them.
_PAIRS = 7.5
# And of one of 10⁵ random ones, a pixel of the photographs, as two runs began.
_PAIRS_RANDOM = 3.3e-4


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
        raster.replace(
            outputs=("rgb",),
            absgrad=config.strategy == "adaptive" and config.adaptive.absgrad,
        ),
        cameras=config.batch,
        gradients=True,
    )
    shared = (devices - 1) * (state_bytes(slots, config) + frame_bytes)
    more = {"to share them among devices": shared, "to compile": _COMPILING}
    return Estimate({**inside.parts, **more})


def trained_sizes(scene: Dataset, config: TrainConfig) -> list[tuple[int, int]]:
    """Width and height, px, of each photograph as it is trained on, by its header; of
    one that is damaged as its camera has it: loading tells."""

    def stored(view: View) -> tuple[int, int]:
        try:
            return stored_size(view)
        except InputError:
            return view.width, view.height

    return [size_within(*stored(view), config.max_size) for view in scene.views]


def run_estimate(
    sizes: Sequence[tuple[int, int]],
    config: TrainConfig,
    count: int,
    slots: int,
    *,
    begins: bool = False,
    masked: bool = False,
) -> Estimate:
    """What a run takes in all, from its photographs on.

    Of three runs of 1.3 GB to 4.4 GB it was within 1.25 times; how many pairs there
    are is guessed here, and found out before a step is compiled.

    Args:
      sizes: of the photographs, from `trained_sizes`.
      config: of the run.
      count: Gaussians, and ``slots`` for them.
      begins: whether they are those that it begins with.
      masked: whether any of the photographs has pixels that do not count.
    """
    size = max(w for w, _ in sizes), max(h for _, h in sizes)
    photos = (3 + masked) * sum(w * h for w, h in sizes)
    some = masked or len({*sizes}) > 1  # the smaller ones are part of a larger
    frames = (3 + some) * size[0] * size[1] * len(sizes)
    each = _PAIRS
    if begins and config.initial == "random":
        # As wide as they are far from one another.
        wide = config.chosen.initial_scale**2 * (1e5 / count) ** (2 / 3)
        each = max(each, _PAIRS_RANDOM * size[0] * size[1] * wide)
    pairs = min(capacity_bucket(math.ceil(each * count)), 2**30 - 1)
    step = step_estimate(
        slots, size, config, config.raster.replace(pair_capacity=pairs), frames
    )
    compiling = _COMPILING + _COMPILING_MORE * len(config.levels)
    # Photographs as loaded, as put together, and as they are on the device.
    held = {
        "of photographs": photos + 2 * frames,
        "of Gaussians and their moments": state_bytes(slots, config),
    }
    return Estimate({**held, **step.parts, "to compile": compiling})


def check_memory(scene: Dataset, config: TrainConfig, state: TrainState | None) -> None:
    """Tell what a run will take, and refuse what would not fit as it is.

    Args:
      scene: the views to train on.
      config: of the run.
      state: to go on from; None at the beginning.

    Raises:
      CapacityError: with the numbers.
    """
    if state is None:
        given = len(scene.points)
        if config.initial == "random":
            given = config.initial_count
        elif config.initial == "dense":  # random ones, where there are none
            given = max(
                given + config.dense_count, 0 if given else config.initial_count
            )
        count = max(1, min(given, config.max_initial, config.max_gaussians))
        slots = slots_for(count, 0, config)
    else:
        count, slots = int(np.sum(state.gaussians.active)), state.gaussians.capacity
    sizes = trained_sizes(scene, config)
    # What a lens does not show counts as little as what a mask hides.
    masked = any(view.mask is not None or view.lens is not None for view in scene.views)
    now = run_estimate(sizes, config, count, slots, begins=state is None, masked=masked)
    most = max(config.max_gaussians, count)
    then = run_estimate(sizes, config, most, capacity_bucket(most), masked=masked).total
    free = available()
    told = "" if free is None else f"; {size_text(free)} is free"
    note(
        f"memory: about {size_text(now.total)} for {_gaussians(count)}, "
        f"{size_text(then)} for {most:,}, which is the most there may be{told}"
    )
    require(now, "this run", "lower --max-size or --max-gaussians")
    if free is not None and then > free:
        note(
            f"warning: {_gaussians(most)} would not fit; the run is saved and stops "
            "where it would take more than there is: lower --max-gaussians to avoid it"
        )


def check_state_memory(count: int, config: TrainConfig) -> None:
    """Refuse a state of so many Gaussians that would not fit.

    Raises:
      CapacityError: with the numbers.
    """
    size = state_bytes(slots_for(max(1, count), 0, config), config)
    require(
        Estimate({"of Gaussians and their moments": size}),
        f"a run from {_gaussians(count)}",
        "leave some out (export --min-opacity)",
    )


def _gaussians(count: int) -> str:
    return "1 Gaussian" if count == 1 else f"{count:,} Gaussians"
