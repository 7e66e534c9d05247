"""A field that moves Gaussians: planes of space and time, and a small decoder.

After Wu et al., "4D Gaussian Splatting for Real-Time Dynamic Scene Rendering", CVPR
2024: six planes, as of HexPlane, hold features whose product is decoded into changes of
the Gaussian there. At one time the planes of time are lines.

Axis legend: N Gaussians (capacity), C channels, R cells, T cells in time, W width.
"""

from functools import cache, partial

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians
from gsjax.runtime.devices import map_over_devices, on_cpu
from gsjax.runtime.loops import cumulative_sum
from gsjax.train.models import Model, ModelParams, Refresh, SceneParams, ViewInfo
from gsjax.train.motion.interpolation import weighted_rows
from gsjax.train.motion.settings import FieldSettings
from gsjax.train.motion.stillness import Limits, refreshed
from gsjax.train.optimiser import scale_by_rate

Array = jax.Array
_PLANES = 0.1, 0.5  # range of the initial features of space
_REACH = 0.25  # unit of the changes of a mean, in sides of the box
_FIRST = 0.08  # share of the time that the first views are drawn from
# A field that serves its neighbours also shakes what is still, by up to these.
_STILL = Limits(shift=1.0, change=1 / 16)
_BLOCK = 4096  # slots decoded together on a CPU
_AXES = ((0, 1), (0, 2), (1, 2))
# Changes of mean, quaternion, log scales, opacity and colour.
_SIZES = (3, 4, 3, 1, 3)


def lines_at(planes: Array, time: Array) -> Array:
    """Return lines [3, R, C] of planes of time [3, T, R, C] at a time from 0 to 1.

    The planes hold what differs from 1, which is no motion.
    """
    last = planes.shape[1] - 1
    place = jnp.clip(time, 0, 1) * last
    low = jnp.clip(jnp.floor(place), 0, last - 1)
    share = (place - low).astype(planes.dtype)
    pair = lax.dynamic_slice_in_dim(planes, low.astype(jnp.int32), 2, 1)
    return 1 + pair[:, 0] + share * (pair[:, 1] - pair[:, 0])


def _cell(place: Array, cells: int) -> tuple[Array, Array]:
    low = jnp.clip(jnp.floor(place), 0, cells - 2)
    return low.astype(jnp.int32), place - low


def features(planes: Array, lines: Array, unit: Array) -> Array:
    """Return the products [N, C] of six interpolations at points [N, 3] in [0, 1]."""
    cells, channels = planes.shape[1], planes.shape[3]
    index, share = _cell(unit * (cells - 1), cells)
    ends = 1 - share, share
    found = jnp.ones((), planes.dtype)
    for plane, (a, b) in zip(planes, _AXES):
        start = index[:, a] * cells + index[:, b]
        weights = [
            jnp.stack([ends[i][:, a] * ends[j][:, b] for j in (0, 1)], -1)
            for i in (0, 1)
        ]
        first, weights = jnp.stack([start, start + cells], -1), jnp.stack(weights, 1)
        found = found * weighted_rows(plane.reshape(-1, channels), first, weights)
    for axis, line in enumerate(lines):
        weights = jnp.stack([end[:, axis] for end in ends], -1)[:, None]
        found = found * weighted_rows(line, index[:, axis, None], weights)
    return found


def decode(decoder: dict[str, Array], features: Array) -> Array:
    """Return changes [N, 14] from features [N, C]."""
    hidden = features
    for layer in ("first", "second"):
        hidden = hidden @ decoder[layer] + decoder[f"{layer}_bias"]
        hidden = jax.nn.relu(hidden)
    return hidden @ decoder["last"]


def moved(params: SceneParams, time: Array, devices: int = 1) -> Gaussians:
    """Return the Gaussians at a time []; N slots.

    Differentiable in time and in all parameters; the place where the field is read is
    that of the canonical mean, and no derivative goes through it.

    Args:
      params: of the model of `field_model`.
      time: from 0 to 1.
      devices: number of devices that share the work.
    """
    still, buffers = params.gaussians.params, params.model.buffers
    moving = buffers["moving"] > 0
    decoded = _changes(params, time, params.gaussians.active & moving, devices)
    changes = jnp.where(moving[:, None], decoded, lax.stop_gradient(buffers["rest"]))
    low, high = params.model.shared["box"]
    ends = [sum(_SIZES[: i + 1]) for i in range(len(_SIZES) - 1)]
    mean, quat, scale, opacity, color = jnp.split(changes, ends, 1)
    dc = still.sh[:, :1] + color[:, None]
    changed = still.replace(  # pyright: ignore
        means=still.means + _REACH * jnp.mean(high - low) * mean,
        quats=still.quats + quat,
        log_scales=still.log_scales + scale,
        logit_opacities=still.logit_opacities + opacity[:, 0],
        sh=jnp.concatenate([dc, still.sh[:, 1:]], 1),
    )
    return params.gaussians.replace(params=changed)  # pyright: ignore


def _changes(params: SceneParams, time: Array, moving: Array, devices: int) -> Array:
    """Return the changes [N, 14] at a time; 0 for slots that do not move."""
    means, shared = params.gaussians.params.means, params.model.shared
    low, high = shared["box"]
    unit = jnp.clip((lax.stop_gradient(means) - low) / (high - low), 0, 1)
    moment = jnp.asarray(time, means.dtype)
    lines = [lines_at(times, moment) for times in shared["times"]]
    tables = shared["planes"], lines, shared["decoder"]
    return _by_blocks(unit, moving, tables, devices)


def _compacted(chosen: Array) -> tuple[Array, Array]:
    """Return the indices where ``chosen`` [N] is set, then N, and their number []."""
    slots = chosen.shape[0]
    numbers = chosen.astype(jnp.int32)
    ends = cumulative_sum(numbers) if on_cpu() else jnp.cumsum(numbers)
    place = jnp.where(chosen, ends - 1, slots)
    index = jnp.full(slots, slots, jnp.int32).at[place]
    return index.set(lax.iota(jnp.int32, slots), mode="drop"), ends[-1]


def _by_blocks(unit: Array, moving: Array, tables, devices: int) -> Array:
    """Return the changes [N, 14] at points [N, 3], 0 where nothing moves.

    Moving slots are compacted, and blocks without any are skipped.
    """
    slots, wide = unit.shape[0], sum(_SIZES)
    size = min(_BLOCK, slots) if on_cpu() else slots
    turns = -(-slots // (size * devices))
    order, count = _compacted(moving)
    some = unit.at[order].get(mode="fill", fill_value=0)
    some = jnp.pad(some, ((0, turns * size * devices - slots), (0, 0)))

    def work(device: Array, some: Array, count: Array, tables):
        planes, lines, decoder = tables

        def change(start: Array) -> Array:
            part = lax.dynamic_slice_in_dim(some, start, size)
            levels = [features(*level, part) for level in zip(planes, lines)]
            return decode(decoder, jnp.concatenate(levels, 1))

        def block(turn: Array) -> Array:
            start = (turn * devices + device[0]) * size
            nothing = jnp.zeros((size, wide), unit.dtype)
            return lax.cond(start < count, change, lambda _: nothing, start)

        numbers = jnp.arange(turns, dtype=jnp.int32)
        return lax.map(jax.checkpoint(block), numbers)[None]

    found = map_over_devices(work, devices, some, count, tables)
    found = jnp.swapaxes(found, 0, 1).reshape(-1, wide)[:slots]
    spread = jnp.zeros((slots, wide), unit.dtype).at[order]
    return spread.set(found, mode="drop", unique_indices=True)


def _init(settings: FieldSettings, gaussians: Gaussians) -> ModelParams:
    """Return parameters at rest."""
    means, active = gaussians.params.means, gaussians.active
    dtype, slots = means.dtype, means.shape[0]
    known = jnp.where(active[:, None], means, jnp.nan)
    low, high = jnp.nanpercentile(known, jnp.asarray([1.0, 99.0]), axis=0)
    margin = 0.1 * jnp.max(high - low) + 1e-6
    channels, width = settings.channels, settings.width
    levels = range(settings.levels)
    sides = [max(3, round(settings.cells / 4**level)) for level in levels]
    times = [max(3, round(settings.times / 3**level)) for level in levels]
    keys = jax.random.split(jax.random.key(0), 2 + len(levels))

    def layer(key: Array, rows: int, columns: int) -> Array:
        return jax.random.normal(key, (rows, columns), dtype) * (2 / rows) ** 0.5

    shared = {
        "planes": tuple(
            jax.random.uniform(key, (3, cells, cells, channels), dtype, *_PLANES)
            for key, cells in zip(keys[2:], sides)
        ),
        "times": tuple(
            jnp.zeros((3, moments, cells, channels), dtype)
            for moments, cells in zip(times, sides)
        ),
        "decoder": {
            "first": layer(keys[0], channels * len(levels), width),
            "first_bias": jnp.zeros(width, dtype),
            "second": layer(keys[1], width, width),
            "second_bias": jnp.zeros(width, dtype),
            "last": jnp.zeros((width, sum(_SIZES)), dtype),
        },
        "box": jnp.stack([low - margin, high + margin]).astype(dtype),
    }
    buffers = {"moving": jnp.ones(slots, dtype)}
    buffers["rest"] = jnp.zeros((slots, sum(_SIZES)), dtype)
    return ModelParams(shared=shared, buffers=buffers)


def variation(params: SceneParams) -> tuple[Array, Array]:
    """Return the variation of a field over space and its curvature in time, [] each.

    They are means of squared differences between neighbouring cells, and of second
    differences in time.
    """
    across = bend = jnp.zeros((), params.gaussians.params.means.dtype)
    for planes in params.model.shared["planes"]:
        for axis in (1, 2):
            across += jnp.mean(jnp.square(jnp.diff(planes, axis=axis)))
    for times in params.model.shared["times"]:
        across += jnp.mean(jnp.square(jnp.diff(times, axis=2)))
        bend += jnp.mean(jnp.square(jnp.diff(times, n=2, axis=1)))
    return across, bend


@cache
def field_model(settings: FieldSettings, devices: int = 1) -> Model:
    """Return the model of a field.

    Its ``shared`` are, for each level, ``planes`` [3, R, R, C] of space and ``times``
    [3, T, R, C] of time and one axis each (less 1); the ``decoder``; and the ``box``
    [2, 3] about the initial means, which is not trained. Its buffer ``moving`` [N] is 0
    for Gaussians kept still, to which the changes ``rest`` [N, 14] apply at all times.

    Args:
      settings: sizes, rates and weights.
      devices: number of devices that share the work.
    """

    def falling(rate: float, shrinkage: float = 0.0):
        def of(fraction: Array) -> Array:
            value = rate * 0.02**fraction
            return jnp.where(fraction < settings.start, 0, value)

        return scale_by_rate(of, shrinkage)

    def penalty(params: SceneParams, view: ViewInfo) -> Array:
        del view
        across, bend = variation(params)
        return settings.smoothness * across + settings.time_smoothness * bend

    def update(params: SceneParams, cameras: Camera, fraction: Array):
        found = (moved, settings.freeze, params, cameras, fraction)
        moving = refreshed(*found, limits=_STILL)
        active = params.gaussians.active
        rest = lax.cond(
            fraction >= settings.freeze,
            lambda: _changes(params, jnp.zeros(()), active, 1),
            lambda: params.model.buffers["rest"],
        )
        return {"moving": moving, "rest": rest}

    def at(params: SceneParams, time: Array) -> Gaussians:
        return moved(params, time, devices)

    def until(fraction: float) -> float:
        return _FIRST + fraction / settings.unroll

    return Model(
        init=partial(_init, settings),
        apply=lambda params, view: at(params, view.time),
        rates={
            "planes": falling(settings.plane_rate),
            "times": falling(settings.plane_rate, settings.stillness),
            "decoder": falling(settings.decoder_rate),
            "box": 0.0,
        },
        refresh=Refresh(update),
        at=at,
        penalty=penalty,
        until=until if settings.unroll else None,
    )
