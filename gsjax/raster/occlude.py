"""What lies behind pixels that have all stopped, found before it is sorted.

Conservative and exact: a Gaussian is dropped only if nothing of it would have been
blended. The smallest α that a Gaussian has over a square stands at one of the four
corners (its level sets are convex), so the product of 1 − α_min over the Gaussians in
front bounds the transmittance of every pixel of the square from above. Squares where
the bound falls to the stop are closed from that depth on. No derivative is taken here.

Axis legend: Y X squares, C candidates front to back, M of them at a step.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from gsjax.raster.types import Array, RasterConfig

SQUARE = 16  # px; small enough that a splat of that size can close it with others
CANDIDATES = 1024  # at most, the front-most ones
PER_STEP = 16
# Room for rounding: of α at a corner, and of the product against the stop.
ALPHA_MARGIN = 0.999
STOP_MARGIN = 0.5


class Box(NamedTuple):
    """Boxes around Gaussians on the image, [K] each, px.

    Attributes:
      u, v: their middles.
      half_width, half_height: to either side of it.
    """

    u: Array
    v: Array
    half_width: Array
    half_height: Array


def is_wide(variance: Array, opacity: Array) -> Array:
    """Whether a Gaussian is wide and opaque enough to close a square with others.

    A heuristic of what pays: σ of half a square, and α ≥ 1/4 in the middle.

    Args:
      variance: px², what it may have at most on its narrow side.
      opacity: as large.
    """
    return (variance > (0.5 * SQUARE) ** 2) & (opacity > 0.25)


def closed_from(
    front: Array,
    depth: Array,
    count: Array,
    width: int,
    height: int,
    config: RasterConfig,
) -> Array:
    """Depth [Y, X] behind which nothing shows in a square; infinity if there is none.

    Args:
      front: [6, C] candidates, front to back; see `project.ellipses`.
      depth: [C] what they are sorted by.
      count: [] how many there are.
      width, height: image size.
      config: its cap, its cut and its stop.
    """
    rows, cols = -(-height // SQUARE), -(-width // SQUARE)
    dtype = front.dtype
    xs = jnp.arange(cols + 1, dtype=dtype) * SQUARE
    ys = jnp.arange(rows + 1, dtype=dtype)[:, None] * SQUARE

    # Past the last there are some that are not there: opacity 0.
    table = jnp.pad(jnp.concatenate([front, depth[None]]), ((0, 0), (0, PER_STEP)))

    def go_on(state):
        start, through, _ = state
        return (start < count) & jnp.any(through > 0)

    def step(state):
        start, through, closed = state
        some = lax.dynamic_slice_in_dim(table, start, PER_STEP, axis=1)
        u, v, inv_sx, slope, inv_sy, opacity, far = some[..., None, None]
        dx, dy = xs - u, ys - v
        y1, y2 = inv_sx * dx, inv_sy * (dy - slope * dx)
        q = y1 * y1 + y2 * y2
        # Not as maxima of slices: XLA would take the exponential of each number alone.
        window = ((1, 2, 2), (1, 1, 1), "VALID")
        q = lax.reduce_window(q, -jnp.inf, lax.max, *window)
        alpha = opacity * jnp.exp(-0.5 * q) * ALPHA_MARGIN
        alpha = jnp.minimum(alpha, config.alpha_cap)
        alpha = jnp.where(alpha > config.alpha_cut, alpha, 0)
        after = through * jnp.cumprod(1 - alpha, axis=0)
        done = after <= config.stop * STOP_MARGIN
        behind = jnp.min(jnp.where(done, far, jnp.inf), axis=0)
        through = jnp.where(done[-1], 0, after[-1])
        return start + PER_STEP, through, jnp.minimum(closed, behind)

    init = (
        jnp.int32(0),
        jnp.ones((rows, cols), dtype),
        jnp.full((rows, cols), jnp.inf, dtype),
    )
    return lax.while_loop(go_on, step, init)[2]


def behind(closed: Array, box: Box, depth: Array, width: int, height: int) -> Array:
    """Which [K] lie behind what closes all squares that their boxes meet.

    Read from a pyramid of maxima, at the level where the box spans at most two
    squares each way: four look-ups whatever its size.

    Args:
      closed: of `closed_from`.
      box, depth: [K].
      width, height: image size.
    """

    def squares(centre, extent, size):
        low = jnp.clip(centre - extent - 1, 0, size - 1)
        high = jnp.clip(centre + extent + 1, 0, size - 1)
        return tuple(a.astype(jnp.int32) // SQUARE for a in (low, high))

    left, right = squares(box.u, box.half_width, width)
    top, bottom = squares(box.v, box.half_height, height)
    span = jnp.maximum(right - left, bottom - top)
    levels = [closed]
    while max(levels[-1].shape) > 1:
        levels.append(_halve(levels[-1]))
    level = sum((span > 2**k).astype(jnp.int32) for k in range(len(levels) - 1))
    level = jnp.where(span > 0, level, 0)
    table = jnp.concatenate([a.ravel() for a in levels])
    start = sum(jnp.where(level > k, a.size, 0) for k, a in enumerate(levels))
    row = sum(jnp.where(level == k, a.shape[1], 0) for k, a in enumerate(levels))

    def look(x, y):
        return table[start + (y >> level) * row + (x >> level)]

    corners = [look(x, y) for x in (left, right) for y in (top, bottom)]
    return depth > jnp.max(jnp.stack(corners), axis=0)


def _halve(closed: Array) -> Array:
    """Maxima of 2 × 2 squares; a missing one counts as closed from the start."""
    rows, cols = closed.shape
    padded = jnp.pad(closed, ((0, rows % 2), (0, cols % 2)), constant_values=-jnp.inf)
    return padded.reshape(-(-rows // 2), 2, -(-cols // 2), 2).max(axis=(1, 3))
