"""Gaussian window of the structural similarity: weighted means around each pixel.

The map is linear and symmetric, so its transpose, and with it every derivative, is the
map itself.

Axis legend: N planes, H W image, C channels.
"""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import sequential_vmap

from gsjax.runtime.custom_transpose import custom_transpose
from gsjax.runtime.devices import on_cpu
from gsjax.runtime.loops import fori_loop, part_at, with_part

Array = jax.Array

RADIUS, _SIGMA = 5, 1.5
# Side of the banded matrices, in pixels.
_BLOCK = 32
# Numbers of a row per loop iteration, few enough to keep each loop one kernel.
_SEGMENT = 1024


def window_means(planes: Sequence[Array]) -> list[Array]:
    """Return the windowed means of each plane.

    Pixels beyond the border count as 0.

    Args:
      planes: arrays [H, W, C] of one shape and dtype.
    """
    by = _by_loops if on_cpu() else _by_products
    forward, transpose = lambda *p: list(by(p)), lambda *p: window_means(p)
    return custom_transpose(forward, transpose, (), planes, planes)


def _weights() -> list[float]:
    """Return the weights [2 · RADIUS + 1] along one axis."""
    offset = np.arange(-RADIUS, RADIUS + 1)
    weight = np.exp(-0.5 * np.square(offset / _SIGMA))
    return (weight / weight.sum()).tolist()


@jax.jit  # so that eager calls compile once
@sequential_vmap
def _by_loops(planes: Sequence[Array]) -> Array:
    """Return the means [N, H, W, C] by sums along columns, then along rows; for CPUs.

    The loops keep XLA from recomputing the column sums for each row sum.
    """
    height, width, channels = planes[0].shape
    margin = RADIUS * channels
    shape = len(planes), height, width * channels + 2 * margin
    down = jnp.zeros(shape, planes[0].dtype)
    for place, plane in enumerate(planes):
        down = _add_column_sums(down, place, plane.reshape(height, -1), margin)
    return _row_sums(down, channels).reshape(-1, height, width, channels)


def _add_column_sums(down: Array, place: int, plane: Array, margin: int) -> Array:
    """Write the column sums of a plane [H, W · C] into planes with margins."""
    height, width = plane.shape
    size, parts = _segments(width)

    def turn(i, down):
        row = i // parts
        left = jnp.minimum(i % parts * size, width - size)
        total = jnp.zeros((1, size), plane.dtype)
        for offset, weight in enumerate(_weights(), -RADIUS):
            # Beyond the border: the border row with weight 0.
            at = jnp.clip(row + offset, 0, height - 1)
            weight = jnp.where(at == row + offset, weight, 0).astype(plane.dtype)
            total += weight * part_at(plane, (at, left), (1, size))
        return with_part(down, total[None], (jnp.int32(place), row, margin + left))

    return fori_loop(0, height * parts, turn, down)


def _row_sums(down: Array, step: int) -> Array:
    """Return the row sums [N, H, W · C] over neighbours at distance ``step`` = C."""
    count, height, width = down.shape
    width -= 2 * RADIUS * step
    size, parts = _segments(width)

    def turn(i, out):
        row, left = i // parts, jnp.minimum(i % parts * size, width - size)
        start = row // height, row % height, left
        segment = part_at(down, start, (1, 1, size + 2 * RADIUS * step))
        total = jnp.zeros((1, 1, size), down.dtype)
        for place, weight in enumerate(_weights()):
            total += weight * segment[..., place * step : place * step + size]
        return with_part(out, total, start)

    out = jnp.zeros((count, height, width), down.dtype)
    return fori_loop(0, count * height * parts, turn, out)


def _segments(width: int) -> tuple[int, int]:
    """Return length and number of the segments of a row; the last may overlap."""
    size = min(width, _SEGMENT)
    return size, -(-width // size)


def _by_products(planes: Sequence[Array]) -> Array:
    """Return the means [N, H, W, C] by banded matrix products; for accelerators."""
    stack = jnp.stack(list(planes))
    count, height, width, channels = stack.shape
    # The weights of a block with its margins.
    shape = _BLOCK, _BLOCK + 2 * RADIUS
    band = sum(
        weight * np.eye(*shape, place) for place, weight in enumerate(_weights())
    )
    window = jnp.asarray(band, stack.dtype)
    product = partial(jnp.einsum, precision=lax.Precision.HIGHEST)
    stack = jnp.moveaxis(stack, -1, 1).reshape(-1, height, width)
    stack = product("rk,nbkw->nbrw", window, _blocks(stack, 1))
    stack = stack.reshape(len(stack), -1, width)[:, :height]
    stack = product("nhbk,rk->nhbr", _blocks(stack, 2), window)
    stack = stack.reshape(count, channels, height, -1)[..., :width]
    return jnp.moveaxis(stack, 1, -1)


def _blocks(planes: Array, axis: int) -> Array:
    """Split ``axis`` into blocks with margins: [..., blocks, size, ...]."""
    length, shape = planes.shape[axis], planes.shape
    count = -(-length // _BLOCK)

    def pad(array: Array, before: int, after: int) -> Array:
        padding = [(0, 0)] * array.ndim
        padding[axis] = (before, after)
        return jnp.pad(array, padding)

    blocks = pad(planes, 0, count * _BLOCK - length)
    blocks = blocks.reshape(*shape[:axis], count, _BLOCK, *shape[axis + 1 :])
    ends = lax.slice_in_dim(blocks, _BLOCK - RADIUS, _BLOCK, axis=axis + 1)
    before = lax.slice_in_dim(ends, 0, count - 1, axis=axis)
    starts = lax.slice_in_dim(blocks, 0, RADIUS, axis=axis + 1)
    after = lax.slice_in_dim(starts, 1, count, axis=axis)
    return jnp.concatenate([pad(before, 1, 0), blocks, pad(after, 0, 1)], axis + 1)
