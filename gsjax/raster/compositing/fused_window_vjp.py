"""Reverse pass of `fused_window` on CPUs: one compiled kernel.

A list is gone through in blocks of arrivals. A first turn through it stores what waits,
and the transmittance, before each block. Then, from the last block to the first, the
arrivals of a block are repeated, and what left at each is kept: its α, the
transmittance that reached it, its value (c_k · ∂L/∂C), and the place that the new one
took. Backward, what left gives cotangents as in `fused_vjp`; they go back to where it
waited, and so, in the end, to the Gaussian when it arrived: only then they are summed
over the pixels.

Axis legend: T tiles, P pixels of a tile, W places of the window, B blocks of a list.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from gsjax.raster.compositing import fused_window
from gsjax.raster.compositing.blending import pass_through
from gsjax.raster.compositing.fused import image_at, number_at, reading_of
from gsjax.raster.compositing.fused_moments import reduction_of
from gsjax.raster.compositing.fused_vjp import by_tables
from gsjax.raster.compositing.fused_window import (
    Window,
    arrive,
    composite_window,
    empty_window,
    key_of,
    waiting_key,
)
from gsjax.raster.compositing.types import (
    Compositor,
    Images,
    ReversePass,
    Task,
    Tiles,
    form_of,
    listed_pairs,
)
from gsjax.raster.types import Array, Channels, RasterConfig, Splat
from gsjax.runtime.loops import part_at, with_part
from gsjax.runtime.setup import KERNEL_BYTES

SIZE = 64  # arrivals of a block
_product = partial(jnp.matmul, precision=lax.Precision.HIGHEST)
# Upper limit of the arrays [P] that a turn touches: without channels, for each, for
# each place of the window, and for a form.
_ARRAYS, _PER_CHANNEL, _PER_PLACE, _OF_FORM = 100, 6, 80, 60


def suits(task: Task) -> bool:
    """Return whether `backward` is one kernel here and gives all that is asked for."""
    config, pixels = task.config, task.grid.tile**2
    arrays = _ARRAYS + _PER_CHANNEL * task.channels + _PER_PLACE * config.order_window
    arrays += _OF_FORM * (form_of(config) is not None)
    given = not config.absgrad and "median_depth" not in config.outputs
    given &= task.itemsize * pixels * arrays <= KERNEL_BYTES
    return given and fused_window.suits(task)


class Passing(NamedTuple):
    """State before an arrival: transmittance [P], and α and value of what waits."""

    carried: Array
    waiting: Window

    def rows(self) -> Array:
        """Return it as rows [1 + 3 W, P]."""
        values = [row for some in self.waiting.values for row in some]
        return jnp.stack([self.carried, *self.waiting.keys, *values])


def _passing(rows: Array, window: int) -> Passing:
    carried, *some = rows
    keys, rest = some[:window], some[window:]
    return Passing(carried, Window(tuple(keys), tuple(zip(rest[::2], rest[1::2]))))


def backward(
    tiles: Tiles,
    arrived: Array,
    cotangents: Images,
    task: Task,
    kinds: frozenset[str] = frozenset({"splats", "channels"}),
) -> tuple[Splat, Channels]:
    """Return ∂L/∂splat and ∂L/∂channels; see `ReversePass.backward`."""
    grid, config = task.grid, task.config
    window = config.order_window
    read, reduction = reading_of(tiles, task), reduction_of(task)
    ranks, _ = read.rows.shape
    channels, pixels = cotangents["sums"].shape[1:]
    empty, zero = jnp.zeros_like(read.ones), jnp.int32(0)
    of_splat, of_channels, *_ = read.widths
    longest = min(read.ranks.shape[0], ranks) + window
    states = -(-longest // SIZE) + 1

    def row_of(rows: Array, index: Array) -> Array:
        return part_at(rows, (index[0], zero), (1, pixels))[0]

    def with_row(rows: Array, row: Array, index: Array) -> Array:
        return with_part(rows, row[None], (index[0], zero))

    def arrival(place, tile, passing: Passing, image: Images):
        """Return α, T before it, value and place of what leaves, and the state."""
        _, row = read.row(place, number_at(read.end, tile))
        splat, values = row[:of_splat], row[of_splat : of_splat + of_channels]
        at, end = read.at(splat, tile, config), number_at(read.end, tile)
        key = waiting_key(place, end, at.alpha, key_of(read, at, row, tile, config))
        corner = number_at(read.left, tile), number_at(read.top, tile)
        value = _product(values, image["sums"])
        value, _ = reduction.at(corner, read.ones, splat, value, image)
        brought = at.alpha, value / read.ones
        _, (alpha, value), waiting, before = arrive(passing.waiting, key, brought)
        taken = sum((jnp.where(some, 0, 1.0) for some in before), start=0 * alpha)
        passed = pass_through(passing.carried, alpha)
        carried = jnp.where(passed > config.transmittance_min, passed, 0)
        left = alpha, passing.carried, value, taken.astype(empty.dtype)
        return left, Passing(carried, waiting)

    def of_tile(tile, state):
        scratch, kept, sums = state
        start, end = number_at(read.start, tile), number_at(read.end, tile)
        blocks = -(-number_at(arrived, tile) // SIZE)
        image = {name: image_at(all_, tile) for name, all_ in cotangents.items()}
        corner = number_at(read.left, tile), number_at(read.top, tile)
        at_tile = partial(reduction.at, corner, read.ones)

        def skim(state):
            at, base, passing = state
            return at + 1, base, arrival(base + at, tile, passing, image)[1]

        def store(state):
            number, passing, saved = state
            saved = with_part(saved, passing.rows()[None], (number[0], zero, zero))
            begun = jnp.zeros(1, jnp.int32), start + number * SIZE, passing
            more = jnp.where(number + 1 < blocks, SIZE, 0)
            *_, passing = lax.while_loop(lambda s: (s[0] < more)[0], skim, begun)
            return number + 1, passing, saved

        def ahead(state):
            at, base, passing, kept = state
            left, passing = arrival(base + at, tile, passing, image)
            kept = tuple(with_row(some, one, at) for some, one in zip(kept, left))
            return at + 1, base, passing, kept

        def back(state):
            at, base, behind, gained, owed, kept, image, sums = state
            at = at - 1
            rank, row = read.row(base + at, end)
            alpha, carried, worth, taken = (row_of(some, at) for some in kept)
            left, gained = _repaid((alpha, carried, worth), behind, gained, config)
            (slope, weight), owed = _returned(taken, left, owed)
            behind = carried
            more, splat = [], row[:of_splat]
            if "splats" in kinds:
                _, moments = at_tile(splat, empty, image)
                more.append(moments(slope / read.ones, weight / read.ones))
            if "channels" in kinds:
                more.append(_product(image["sums"], weight))
            more = jnp.concatenate(more)
            old = part_at(sums, (rank[0], zero), (1, len(more)))
            sums = with_part(sums, old + more, (rank[0], zero))
            return at, base, behind, gained, owed, kept, image, sums

        def block(state):
            number, gained, owed, kept, saved, sums = state
            base = start + number * SIZE
            passing = _passing(image_at(saved, number[0]), window)
            begun = jnp.zeros(1, jnp.int32), base, passing, kept
            at, _, passing, kept = lax.while_loop(
                lambda s: s[0][0] < SIZE, ahead, begun
            )
            begun = at, base, passing.carried, gained, owed, kept, image, sums
            found = lax.while_loop(lambda s: s[0][0] > 0, back, begun)
            *_, gained, owed, kept, _, sums = found
            return number - 1, gained, owed, kept, saved, sums

        begun = Passing(jnp.ones_like(empty), empty_window(window, (empty, empty)))
        begun = jnp.zeros(1, jnp.int32), begun, scratch
        *_, saved = lax.while_loop(lambda s: (s[0] < blocks)[0], store, begun)
        owed = ((empty, empty),) * window
        begun = blocks - 1, empty, owed, kept, saved, sums
        *_, kept, saved, sums = lax.while_loop(lambda s: s[0][0] >= 0, block, begun)
        return saved, kept, sums

    moments = reduction.size(tiles.splat)
    columns = ("splats" in kinds) * moments + ("channels" in kinds) * channels
    sums = jnp.zeros((ranks, columns), read.rows.dtype)
    saved = jnp.zeros((states, 1 + 3 * window, pixels), empty.dtype)
    kept = (jnp.zeros((SIZE, pixels), empty.dtype),) * 4
    begun = saved, kept, sums
    *_, sums = lax.fori_loop(zero, jnp.int32(grid.tiles), of_tile, begun)
    return by_tables(tiles, sums[:-1].T, reduction, kinds, config)


def _repaid(left, behind: Array, gained: Array, config: RasterConfig):
    """Return q and α T of what left, and D before it, see `fused_vjp`; [P] each.

    Args:
      left: α, T before it and its value.
      behind: T behind it, 0 where the pixel has stopped.
      gained: D behind it.
      config: static settings.
    """
    alpha, carried, value = left
    on = behind > 0
    gained = jnp.where(on, gained, 0)
    weight, slope = carried * alpha, value - gained
    if config.stop_rule == "before":
        weight, slope = jnp.where(on, weight, 0), jnp.where(on, slope, 0)
    free = jnp.where(alpha < config.alpha_max, alpha, 0)
    return (free * carried * slope, weight), gained + alpha * slope


def _returned(taken: Array, left, owed):
    """Return the cotangents of what arrived, and those of what waited before.

    Args:
      taken: [P] place that the new one took, 0 to W.
      left: cotangents [P] of what left.
      owed: W times those of what waited then.
    """
    all_, back = (left, *owed), []
    arrived = all_[-1]
    for w in range(len(owed)):
        shifted = taken <= w
        pairs = zip(all_[w + 1], all_[w])
        back.append(tuple(jnp.where(shifted, a, b) for a, b in pairs))
    for w in reversed(range(len(owed))):
        pairs = zip(all_[w], arrived)
        arrived = tuple(jnp.where(taken <= w, a, b) for a, b in pairs)
    return arrived, tuple(back)


def _memory(pairs: int, task: Task, gradients: bool) -> tuple[int, int]:
    pixels, window = task.grid.tile**2, task.config.order_window
    kept = pairs // SIZE * (1 + 3 * window) * pixels if gradients else 0
    return max(kept, 3 * 16 * task.config.chunk_size * pixels), 0


WINDOWED = Compositor(
    name="window",
    suits=fused_window.suits,
    forward=lambda tiles, task: composite_window(tiles, task)[0],
    differentiable=None,
    reverse=ReversePass(suits=suits, forward=composite_window, backward=backward),
    capacity=listed_pairs,
    memory=_memory,
)
