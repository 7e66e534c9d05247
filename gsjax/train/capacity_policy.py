"""Capacities of a run: slots, visible Gaussians and pairs, and when they grow.

A larger pair capacity recompiles most of a step, more slots recompile all of it. Spare
capacity is chosen to minimise recompilation plus the cost of idle slots.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.cameras.distortion import distortion_of, project_points
from gsjax.densify.schedule import EditSchedule
from gsjax.errors import CapacityError
from gsjax.gaussians import Gaussians, capacity_bucket, grow
from gsjax.raster.exact import count_demand
from gsjax.raster.types import RasterConfig
from gsjax.runtime.devices import on_cpu
from gsjax.train.config import TrainConfig
from gsjax.train.frames import Frames
from gsjax.train.state import TrainState

# Slots grow when fewer than this multiple of the Gaussians are left.
_SLOT_MARGIN = 1.1
_FEWEST_SLOTS = 1024
# Margins of the pair capacity: without growth, and limits with growth.
_PAIR_MARGIN, _GROWING_MARGINS = 1.5, (2.5, 4.0)
_PER_GROWTH = 1.2  # pairs grow faster than Gaussians, and only some views are probed
_WIDENING = 2.0  # initial Gaussians are narrower than trained ones
_MAX_PROBED_VIEWS = 6
# Spare room for visible Gaussians, and the share of the slots up to which it is worth
# a limit.
_VISIBLE_MARGIN, _WORTH = 1.5, 0.5
# Minimum number of pairs per tile that the compositor needs.
_PAIRS_OF_TILE = 7


class _Price(NamedTuple):
    """Compile time of a program, in idle capacity that costs as much time."""

    slots: float  # in one step (SH degree 2)
    pairs: float  # in one view
    most: float  # largest number of slots per Gaussian, to limit memory


_ON_CPU = _Price(13 / 1.3e-6, 22 / 0.12e-6, math.inf)  # seconds, on two cores
_ON_ACCELERATOR = _Price(16 / 1e-9, 16 / 0.3e-9, 4.0)  # an H100


def _price() -> _Price:
    return _ON_CPU if on_cpu() else _ON_ACCELERATOR


def capacities_for(
    state: TrainState, frames: Frames, config: TrainConfig, schedule: EditSchedule
) -> tuple[int, int | None]:
    """Return pair and visible capacities with a margin for these photographs.

    Before the first step pairs are estimated on the host, since counting would compile
    a program, and there is room for all Gaussians.

    Raises:
      CapacityError: as `with_margin` and `count_demand`.
    """
    gaussians, begins = state.gaussians, int(state.step) == 0
    # A fixed visible capacity, so that one program serves all views.
    raster = config.raster.replace(visible_capacity=gaussians.capacity)
    spheres = as_spheres(gaussians)

    def count(camera: Camera) -> tuple[int, int]:
        if begins:
            return int(expected_pairs(spheres, camera, raster)), gaussians.capacity
        found = count_demand(gaussians, camera, raster)
        return int(found.capacity), int(found.visible)

    tiles = [-(-side // raster.tile_size) for side in frames.pixels.shape[1:3]]
    least = _PAIRS_OF_TILE * int(np.prod(tiles)) if begins else 1
    probed = np.linspace(0, frames.count - 1, min(frames.count, _MAX_PROBED_VIEWS))
    cameras = jax.device_get(frames.camera)  # indexing on the host compiles nothing
    wanted = [
        count(jax.tree.map(lambda a, i=index: a[i], cameras))
        for index in np.unique(probed.astype(int))
    ]
    pairs, visible = (max(numbers) for numbers in zip(*wanted))
    pairs = with_margin(max(least, pairs), state, config, schedule)
    return pairs, visible_room(visible, gaussians.capacity)


Spheres = tuple[np.ndarray, np.ndarray, np.ndarray]


def as_spheres(gaussians: Gaussians) -> Spheres:
    """Return means [N, 3], mean variances [N] and opacities [N] of active Gaussians."""
    active, params = np.asarray(gaussians.active), gaussians.params
    fields = params.means, params.log_scales, params.logit_opacities
    means, scales, logits = (np.asarray(a, float)[active] for a in fields)
    variances = np.mean(np.exp(2 * scales), 1)
    return means, variances, 1 / (1 + np.exp(-logits))


def expected_pairs(spheres: Spheres, camera: Camera, config: RasterConfig) -> float:
    """Return the expected number of pairs of a view of isotropic Gaussians.

    A convex figure of area A and size w × h meets on average (A + c (w + h) + c²) / t²
    squares of side c on a grid of spacing t (Santaló, "Integral Geometry and Geometric
    Probability", 1976). The pixel centres of a tile of t px span c = t − 1. Occlusion
    is ignored, and figures are clipped to the image as ellipses.
    """
    viewmat, K = np.asarray(camera.viewmat, float), np.asarray(camera.K, float)
    means, variances, opacities = spheres
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    centre, depth, imaged = project_points(distortion_of(camera), K, points)
    drawn = imaged & (depth > camera.near) & (depth < camera.far)
    centre, z = centre[drawn], depth[drawn]
    variance = variances[drawn] * K[0, 0] * K[1, 1] / z**2
    reach = 2 * np.log(np.maximum(opacities[drawn] / config.alpha_min, 1))
    radius = np.sqrt(reach * (variance + config.dilation))[:, None]
    size = np.asarray([camera.width, camera.height], float)
    sides = np.clip(centre + radius, 0, size) - np.clip(centre - radius, 0, size)
    wide, high = sides[(sides > 0).all(1)].T
    tile, inner = config.tile_size, config.tile_size - 1
    met = np.pi / 4 * wide * high + inner * (wide + high) + inner**2
    return float(np.sum(met)) / tile**2


def with_margin(
    wanted: int, state: TrainState, config: TrainConfig, schedule: EditSchedule
) -> int:
    """Return a pair capacity of at least ``wanted``, with a margin for growth.

    Raises:
      CapacityError: if ``wanted`` exceeds the limit.
    """
    if wanted >= 2**30:
        raise CapacityError(
            f"pair capacity: expected at most {2**30 - 1:,} pairs in a view, got "
            f"{wanted:,} or more; train with smaller images, fewer Gaussians or larger "
            "tiles"
        )
    wanted = max(1, wanted)
    step, margin = int(state.step), _PAIR_MARGIN
    if step < schedule.stop:
        # Up to the growth until the next recompilation, at most the cost of one.
        views = config.batch * _remaining_steps(step, config)
        worth = _price().pairs / views
        growing = float(np.clip(1 + worth / wanted, *_GROWING_MARGINS))
        count = max(1, _count(state))
        expected = _expected(count, step, config, schedule)
        growth = max(1, min(expected, state.gaussians.capacity) / count)
        likely = _PER_GROWTH * growth * (1 if step else _WIDENING)
        margin = max(margin, min(likely, growing))
    return min(capacity_bucket(int(margin * wanted)), 2**30 - 1)


def visible_room(most: int, slots: int) -> int | None:
    """Return a visible capacity for views that show at most ``most`` of the slots.

    None is room for all slots, where less would hardly save time.
    """
    room = capacity_bucket(int(_VISIBLE_MARGIN * most))
    return room if room <= _WORTH * slots else None


def _count(state: TrainState) -> int:
    """Return the number of Gaussians, counted on the host to compile nothing."""
    return int(np.asarray(state.gaussians.active).sum())


def _remaining_steps(step: int, config: TrainConfig) -> int:
    """Return the number of steps until the resolution changes or the run ends."""
    finer = (level.start * config.steps for level in config.levels)
    return max(1, int(min((s for s in finer if s > step), default=config.steps)) - step)


def _expected(
    count: int, step: int, config: TrainConfig, schedule: EditSchedule
) -> int:
    """Return the number of Gaussians to expect at the next recompilation."""
    return schedule.expected(count, step, step + _remaining_steps(step, config))


def slots_for(
    count: int, step: int, config: TrainConfig, schedule: EditSchedule
) -> int:
    """Return the number of slots for ``count`` Gaussians at ``step`` and some growth.

    If each step adds r Gaussians, m spare slots last m / r steps, with half of them
    idle on average. The cost of compiling and of idle slots is least at m = √(2 r p),
    where p is the cost of a compilation in slots (Harris, "How Many Parts to Make at
    Once", 1913). The growth until the next recompilation is the upper limit.
    """
    price, growth = _price(), _expected(count, step, config, schedule) - count
    steps = min(_remaining_steps(step, config), schedule.stop - step)
    spare = min(growth, math.sqrt(2 * price.slots * growth / max(1, steps)))
    spare = min(spare, price.most * max(1, count) - count)
    wanted = max(_FEWEST_SLOTS, math.ceil(count + spare))
    unit = 2 ** max(0, wanted.bit_length() - 4)  # at most an eighth of it
    return -(-wanted // unit) * unit


def with_slots(
    state: TrainState, wanted: int, config: TrainConfig, schedule: EditSchedule
) -> TrainState:
    """Return the state with more slots if ``wanted`` Gaussians may soon exceed them.

    Slots do not grow beyond the maximum number of Gaussians, nor after the last edit.
    """
    wanted = min(wanted, schedule.max_gaussians)
    if _SLOT_MARGIN * wanted <= state.gaussians.capacity:
        return state
    step, count = int(state.step), _count(state)
    if _expected(count, step, config, schedule) == count:
        return state
    return grow_state(state, slots_for(wanted, step, config, schedule))


def with_slots_ahead(
    state: TrainState, config: TrainConfig, schedule: EditSchedule
) -> TrainState:
    """Return the state with slots for the steps ahead, when recompiling anyway."""
    slots = slots_for(_count(state), int(state.step), config, schedule)
    return grow_state(state, slots)


def grow_state(state: TrainState, capacity: int) -> TrainState:
    """Return the state with at least ``capacity`` slots; new ones are inactive."""
    slots = state.gaussians.capacity
    if capacity <= slots:
        return state

    def pad(array):
        if array.shape[:1] != (slots,):
            return array
        return jnp.pad(array, [(0, capacity - slots), *[(0, 0)] * (array.ndim - 1)])

    return state.replace(
        gaussians=grow(state.gaussians, capacity),
        model=state.model._replace(
            slots=jax.tree.map(pad, state.model.slots),
            buffers=jax.tree.map(pad, state.model.buffers),
        ),
        moments=jax.tree.map(pad, state.moments),
        stats=jax.tree.map(pad, state.stats),
    )
