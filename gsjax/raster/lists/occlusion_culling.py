"""Occlusion culling before sorting. No derivative is taken here.

Conservative and exact: a Gaussian is dropped only if nothing of it would be blended.
The smallest α that a Gaussian has over a square lies at one of its four corners (the
level sets are convex). So the product of 1 − α_min over the Gaussians in front bounds
the transmittance of every pixel of the square from above. A square where this bound
falls to the limit is closed from that depth on.

Axis legend: N slots, Y X squares, K candidates front to back, M of them at a step.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax

from gsjax.raster.forms import unmarked, values_at
from gsjax.raster.lists.counting import compact_indices
from gsjax.raster.lists.depth_order import depth_of_slots
from gsjax.raster.lists.sorting import argsort_float
from gsjax.raster.types import Array, Bounds, Box, RasterConfig, Splat
from gsjax.raster.vmap_branching import any_in_batch

SQUARE = 16  # px; small enough that a splat of that size can close it with others
CANDIDATES = 1024  # at most, the front-most ones
PER_STEP = 16
# Room for rounding: of α at a corner, and of the product against the limit.
ALPHA_MARGIN = 0.999
STOP_MARGIN = 0.5


def is_wide(variance: Array, opacity: Array) -> Array:
    """Return whether a Gaussian is wide and opaque enough to close a square.

    A heuristic of what pays off: σ of half a square, and α ≥ 1/4 at the centre.

    Args:
      variance: px², upper limit of the variance along the narrow side.
      opacity: of the same shape.
    """
    return (variance > (0.5 * SQUARE) ** 2) & (opacity > 0.25)


def cull(
    bounds: Bounds,
    occluders: Callable[[Array, Array], Splat],
    size: tuple[int, int],
    config: RasterConfig,
) -> Array:
    """Return the depth [N], infinity for what lies behind pixels that have all stopped.

    Args:
      bounds: [N].
      occluders: (slots [K], count []) → splats of the candidates.
      size: (width, height) of the image, px.
      config: the limits of α and of the transmittance are used.
    """
    if config.transmittance_min == 0:
        return bounds.z

    def search(bounds: Bounds) -> Array:
        slots, count = _front_most(bounds.wide, bounds.z)
        front = occluders(slots, count)
        closed = closed_from(
            front, depth_of_slots(bounds.z, slots), count, size, config
        )

        def left(bounds: Bounds) -> Array:
            hidden = behind(closed, bounds.box, bounds.z, size)
            return jnp.where(hidden, jnp.inf, bounds.z)

        some = any_in_batch(jnp.any(closed < jnp.inf))
        return lax.cond(some, left, lambda bounds: bounds.z, bounds)

    some = any_in_batch(jnp.any(bounds.wide))
    return lax.cond(some, search, lambda bounds: bounds.z, bounds)


def _front_most(wide: Array, z: Array) -> tuple[Array, Array]:
    """Return the slots of the front-most wide ones, front to back, and their number.

    At most four times `CANDIDATES` of the lowest slots are looked at.
    """
    slots, count = compact_indices(wide, min(4 * CANDIDATES, wide.shape[0]))
    order = argsort_float(depth_of_slots(z, slots))[:CANDIDATES]
    return slots[order], jnp.minimum(count, order.shape[0])


def closed_from(
    front: Splat,
    depth: Array,
    count: Array,
    size: tuple[int, int],
    config: RasterConfig,
) -> Array:
    """Return the depth [Y, X] behind which nothing shows in a square; infinity if none.

    Args:
      front: splats of the candidates, front to back, [K] each.
      depth: [K] by which they are sorted.
      count: [] number of candidates; those behind it have opacity 0.
      size: (width, height) of the image, px.
      config: the limits of α and of the transmittance are used.
    """
    width, height = size
    rows, cols = -(-height // SQUARE), -(-width // SQUARE)
    dtype, candidates = depth.dtype, depth.shape[0]
    xs = jnp.arange(cols + 1, dtype=dtype) * SQUARE
    ys = jnp.arange(rows + 1, dtype=dtype)[:, None] * SQUARE
    several, limit = min(PER_STEP, candidates), config.transmittance_min * STOP_MARGIN

    def cut(column, start):
        """Slice from ``start``; the last slices begin earlier."""
        return lax.dynamic_slice_in_dim(column, start, several)

    def at_corners(start):
        """Return a lower bound of α [M, Y + 1, X + 1]."""
        u, v, *shape, opacity = (
            cut(column, start)[:, None, None]
            for column in (front.u, front.v, *front.shape)
        )
        power = _power(tuple(shape), xs - u, ys - v, config)
        alpha = opacity * jnp.exp(power) * ALPHA_MARGIN
        alpha = jnp.minimum(alpha, config.alpha_max)
        return jnp.where(alpha > config.alpha_min, alpha, 0)

    def unfinished(state):
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
        # Carried to the next turn: within one, XLA would evaluate the exponentials
        # again for each of the four squares at a corner.
        start = start + several
        return start, at_corners(start), through, closed

    init = (
        jnp.int32(0),
        at_corners(jnp.int32(0)),
        jnp.ones((rows, cols), dtype),
        jnp.full((rows, cols), jnp.inf, dtype),
    )
    return lax.while_loop(unfinished, step, init)[3]


def _power(shape, dx: Array, dy: Array, config: RasterConfig) -> Array:
    """Return the logarithm of α / opacity, or less, at offsets from the centre."""
    form = None if config.primitive is None else config.primitive.form
    if form is None:
        inv_sx, slope, inv_sy, *_ = shape
        y1, y2 = inv_sx * dx, inv_sy * (dy - slope * dx)
        return -0.5 * (y1 * y1 + y2 * y2)
    parts = (form.convex_parts or form.parts)(shape)
    values = values_at(parts, dx, dy)
    return form.evaluate(values, parts.depth, parts.limits, unmarked).power


def behind(closed: Array, box: Box, depth: Array, size: tuple[int, int]) -> Array:
    """Return which [K] lie behind what closes all squares that their boxes meet.

    The look-up reads a pyramid of maxima at the level where the box spans at most two
    squares each way: four reads whatever its size.

    Args:
      closed: [Y, X] from `closed_from`.
      box, depth: [K].
      size: (width, height) of the image, px.
    """

    def squares(centre, extent, length):
        low = jnp.clip(centre - extent - 1, 0, length - 1)
        high = jnp.clip(centre + extent + 1, 0, length - 1)
        return tuple(a.astype(jnp.int32) // SQUARE for a in (low, high))

    left, right = squares(box.u, box.half_width, size[0])
    top, bottom = squares(box.v, box.half_height, size[1])
    span = jnp.maximum(right - left, bottom - top)
    levels = [closed]
    while max(levels[-1].shape) > 1:
        levels.append(_halve(levels[-1]))
    level = sum((span > 2**k).astype(jnp.int32) for k in range(len(levels) - 1))
    level = jnp.where(span > 0, level, 0)
    table = jnp.concatenate([a.ravel() for a in levels])
    start = sum(jnp.where(level > k, a.size, 0) for k, a in enumerate(levels))
    row = sum(jnp.where(level == k, a.shape[1], 0) for k, a in enumerate(levels))

    def look_up(x, y):
        return table[start + (y >> level) * row + (x >> level)]

    corners = [look_up(x, y) for x in (left, right) for y in (top, bottom)]
    return depth > jnp.max(jnp.stack(corners), axis=0)


def _halve(closed: Array) -> Array:
    """Return maxima of 2 × 2 squares; a missing one counts as closed from the start."""
    rows, cols = closed.shape
    padded = jnp.pad(closed, ((0, rows % 2), (0, cols % 2)), constant_values=-jnp.inf)
    return padded.reshape(-(-rows // 2), 2, -(-cols // 2), 2).max(axis=(1, 3))
