"""Front-to-back compositing on a CPU, Gaussian by Gaussian: one compiled kernel.

As plain code would have it: for each tile, for each Gaussian of its list, until no
pixel of the tile is open. It needs no schedule, looks up each Gaussian when it is due,
and keeps the sums of a tile in the nearest cache. It is fast where XLA makes one kernel
of the loops (`gsjax.runtime.loops`), which it does of larger turns than by default only
if the process was started so, as `gsjax.use_all_cores` does; `suits` tells. The way
back, for gradients, is `gsjax.raster.compositing.fused_vjp`.

Axis legend: T tiles, P pixels of a tile, C channels, R ranks, L looks.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.raster.compositing.alpha import alphas, pixel_centres
from gsjax.raster.compositing.blending import columns_of, pass_through, table_of
from gsjax.raster.lists.binning import Grid, Lists, corners
from gsjax.raster.lists.counting import cumulative_sum
from gsjax.raster.types import Array, Projected, RasterConfig
from gsjax.runtime import loops
from gsjax.runtime.devices import KERNEL_BYTES
from gsjax.runtime.loops import part_at, with_part

TURN = 2  # Gaussians: the sums are fetched and stored once for so many
LOOK = 8  # Gaussians from one look at who is open to the next; a multiple of TURN
_FEWEST = 64  # pixels: of fewer XLA hardly makes vector instructions
# What a turn (of two) touches at most: arrays [P] that have no channels, and for each
# channel. XLA counts what every kernel reads and writes, in the loops around as well.
_ARRAYS, _OF_CHANNEL = 64, 8


class Reading(NamedTuple):
    """What the loops read.

    Attributes:
      rows: [R + 1, columns] the Gaussians; the last is nothing.
      widths: how many columns are u, v, inv_sx, slope, inv_sy, opacity; the channels;
        and the depth, where a median is asked for.
      ranks: the lists, one behind the other.
      start, end: [T] where each begins and ends.
      left, top: [T] corners of the tiles, px.
      pixels: [2, P] x and y of a tile's pixels, from its corner.
      ones: [P] that XLA does not know to be 1.
    """

    rows: Array
    widths: tuple[int, ...]
    ranks: Array
    start: Array
    end: Array
    left: Array
    top: Array
    pixels: np.ndarray
    ones: Array

    def row(self, place: Array, end: Array) -> tuple[Array, Array]:
        """(Rank [1], row [columns]) of what stands at ``place`` [1] of the lists, or
        nothing from ``end`` [1] on."""
        none = self.rows.shape[0] - 1
        rank = part_at(self.ranks, (place[0],), (1,))
        rank = jnp.where(place < end, rank, none)
        columns = self.rows.shape[1]
        return rank, part_at(self.rows, (rank[0], jnp.int32(0)), (1, columns))[0]

    def alpha(self, splat: Array, tile: Array, config: RasterConfig) -> Array:
        """α [P] of a Gaussian [6] at the pixels of a tile []."""
        u, v, *shape = (number[0] for number in lax.split(splat, [1] * 6))
        offset = u - number_at(self.left, tile)[0], v - number_at(self.top, tile)[0]
        # XLA would evaluate it anew for each channel, were it not for a division.
        return alphas((*shape, *offset), self.pixels, config) / self.ones


class Residuals(NamedTuple):
    """What the way back needs of the way forward.

    Attributes:
      carried: [L, P] transmittance before each look, of one tile after the other; 0
        where a pixel has stopped.
      first: [T] the first look of each tile.
      looks: [T] how many were made.
    """

    carried: Array
    first: Array
    looks: Array


def suits(colors: int, width: int, grid: Grid) -> bool:
    """Whether the loops are one kernel here, which vector instructions are made of;
    ``width`` is the bytes of a number, beside ``colors`` of which depth may be asked
    for, and the median."""
    channels = colors + 3  # depth, ones, the median
    touched = width * grid.tile**2 * (_ARRAYS + _OF_CHANNEL * channels)
    fits = grid.tile**2 >= _FEWEST and touched <= KERNEL_BYTES
    return fits and loops.large_are_kernels()


def look_capacity(capacity: int, grid: Grid) -> int:
    """Room for as many looks as the lists of so many pairs may want."""
    return capacity // LOOK + grid.tiles


def reading_of(
    projected: Projected,
    lists: Lists,
    device: Array,
    grid: Grid,
    config: RasterConfig,
) -> Reading:
    """What the loops read, of one device's tiles."""
    columns = columns_of(projected._replace(probe=None), config)
    # In one table: a Gaussian is looked up once.
    rows = table_of([column for some in columns.values() for column in some])
    left, top = corners(lax.iota(jnp.int32, grid.tiles), grid, device, rows.dtype).T
    pixels = pixel_centres(grid.tile, rows.dtype)
    return Reading(
        rows=rows,
        widths=tuple(len(some) for some in columns.values()),
        ranks=lists.ranks,
        start=lists.start,
        end=lists.start + jnp.where(lists.fit, lists.length, 0),
        left=left,
        top=top,
        pixels=pixels,
        ones=lax.optimization_barrier(jnp.ones_like(pixels[0])),
    )


def composite_fused(
    projected: Projected,
    lists: Lists,
    device: Array,
    grid: Grid,
    config: RasterConfig,
    keeping: bool = False,
) -> tuple[dict[str, Array], Residuals | None]:
    """Images of one device's tiles, before the background, and, if ``keeping``, what
    the way back needs.

    As `gsjax.raster.compositing.compositor.composite`; no derivative can be taken of it backward.
    """
    read = reading_of(projected, lists, device, grid, config)
    empty = jnp.zeros_like(read.ones)
    nothing = {"sums": jnp.zeros((read.widths[1], len(empty)), empty.dtype)}
    if "median_depth" in config.outputs:
        nothing["median"] = empty
    images = {
        name: jnp.zeros((grid.tiles, *one.shape), one.dtype)
        for name, one in nothing.items()
    }
    kept = _nothing_kept(read, empty, grid) if keeping else None

    def of_tile(tile, state):
        images, kept = state
        start, end = number_at(read.start, tile), number_at(read.end, tile)

        def blend(place, carried, image):
            _, row = read.row(place, end)
            splat, values, *depth = lax.split(row, read.widths)
            alpha = read.alpha(splat, tile, config)
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
            (place, _, carried, _), kept = state
            if kept is not None:
                look = number_at(kept.first, tile) + (place - start) // LOOK
                rows = with_part(kept.carried, carried[None], (look[0], jnp.int32(0)))
                kept = kept._replace(carried=rows)
            until = jnp.minimum(place + LOOK, end)
            place, _, *blended = lax.while_loop(
                unfinished, turn, (place, until, *state[0][2:])
            )
            return (place, end, *blended), kept

        def open_(state):
            return unfinished(state[0]) & jnp.any(state[0][2] > 0)

        begun = start, end, jnp.ones_like(empty), nothing
        (place, *_, image), kept = lax.while_loop(open_, several, (begun, kept))
        if kept is not None:
            made = (place - start + LOOK - 1) // LOOK
            kept = kept._replace(looks=with_part(kept.looks, made, (tile,)))
        images = {name: _with_image(images[name], image[name], tile) for name in images}
        return images, kept

    tiles = jnp.int32(0), jnp.int32(grid.tiles)
    return lax.fori_loop(*tiles, of_tile, (images, kept))


def number_at(values: Array, tile: Array) -> Array:
    """[1] what stands in ``values`` [T] for a tile []."""
    return part_at(values, (tile,), (1,))


def _nothing_kept(read: Reading, empty: Array, grid: Grid) -> Residuals:
    wanted = -(-(read.end - read.start) // LOOK)
    room = look_capacity(read.ranks.shape[0], grid)
    return Residuals(
        carried=jnp.zeros((room, len(empty)), empty.dtype),
        first=cumulative_sum(wanted) - wanted,
        looks=jnp.zeros_like(wanted),
    )


def _with_image(images: Array, image: Array, tile: Array) -> Array:
    """``images`` [T, …] with that of a tile."""
    start = tile, *(jnp.int32(0) for _ in image.shape)
    return with_part(images, image[None], start)
