"""Contribution of each Gaussian to a picture: its weights, and the effect of removal.

A picture is I = Σ_k w_k c_k + T b with w_k = α_k T_k. One pass over the tile lists
sums w and w² over the pixels of each Gaussian, and finds the largest. Without Gaussian
k, what lies behind it is divided by 1 − α_k, so the pixel changes by

    R_k α_k / (1 − α_k) − w_k c_k,

with R_k the part of I behind it. The squares of that are summed too.

Axis legend: N Gaussians (capacity), R ranks, H W image, G tiles of a step, K Gaussians
of a chunk, P pixels of a tile.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians
from gsjax.raster.compositing import schedules
from gsjax.raster.compositing.alpha import pixel_centres
from gsjax.raster.compositing.blending import (
    Chunk,
    Parts,
    evaluated,
    running_product,
    tables_of,
)
from gsjax.raster.compositing.chunked import take_rows
from gsjax.raster.exact import exact_config
from gsjax.raster.lists import binning
from gsjax.raster.primitives.table import with_primitive
from gsjax.raster.render import render
from gsjax.raster.render_camera import project_camera
from gsjax.raster.tile_render import device_count
from gsjax.raster.types import Array, Inputs, Projection, RasterConfig
from gsjax.runtime.devices import map_over_devices, platform_name

_CHUNK = 32  # Gaussians of a step: the numbers of a step stay in a CPU's caches


class Contribution(NamedTuple):
    """Sums over the pixels of a picture, [N] each; 0 for what is not visible.

    Attributes:
      total: Σ w, in pixels.
      largest: largest w.
      energy: Σ w²: times the squared error of a colour, the squared error of the
        picture.
      removal: Σ over pixels and channels of the squared change without the Gaussian.
    """

    total: Array
    largest: Array
    energy: Array
    removal: Array


class _Sums(NamedTuple):
    """`Contribution` by rank, [R + 1] each; the last place collects what is nothing."""

    total: Array
    largest: Array
    energy: Array
    removal: Array


def contribution(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig,
    background: Array | None = None,
) -> Contribution:
    """Return the contribution of each Gaussian to the picture of one camera.

    Gaussians are blended in the order of their centres, whatever ``config.order`` is.
    Call it outside of jit. No derivative is taken.

    Args:
      gaussians: N slots, concrete.
      camera: a single camera.
      config: static settings of the render; its outputs are not used. Without a pair
        capacity, or if it is too small, the capacities are fitted to the view.
      background: [3] RGB behind the scene; None for black.

    Raises:
      InputError, CapacityError: as `render_exact`.
    """
    config = config.replace(outputs=("rgb",), order="center", absgrad=False)
    if config.pair_capacity is None:
        config = exact_config(gaussians, camera, config)
    inputs, platform = Inputs(gaussians, camera), platform_name()
    result, overflowed = _of_view(inputs, background, config, platform)
    if bool(overflowed):
        config = exact_config(gaussians, camera, config)
        result, _ = _of_view(inputs, background, config, platform)
    return result


@partial(jax.jit, static_argnums=(2, 3))
def _of_view(
    inputs: Inputs, background: Array | None, config: RasterConfig, platform: str
) -> tuple[Contribution, Array]:
    """Return the contribution, and whether the capacities were too small."""
    del platform  # part of the key of the compiled program: stages depend on it
    drawn = render(inputs.gaussians, inputs.camera, config, background)
    image, config = drawn.rgb, with_primitive(config)
    assert image is not None
    out, order, _, _ = project_camera(inputs, config)
    devices = device_count(config)
    size = inputs.camera.width, inputs.camera.height
    grid = binning.make_grid(*size, config.tile_size, devices)
    assert config.pair_capacity is not None
    share = -(-config.pair_capacity // devices)
    local = partial(_of_device, grid=grid, config=config, capacity=share)
    sums = _Sums(*map_over_devices(local, devices, out, image))
    nothing = jnp.zeros(inputs.gaussians.capacity, image.dtype)

    def by_slot(name: str, values: Array) -> Array:
        if name == "largest":
            return nothing.at[order].max(jnp.max(values, 0), mode="drop")
        return nothing.at[order].add(jnp.sum(values, 0), mode="drop")

    result = {k: by_slot(k, v[:, :-1]) for k, v in sums._asdict().items()}
    return Contribution(**result), drawn.overflowed


def _of_device(
    device: Array,
    projection: Projection,
    image: Array,
    *,
    grid: binning.Grid,
    config: RasterConfig,
    capacity: int,
) -> tuple[Array, ...]:
    """Return the sums of one device's tiles [1, R + 1]."""
    lists = binning.make_lists(
        projection.footprint, grid, device[0], capacity, config.num_size_buckets
    )
    tables = tables_of(projection.splat, projection.channels, config)
    none = projection.splat.u.shape[0]
    group = schedules.tiles_per_step(config, grid)
    schedule = schedules.make_schedule(lists, grid, group, _CHUNK, 2**30)
    pixels = pixel_centres(grid.tile, tables.splats.dtype)

    def of_block(block, sums: _Sums) -> _Sums:
        tile = schedule.tiles[block]
        corner = binning.corners(tile, grid, device[0], tables.splats.dtype)
        place = jnp.floor(corner[..., None] + pixels).astype(jnp.int32)
        inside = (place[:, 0] < grid.width) & (place[:, 1] < grid.height)
        picture = image.at[place[:, 1], place[:, 0]].get(mode="clip")

        def step(state):
            level, left, rest, sums = state
            ranks = schedules.ranks_at(lists, tile, level, _CHUNK, none)
            chunk = Chunk(take_rows(tables, ranks), corner)
            left, rest, more = _blend(chunk, pixels, left, rest, config)
            return level + 1, left, rest, _add(sums, ranks, more)

        def unfinished(state):
            level, left, *_ = state
            go = jnp.any(left > config.transmittance_min)
            return (level < schedule.levels[block]) & go

        left = jnp.where(inside, 1.0, 0.0).astype(image.dtype)
        start = jnp.int32(0), left, picture, sums
        return lax.while_loop(unfinished, step, start)[-1]

    sums = _Sums(*(jnp.zeros(none + 1, image.dtype) for _ in _Sums._fields))
    sums = lax.fori_loop(0, len(schedule.tiles), of_block, sums)
    return tuple(values[None] for values in sums)


def _blend(
    chunk: Chunk, pixels, left: Array, rest: Array, config: RasterConfig
) -> tuple[Array, Array, _Sums]:
    """Blend a chunk behind ``left`` [G, P]; ``rest`` [G, P, 3] is what the image holds.

    Returns:
      Both behind the chunk, and what it adds [G, K].
    """
    alpha = evaluated(chunk, pixels, config).alpha
    total, before = running_product(alpha)
    reached = left[:, None] * before
    behind = reached * (1 - alpha)
    tested = behind if config.stop_rule == "before" else reached
    weight = jnp.where(tested > config.transmittance_min, alpha * reached, 0)
    colors = _colors(chunk.parts)
    shares = weight[..., None] * colors[:, :, None]
    after = rest[:, None] - jnp.cumsum(shares, axis=1)
    there = weight > 0
    factor = jnp.where(there, alpha / jnp.maximum(1 - alpha, 1e-6), 0)
    change = jnp.where(there[..., None], after * factor[..., None] - shares, 0)
    added = _Sums(
        total=jnp.sum(weight, -1),
        largest=jnp.max(weight, -1),
        energy=jnp.sum(weight * weight, -1),
        removal=jnp.sum(change * change, (-1, -2)),
    )
    return left * total, after[:, -1], added


def _colors(parts: Parts) -> Array:
    """Return the colours [G, K, 3]; the channel of ones comes last."""
    return parts.channels[..., :3]


def _add(sums: _Sums, ranks: Array, more: _Sums) -> _Sums:
    """Add what a chunk [G, K] contributes at its ranks."""

    def one(name: str, values: Array, added: Array) -> Array:
        if name == "largest":
            return values.at[ranks].max(added, mode="promise_in_bounds")
        return values.at[ranks].add(added, mode="promise_in_bounds")

    return _Sums(*(one(k, v, a) for k, v, a in zip(sums._fields, sums, more)))
