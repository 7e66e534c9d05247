"""Fused compositing on CPUs, Gaussian by Gaussian: one compiled kernel.

For each tile, for each Gaussian of its list, until no pixel of the tile is open. It
needs no schedule, looks up each Gaussian when it is due, and keeps the sums of a tile
in the nearest cache. It is fast if XLA makes one kernel of the loops
(`gsjax.runtime.loops`), which it does for turns of this size only in a process that was
started so (`gsjax.runtime.devices`); `suits` tells. Its reverse pass is `fused_vjp`.

This file and `fused_vjp` can be removed together with the entry in `compositor`.

Axis legend: T tiles, P pixels of a tile, C channels, R ranks, L blocks of Gaussians.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.raster.compositing.alpha import Evaluated, evaluate, pixel_centres
from gsjax.raster.compositing.blending import (
    columns_of,
    pass_through,
    pixel_value,
    table_of,
)
from gsjax.raster.compositing.types import (
    Images,
    Task,
    Tiles,
    pixel_channels,
    single_images,
)
from gsjax.raster.lists.binning import Grid, corners
from gsjax.raster.lists.counting import cumulative_sum
from gsjax.raster.types import Array, RasterConfig
from gsjax.runtime import loops
from gsjax.runtime.loops import part_at, with_part
from gsjax.runtime.setup import KERNEL_BYTES

TURN = 2  # Gaussians per turn: the sums are loaded and stored once per turn
BLOCK = 8  # Gaussians between two checks for open pixels; a multiple of TURN
_FEWEST = 64  # pixels: for fewer XLA hardly makes vector instructions
# Upper limit of the arrays [P] that a turn touches, without channels and per channel.
# XLA counts everything that the kernel reads and writes, in the loops around as well.
_ARRAYS, _PER_CHANNEL = 64, 8


class Reading(NamedTuple):
    """Inputs of the loops.

    Attributes:
      rows: [R + 1, columns] the Gaussians; the last is empty.
      widths: numbers of columns of the splat (u, v and `Splat.shape`), of the channels,
        of the depth if its median is asked for, and of `Splat.key`, if there are any.
      ranks: the lists, one behind the other.
      start, end: [T] where each begins and ends.
      left, top: [T] corners of the tiles, px.
      pixels: [2, P] x and y of a tile's pixels, from its corner.
      ones: [P] that XLA does not know to be 1.
      alpha_min: [] in place of that of the config, or None.
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
    alpha_min: Array | None

    def row(self, place: Array, end: Array) -> tuple[Array, Array]:
        """Return (rank [1], row [columns]) at ``place``; the empty one from ``end``."""
        none = self.rows.shape[0] - 1
        rank = part_at(self.ranks, (place[0],), (1,))
        rank = jnp.where(place < end, rank, none)
        columns = self.rows.shape[1]
        return rank, part_at(self.rows, (rank[0], jnp.int32(0)), (1, columns))[0]

    def at(self, splat: Array, tile: Array, config: RasterConfig) -> Evaluated:
        """Return a splat [S] at the pixels [P] of a tile []."""
        u, v, *shape = (number[0] for number in lax.split(splat, [1] * self.widths[0]))
        offset = u - number_at(self.left, tile)[0], v - number_at(self.top, tile)[0]
        at = evaluate((*shape, *offset), self.pixels, config, self.alpha_min)
        # The division keeps XLA from evaluating α again for each channel.
        return at._replace(alpha=at.alpha / self.ones)


class Residuals(NamedTuple):
    """Values of the forward pass that the reverse pass needs.

    Attributes:
      carried: [L, P] transmittance before each block, one tile after the other; 0 for
        pixels that have stopped.
      first: [T] first block of each tile.
      blocks: [T] number of blocks blended.
    """

    carried: Array
    first: Array
    blocks: Array


def suits(task: Task) -> bool:
    """Return whether the loops are one kernel here, made of vector instructions."""
    channels = task.colors + 3  # depth, ones, the median
    channels = max(channels, task.channels + 1)
    pixels = task.grid.tile**2
    touched = task.itemsize * pixels * (_ARRAYS + _PER_CHANNEL * channels)
    fits = pixels >= _FEWEST and touched <= KERNEL_BYTES
    on_cpu = task.platform == "cpu"
    on_cpu &= not task.config.sorts_pixels
    return on_cpu and fits and loops.large_loops_are_kernels()


def block_capacity(capacity: int, grid: Grid) -> int:
    """Return the largest number of blocks of lists with ``capacity`` pairs."""
    return capacity // BLOCK + grid.tiles


def reading_of(tiles: Tiles, task: Task) -> Reading:
    """Return the inputs of the loops."""
    grid, lists = task.grid, tiles.lists
    channels = tiles.channels._replace(probe=None)
    columns = columns_of(tiles.splat, channels, task.config)
    # One table: a Gaussian is looked up once.
    rows = table_of([column for some in columns.values() for column in some])
    tile = lax.iota(jnp.int32, grid.tiles)
    left, top = corners(tile, grid, tiles.device, rows.dtype).T
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
        alpha_min=channels.alpha_min,
    )


def composite_fused(
    tiles: Tiles, task: Task, keep: bool = False
) -> tuple[Images, Residuals | None]:
    """Composite one device's tiles; see `Compositor.forward`.

    Args:
      tiles, task: as there.
      keep: return the residuals of the reverse pass, too.
    """
    grid, config = task.grid, task.config
    read = reading_of(tiles, task)
    empty = jnp.zeros_like(read.ones)
    nothing = {"sums": jnp.zeros((read.widths[1], len(empty)), empty.dtype)}
    nothing |= dict.fromkeys(single_images(config), empty)
    varying = pixel_channels(config)
    images = {
        name: jnp.zeros((grid.tiles, *one.shape), one.dtype)
        for name, one in nothing.items()
    }
    kept = _no_residuals(read, empty, grid) if keep else None

    def of_tile(tile, state):
        images, kept = state
        start, end = number_at(read.start, tile), number_at(read.end, tile)

        def blend(place, carried, image):
            _, row = read.row(place, end)
            splat, values, *depth = lax.split(row, read.widths)
            at = read.at(splat, tile, config)
            # Pixels that have stopped carry 0.
            passed = pass_through(carried, at.alpha)
            behind = jnp.where(passed > config.transmittance_min, passed, 0)
            weight = carried * at.alpha
            if config.stop_rule == "before":
                weight = jnp.where(behind > 0, weight, 0)
            added = {"sums": weight * values[:, None]}
            added |= {name: weight * pixel_value(name, at) for name in varying}
            if "median" in nothing:
                half = (carried > 0.5) & (passed <= 0.5) & (weight > 0)
                there = depth[0] if depth else pixel_value("depth", at)
                added["median"] = jnp.where(half, there, 0)
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
                block = number_at(kept.first, tile) + (place - start) // BLOCK
                rows = with_part(kept.carried, carried[None], (block[0], jnp.int32(0)))
                kept = kept._replace(carried=rows)
            until = jnp.minimum(place + BLOCK, end)
            place, _, *blended = lax.while_loop(
                unfinished, turn, (place, until, *state[0][2:])
            )
            return (place, end, *blended), kept

        def open_(state):
            return unfinished(state[0]) & jnp.any(state[0][2] > 0)

        begun = start, end, jnp.ones_like(empty), nothing
        (place, *_, image), kept = lax.while_loop(open_, several, (begun, kept))
        if kept is not None:
            made = (place - start + BLOCK - 1) // BLOCK
            kept = kept._replace(blocks=with_part(kept.blocks, made, (tile,)))
        images = {name: with_image(images[name], image[name], tile) for name in images}
        return images, kept

    zero, count = jnp.int32(0), jnp.int32(grid.tiles)
    return lax.fori_loop(zero, count, of_tile, (images, kept))


def number_at(values: Array, tile: Array) -> Array:
    """Return the number [1] of a tile [] in ``values`` [T]."""
    return part_at(values, (tile,), (1,))


def image_at(images: Array, tile: Array) -> Array:
    """Return the image of a tile [] in ``images`` [T, …]."""
    start = tile, *(jnp.int32(0) for _ in images.shape[1:])
    return part_at(images, start, (1, *images.shape[1:]))[0]


def _no_residuals(read: Reading, empty: Array, grid: Grid) -> Residuals:
    needed = -(-(read.end - read.start) // BLOCK)
    room = block_capacity(read.ranks.shape[0], grid)
    return Residuals(
        carried=jnp.zeros((room, len(empty)), empty.dtype),
        first=cumulative_sum(needed) - needed,
        blocks=jnp.zeros_like(needed),
    )


def with_image(images: Array, image: Array, tile: Array) -> Array:
    """Return ``images`` [T, …] with that of one tile replaced."""
    start = tile, *(jnp.int32(0) for _ in image.shape)
    return with_part(images, image[None], start)
