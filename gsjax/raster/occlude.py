"""Leave out what lies behind pixels that have all stopped, before it is binned.

Conservative and exact: a Gaussian is dropped only if nothing of it would have been
blended. The smallest α that a Gaussian has over a square stands at one of the four
corners (its level sets are convex), so the product of 1 − α_min over the Gaussians in
front bounds the transmittance of every pixel of the square from above. Squares where
the bound falls to the stop are closed from that rank on. No derivative is taken here.

Axis legend: R ranks (front to back), Y X squares, M candidates of a step.
"""

import jax.numpy as jnp
from jax import lax

from gsjax.numerics import safe_sqrt
from gsjax.raster.batches import any_of_batch
from gsjax.raster.counts import squeeze
from gsjax.raster.types import Array, Projected, RasterConfig

SQUARE = 16  # px; small enough that a splat of that size can close it with others
CANDIDATES = 2048  # at most, the front-most ones
PER_STEP = 64
OPEN = 2**31 - 1
# Room for rounding: of α at a corner, and of the product against the stop.
ALPHA_MARGIN = 0.999
STOP_MARGIN = 0.5


def hidden(
    projected: Projected, width: int, height: int, config: RasterConfig
) -> Array:
    """Which ranks [R] of one camera cannot add to any pixel."""
    ranks = projected.u.shape[0]
    index, count = _candidates(projected)

    def search():
        closed = _closed_from(projected, index, count, width, height, config)
        latest = _latest_over_box(projected, closed, width, height)
        return lax.iota(jnp.int32, ranks) > latest

    return lax.cond(any_of_batch(count > 0), search, lambda: jnp.zeros(ranks, bool))


def _candidates(projected: Projected) -> tuple[Array, Array]:
    """Ranks of Gaussians wide and opaque enough to close a square, front-most first.

    A heuristic of what pays: σ no less than half a square on the narrow side (2 det /
    trace is at most twice, and for round ones just, the smaller eigenvalue), and
    α ≥ 1/4 in the middle.
    """
    trace = 1 / (projected.inv_sx * projected.inv_sx) + projected.var_y
    wide = 2 * projected.det > trace * (0.5 * SQUARE) ** 2
    chosen = wide & (projected.opacity > 0.25) & (projected.reach > 0)
    room = min(CANDIDATES, chosen.shape[0])
    index, count = squeeze(chosen, room)
    return index, jnp.minimum(count, room)


def _closed_from(
    projected: Projected,
    index: Array,
    count: Array,
    width: int,
    height: int,
    config: RasterConfig,
) -> Array:
    """Rank [Y, X] after which nothing shows in a square, or `OPEN`."""
    rows, cols = -(-height // SQUARE), -(-width // SQUARE)
    dtype = projected.u.dtype
    xs = jnp.arange(cols + 1, dtype=dtype) * SQUARE
    ys = jnp.arange(rows + 1, dtype=dtype)[:, None] * SQUARE
    index = jnp.pad(index, (0, PER_STEP), constant_values=projected.u.shape[0])

    def go_on(state):
        start, through, _ = state
        return (start < count) & jnp.any(through > 0)

    def step(state):
        start, through, closed = state
        some = lax.dynamic_slice_in_dim(index, start, PER_STEP)

        def take(values):
            filled = values.at[some].get(mode="fill", fill_value=0)
            return filled[:, None, None]

        dx, dy = xs - take(projected.u), ys - take(projected.v)
        y1 = take(projected.inv_sx) * dx
        y2 = take(projected.inv_sy) * (dy - take(projected.slope) * dx)
        alpha = take(projected.opacity) * jnp.exp(-0.5 * (y1 * y1 + y2 * y2))
        alpha = jnp.minimum(alpha[:, :-1], alpha[:, 1:])
        alpha = jnp.minimum(alpha[..., :-1], alpha[..., 1:]) * ALPHA_MARGIN
        alpha = jnp.minimum(alpha, config.alpha_cap)
        alpha = jnp.where(alpha > config.alpha_cut, alpha, 0)
        after = through * jnp.cumprod(1 - alpha, axis=0)
        done = after <= config.stop * STOP_MARGIN
        rank = jnp.min(jnp.where(done, some[:, None, None], OPEN), axis=0)
        through = jnp.where(done[-1], 0, after[-1])
        return start + PER_STEP, through, jnp.minimum(closed, rank)

    init = (
        jnp.int32(0),
        jnp.ones((rows, cols), dtype),
        jnp.full((rows, cols), OPEN, jnp.int32),
    )
    return lax.while_loop(go_on, step, init)[2]


def _latest_over_box(
    projected: Projected, closed: Array, width: int, height: int
) -> Array:
    """Largest rank [R] of ``closed`` over the squares that the box of each meets.

    Read from a pyramid of maxima, at the level where the box spans at most two
    squares each way: four look-ups whatever its size.
    """
    var_x = 1 / (projected.inv_sx * projected.inv_sx)

    def squares(centre, variance, size):
        extent = safe_sqrt(projected.reach * variance) * (1 + 1e-3) + 1
        low = jnp.clip(centre - extent, 0, size - 1)
        high = jnp.clip(centre + extent, 0, size - 1)
        return tuple(a.astype(jnp.int32) // SQUARE for a in (low, high))

    left, right = squares(projected.u, var_x, width)
    top, bottom = squares(projected.v, projected.var_y, height)
    span = jnp.maximum(right - left, bottom - top)
    levels = [closed]
    while max(levels[-1].shape) > 1:
        levels.append(_halve(levels[-1]))
    level = sum((span > 2**k).astype(jnp.int32) for k in range(len(levels) - 1))
    level = jnp.where(span > 0, level, 0)
    sizes = [a.size for a in levels]
    starts = jnp.asarray([sum(sizes[:k]) for k in range(len(sizes))], jnp.int32)
    widths = jnp.asarray([a.shape[1] for a in levels], jnp.int32)
    table = jnp.concatenate([a.ravel() for a in levels])

    def look(x, y):
        return table[starts[level] + (y >> level) * widths[level] + (x >> level)]

    corners = [look(x, y) for x in (left, right) for y in (top, bottom)]
    return jnp.max(jnp.stack(corners), axis=0)


def _halve(closed: Array) -> Array:
    """Maxima of 2 × 2 squares; a missing one counts as closed from the start."""
    rows, cols = closed.shape
    padded = jnp.pad(closed, ((0, rows % 2), (0, cols % 2)), constant_values=-1)
    return padded.reshape(-(-rows // 2), 2, -(-cols // 2), 2).max(axis=(1, 3))
