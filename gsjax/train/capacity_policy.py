"""How many slots and pairs a run has room for, and how that grows.

Each growth compiles anew: of pairs most of a step, of slots all of it. That takes
longer than all its steps take for a little room beyond what is wanted, and less than
for a lot; on an accelerator, where what is empty costs next to nothing, hardly ever.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.errors import CapacityError
from gsjax.gaussians import Gaussians, capacity_bucket, grow
from gsjax.raster.render import count_demand
from gsjax.raster.types import RasterConfig
from gsjax.runtime.devices import on_cpu
from gsjax.train.config import TrainConfig
from gsjax.train.frames import Frames
from gsjax.train.state import TrainState

# Slots grow before an edit may run short of them.
_SLOT_MARGIN = 1.1
_FEWEST_SLOTS = 1024
# For pairs: of a scene that does not grow, and from less to more of one that does.
_PAIR_MARGIN, _GROWING_MARGINS = 1.5, (2.5, 4.0)
_PER_GROWTH = 1.2  # pairs grow with Gaussians, and views not probed may want more
_WIDENING = 2.0  # and Gaussians begin narrow, half as wide as they are apart
_MAX_PROBED_VIEWS = 6
# What the steps of the compositor want room in where tiles hold few pairs.
_PAIRS_OF_TILE = 7


class _Price(NamedTuple):
    """Of a program: as long as it takes to compile, so many empty slots take in one
    step (harmonics of degree 2), and so many empty pairs in one view. And how many
    slots there may be, for the sake of memory, for each Gaussian."""

    slots: float
    pairs: float
    most: float


_ON_CPU = _Price(13 / 1.3e-6, 22 / 0.12e-6, math.inf)  # seconds, on two cores
_ON_ACCELERATOR = _Price(16 / 1e-9, 16 / 0.3e-9, 4.0)  # an H100


def _price() -> _Price:
    return _ON_CPU if on_cpu() else _ON_ACCELERATOR


def pairs_for(state: TrainState, frames: Frames, config: TrainConfig) -> int:
    """A pair capacity for these photographs, with room to spare.

    Before the first step it is estimated: to count takes a program, and that seconds.

    Raises:
      CapacityError: as `roomy_pairs` and `count_demand`.
    """
    probed = np.linspace(0, frames.count - 1, min(frames.count, _MAX_PROBED_VIEWS))
    scene, most = None, 1
    if int(state.step) == 0:
        scene = round_ones(state.gaussians)
        tile = config.raster.tile_size
        tiles = np.prod([-(-side // tile) for side in frames.pixels.shape[1:3]])
        most = _PAIRS_OF_TILE * int(tiles)
    # The same settings for each, and however many Gaussians there are: one program.
    raster = config.raster.replace(visible_capacity=state.gaussians.capacity)
    cameras = jax.device_get(frames.camera)  # to take one of them compiles nothing
    for index in np.unique(probed.astype(int)):
        camera = jax.tree.map(lambda a, i=index: a[i], cameras)
        if scene is not None:
            wanted = expected_pairs(scene, camera, config.raster)
        else:
            wanted = count_demand(state.gaussians, camera, raster).capacity
        most = max(most, int(wanted))
    return roomy_pairs(most, state, config)


class RoundOnes(NamedTuple):
    """Gaussians as if they were round: means [N, 3], variances [N], opacities [N]."""

    means: np.ndarray
    variances: np.ndarray
    opacities: np.ndarray


def round_ones(gaussians: Gaussians) -> RoundOnes:
    """The active ones, on the host."""
    active, params = np.asarray(gaussians.active), gaussians.params
    names = ("means", "log_scales", "logit_opacities")
    means, scales, logits = (
        np.asarray(getattr(params, name))[active].astype(np.float64) for name in names
    )
    variances = np.mean(np.exp(2 * scales), 1)
    return RoundOnes(means, variances, 1 / (1 + np.exp(-logits)))


def expected_pairs(scene: RoundOnes, camera: Camera, config: RasterConfig) -> float:
    """How many pairs a view of round Gaussians wants, as runs begin with them.

    A convex figure of area A that is w × h meets (A + c (w + h) + c²) / t² squares of
    side c on a grid of t, on average over where it lies (Santaló 1976). Those that hold
    the pixel centres of a tile of t px have c = t − 1. Nothing is hidden here, and of
    what reaches out of the picture the part in it is taken as an ellipse.

    Args:
      scene: from `round_ones`.
      camera: one.
      config: for the size of tiles, the α cut and the dilation.
    """
    viewmat, K = np.asarray(camera.viewmat, float), np.asarray(camera.K, float)
    seen = scene.means @ viewmat[:3, :3].T + viewmat[:3, 3]
    drawn = (seen[:, 2] > camera.near) & (seen[:, 2] < camera.far)
    seen = seen[drawn]
    z = seen[:, 2]
    centre = (seen @ K.T)[:, :2] / z[:, None]
    variance = scene.variances[drawn] * K[0, 0] * K[1, 1] / z**2
    reach = 2 * np.log(np.maximum(scene.opacities[drawn] / config.alpha_min, 1))
    radius = np.sqrt(reach * (variance + config.dilation))[:, None]
    size = np.asarray([camera.width, camera.height], float)
    sides = np.clip(centre + radius, 0, size) - np.clip(centre - radius, 0, size)
    wide, high = sides[(sides > 0).all(1)].T
    tile, inner = config.tile_size, config.tile_size - 1
    met = np.pi / 4 * wide * high + inner * (wide + high) + inner**2
    return float(np.sum(met)) / tile**2


def roomy_pairs(wanted: int, state: TrainState, config: TrainConfig) -> int:
    """A pair capacity that holds ``wanted``, with room to spare where there is.

    Raises:
      CapacityError: if that is more than can be addressed.
    """
    if wanted >= 2**30:
        raise CapacityError(
            f"a view wants {wanted:,} or more pairs, above the limit of {2**30 - 1:,}; "
            "train with smaller images, fewer Gaussians, or larger tiles"
        )
    wanted = max(1, wanted)  # a view of nothing wants none
    step, margin = int(state.step), _PAIR_MARGIN
    if step < config.chosen.stop:
        # Room until the next program is due anyway, at the price of one.
        views = config.batch * _steps_of_program(step, config)
        worth = _price().pairs / views
        growing = float(np.clip(1 + worth / wanted, *_GROWING_MARGINS))
        count = max(1, _count(state))
        room = min(_likely(count, step, config), state.gaussians.capacity)
        growth = max(1, room / count)
        likely = _PER_GROWTH * growth * (1 if step else _WIDENING)
        margin = max(margin, min(likely, growing))
    return min(capacity_bucket(int(margin * wanted)), 2**30 - 1)


def _count(state: TrainState) -> int:
    """Gaussians, counted on the host: nothing is compiled for it."""
    return int(np.asarray(state.gaussians.active).sum())


def _steps_of_program(step: int, config: TrainConfig) -> int:
    """Steps from this one on until the photographs become finer, or the run ends."""
    finer = (level.start * config.steps for level in config.levels)
    return max(1, int(min((s for s in finer if s > step), default=config.steps)) - step)


def _likely(count: int, step: int, config: TrainConfig) -> int:
    """How many ``count`` Gaussians may be when a program is due anyway."""
    until = step + _steps_of_program(step, config)
    return config.chosen.likely(count, step, until)


def slots_for(count: int, step: int, config: TrainConfig) -> int:
    """Slots for ``count`` Gaussians at ``step``, and for some of those to come.

    If r come with every step, room for m lasts m / r steps, in which half of it is
    empty on average. Compiling and what is empty cost least together at m = √(2 r p),
    p being the price of a program in slots (the lot size of Harris 1913). But no more
    than come until a program is due anyway.
    """
    price, to_come = _price(), _likely(count, step, config) - count
    growing = min(_steps_of_program(step, config), config.chosen.stop - step)
    room = min(to_come, math.sqrt(2 * price.slots * to_come / max(1, growing)))
    room = min(room, price.most * max(1, count) - count)
    wanted = max(_FEWEST_SLOTS, math.ceil(count + room))
    unit = 2 ** max(0, wanted.bit_length() - 4)  # an eighth or less of it
    return -(-wanted // unit) * unit


def with_slots(state: TrainState, wanted: int, config: TrainConfig) -> TrainState:
    """``state``, with more slots if it will soon have too few for ``wanted``, as far
    as there may be so many, and some are still to come."""
    wanted = min(wanted, config.max_gaussians)
    if _SLOT_MARGIN * wanted <= state.gaussians.capacity:
        return state
    step, count = int(state.step), _count(state)
    if _likely(count, step, config) == count:
        return state
    return _grown(state, slots_for(wanted, step, config))


def with_slots_ahead(state: TrainState, config: TrainConfig) -> TrainState:
    """``state``, with slots for the steps ahead where a program is due anyway."""
    count = _count(state)
    return _grown(state, slots_for(count, int(state.step), config))


def _grown(state: TrainState, slots: int) -> TrainState:
    return grow_state(state, slots) if slots > state.gaussians.capacity else state


def grow_state(state: TrainState, capacity: int) -> TrainState:
    """The same run with ``capacity`` slots, more than it has."""
    slots = state.gaussians.capacity

    def pad(array):
        if array.ndim and array.shape[0] == slots:
            widths = [(0, capacity - slots)] + [(0, 0)] * (array.ndim - 1)
            return jnp.pad(array, widths)
        return array

    return state.replace(
        gaussians=grow(state.gaussians, capacity),
        moments=jax.tree.map(pad, state.moments),
        stats=jax.tree.map(pad, state.stats),
    )
