"""Reverse pass of fused compositing on CPUs, Gaussian by Gaussian: one compiled kernel.

It goes from the last block of a tile to the first. α and T of the Gaussians of a block
are recomputed from the transmittance stored before it. Then, from the last Gaussian to
the first, with T_k the transmittance that reaches a Gaussian, v_k = c_k · ∂L/∂C at a
pixel, and D_k the derivative of L by the transmittance behind it divided by that,

    ∂L/∂c_k = Σ α_k T_k ∂L/∂C over the pixels
    ∂L/∂α_k = T_k (v_k − D_k)
    D_{k−1} = D_k + α_k (v_k − D_k)

so that nothing is divided by 1 − α. `fused_moments` reduces q = α ∂L/∂α, and the
cotangents of depths, over the pixels to a few sums a Gaussian.

Axis legend: T tiles, P pixels of a tile, C channels, R ranks, L blocks of Gaussians.
"""

from functools import partial

import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.math.numerics import safe_divide
from gsjax.raster.compositing import fused
from gsjax.raster.compositing.blending import pass_through
from gsjax.raster.compositing.fused import (
    BLOCK,
    Residuals,
    block_capacity,
    composite_fused,
    image_at,
    number_at,
    reading_of,
)
from gsjax.raster.compositing.fused_moments import Reduction, reduction_of
from gsjax.raster.compositing.types import (
    Compositor,
    Images,
    ReversePass,
    Task,
    Tiles,
    form_of,
    listed_pairs,
    summed_channels,
)
from gsjax.raster.types import Array, Channels, RasterConfig, Splat
from gsjax.runtime.loops import part_at, with_part
from gsjax.runtime.setup import KERNEL_BYTES

TURN = 2  # Gaussians, as in `fused`; BLOCK is a multiple
_product = partial(jnp.matmul, precision=lax.Precision.HIGHEST)
# Upper limit of the arrays [P] that a turn touches, as in `fused`.
_ARRAYS, _PER_CHANNEL = 108, 7
# The same with a form, and bytes of a pixel beside them.
_ARRAYS_OF_FORM, _PER_CHANNEL_OF_FORM, _BYTES_OF_FORM = 80, 10, 480


def suits(task: Task) -> bool:
    """Return whether `backward` is one kernel here and gives all that is asked for."""
    channels = max(task.colors + 2, task.channels)  # depth, ones
    pixels = task.grid.tile**2
    touched = task.itemsize * pixels * (_ARRAYS + _PER_CHANNEL * channels)
    if form_of(task.config) is not None:
        arrays = _ARRAYS_OF_FORM + _PER_CHANNEL_OF_FORM * task.channels
        touched = pixels * (task.itemsize * arrays + _BYTES_OF_FORM)
    config = task.config
    given = not config.absgrad and "median_depth" not in config.outputs
    return given and touched <= KERNEL_BYTES and fused.suits(task)


def backward(
    tiles: Tiles,
    residuals: Residuals,
    cotangents: Images,
    task: Task,
    kinds: frozenset[str] = frozenset({"splats", "channels"}),
) -> tuple[Splat, Channels]:
    """Return ∂L/∂splat and ∂L/∂channels; see `ReversePass.backward`."""
    grid, config = task.grid, task.config
    read, reduction = reading_of(tiles, task), reduction_of(task)
    ranks, _ = read.rows.shape
    channels, pixels = cotangents["sums"].shape[1:]
    empty = jnp.zeros_like(read.ones)
    zero, width = jnp.int32(0), read.widths[0]

    def blended(on, values):
        return jnp.where(on, values, 0) if config.stop_rule == "before" else values

    def of_tile(tile, sums):
        start, end = number_at(read.start, tile), number_at(read.end, tile)
        first = number_at(residuals.first, tile)
        image = {name: image_at(all_, tile) for name, all_ in cotangents.items()}
        corner = number_at(read.left, tile), number_at(read.top, tile)
        at_tile = partial(reduction.at, corner, read.ones)

        def ahead(state):
            """Recompute α and T of the next Gaussians of a block."""
            at, base, carried, alphas, reached = state
            for _ in range(TURN):
                _, row = read.row(base + at, end)
                alpha = read.at(row[:width], tile, config).alpha
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
                weight = blended(on, carried * alpha)
                if "splats" in kinds:
                    gained = jnp.where(on, gained, 0)
                    worth = _product(row[width:], image["sums"])
                    worth, moments = at_tile(row[:width], worth, image)
                    slope = blended(on, worth - gained)
                    free = jnp.where(alpha < config.alpha_max, alpha, 0)
                    more.append(moments(free * carried * slope, weight))
                    gained = gained + alpha * slope
                if "channels" in kinds:
                    more.append(_product(image["sums"], weight))
                behind = carried
                more = jnp.concatenate(more)
                old = part_at(sums, (rank[0], zero), (1, len(more)))
                sums = with_part(sums, old + more, (rank[0], zero))
            return at, base, behind, gained, alphas, reached, image, sums

        def block(state):
            number, gained, alphas, reached, sums = state
            base = start + number * BLOCK
            carried = image_at(residuals.carried, (first + number)[0])
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

    moments = reduction.size(tiles.splat)
    columns = ("splats" in kinds) * moments + ("channels" in kinds) * channels
    sums = jnp.zeros((ranks, columns), read.rows.dtype)
    sums = lax.fori_loop(zero, jnp.int32(grid.tiles), of_tile, sums)[:-1].T
    return by_tables(tiles, sums, reduction, kinds, config)


def by_tables(
    tiles: Tiles,
    sums: Array,
    reduction: Reduction,
    kinds: frozenset[str],
    config: RasterConfig,
) -> tuple[Splat, Channels]:
    """Return the cotangents of splats and channels from sums over all tiles.

    Args:
      tiles: what was composited.
      sums: [M + C, R] moments of each splat and Σ α T ∂L/∂C of its channels; without
        those of a kind that is not in ``kinds``.
      reduction: of the splats.
      kinds: as of `ReversePass.backward`.
      config: static settings.
    """
    moments = reduction.size(tiles.splat)
    channels = sum(summed_channels(config, len(tiles.channels.colors)).values())
    if "splats" not in kinds:
        sums = jnp.pad(sums, ((moments, 0), (0, 0)))
    if "channels" not in kinds:
        sums = jnp.pad(sums, ((0, channels), (0, 0)))
    by_splat = reduction.cotangent(tiles.splat, sums[:moments])
    by_splat = by_splat._replace(key=tuple(map(jnp.zeros_like, tiles.splat.key)))
    return by_splat, _by_channels(tiles.channels, sums[moments:], config)


def _by_channels(channels: Channels, sums: Array, config: RasterConfig) -> Channels:
    """Return the cotangent of channels, from the sums [C, R] of Σ α T ∂L/∂C."""
    count = len(channels.colors)
    widths = summed_channels(config, count)
    splits = np.cumsum([*widths.values()])[:-1]
    parts = dict(zip(widths, jnp.split(sums, splits)))
    by_colors = parts.get("colors", jnp.zeros_like(channels.colors))
    by_depth = parts["depth"][0] if "depth" in parts else jnp.zeros_like(channels.depth)
    if "disparities" in parts:
        mean, square = parts["disparities"]
        there = channels.depth != 0
        disparity = safe_divide(jnp.ones_like(mean), channels.depth, there)
        by_depth -= (mean + 2 * disparity * square) * disparity * disparity
    return channels._replace(
        colors=by_colors, depth=by_depth, normals=parts.get("normals", channels.normals)
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
