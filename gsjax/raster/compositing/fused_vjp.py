"""Reverse pass of fused compositing on CPUs, Gaussian by Gaussian: one compiled kernel.

It goes from the last block of a tile to the first. α and T of the Gaussians of a block
are recomputed from the transmittance stored before it. Then, from the last Gaussian to
the first, with T_k the transmittance that reaches a Gaussian, v_k = c_k · ∂L/∂C at a
pixel, and D_k the derivative of L by the transmittance behind it divided by that,

    ∂L/∂c_k = Σ α_k T_k ∂L/∂C over the pixels
    ∂L/∂α_k = T_k (v_k − D_k)
    D_{k−1} = D_k + α_k (v_k − D_k)

so that nothing is divided by 1 − α. α depends on its Gaussian through y1 and y2 alone
(see `Splat`), and both are linear over a tile. So the cotangents of a Gaussian follow
from six moments of q = α ∂L/∂α over the pixels: of 1, y1, y2, y1², y1 y2, y2².

Axis legend: T tiles, P pixels of a tile, C channels, R ranks, L blocks of Gaussians.
"""

from functools import partial

import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.raster.compositing import fused
from gsjax.raster.compositing.blending import pass_through
from gsjax.raster.compositing.fused import (
    BLOCK,
    Residuals,
    block_capacity,
    composite_fused,
    number_at,
    reading_of,
)
from gsjax.raster.compositing.types import (
    Compositor,
    ReversePass,
    Task,
    Tiles,
    listed_pairs,
)
from gsjax.raster.types import Array, Channels, RasterConfig, Splat
from gsjax.runtime.loops import part_at, with_part
from gsjax.runtime.setup import KERNEL_BYTES

TURN = 2  # Gaussians, as in `fused`; BLOCK is a multiple
_MOMENTS = 6
_product = partial(jnp.matmul, precision=lax.Precision.HIGHEST)
# Upper limit of the arrays [P] that a turn touches, as in `fused`.
_ARRAYS, _PER_CHANNEL = 108, 7


def suits(task: Task) -> bool:
    """Return whether `backward` is one kernel here and gives all that is asked for."""
    channels = task.colors + 2  # depth, ones
    pixels = task.grid.tile**2
    touched = task.itemsize * pixels * (_ARRAYS + _PER_CHANNEL * channels)
    config = task.config
    given = not config.absgrad and "median_depth" not in config.outputs
    return given and touched <= KERNEL_BYTES and fused.suits(task)


def backward(
    tiles: Tiles,
    residuals: Residuals,
    cotangent: Array,
    task: Task,
    kinds: frozenset[str] = frozenset({"splats", "channels"}),
) -> tuple[Splat, Channels]:
    """Return ∂L/∂splat and ∂L/∂channels; see `ReversePass.backward`."""
    grid, config = task.grid, task.config
    read = reading_of(tiles, task)
    ranks, _ = read.rows.shape
    channels, pixels = cotangent.shape[1:]
    empty = jnp.zeros_like(read.ones)
    zero = jnp.int32(0)
    monomials = _monomials(read.pixels - grid.tile / 2)

    def blended(on, values):
        return jnp.where(on, values, 0) if config.stop_rule == "before" else values

    def of_tile(tile, sums):
        start, end = number_at(read.start, tile), number_at(read.end, tile)
        first = number_at(residuals.first, tile)
        image = part_at(cotangent, (tile, zero, zero), (1, channels, pixels))[0]
        half = grid.tile / 2
        middle = number_at(read.left, tile) + half, number_at(read.top, tile) + half

        def ahead(state):
            """Recompute α and T of the next Gaussians of a block."""
            at, base, carried, alphas, reached = state
            for _ in range(TURN):
                _, row = read.row(base + at, end)
                alpha = read.alpha(row[:6], tile, config)
                alphas = with_part(alphas, alpha[None], (at[0], zero))
                reached = with_part(reached, carried[None], (at[0], zero))
                passed = pass_through(carried, alpha)
                carried = jnp.where(passed > config.transmittance_min, passed, 0)
                at = at + 1
            return at, base, carried, alphas, reached

        def back(state):
            """Go from the Gaussians behind to those in front."""
            at, base, behind, gained, alphas, reached, image, sums = state
            for _ in range(TURN):
                at = at - 1
                rank, row = read.row(base + at, end)
                alpha = part_at(alphas, (at[0], zero), (1, pixels))[0]
                carried = part_at(reached, (at[0], zero), (1, pixels))[0]
                on, more = behind > 0, []
                if "splats" in kinds:
                    gained = jnp.where(on, gained, 0)
                    slope = blended(on, _product(row[6:], image) - gained)
                    free = jnp.where(alpha < config.alpha_max, alpha, 0)
                    moments = _product(monomials, free * carried * slope)
                    more.append(_moments_about_mean(row, middle, moments))
                    gained = gained + alpha * slope
                if "channels" in kinds:
                    more.append(_product(image, blended(on, carried * alpha)))
                behind = carried
                more = jnp.concatenate(more)
                old = part_at(sums, (rank[0], zero), (1, len(more)))
                sums = with_part(sums, old + more, (rank[0], zero))
            return at, base, behind, gained, alphas, reached, image, sums

        def block(state):
            number, gained, alphas, reached, sums = state
            base = start + number * BLOCK
            carried = part_at(
                residuals.carried, ((first + number)[0], zero), (1, pixels)
            )[0]
            begun = jnp.zeros(1, jnp.int32), base, carried, alphas, reached
            at, _, behind, alphas, reached = lax.while_loop(
                lambda state: state[0][0] < BLOCK, ahead, begun
            )
            begun = at, base, behind, gained, alphas, reached, image, sums
            *_, gained, alphas, reached, _, sums = lax.while_loop(
                lambda state: state[0][0] > 0, back, begun
            )
            return number - 1, gained, alphas, reached, sums

        room = jnp.zeros((BLOCK, pixels), empty.dtype)
        begun = number_at(residuals.blocks, tile) - 1, empty, room, room, sums
        return lax.while_loop(lambda state: state[0][0] >= 0, block, begun)[-1]

    columns = ("splats" in kinds) * _MOMENTS + ("channels" in kinds) * channels
    sums = jnp.zeros((ranks, columns), read.rows.dtype)
    sums = lax.fori_loop(zero, jnp.int32(grid.tiles), of_tile, sums)[:-1].T
    if "splats" not in kinds:
        sums = jnp.pad(sums, ((_MOMENTS, 0), (0, 0)))
    if "channels" not in kinds:
        sums = jnp.pad(sums, ((0, channels), (0, 0)))
    return _cotangents(tiles.splat, tiles.channels, sums, config)


def _monomials(pixels: np.ndarray) -> np.ndarray:
    """Return 1, x, y, x², xy, y² [6, P] of pixels, from the middle of the tile."""
    x, y = pixels
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])


def _moments_about_mean(
    row: Array, middle: tuple[Array, Array], moments: Array
) -> Array:
    """Return the moments [6] in y1 and y2 of a Gaussian, from those of `_monomials`.

    y1 and y2 are a few standard deviations in the middle of any tile that the Gaussian
    touches, and change by no more within it. So little cancels, however far the mean.
    """
    u, v, inv_sx, slope, inv_sy, _ = lax.split(row[:6], [1] * 6)
    one, x, y, xx, xy, yy = lax.split(moments, [1] * _MOMENTS)
    dx, dy = middle[0] - u, middle[1] - v
    y1, y2 = inv_sx * dx, inv_sy * (dy - slope * dx)
    by_1, by_2 = inv_sx * x, inv_sy * (y - slope * x)
    by_11 = inv_sx * inv_sx * xx
    by_12 = inv_sx * inv_sy * (xy - slope * xx)
    by_22 = inv_sy * inv_sy * (yy - slope * (2 * xy - slope * xx))
    about = (
        one,
        y1 * one + by_1,
        y2 * one + by_2,
        y1 * (y1 * one + 2 * by_1) + by_11,
        y2 * (y1 * one + by_1) + y1 * by_2 + by_12,
        y2 * (y2 * one + 2 * by_2) + by_22,
    )
    return jnp.concatenate(about)


def _cotangents(
    splat: Splat, channels: Channels, sums: Array, config: RasterConfig
) -> tuple[Splat, Channels]:
    """Return the cotangents from moments and Σ α T ∂L/∂C of each channel [6 + C, R].

    They follow from d log α = d log opacity − y1 dy1 − y2 dy2.
    """
    one, y1, y2, y11, y12, y22 = sums[:_MOMENTS]
    summed = list(sums[_MOMENTS:-1])  # the last channel is ones
    inv_sx, slope, inv_sy, opacity = splat.shape

    def over(moment, number):
        # Gaussians that are not drawn may hold anything, and have no moments.
        return jnp.where(number != 0, moment / jnp.where(number != 0, number, 1), 0)

    by_colors = jnp.zeros_like(channels.colors)
    if "rgb" in config.outputs:
        count = len(channels.colors)
        by_colors, summed = jnp.stack(summed[:count]), summed[count:]
    by_shape = (
        -over(y11, inv_sx),
        over(inv_sy * y12, inv_sx),
        -over(y22, inv_sy),
        over(one, opacity),
    )
    return (
        Splat(inv_sx * y1 - inv_sy * slope * y2, inv_sy * y2, by_shape),
        channels._replace(
            colors=by_colors,
            depth=summed[0] if "depth" in config.outputs else jnp.zeros_like(one),
        ),
    )


def _memory(pairs: int, task: Task, gradients: bool) -> tuple[int, int]:
    pixels = task.grid.tile**2
    kept = block_capacity(pairs, task.grid) * pixels if gradients else 0
    return max(kept, 3 * 16 * task.config.chunk_size * pixels), kept


FUSED = Compositor(
    name="fused",
    suits=fused.suits,
    forward=lambda tiles, task: composite_fused(tiles, task)[0],
    differentiable=None,
    reverse=ReversePass(
        suits=suits,
        forward=partial(composite_fused, keep=True),
        backward=backward,
    ),
    capacity=listed_pairs,
    memory=_memory,
)
