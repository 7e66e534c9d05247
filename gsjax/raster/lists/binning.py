"""Binning: the tiles that each footprint meets, and one sorted list per tile.

Footprints become items, one per (Gaussian, row of tiles), whose span of tiles along the
row follows exactly from the ellipse. `tile_lists` turns items into lists. No derivative
is taken here.

Axis legend: R ranks (front to back), T tiles, P pairs.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from gsjax.math.numerics import safe_sqrt
from gsjax.raster.lists.blocks import block_size
from gsjax.raster.lists.counting import cumulative_sum, segment_ids, total_count
from gsjax.raster.lists.tile_lists import choose_list_builder
from gsjax.raster.types import Array, Footprint
from gsjax.runtime.devices import platform_name


class Grid(NamedTuple):
    """Tiles of one device: every ``stride``-th row of tiles.

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
        """Number of tiles on this device."""
        return self.rows * self.cols


def make_grid(width: int, height: int, tile: int, stride: int) -> Grid:
    """Return the tiles that cover the image, rows dealt out to ``stride`` devices."""
    rows = -(-height // tile)
    return Grid(width, height, tile, -(-width // tile), -(-rows // stride), stride)


def tile_origins(grid: Grid, tile: Array, device: Array) -> tuple[Array, Array]:
    """Return pixel coordinates (x, y) of the upper left corners of local tiles."""
    row, col = tile // grid.cols, tile % grid.cols
    return col * grid.tile, (row * grid.stride + device) * grid.tile


def corners(tile: Array, grid: Grid, device: Array, dtype) -> Array:
    """Return the upper left corners [..., 2] of the tiles, px."""
    return jnp.stack(tile_origins(grid, tile, device), -1).astype(dtype)


class Spans(NamedTuple):
    """Spans of ``rows`` local rows of tiles from ``first``, [R] each."""

    first: Array
    rows: Array


class Lists(NamedTuple):
    """Sorted tile lists of one device.

    Attributes:
      ranks: [P] ranks sorted by (tile, rank); nothing behind the last list is read.
      start: [T] where the list of each tile begins.
      length: [T] entries of each tile; 0 if they cannot be counted, or the tile is
        masked out.
      pairs: [] entries of all lists, saturating.
      fit: [] bool, whether there was room; if not, ``ranks`` is meaningless, and the
        counts are right all the same.
    """

    ranks: Array
    start: Array
    length: Array
    pairs: Array
    fit: Array


def row_spans(footprint: Footprint, grid: Grid, device: Array) -> Spans:
    """Return the local rows of tiles that the box of each rank [R] meets.

    The rows of this device are device, device + stride, ….
    """
    *_, top, bottom, seen = _boxes(footprint, grid.width, grid.height)
    # Global rows of tiles g0 … g1 hold the local rows j with g0 ≤ j·stride + d ≤ g1.
    first = -((device - top // grid.tile) // grid.stride)
    last = (bottom // grid.tile - device) // grid.stride
    rows = jnp.where(seen, jnp.maximum(last - first + 1, 0), 0)
    return Spans(first=first, rows=rows)


def radii(footprint: Footprint, width: int | Array, height: int | Array) -> Array:
    """Return half the longer side [R] of the box around Q ≤ reach, in px.

    It is 0 if the box holds no pixel of the image.
    """
    var_x = 1 / jnp.square(footprint.inv_sx)
    radius = safe_sqrt(footprint.reach * jnp.maximum(var_x, footprint.var_y))
    *_, seen = _boxes(footprint, width, height)
    return jnp.where(seen, radius, 0)


def _boxes(
    footprint: Footprint, width: int | Array, height: int | Array
) -> tuple[Array, ...]:
    """Return the first and last pixel across and down, and whether any is seen."""
    extent_x = _extent(footprint.reach / jnp.square(footprint.inv_sx))
    extent_y = _extent(footprint.reach * footprint.var_y)
    left, right = _pixel_range(footprint.u, extent_x, width)
    top, bottom = _pixel_range(footprint.v, extent_y, height)
    seen = (footprint.reach > 0) & (left <= right) & (top <= bottom)
    return left, right, top, bottom, seen


def _extent(squared: Array) -> Array:
    """Return the half-width √squared plus room for rounding where α is evaluated."""
    return safe_sqrt(squared) * (1 + 1e-4) + 1e-2


def _pixel_range(
    centre: Array, extent: Array, size: int | Array
) -> tuple[Array, Array]:
    """Return the first and last pixel with a centre in centre ± extent.

    Both are clipped as floats: a cast of huge values would saturate and then wrap.
    """
    first = jnp.clip(jnp.ceil(centre - extent - 0.5), 0, size)
    last = jnp.clip(jnp.floor(centre + extent - 0.5), -1, size - 1)
    return first.astype(jnp.int32), last.astype(jnp.int32)


def _at(values: Array, index: Array) -> Array:
    """Return ``values`` at ``index``; the last one past the end."""
    return values.at[index].get(mode="clip")


def _tiles_in_row(
    footprint: Footprint, rank: Array, row: Array, grid: Grid, device: Array
) -> tuple[Array, Array]:
    """Return the first tile and the number of tiles that the ellipse meets in a row.

    The extreme x of Q ≤ reach within the strip dy ∈ [low, high] lies at the ellipse's
    own extreme if that is in the strip, else on the strip's nearer edge (the region is
    convex). The strip spans pixel centres: anything between them is unseen.
    """
    u, v, slope, var_y, det, reach, inv_sx = (
        _at(value, rank)
        for value in (
            footprint.u,
            footprint.v,
            footprint.slope,
            footprint.var_y,
            footprint.det,
            footprint.reach,
            footprint.inv_sx,
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
    # Rounds towards zero, which is down wherever there is a tile.
    first_tile, last_tile = (lax.div(a, jnp.int32(grid.tile)) for a in (first, last))
    count = jnp.where((reach > 0) & (first <= last), last_tile - first_tile + 1, 0)
    return row * grid.cols + first_tile, count


def masked_tiles(mask: Array, grid: Grid, device: Array) -> Array:
    """Return which local tiles [T] hold a pixel of ``mask`` [H, W]."""
    tall = grid.rows * grid.stride * grid.tile
    wide = grid.cols * grid.tile
    mask = jnp.pad(mask, ((0, tall - grid.height), (0, wide - grid.width)))
    tiles = mask.reshape(-1, grid.tile, grid.cols, grid.tile).any(axis=(1, 3))
    return tiles.reshape(grid.rows, grid.stride, grid.cols)[:, device].ravel()


def _trimming(masked: Array):
    """Return a function that trims unmasked tiles off both ends of a span."""
    tiles = masked.shape[0]
    place = lax.iota(jnp.int32, tiles)
    following = lax.cummin(jnp.where(masked, place, tiles), reverse=True)
    preceding = lax.cummax(jnp.where(masked, place, -1))

    def trim(first: Array, count: Array) -> tuple[Array, Array]:
        last = _at(preceding, first + count - 1)
        first = _at(following, first)
        return first, jnp.where(count > 0, jnp.maximum(last - first + 1, 0), 0)

    return trim


def make_lists(
    footprint: Footprint,
    grid: Grid,
    device: Array,
    capacity: int,
    num_size_buckets: int = 1,
    masked: Array | None = None,
    platform: str | None = None,
) -> Lists:
    """Return the sorted tile lists of one device.

    The work is done block by block and goes with what the view holds, not with the
    capacity. Pairs beyond the capacity are only counted.

    Args:
      footprint: [R], front to back.
      grid: tiles of this device.
      device: [] its number.
      capacity: room for pairs.
      num_size_buckets: sorting has at most 2 · num_size_buckets − 1 sizes.
      masked: [T] bool, the tiles to list, or None for all. Between two masked tiles of
        a row, unmasked ones count as pairs.
      platform: name of the platform the lists are made for; None for that of JAX.
    """
    spans = row_spans(footprint, grid, device)
    platform = platform or platform_name()
    ranks = footprint.u.shape[0]
    _, countable = total_count(spans.rows)
    past = jnp.where(spans.rows > 0, lax.iota(jnp.int32, ranks) + 1, 0)
    past = jnp.where(countable, jnp.max(past), 0)
    # Sums over a block must not wrap.
    window = min(block_size(ranks, 2), 2**30 // grid.rows)
    most = min(ranks * grid.rows, max(ranks, capacity))
    block = min(block_size(most, 2), 2**30 // grid.cols)
    place = lax.iota(jnp.int32, block)
    trim = None if masked is None else _trimming(masked)
    builder = choose_list_builder(
        platform, capacity, ranks, grid.tiles, num_size_buckets
    )

    def add_items(state):
        """Add as many items as a block holds, or as the ranks of a window have."""
        following, done, change, listed = state
        start = jnp.minimum(following, ranks - window)
        first, rows = (lax.dynamic_slice_in_dim(a, start, window) for a in spans)
        behind = start + lax.iota(jnp.int32, window) - following
        # The first of them had ``done`` items in the block before.
        before = jnp.where(behind < 0, rows, jnp.where(behind == 0, done, 0))
        first, rows = first + before, rows - before
        ends = cumulative_sum(rows)
        count = jnp.minimum(ends[-1], block)
        owner = segment_ids(ends, block)
        rank, row = start + owner, _at(first - (ends - rows), owner) + place
        tile, tiles = _tiles_in_row(footprint, rank, row, grid, device)
        tiles = jnp.where(place < count, tiles, 0)
        if trim is not None:
            tile, tiles = trim(tile, tiles)
        # Without a barrier each user would compute them again.
        tile, tiles = lax.optimization_barrier((tile, tiles))
        # + 1 where its tiles begin, − 1 behind their end.
        some = (tiles > 0).astype(jnp.int32)
        change = change.at[tile].add(some, mode="drop")
        change = change.at[tile + tiles].add(-some, mode="drop")
        through = ends <= count
        after = start + jnp.sum(through, dtype=jnp.int32)
        done = jnp.where(after == following, done, 0)
        done += count - jnp.max(jnp.where(through, ends, 0))
        return after, done, change, builder.add(listed, rank, tile, tiles)

    none = jnp.int32(0)
    init = none, none, jnp.zeros(grid.tiles, jnp.int32), builder.empty
    state = lax.while_loop(lambda state: state[0] < past, add_items, init)
    *_, change, listed = state
    length = cumulative_sum(change)
    pairs, _ = total_count(length)
    pairs = jnp.where(countable, pairs, 2**31 - 1)
    start = cumulative_sum(length) - length
    if masked is not None:
        length = jnp.where(masked, length, 0)
    return Lists(
        ranks=builder.ranks(listed, start, pairs),
        start=start,
        length=length,
        pairs=pairs,
        fit=pairs <= capacity,
    )
