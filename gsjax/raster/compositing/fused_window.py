"""Fused compositing on CPUs through a window for each pixel: one compiled kernel.

As in `fused`, for each tile, for each Gaussian of its list. But one that arrives is
first put in its place among the few that wait at each pixel, by its depth there, and
the one in front of all leaves and is blended. What waits brings its values with it: a
look-up for each pixel would cost more. A Gaussian that does not show at a pixel takes
no place there. Behind the end of a list, empty ones arrive to send off the last.

Its reverse pass is `fused_window_vjp`.

Axis legend: T tiles, P pixels of a tile, W places of the window, V values.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from gsjax.raster.compositing.alpha import Evaluated
from gsjax.raster.compositing.blending import pass_through, pixel_value
from gsjax.raster.compositing.fused import (
    BLOCK,
    TURN,
    Reading,
    number_at,
    reading_of,
    with_image,
)
from gsjax.raster.compositing.types import (
    Images,
    Task,
    Tiles,
    form_of,
    pixel_channels,
    single_images,
)
from gsjax.raster.types import Array, RasterConfig
from gsjax.runtime import loops
from gsjax.runtime.loops import with_part
from gsjax.runtime.setup import KERNEL_BYTES

_FEWEST = 64  # pixels, as in `fused`
# Upper limit of the arrays [P] that a turn touches, as in `fused`: without channels,
# for each, the same for each place of the window, and for a form.
_ARRAYS, _PER_CHANNEL, _PER_PLACE, _PER_BOTH, _OF_FORM = 64, 8, 16, 7, 190


class Window(NamedTuple):
    """Gaussians that wait at each pixel, front to back.

    Attributes:
      keys: W depths [P], rising.
      values: W times what comes with them, a tuple of arrays [..., P].
    """

    keys: tuple[Array, ...]
    values: tuple[tuple[Array, ...], ...]


def empty_window(window: int, values: tuple[Array, ...]) -> Window:
    """Return a window in which nothing waits; ``values`` are like those of one."""
    key = jnp.full_like(values[0], -jnp.inf)
    nothing = tuple(jnp.zeros_like(value) for value in values)
    return Window((key,) * window, (nothing,) * window)


def arrive(
    waiting: Window, key: Array, values: tuple[Array, ...]
) -> tuple[Array, tuple[Array, ...], Window, list[Array]]:
    """Return key and values of what leaves, the window then, and where it shifted.

    The latter are W arrays [P] bool, False, then True from the place on that was taken.
    """
    before = [key < other for other in waiting.keys]
    keys = merged(before, waiting.keys, key)
    columns = [merged(before, *some) for some in zip(zip(*waiting.values), values)]
    rows = list(zip(*columns))
    return keys[0], rows[0], Window(tuple(keys[1:]), tuple(rows[1:])), before


def merged(before: list[Array], some: Sequence[Array], new: Array) -> list[Array]:
    """Return W + 1 arrays: W of a window, with a new one in its place."""
    out = [jnp.where(before[0], new, some[0])]
    for w in range(1, len(some)):
        moved = jnp.where(before[w - 1], some[w - 1], new)
        out.append(jnp.where(before[w], moved, some[w]))
    return [*out, jnp.where(before[-1], some[-1], new)]


class Layout(NamedTuple):
    """Rows of the values that wait with a Gaussian, beside its α.

    Attributes:
      channels: number of summed channels, without the ones.
      varying: names of the values that vary from pixel to pixel, behind them.
      median: row of the depth of which a median is asked for, or None.
      rows: number of rows.
    """

    channels: int
    varying: tuple[str, ...]
    median: int | None
    rows: int


def layout_of(channels: int, config: RasterConfig) -> Layout:
    """Return the layout for a number of summed channels, with the ones."""
    count, varying = channels - 1, pixel_channels(config)
    rows = count + len(varying)
    if "median_depth" not in config.outputs:
        return Layout(count, varying, None, rows)
    if "depth" in varying:
        return Layout(count, varying, count + varying.index("depth"), rows)
    return Layout(count, varying, rows, rows + 1)


def key_of(
    read: Reading, at: Evaluated, row: Array, tile: Array, config: RasterConfig
) -> Array:
    """Return the depth [P] by which pixels of a tile [] order a Gaussian."""
    assert config.primitive is not None
    if config.primitive.key is None:
        assert at.depth is not None
        return at.depth / read.ones
    numbers = lax.split(row[-read.widths[-1] :], [1] * read.widths[-1])
    x = read.pixels[0] - (row[:1] - number_at(read.left, tile))
    y = read.pixels[1] - (row[1:2] - number_at(read.top, tile))
    # The division keeps XLA from evaluating it again for each use.
    return config.primitive.key(tuple(numbers), x, y) / read.ones


def waiting_key(place: Array, end: Array, alpha: Array, key: Array) -> Array:
    """Return the key [P] with which what is at ``place`` of a list arrives."""
    # What does not show leaves at once; from the end on, what arrives stays.
    return jnp.where(place < end, jnp.where(alpha > 0, key, -jnp.inf), jnp.inf)


def suits(task: Task) -> bool:
    """Return whether the loops are one kernel here, made of vector instructions."""
    pixels = task.grid.tile**2
    channels = task.channels + ("median_depth" in task.config.outputs)
    window = task.config.order_window
    arrays = _ARRAYS + _PER_CHANNEL * channels
    arrays += window * (_PER_PLACE + _PER_BOTH * channels)
    arrays += _OF_FORM * (form_of(task.config) is not None)
    fits = pixels >= _FEWEST and task.itemsize * pixels * arrays <= KERNEL_BYTES
    fits &= task.platform == "cpu" and task.config.order == "window"
    return fits and loops.large_loops_are_kernels()


def composite_window(tiles: Tiles, task: Task) -> tuple[Images, Array]:
    """Composite one device's tiles; see `Compositor.forward`.

    Returns:
      Images, and the number [T] of Gaussians of each list that arrived, with the empty
      ones behind its end.
    """
    grid, config = task.grid, task.config
    read, window = reading_of(tiles, task), config.order_window
    empty = jnp.zeros_like(read.ones)
    nothing = {"sums": jnp.zeros((read.widths[1], len(empty)), empty.dtype)}
    nothing |= dict.fromkeys(single_images(config), empty)
    layout = layout_of(read.widths[1], config)
    images = {
        name: jnp.zeros((grid.tiles, *one.shape), one.dtype)
        for name, one in nothing.items()
    }
    arrived = jnp.zeros(grid.tiles, jnp.int32)

    def values_of(at: Evaluated, row: Array) -> tuple[Array, ...]:
        """Return α and the values of `Layout`."""
        _, channels, *rest = lax.split(row, read.widths)
        parts = [jnp.broadcast_to(channels[:-1, None], (layout.channels, len(empty)))]
        parts += [pixel_value(name, at)[None] for name in layout.varying]
        if layout.median == layout.rows - 1 and "depth" not in layout.varying:
            depth = rest[0] if at.depth is None else at.depth
            parts.append(jnp.broadcast_to(depth, (1, len(empty))))
        return at.alpha, jnp.concatenate(parts)

    def blend(place, end, tile, state):
        carried, deepest, waiting, image = state
        _, row = read.row(place, end)
        at = read.at(row[: read.widths[0]], tile, config)
        key = waiting_key(place, end, at.alpha, key_of(read, at, row, tile, config))
        key, (alpha, values), waiting, _ = arrive(waiting, key, values_of(at, row))
        passed = pass_through(carried, alpha)
        behind = jnp.where(passed > config.transmittance_min, passed, 0)
        weight = carried * alpha
        if config.stop_rule == "before":
            weight = jnp.where(behind > 0, weight, 0)
        there = weight > 0
        constant = weight * values[: layout.channels]
        added = {"sums": jnp.concatenate([constant, weight[None]])}
        for row, name in enumerate(layout.varying, layout.channels):
            added[name] = weight * values[row]
        if layout.median is not None:
            half = (carried > 0.5) & (passed <= 0.5) & there
            added["median"] = jnp.where(half, values[layout.median], 0)
        added["misordered"] = jnp.where(there & (key < deepest), 1.0, 0.0)
        deepest = jnp.where(there & (key > deepest), key, deepest)
        image = {name: image[name] + added[name] for name in image}
        return behind, deepest, waiting, image

    def of_tile(tile, state):
        images, arrived = state
        start, end = number_at(read.start, tile), number_at(read.end, tile)
        last = jnp.where(end > start, end + window, start)

        def turn(state):
            place, until, *rest = state
            for _ in range(TURN):
                rest = blend(place, end, tile, rest)
                place = place + 1
            return place, until, *rest

        def unfinished(state):
            return state[0][0] < state[1][0]

        def several(state):
            place, _, *rest = state
            until = jnp.minimum(place + BLOCK, last)
            place, _, *rest = lax.while_loop(unfinished, turn, (place, until, *rest))
            return place, last, *rest

        def open_(state):
            return unfinished(state) & jnp.any(state[2] > 0)

        like = empty, jnp.zeros((layout.rows, len(empty)), empty.dtype)
        begun = (
            *(start, last, jnp.ones_like(empty), jnp.full_like(empty, -jnp.inf)),
            *(empty_window(window, like), nothing),
        )
        place, *_, image = lax.while_loop(open_, several, begun)
        images = {name: with_image(images[name], image[name], tile) for name in images}
        return images, with_part(arrived, place - start, (tile,))

    zero, count = jnp.int32(0), jnp.int32(grid.tiles)
    return lax.fori_loop(zero, count, of_tile, (images, arrived))
