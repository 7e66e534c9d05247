"""The Gaussian window of the structural similarity (Wang et al. 2004): weighted means
around every pixel, with zeros beyond the border.

A linear map that is its own transpose, so derivatives go through it as the values do.

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
from gsjax.runtime.loops import each, part_at, with_part

Array = jax.Array

RADIUS, _SIGMA = 5, 1.5
# Pixels taken at a time by a product with a banded matrix.
_BLOCK = 32
# Numbers of a row taken at a time by the loops, few enough for one kernel of each.
_STRETCH = 1024


def window_means(planes: Sequence[Array]) -> list[Array]:
    """Means of planes [H, W, C], all of one shape and type, under the window at each
    pixel and channel, alike."""
    by = _by_loops if on_cpu() else _by_products
    return custom_transpose(
        lambda *planes: list(by(planes)),
        lambda *cotangents: window_means(cotangents),
        (),
        planes,
        planes,
    )


def _weights() -> list[float]:
    """[2 · RADIUS + 1] of the pixels around one, in a line."""
    offset = np.arange(-RADIUS, RADIUS + 1)
    weight = np.exp(-0.5 * np.square(offset / _SIGMA))
    return (weight / weight.sum()).tolist()


@jax.jit  # by itself: where it is called outside of one, it is compiled once
@sequential_vmap
def _by_loops(planes: Sequence[Array]) -> Array:
    """[N, H, W, C], for CPUs: sums down the picture, then sums of those across.

    In one expression XLA would make the sums down anew for every one across. Where it
    makes no kernels of the loops (`gsjax.runtime.loops`), they take as long as the products.
    """
    height, width, channels = planes[0].shape
    margin = RADIUS * channels
    shape = len(planes), height, width * channels + 2 * margin
    down = jnp.zeros(shape, planes[0].dtype)
    for place, plane in enumerate(planes):
        down = _with_sums_down(down, place, plane.reshape(height, -1), margin)
    return _sums_across(down, channels).reshape(-1, height, width, channels)


def _with_sums_down(down: Array, place: int, plane: Array, margin: int) -> Array:
    """``down`` [N, H, margin + W · C + margin] with those of a plane [H, W · C], at
    ``place`` and between the margins."""
    height, width = plane.shape
    size, parts = _stretches(width)

    def turn(i, down):
        row = i // parts
        left = jnp.minimum(i % parts * size, width - size)
        total = jnp.zeros((1, size), plane.dtype)
        for offset, weight in enumerate(_weights(), -RADIUS):
            # A row beyond the border is 0 times that at it, which is in reach as well.
            at = jnp.clip(row + offset, 0, height - 1)
            weight = jnp.where(at == row + offset, weight, 0).astype(plane.dtype)
            total += weight * part_at(plane, (at, left), (1, size))
        return with_part(down, total[None], (jnp.int32(place), row, margin + left))

    return each(0, height * parts, turn, down)


def _sums_across(down: Array, step: int) -> Array:
    """[N, H, W · C] of neighbours ``step`` = C apart; ``down`` has margins for them."""
    count, height, width = down.shape
    width -= 2 * RADIUS * step
    size, parts = _stretches(width)

    def turn(i, out):
        row, left = i // parts, jnp.minimum(i % parts * size, width - size)
        start = row // height, row % height, left
        some = part_at(down, start, (1, 1, size + 2 * RADIUS * step))
        total = jnp.zeros((1, 1, size), down.dtype)
        for place, weight in enumerate(_weights()):
            total += weight * some[..., place * step : place * step + size]
        return with_part(out, total, start)

    out = jnp.zeros((count, height, width), down.dtype)
    return each(0, count * height * parts, turn, out)


def _stretches(width: int) -> tuple[int, int]:
    """Length of a part of a row, and how many a row has; the last may overlap."""
    size = min(width, _STRETCH)
    return size, -(-width // size)


def _by_products(planes: Sequence[Array]) -> Array:
    """[N, H, W, C], for accelerators: products with small banded matrices."""
    stack = jnp.stack(list(planes))
    count, height, width, channels = stack.shape
    window = jnp.asarray(_band(), stack.dtype)
    product = partial(jnp.einsum, precision=lax.Precision.HIGHEST)
    stack = jnp.moveaxis(stack, -1, 1).reshape(-1, height, width)
    stack = product("rk,nbkw->nbrw", window, _blocks(stack, 1))
    stack = stack.reshape(len(stack), -1, width)[:, :height]
    stack = product("nhbk,rk->nhbr", _blocks(stack, 2), window)
    stack = stack.reshape(count, channels, height, -1)[..., :width]
    return jnp.moveaxis(stack, 1, -1)


def _band() -> np.ndarray:
    """[block, block + 2 · RADIUS]: weights of the pixels of a block and around it."""
    band = np.zeros((_BLOCK, _BLOCK + 2 * RADIUS))
    for row in range(_BLOCK):
        band[row, row : row + 2 * RADIUS + 1] = _weights()
    return band


def _blocks(planes: Array, axis: int) -> Array:
    """``axis`` in blocks, each with what is around it: [..., blocks, size, ...]."""
    length, shape = planes.shape[axis], planes.shape
    count = -(-length // _BLOCK)
    blocks = _pad(planes, axis, 0, count * _BLOCK - length)
    blocks = blocks.reshape(*shape[:axis], count, _BLOCK, *shape[axis + 1 :])
    ends = lax.slice_in_dim(blocks, _BLOCK - RADIUS, _BLOCK, axis=axis + 1)
    before = lax.slice_in_dim(ends, 0, count - 1, axis=axis)
    starts = lax.slice_in_dim(blocks, 0, RADIUS, axis=axis + 1)
    after = lax.slice_in_dim(starts, 1, count, axis=axis)
    parts = [_pad(before, axis, 1, 0), blocks, _pad(after, axis, 0, 1)]
    return jnp.concatenate(parts, axis + 1)


def _pad(array: Array, axis: int, before: int, after: int) -> Array:
    """Zeros along one axis."""
    padding = [(0, 0)] * array.ndim
    padding[axis] = (before, after)
    return jnp.pad(array, padding)
