"""Which Gaussian meets which tile, and in which order.

The way of the counts: Gaussians → (Gaussian, row of tiles) items, whose span of tiles
along the row follows exactly from the ellipse → sorted lists, one a tile
(`gsjax.raster.lists.tile_lists`); what follows from those is in `gsjax.raster.compositing.schedules`. No
derivative is taken here.

Axis legend: R ranks (front to back), T tiles, P pairs.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from gsjax.math.numerics import safe_sqrt
from gsjax.raster.lists.blocks import block_size
from gsjax.raster.lists.counting import cumulative_sum, segment_ids, total_count
from gsjax.raster.lists.tile_lists import choose_list_builder
from gsjax.raster.types import Array, Projected
from gsjax.runtime.devices import platform_name


class Grid(NamedTuple):
    """The tiles one device works on: every ``stride``-th row of tiles.

    Attributes:
      width, height: image size in pixels.
      tile: side of a tile in pixels.
      cols: tiles along a row.
      rows: rows of tiles on this device.
      stride: number of devices that share the rows.
    """

    width: int
    height: int
    tile: int
    cols: int
    rows: int
    stride: int

    @property
    def tiles(self) -> int:
        """Tiles on this device."""
        return self.rows * self.cols


def make_grid(width: int, height: int, tile: int, stride: int) -> Grid:
    """Tiles that cover the image, the rows dealt out to ``stride`` devices."""
    rows = -(-height // tile)
    return Grid(width, height, tile, -(-width // tile), -(-rows // stride), stride)


def tile_origins(grid: Grid, tile: Array, device: Array) -> tuple[Array, Array]:
    """Pixel coordinates (x, y) of the upper left corners of local tiles."""
    row, col = tile // grid.cols, tile % grid.cols
    return col * grid.tile, (row * grid.stride + device) * grid.tile


def corners(tile: Array, grid: Grid, device: Array, dtype) -> Array:
    """[..., 2] upper left corners of the tiles, px."""
    return jnp.stack(tile_origins(grid, tile, device), -1).astype(dtype)


class Spans(NamedTuple):
    """``rows`` local rows of tiles from ``first``, [R] each."""

    first: Array
    rows: Array


class Lists(NamedTuple):
    """Sorted lists of one device.

    Attributes:
      ranks: [P] ranks sorted by (tile, rank); what follows the last is never read.
      start: [T] where the list of each tile begins.
      length: [T] entries of each tile; zero if they cannot be counted, or the tile is
        not wanted.
      pairs: [] in all lists, saturating.
      fit: [] bool, whether there was room; if not, ``ranks`` holds nothing of use, and
        the counts are right all the same.
    """

    ranks: Array
    start: Array
    length: Array
    pairs: Array
    fit: Array


def row_spans(projected: Projected, grid: Grid, device: Array) -> Spans:
    """Local rows of tiles that the box of each rank [R] meets.

    The rows of this device are device, device + stride, ….
    """
    *_, top, bottom, seen = _boxes(projected, grid.width, grid.height)
    # Global rows of tiles g0 … g1 hold the local rows j with g0 ≤ j·stride + d ≤ g1.
    first = -((device - top // grid.tile) // grid.stride)
    last = (bottom // grid.tile - device) // grid.stride
    rows = jnp.where(seen, jnp.maximum(last - first + 1, 0), 0)
    return Spans(first=first, rows=rows)


def radii(projected: Projected, width: int | Array, height: int | Array) -> Array:
    """Half the longer side [R] of the box around Q ≤ reach, in px; 0 where it holds no
    pixel of the image.
    """
    var_x = 1 / jnp.square(projected.inv_sx)
    radius = safe_sqrt(projected.reach * jnp.maximum(var_x, projected.var_y))
    *_, seen = _boxes(projected, width, height)
    return jnp.where(seen, radius, 0)


def _boxes(
    projected: Projected, width: int | Array, height: int | Array
) -> tuple[Array, ...]:
    """First and last pixel across, then down, and whether there is any, [R] each."""
    extent_x = _extent(projected.reach / jnp.square(projected.inv_sx))
    extent_y = _extent(projected.reach * projected.var_y)
    left, right = _pixel_range(projected.u, extent_x, width)
    top, bottom = _pixel_range(projected.v, extent_y, height)
    seen = (projected.reach > 0) & (left <= right) & (top <= bottom)
    return left, right, top, bottom, seen


def _extent(squared: Array) -> Array:
    """Half-width √squared plus room for the rounding of whoever evaluates α."""
    return safe_sqrt(squared) * (1 + 1e-4) + 1e-2


def _pixel_range(
    centre: Array, extent: Array, size: int | Array
) -> tuple[Array, Array]:
    """First and last pixel whose centre lies in centre ± extent, within the image.

    Clipped as floats: a cast of wild values would saturate and then wrap.
    """
    first = jnp.clip(jnp.ceil(centre - extent - 0.5), 0, size)
    last = jnp.clip(jnp.floor(centre + extent - 0.5), -1, size - 1)
    return first.astype(jnp.int32), last.astype(jnp.int32)


def _at(values: Array, index: Array) -> Array:
    """``values`` at ``index``, the last past the last."""
    return values.at[index].get(mode="clip")


def _tiles_in_row(
    projected: Projected, rank: Array, row: Array, grid: Grid, device: Array
) -> tuple[Array, Array]:
    """First tile and number of tiles that the ellipse meets along one row of tiles.

    The extreme x of Q ≤ reach within the strip dy ∈ [low, high] lies at the ellipse's
    own extreme if that is in the strip, else on the strip's nearer edge (the region is
    convex). The strip spans pixel *centres*: what falls between them is unseen.
    """
    u, v, slope, var_y, det, reach, inv_sx = (
        _at(value, rank)
        for value in (
            projected.u,
            projected.v,
            projected.slope,
            projected.var_y,
            projected.det,
            projected.reach,
            projected.inv_sx,
        )
    )
    var_x = 1 / jnp.square(inv_sx)
    top = (row * grid.stride + device) * grid.tile
    low = top.astype(u.dtype) + 0.5 - v
    high = jnp.minimum(low + (grid.tile - 1), grid.height - 0.5 - v)
    safe_c = jnp.where(var_y > 0, var_y, 1)
    extreme_x = safe_sqrt(reach * var_x)

    def reach_towards(sign):
        dy = jnp.clip(sign * slope * extreme_x, low, high)
        width = safe_sqrt((reach - dy * dy / safe_c) * (det / safe_c))
        return sign * (slope * var_x / safe_c * dy) + width

    left = _extent(0 * u) + reach_towards(-1.0) * (1 + 1e-4)
    right = _extent(0 * u) + reach_towards(1.0) * (1 + 1e-4)
    first = jnp.clip(jnp.ceil(u - left - 0.5), 0, grid.width).astype(jnp.int32)
    last = jnp.clip(jnp.floor(u + right - 0.5), -1, grid.width - 1).astype(jnp.int32)
    # Towards zero, which is down where there is any.
    first_tile, last_tile = (lax.div(a, jnp.int32(grid.tile)) for a in (first, last))
    count = jnp.where((reach > 0) & (first <= last), last_tile - first_tile + 1, 0)
    return row * grid.cols + first_tile, count


def wanted_tiles(mask: Array, grid: Grid, device: Array) -> Array:
    """Which local tiles [T] hold a pixel of ``mask`` [H, W]."""
    tall = grid.rows * grid.stride * grid.tile
    wide = grid.cols * grid.tile
    mask = jnp.pad(mask, ((0, tall - grid.height), (0, wide - grid.width)))
    tiles = mask.reshape(-1, grid.tile, grid.cols, grid.tile).any(axis=(1, 3))
    return tiles.reshape(grid.rows, grid.stride, grid.cols)[:, device].ravel()


def _trimming(wanted: Array):
    """(first tile, count) → the same span without unwanted tiles at its ends."""
    tiles = wanted.shape[0]
    place = lax.iota(jnp.int32, tiles)
    following = lax.cummin(jnp.where(wanted, place, tiles), reverse=True)
    preceding = lax.cummax(jnp.where(wanted, place, -1))

    def trim(first: Array, count: Array) -> tuple[Array, Array]:
        last = _at(preceding, first + count - 1)
        first = _at(following, first)
        return first, jnp.where(count > 0, jnp.maximum(last - first + 1, 0), 0)

    return trim


def make_lists(
    projected: Projected,
    spans: Spans,
    grid: Grid,
    device: Array,
    capacity: int,
    num_size_buckets: int = 1,
    wanted: Array | None = None,
    platform: str | None = None,
) -> Lists:
    """Expand ranks to items, and those to sorted lists; room for ``capacity`` pairs.

    By blocks of items, and only as many as there are: what is paid goes with what
    a view holds, and not with the capacity. Without room the rest is counted alone.

    Args:
      projected: [R], front to back.
      spans: of `row_spans`.
      grid: the tiles of this device.
      device: [] its number.
      capacity: of pairs.
      num_size_buckets: 2 · num_size_buckets − 1 sizes at which to sort, at most.
      wanted: [T] bool, or None for all: other tiles have no list. (What meets wanted
        ones of their row on both sides is listed all the same.)
      platform: that the lists are made for; None means that of JAX.
    """
    platform = platform or platform_name()
    ranks = projected.u.shape[0]
    _, countable = total_count(spans.rows)
    past = jnp.where(spans.rows > 0, lax.iota(jnp.int32, ranks) + 1, 0)
    past = jnp.where(countable, jnp.max(past), 0)
    # Nor do the sums over a block wrap.
    window = min(block_size(ranks, 2), 2**30 // grid.rows)
    most = min(ranks * grid.rows, max(ranks, capacity))
    block = min(block_size(most, 2), 2**30 // grid.cols)
    place = lax.iota(jnp.int32, block)
    trim = None if wanted is None else _trimming(wanted)
    way = choose_list_builder(platform, capacity, ranks, grid.tiles, num_size_buckets)

    def add_items(state):
        """As many as a block holds, or the ranks of a window have."""
        following, done, change, listed = state
        start = jnp.minimum(following, ranks - window)
        first, rows = (lax.dynamic_slice_in_dim(a, start, window) for a in spans)
        behind = start + lax.iota(jnp.int32, window) - following
        # Of the first that follows ``done`` were in the block before.
        before = jnp.where(behind < 0, rows, jnp.where(behind == 0, done, 0))
        first, rows = first + before, rows - before
        ends = cumulative_sum(rows)
        count = jnp.minimum(ends[-1], block)
        owner = segment_ids(ends, block)
        rank, row = start + owner, _at(first - (ends - rows), owner) + place
        tile, tiles = _tiles_in_row(projected, rank, row, grid, device)
        tiles = jnp.where(place < count, tiles, 0)
        if trim is not None:
            tile, tiles = trim(tile, tiles)
        # Else computed by each of those who use them.
        tile, tiles = lax.optimization_barrier((tile, tiles))
        # 1 where its tiles begin, off again where they end.
        some = (tiles > 0).astype(jnp.int32)
        change = change.at[tile].add(some, mode="drop")
        change = change.at[tile + tiles].add(-some, mode="drop")
        through = ends <= count
        after = start + jnp.sum(through, dtype=jnp.int32)
        done = jnp.where(after == following, done, 0)
        done += count - jnp.max(jnp.where(through, ends, 0))
        return after, done, change, way.add(listed, rank, tile, tiles)

    none = jnp.int32(0)
    init = none, none, jnp.zeros(grid.tiles, jnp.int32), way.nothing
    state = lax.while_loop(lambda state: state[0] < past, add_items, init)
    *_, change, listed = state
    length = cumulative_sum(change)
    pairs, _ = total_count(length)
    pairs = jnp.where(countable, pairs, 2**31 - 1)
    start = cumulative_sum(length) - length
    if wanted is not None:
        length = jnp.where(wanted, length, 0)
    return Lists(
        ranks=way.ranks(listed, start, pairs),
        start=start,
        length=length,
        pairs=pairs,
        fit=pairs <= capacity,
    )
