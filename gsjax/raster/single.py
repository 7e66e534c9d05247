"""Front-to-back compositing on a CPU, Gaussian by Gaussian: one compiled kernel.

As plain code would have it: for each tile, for each Gaussian of its list, until no
pixel of the tile is open. It needs no schedule, looks up each Gaussian when it is due,
and keeps the sums of a tile in the nearest cache. It is fast where XLA makes one kernel
of the loops (`gsjax.raster.loops`), which it does of larger turns than by default only
if the process was started so, as `gsjax.use_all_cores` does; `suits` tells. Derivatives
are taken of the chunks of `gsjax.raster.composite`.

Axis legend: T tiles, P pixels of a tile, C channels, R ranks.
"""

import jax.numpy as jnp
from jax import lax

from gsjax.devices import KERNEL_BYTES
from gsjax.raster import loops
from gsjax.raster.alpha import alphas, pixel_centres
from gsjax.raster.bins import Grid, Lists, corners
from gsjax.raster.blend import columns_of, pass_through, table_of
from gsjax.raster.types import Array, Projected, RasterConfig

TURN = 2  # Gaussians: the sums are fetched and stored once for so many
LOOK = 8  # Gaussians from one look at who is open to the next; a multiple of TURN
_FEWEST = 64  # pixels: of fewer XLA hardly makes vector instructions
# What a turn touches at most: arrays [P] of each Gaussian, without channels and for
# each. XLA counts what every kernel reads and writes, in the loops around it as well.
_ARRAYS, _OF_CHANNEL = 32, 4


def suits(projected: Projected, grid: Grid) -> bool:
    """Whether the loops are one kernel here, which vector instructions are made of."""
    channels = projected.colors.shape[0] + 3  # depth, ones, the median
    row = projected.u.dtype.itemsize * grid.tile**2
    touched = row * TURN * (_ARRAYS + _OF_CHANNEL * channels)
    fits = grid.tile**2 >= _FEWEST and touched <= KERNEL_BYTES
    return fits and loops.large_are_kernels()


def composite_singly(
    projected: Projected,
    lists: Lists,
    device: Array,
    grid: Grid,
    config: RasterConfig,
) -> dict[str, Array]:
    """Images of one device's tiles, before the background.

    As `gsjax.raster.composite.composite`; no derivative can be taken backward.
    """
    columns = columns_of(projected._replace(probe=None), config)
    # In one table: a Gaussian is looked up once.
    rows = table_of([column for some in columns.values() for column in some])
    widths = [len(some) for some in columns.values()]
    none = jnp.full(1, rows.shape[0] - 1, jnp.int32)
    pixels = pixel_centres(grid.tile, rows.dtype)
    empty = jnp.zeros_like(pixels[0])
    ones = lax.optimization_barrier(jnp.ones_like(empty))  # XLA is not to know them
    nothing = {"sums": jnp.zeros((len(columns["channels"]), len(empty)), rows.dtype)}
    if "depth" in columns:
        nothing["median"] = empty
    every = lax.iota(jnp.int32, grid.tiles)
    left, top = corners(every, grid, device, rows.dtype).T
    lengths = jnp.where(lists.fit, lists.length, 0)

    def of_tile(tile, images):
        start = _part(lists.start, tile)
        end = start + _part(lengths, tile)
        corner_x, corner_y = _part(left, tile), _part(top, tile)

        def blend(place, carried, image):
            rank = jnp.where(place < end, _part(lists.ranks, place[0]), none)
            row = _part(rows, rank[0], jnp.int32(0), size=(1, rows.shape[1]))[0]
            splat, values, *depth = lax.split(row, widths)
            u, v, *shape = (number[0] for number in lax.split(splat, [1] * len(splat)))
            offset = u - corner_x[0], v - corner_y[0]
            # It would be evaluated again for each channel, were it not for a division.
            alpha = alphas((*shape, *offset), pixels, config) / ones
            # Stopped pixels carry nothing on, and are given nothing.
            passed = pass_through(carried, alpha)
            behind = jnp.where(passed > config.stop, passed, 0)
            weight = carried * alpha
            if config.stop_rule == "before":
                weight = jnp.where(behind > 0, weight, 0)
            added = {"sums": weight * values[:, None]}
            if depth:
                half = (carried > 0.5) & (passed <= 0.5) & (weight > 0)
                added["median"] = jnp.where(half, depth[0], 0)
            return behind, {name: image[name] + added[name] for name in image}

        def turn(state):
            place, until, carried, image = state
            for _ in range(TURN):
                carried, image = blend(place, carried, image)
                place = place + 1
            return place, until, carried, image

        def unfinished(state):
            return state[0][0] < state[1][0]

        def several(state):
            place, _, carried, image = state
            until = jnp.minimum(place + LOOK, end)
            place, *_ = state = lax.while_loop(
                unfinished, turn, (place, until, carried, image)
            )
            return place, end, *state[2:]

        def open_(state):
            return unfinished(state) & jnp.any(state[2] > 0)

        start = start, end, jnp.ones_like(empty), nothing
        *_, image = lax.while_loop(open_, several, start)
        return {name: _put(images[name], image[name], tile) for name in images}

    images = {
        name: jnp.zeros((grid.tiles, *one.shape), one.dtype)
        for name, one in nothing.items()
    }
    return lax.fori_loop(jnp.int32(0), jnp.int32(grid.tiles), of_tile, images)


def _part(values: Array, *start: Array, size: tuple[int, ...] = (1,)) -> Array:
    """What begins at ``start``, which is there."""
    return lax.dynamic_slice(values, start, size, allow_negative_indices=False)


def _put(images: Array, image: Array, tile: Array) -> Array:
    """``images`` [T, …] with that of a tile."""
    start = tile, *(jnp.int32(0) for _ in image.shape)
    return lax.dynamic_update_slice(
        images, image[None], start, allow_negative_indices=False
    )
