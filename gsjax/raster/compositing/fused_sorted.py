"""Exact order of each pixel on CPUs: lists are sorted at all pixels of a tile at once.

For each tile, all Gaussians of its list are evaluated at its pixels. Their depths are
sorted by merge exchange (Batcher 1968; Knuth, The Art of Computer Programming, volume
3, algorithm 5.2.2M): the places that it compares do not depend on the values, so each
comparison is one of vectors. Then each pixel blends what it sees, until it stops. The
time grows as n log² n with the length of a list, in any order.

The loops are compiled as in `fused`. For derivatives there is `ordered`.

Axis legend: T tiles, P pixels of a tile, L places of a list, V values.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from gsjax.raster.compositing.blending import pass_through, pixel_value
from gsjax.raster.compositing.fused import Reading, number_at, reading_of
from gsjax.raster.compositing.fused_window import Layout, key_of, layout_of
from gsjax.raster.compositing.types import (
    Compositor,
    Images,
    Task,
    Tiles,
    listed_pairs,
    single_images,
)
from gsjax.raster.size_buckets import run_at_bucket
from gsjax.raster.types import Array, RasterConfig
from gsjax.runtime import loops
from gsjax.runtime.loops import part_at, with_part

_FEWEST = 64  # pixels, as in `fused`
_SIZES = 4  # of lists, each a quarter of the one before


class Sorting(NamedTuple):
    """Lists at the pixels of a tile.

    Attributes:
      keys: [2 L, P] depths, infinity for what does not show, each with its place in
        the list. One array: XLA would copy the second of two in every turn.
      values: [L, P] each: α and what varies from pixel to pixel, in the list's order.
    """

    keys: Array
    values: tuple[Array, ...]


def suits(task: Task) -> bool:
    """Return whether the loops are kernels here."""
    fits = task.platform == "cpu" and task.config.order == "pixel"
    fits &= task.grid.tile**2 >= _FEWEST
    return fits and loops.large_loops_are_kernels()


def composite_sorted(tiles: Tiles, task: Task) -> Images:
    """Composite one device's tiles; see `Compositor.forward`."""
    longest = max(1, min(tiles.lists.ranks.shape[0], tiles.splat.u.shape[0]))
    needed = jnp.max(jnp.where(tiles.lists.fit, tiles.lists.length, 0))

    def of_size(room: int) -> Images:
        return _composite(tiles, task, room)

    return run_at_bucket(needed, longest, _SIZES, of_size)


class Reader(NamedTuple):
    """Evaluates the Gaussians of lists, and blends sorted ones.

    Attributes:
      read: inputs of the loops.
      config: static settings.
      layout: what varies from pixel to pixel.
    """

    read: Reading
    config: RasterConfig
    layout: Layout

    @property
    def names(self) -> tuple[str, ...]:
        """Names of `Sorting.values`."""
        names = ("alpha", *self.layout.varying)
        apart = self.layout.median is not None and "depth" not in names
        return (*names, "median") if apart else names

    def evaluate(self, place: Array, tile: Array, sorting: Sorting) -> Sorting:
        """Return ``sorting`` with what is at a place [1] of the list of a tile []."""
        read, config, zero = self.read, self.config, jnp.int32(0)
        start, end = number_at(read.start, tile), number_at(read.end, tile)
        _, row = read.row(start + place, end)
        at = read.at(row[: read.widths[0]], tile, config)
        key = key_of(read, at, row, tile, config)
        key = jnp.where(at.alpha > 0, key, jnp.inf)
        found = [at.alpha, *(pixel_value(name, at) for name in self.layout.varying)]
        if "median" in self.names:
            _, _, *rest = lax.split(row, read.widths)
            found.append(rest[0] if at.depth is None else at.depth)
        number = jnp.broadcast_to(place.astype(key.dtype), key.shape)
        keys = with_part(sorting.keys, key[None], (2 * place[0], zero))
        keys = with_part(keys, number[None], (2 * place[0] + 1, zero))
        values = tuple(
            with_part(some, jnp.broadcast_to(one, (1, len(key))), (place[0], zero))
            for some, one in zip(sorting.values, found)
        )
        return Sorting(keys, values)

    def blend(self, at: Array, pixel: Array, tile: Array, sorting: Sorting, state):
        """Blend what is at place ``at`` [1] of the order of a pixel []."""
        carried, sums, median = state
        read, config, layout = self.read, self.config, self.layout
        place = part_at(sorting.keys, (2 * at[0] + 1, pixel), (1, 1))[0]
        place = place.astype(jnp.int32)
        values = {
            name: part_at(some, (place[0], pixel), (1, 1))[0]
            for name, some in zip(self.names, sorting.values)
        }
        start, end = number_at(read.start, tile), number_at(read.end, tile)
        _, row = read.row(start + place, end)
        passed = pass_through(carried, values["alpha"])
        behind = jnp.where(passed > config.transmittance_min, passed, 0)
        weight = carried * values["alpha"]
        if config.stop_rule == "before":
            weight = jnp.where(behind > 0, weight, 0)
        of_splat, channels, *_ = read.widths
        more = [row[of_splat : of_splat + channels]]
        more += [values[name] for name in layout.varying]
        sums = sums + weight * jnp.concatenate(more)
        if layout.median is not None:
            half = (carried > 0.5) & (passed <= 0.5) & (weight > 0)
            name = "median" if "median" in values else "depth"
            median = median + jnp.where(half, values[name], 0)
        return behind, sums, median


def _composite(tiles: Tiles, task: Task, room: int) -> Images:
    """Composite lists of ``room`` Gaussians at most."""
    grid, config = task.grid, task.config
    read = reading_of(tiles, task)
    channels, pixels = read.widths[1], len(read.ones)
    layout = layout_of(channels, config)
    reader = Reader(read, config, layout)
    one, none = jnp.ones_like(read.ones[:1]), jnp.zeros_like(read.ones[:1])
    images = {"sums": jnp.zeros((grid.tiles, channels, pixels), one.dtype)}
    for name in single_images(config):
        images[name] = jnp.zeros((grid.tiles, pixels), one.dtype)

    def of_tile(tile, state):
        sorting, images = state
        length = number_at(read.end, tile) - number_at(read.start, tile)

        def evaluate(state):
            place, sorting = state
            return place + 1, reader.evaluate(place, tile, sorting)

        begun = jnp.zeros(1, jnp.int32), sorting
        _, sorting = lax.while_loop(lambda s: (s[0] < length)[0], evaluate, begun)
        sorting = sorting._replace(keys=merge_exchange(sorting.keys, length, read.ones))

        def of_pixel(pixel, images):
            def unfinished(state):
                at, carried, *_ = state
                key = part_at(sorting.keys, (2 * at[0], pixel), (1, 1))[0, 0]
                return (at < length)[0] & (carried > 0)[0] & (key < jnp.inf)

            def blend(state):
                at, *rest = state
                return at + 1, *reader.blend(at, pixel, tile, sorting, rest)

            sums = jnp.zeros(channels + len(layout.varying), one.dtype)
            begun = jnp.zeros(1, jnp.int32), one, sums, none
            *_, sums, median = lax.while_loop(unfinished, blend, begun)
            found = {"sums": sums[:channels, None], "median": median}
            for number, name in enumerate(layout.varying, channels):
                found[name] = sums[number : number + 1]
            out = {}
            for name, image in images.items():
                new = found.get(name, none)[None]
                middle = (jnp.int32(0),) * (new.ndim - 2)
                out[name] = with_part(image, new, (tile, *middle, pixel))
            return out

        return sorting, loops.fori_loop(0, pixels, of_pixel, images)

    scratch = jnp.zeros((room, pixels), one.dtype)
    keys = jnp.zeros((2 * room, pixels), one.dtype)
    sorting = Sorting(keys, (scratch,) * len(reader.names))
    return loops.fori_loop(0, grid.tiles, of_tile, (sorting, images))[1]


def merge_exchange(rows: Array, length: Array, ones: Array) -> Array:
    """Sort pairs of numbers, of rows [2 L, P], by the first of each.

    Where those are equal, by the second.

    Args:
      rows: the pairs, one row behind the other; the second are whole numbers.
      length: [1] pairs to sort.
      ones: [P] that XLA does not know to be 1.
    """
    zero, shape = jnp.int32(0), (1, rows.shape[1])

    def pair_at(rows, first):
        """Return a pair of rows; past the end, any."""
        return tuple(part_at(rows, (2 * first[0] + i, zero), shape) for i in range(2))

    def with_pair(rows, pair, first):
        for i, row in enumerate(pair):
            rows = with_part(rows, row, (2 * first[0] + i, zero))
        return rows

    def first_of(number, bits, offset):
        """Return the place of a number in stretches of 2^bits of which half count."""
        rest = number & ((1 << bits) - 1)
        return ((number >> bits) << (bits + 1)) + rest + offset

    def exchange(state):
        number, (key, place), (other, behind), rows, (bits, offset, apart) = state
        first = first_of(number, bits, offset)
        swap = (other < key) | ((other == key) & (behind < place))
        # The division keeps XLA from comparing again for the other row.
        nearer = jnp.where(swap, behind, place) / ones
        low = jnp.minimum(key, other), nearer
        high = jnp.maximum(key, other), place + behind - nearer
        rows = with_pair(rows, low, first)
        rows = with_pair(rows, high, first + apart)
        # Read from the updated array: else XLA would copy it.
        following = first_of(number + 1, bits, offset)
        pairs = pair_at(rows, following), pair_at(rows, following + apart)
        return number + 1, *pairs, rows, (bits, offset, apart)

    def left(state):
        number, *_, (bits, offset, apart) = state
        return (first_of(number, bits, offset) + apart < length)[0]

    def one_pass(state):
        bits, stride, offset, apart, top, rows = state
        none = jnp.zeros_like(bits)
        first = first_of(none, bits, offset)
        pairs = pair_at(rows, first), pair_at(rows, first + apart)
        begun = none, *pairs, rows, (bits, offset, apart)
        *_, rows, _ = lax.while_loop(left, exchange, begun)
        step = 1 << bits
        again = stride != step
        after = jnp.where(again, bits, bits - 1)
        apart = jnp.where(again, stride - step, step >> 1)
        offset = jnp.where(again, step, 0)
        stride = jnp.where(again, stride >> 1, top)
        return after, stride, offset, apart, top, rows

    def halves(bits):
        return ((2 << bits) < length)[0]

    bits = lax.while_loop(halves, lambda bits: bits + 1, jnp.zeros(1, jnp.int32))
    top = 1 << bits
    begun = bits, top, jnp.zeros_like(top), top, top, rows
    return lax.while_loop(lambda state: (state[0] >= 0)[0], one_pass, begun)[-1]


def _memory(pairs: int, task: Task, gradients: bool) -> tuple[int, int]:
    del gradients
    return 4 * min(pairs, 2**17) * task.grid.tile**2, 0


SORTED = Compositor(
    name="sorted",
    suits=suits,
    forward=composite_sorted,
    differentiable=None,
    reverse=None,
    capacity=listed_pairs,
    memory=_memory,
)
