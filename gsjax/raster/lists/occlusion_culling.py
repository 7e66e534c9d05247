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
    front: tuple[Array, ...],
    depth: Array,
    count: Array,
    width: int,
    height: int,
    config: RasterConfig,
) -> Array:
    """Depth [Y, X] behind which nothing shows in a square; infinity if there is none.

    Args:
      front: of candidates, front to back, [C] each; see `project.ellipses`.
      depth: [C] what they are sorted by.
      count: [] how many there are; those behind have opacity 0.
      width, height: image size.
      config: its cap, its cut and its stop.
    """
    rows, cols = -(-height // SQUARE), -(-width // SQUARE)
    dtype, candidates = depth.dtype, depth.shape[0]
    xs = jnp.arange(cols + 1, dtype=dtype) * SQUARE
    ys = jnp.arange(rows + 1, dtype=dtype)[:, None] * SQUARE
    several, limit = min(PER_STEP, candidates), config.stop * STOP_MARGIN

    def cut(column, start):
        """From ``start``; the last begin earlier instead of ending later."""
        return lax.dynamic_slice_in_dim(column, start, several)

    def at_corners(start):
        """α [M, Y + 1, X + 1], the smallest that it may be."""
        u, v, inv_sx, slope, inv_sy, opacity = (
            cut(column, start)[:, None, None] for column in front
        )
        dx, dy = xs - u, ys - v
        y1, y2 = inv_sx * dx, inv_sy * (dy - slope * dx)
        alpha = opacity * jnp.exp(-0.5 * (y1 * y1 + y2 * y2)) * ALPHA_MARGIN
        alpha = jnp.minimum(alpha, config.alpha_max)
        return jnp.where(alpha > config.alpha_min, alpha, 0)

    def go_on(state):
        start, _, through, _ = state
        return (start < count) & jnp.any(through > 0)

    def step(state):
        start, alpha, through, closed = state
        far = cut(depth, start)
        alpha = jnp.minimum(alpha[:, :-1], alpha[:, 1:])
        alpha = jnp.minimum(alpha[:, :, :-1], alpha[:, :, 1:])
        place = jnp.minimum(start, candidates - several) + lax.iota(jnp.int32, several)
        fresh = place >= start
        alpha = jnp.where(fresh[:, None, None], alpha, 0)
        for k in range(several):
            through = through * (1 - alpha[k])
            closed = jnp.minimum(closed, jnp.where(through <= limit, far[k], jnp.inf))
        through = jnp.where(through <= limit, 0, through)
        # From one turn to the next: within one, XLA would take the exponentials again
        # for each of the four squares at a corner.
        start = start + several
        return start, at_corners(start), through, closed

    init = (
        jnp.int32(0),
        at_corners(jnp.int32(0)),
        jnp.ones((rows, cols), dtype),
        jnp.full((rows, cols), jnp.inf, dtype),
    )
    return lax.while_loop(go_on, step, init)[3]


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
