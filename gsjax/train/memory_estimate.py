"""Memory estimate of a training run; see `render_estimate` for that of a render."""

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import jax
import numpy as np

from gsjax.cameras.camera import USUAL_EXTENT
from gsjax.data.photos import size_within, stored_size
from gsjax.data.types import Dataset, View
from gsjax.errors import InputError
from gsjax.gaussians import capacity_bucket
from gsjax.math.sh import num_bases
from gsjax.raster.memory_estimate import render_estimate
from gsjax.raster.types import RasterConfig
from gsjax.runtime.console import note
from gsjax.runtime.memory import Estimate, available, require, size_text
from gsjax.train.capacity_policy import slots_for
from gsjax.train.config import TrainConfig
from gsjax.train.initialisation import blank_gaussians
from gsjax.train.state import TrainState, model_of

Size = tuple[int, int]  # width and height, px

# Bytes taken by compiling a step, and by each further image size.
_COMPILING, _COMPILING_MORE = 900_000_000, 150_000_000
# Pairs per Gaussian before a run begins, with the margin of `capacity_policy`.
_PAIRS = 7.5
# The same per pixel of a photograph, for 10⁵ random initial Gaussians.
_PAIRS_RANDOM = 3.3e-4


def state_bytes(slots: int, config: TrainConfig) -> int:
    """Return the bytes of parameters, both moments, statistics and mask."""
    numbers = 11 + 3 * num_bases(config.sh_degree)
    each, shared = _model_numbers(config)
    return slots * (4 * (3 * numbers + each + 3) + 1) + 4 * shared


@cache
def _model_numbers(config: TrainConfig) -> tuple[int, int]:
    """Return what a scene model adds, with moments: numbers per slot, and others."""
    model = model_of(config, USUAL_EXTENT)
    two = jax.eval_shape(lambda: model.init(blank_gaussians(2, config.sh_degree)))

    def numbers(tree: Any) -> int:
        return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(tree))

    each = (3 * numbers(two.slots) + numbers(two.buffers)) // 2
    return each, 3 * numbers(two.shared)


def step_estimate(
    slots: int, size: Size, config: TrainConfig, raster: RasterConfig, frame_bytes: int
) -> Estimate:
    """Return the memory of a step beyond its state and photographs (frame_bytes).

    The render settings are those of `gsjax.train.step.step_raster`.
    """
    devices = raster.devices or jax.local_device_count()
    bases, options = num_bases(config.sh_degree), {"cameras": config.batch}
    inside = render_estimate(slots, bases, size, raster, **options, gradients=True)
    shared = (devices - 1) * (state_bytes(slots, config) + frame_bytes)
    more = {"to share them among devices": shared, "to compile": _COMPILING}
    return Estimate({**inside.parts, **more})


def trained_sizes(dataset: Dataset, config: TrainConfig) -> list[Size]:
    """Return width and height, px, of each photograph at training size.

    Sizes are read from the file headers. If a header is damaged, which loading reports,
    the size is that of the camera.
    """

    def stored(view: View) -> Size:
        try:
            return stored_size(view)
        except InputError:
            return view.width, view.height

    return [size_within(*stored(view), config.max_size) for view in dataset.views]


def run_estimate(
    sizes: Sequence[Size],
    config: TrainConfig,
    count: int,
    slots: int,
    *,
    begins: bool = False,
    masked: bool = False,
) -> Estimate:
    """Return the memory of a whole run, with an estimate of the number of pairs.

    Args:
      sizes: of the photographs, from `trained_sizes`.
      config: settings.
      count, slots: number of Gaussians, and their capacity.
      begins: whether they are the initial Gaussians.
      masked: whether any photograph has excluded pixels.
    """
    size = max(w for w, _ in sizes), max(h for _, h in sizes)
    photos = (3 + masked) * sum(w * h for w, h in sizes)
    some = masked or len({*sizes}) > 1  # smaller photographs are padded
    frames = (3 + some) * size[0] * size[1] * len(sizes)
    each = _PAIRS
    if begins and config.initial == "random":
        # Initial scales are proportional to the distance between neighbours.
        wide = config.strategy_settings.initial_scale**2 * (1e5 / count) ** (2 / 3)
        each = max(each, _PAIRS_RANDOM * size[0] * size[1] * wide)
    pairs = min(capacity_bucket(math.ceil(each * count)), 2**30 - 1)
    absgrad = config.strategy == "adaptive" and config.adaptive.absgrad
    raster = config.raster.replace(outputs=("rgb",), absgrad=absgrad)
    raster = raster.replace(pair_capacity=pairs)
    step = step_estimate(slots, size, config, raster, frames)
    compiling = _COMPILING + _COMPILING_MORE * len(config.levels)
    # Photographs as loaded, as one array, and on the device.
    inputs = {
        "of photographs": photos + 2 * frames,
        "of Gaussians and their moments": state_bytes(slots, config),
    }
    return Estimate({**inputs, **step.parts, "to compile": compiling})


def check_memory(
    dataset: Dataset, config: TrainConfig, state: TrainState | None
) -> None:
    """Report the memory that a run will take; reject a run that does not fit.

    The state is that to resume from, or None for a new run.

    Raises:
      CapacityError: if more memory is required than available; with the numbers.
    """
    if state is None:
        given = len(dataset.points)
        if config.initial == "random":
            given = config.initial_count
        elif config.initial == "dense":  # random if there are no points
            random = 0 if given else config.initial_count
            given = max(given + config.dense_count, random)
        count = max(1, min(given, config.max_initial, config.max_gaussians))
        slots = slots_for(count, 0, config, config.schedule)
    else:
        count, slots = int(np.sum(state.gaussians.active)), state.gaussians.capacity
    sizes = trained_sizes(dataset, config)
    # Undistortion leaves pixels without content, which are excluded as if masked; so
    # are those outside the circle of a fisheye.
    masked = any(v.mask is not None or v.lens is not None for v in dataset.views)
    now = run_estimate(sizes, config, count, slots, begins=state is None, masked=masked)
    most = max(config.max_gaussians, count)
    then = run_estimate(sizes, config, most, capacity_bucket(most), masked=masked).total
    free = available()
    told = "" if free is None else f"; {size_text(free)} is free"
    note(
        f"memory: about {size_text(now.total)} for {_gaussians(count)}, "
        f"{size_text(then)} for the maximum of {most:,}{told}"
    )
    require(now, "this run", "lower --max-size or --max-gaussians")
    if free is not None and then > free:
        note(
            f"warning: {_gaussians(most)} would not fit in memory: the run would be "
            "saved and stopped; lower --max-gaussians to avoid it"
        )


def check_state_memory(count: int, config: TrainConfig) -> None:
    """Reject an initial scene whose training state does not fit in memory.

    Raises:
      CapacityError: with the numbers.
    """
    slots = slots_for(max(1, count), 0, config, config.schedule)
    size = state_bytes(slots, config)
    require(
        Estimate({"of Gaussians and their moments": size}),
        f"a run from {_gaussians(count)}",
        "remove some of them (export --min-opacity)",
    )


def _gaussians(count: int) -> str:
    return "1 Gaussian" if count == 1 else f"{count:,} Gaussians"
