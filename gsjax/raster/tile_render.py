"""Bin and composite what was projected, over all devices.

Axis legend: R ranks, D devices, T tiles of a device, P pixels of a tile, C channels,
H W image.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.errors import InputError
from gsjax.gaussians import capacity_bucket
from gsjax.raster.compositing import schedules
from gsjax.raster.compositing.compositor import composite
from gsjax.raster.compositing.parallel import composite_parallel
from gsjax.raster.lists import binning
from gsjax.raster.lists.counting import COUNT_LIMIT
from gsjax.raster.types import Array, Demand, Projected, RasterConfig
from gsjax.runtime.devices import on_cpu, spread


def default_pair_capacity(ranks: int, grid: binning.Grid) -> int:
    """Room for eight tiles a Gaussian and two Gaussians a tile, as a bucket."""
    return capacity_bucket(8 * ranks + 2 * grid.tiles * grid.stride)


def rasterise(
    projected: Projected,
    width: int,
    height: int,
    config: RasterConfig,
    mask: Array | None = None,
) -> tuple[dict[str, Array], Demand, Array]:
    """Bin and composite what was projected, over all devices.

    Args:
      projected: [R].
      width, height: image size.
      config: static settings.
      mask: [H, W] bool, the pixels that are wanted; or None for all.

    Returns:
      Images before the background, {"sums": [H, W, C], "median": [H, W]}; the demand
      (``visible`` is left at 0); whether the capacity was too small.
    """
    devices = device_count(config)
    grid = binning.make_grid(width, height, config.tile_size, devices)
    ranks = projected.u.shape[0]
    capacity = config.pair_capacity or default_pair_capacity(ranks, grid)
    share = -(-capacity // devices)
    local = partial(_rasterise_local, grid=grid, config=config, capacity=share)
    images, pairs, wanted = spread(local, devices, projected, mask)
    images = {name: _untile(image, grid) for name, image in images.items()}
    overflowed = jnp.any(wanted > share)
    wanted = jnp.max(wanted)
    limit = COUNT_LIMIT // devices
    capacity_wanted = jnp.where(wanted < limit, wanted * devices, 2**31 - 1)
    pairs_float = jnp.sum(pairs.astype(jnp.float32))
    total = jnp.where(
        pairs_float < COUNT_LIMIT, jnp.sum(pairs, dtype=jnp.int32), 2**31 - 1
    )
    demand = Demand(visible=jnp.int32(0), pairs=total, capacity=capacity_wanted)
    return images, demand, overflowed


def device_count(config: RasterConfig) -> int:
    """How many devices share a render.

    Raises:
      InputError: if there are fewer.
    """
    there = jax.local_device_count()
    if config.devices is not None and config.devices > there:
        raise InputError(
            f"RasterConfig.devices = {config.devices}, and {there} "
            f"{'is' if there == 1 else 'are'} there; None takes them all (on a CPU, "
            "gsjax.use_all_cores() makes one of each core)"
        )
    return config.devices or there


def _rasterise_local(
    device: Array,
    projected: Projected,
    mask: Array | None,
    *,
    grid: binning.Grid,
    config: RasterConfig,
    capacity: int,
):
    """One device's tiles; ``device`` is [1]. Results gain a leading device axis."""
    device = device[0]
    geometry = lax.stop_gradient(projected)
    with jax.named_scope("lists"):
        spans = binning.row_spans(geometry, grid, device)
        tiles = None if mask is None else binning.wanted_tiles(mask, grid, device)
        lists = binning.make_lists(
            geometry, spans, grid, device, capacity, config.num_size_buckets, tiles
        )
    with jax.named_scope("composite"):
        if on_cpu():
            images, wanted = _composite_by_turns(projected, lists, device, grid, config)
        else:
            images = composite_parallel(projected, lists, device, grid, config)
            wanted = lists.pairs
    images = {name: image[None] for name, image in images.items()}
    return images, lists.pairs[None], wanted[None]


def _composite_by_turns(
    projected: Projected,
    lists: binning.Lists,
    device: Array,
    grid: binning.Grid,
    config: RasterConfig,
) -> tuple[dict[str, Array], Array]:
    """`composite`, and the pair capacity that would have been enough for it."""
    capacity, chunk = lists.ranks.shape[0], config.chunk_size
    group = schedules.tiles_per_step(config, grid)
    room = schedules.step_capacity(capacity, grid, group, chunk)
    schedule = schedules.make_schedule(lists, grid, group, chunk, room)
    images = composite(projected, lists, schedule, device, grid, room, config)
    for_steps = schedules.pairs_for_steps(schedule.steps, grid, group, chunk)
    return images, jnp.maximum(lists.pairs, for_steps)


def _untile(image: Array, grid: binning.Grid) -> Array:
    """[D, T, (C,) P] to [H, W, (C)]: rows of tiles were dealt out to D devices."""
    channels = image.shape[2:-1]
    image = image.reshape(
        grid.stride, grid.rows, grid.cols, int(np.prod(channels)), grid.tile, grid.tile
    )
    image = image.transpose(1, 0, 4, 2, 5, 3)
    image = image.reshape(
        grid.rows * grid.stride * grid.tile, grid.cols * grid.tile, *channels
    )
    return image[: grid.height, : grid.width]
