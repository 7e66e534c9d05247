"""Lists and compositing of one camera, over all devices.

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
from gsjax.raster.compositing.compositor import composite
from gsjax.raster.compositing.types import Images, Task, Tiles
from gsjax.raster.lists import binning
from gsjax.raster.lists.counting import COUNT_LIMIT
from gsjax.raster.types import Array, Demand, Projection, RasterConfig
from gsjax.runtime.devices import local_device_count, map_over_devices, platform_name

# Pairs that cost little room, and that few, large Gaussians may need.
_FEW_PAIRS = 2**18


def default_pair_capacity(ranks: int, grid: binning.Grid) -> int:
    """Return room for eight tiles a Gaussian, or for few, large ones; a bucket."""
    tiles = grid.tiles * grid.stride
    usual, most = 8 * ranks + 2 * tiles, ranks * tiles
    return capacity_bucket(max(usual, min(most, _FEW_PAIRS)))


def render_tiles(
    projection: Projection,
    size: tuple[int, int],
    config: RasterConfig,
    mask: Array | None = None,
) -> tuple[Images, Demand, Array]:
    """Bin and composite projected Gaussians, over all devices.

    Args:
      projection: [R].
      size: (width, height) of the image, px.
      config: static settings.
      mask: [H, W] bool, the pixels to draw; or None for all.

    Returns:
      Images before the background, {"sums": [H, W, C], "median": [H, W]}; the demand
      (``visible`` is left at 0); whether the capacity was too small.
    """
    devices = device_count(config)
    grid = binning.make_grid(*size, config.tile_size, devices)
    ranks = projection.splat.u.shape[0]
    capacity = config.pair_capacity or default_pair_capacity(ranks, grid)
    share = -(-capacity // devices)
    task = Task(
        platform=platform_name(),
        colors=projection.channels.colors.shape[0],
        itemsize=projection.splat.u.dtype.itemsize,
        grid=grid,
        config=config,
    )
    local = partial(_render_local, task=task, capacity=share)
    # Lists have no derivative. Stopped here, none is passed between devices.
    footprint = lax.stop_gradient(projection.footprint)
    projection = projection._replace(footprint=footprint)
    images, pairs, needed = map_over_devices(local, devices, projection, mask)
    images = {name: _untile(image, grid) for name, image in images.items()}
    overflowed = jnp.any(needed > share)
    needed = jnp.max(needed)
    limit = COUNT_LIMIT // devices
    capacity_needed = jnp.where(needed < limit, needed * devices, 2**31 - 1)
    pairs_float = jnp.sum(pairs.astype(jnp.float32))
    total = jnp.where(
        pairs_float < COUNT_LIMIT, jnp.sum(pairs, dtype=jnp.int32), 2**31 - 1
    )
    demand = Demand(visible=jnp.int32(0), pairs=total, capacity=capacity_needed)
    return images, demand, overflowed


def device_count(config: RasterConfig) -> int:
    """Return the number of devices that share a render.

    Raises:
      InputError: if there are fewer than the config asks for.
    """
    there = local_device_count()
    if config.devices is not None and config.devices > there:
        raise InputError(
            f"RasterConfig.devices: expected at most {there}, got {config.devices}; "
            "None uses all (on a CPU, gsjax.use_all_cores() makes one of each core)"
        )
    return config.devices or there


def _render_local(
    device: Array,
    projection: Projection,
    mask: Array | None,
    *,
    task: Task,
    capacity: int,
):
    """Render one device's tiles; results gain a leading device axis."""
    device, grid = device[0], task.grid
    # The names that a profile shows.
    with jax.named_scope("lists"):
        masked = None if mask is None else binning.masked_tiles(mask, grid, device)
        lists = binning.make_lists(
            projection.footprint,
            grid,
            device,
            capacity,
            task.config.num_size_buckets,
            masked,
        )
    with jax.named_scope("composite"):
        tiles = Tiles(projection.splat, projection.channels, lists, device)
        images, needed = composite(tiles, task)
    images = {name: image[None] for name, image in images.items()}
    return images, lists.pairs[None], needed[None]


def _untile(image: Array, grid: binning.Grid) -> Array:
    """Reorder [D, T, (C,) P] to [H, W, (C)]; rows of tiles were dealt to D devices."""
    channels = image.shape[2:-1]
    image = image.reshape(
        grid.stride, grid.rows, grid.cols, int(np.prod(channels)), grid.tile, grid.tile
    )
    image = image.transpose(1, 0, 4, 2, 5, 3)
    image = image.reshape(
        grid.rows * grid.stride * grid.tile, grid.cols * grid.tile, *channels
    )
    return image[: grid.height, : grid.width]
