"""The gradient of compositing on a CPU, Gaussian by Gaussian: one compiled kernel.

The transpose of `gsjax.raster.compositing.fused`, which keeps for it what each tile carries before
each look. From the last look of a tile to the first: α and T of its Gaussians are made
again, and then, from the last of them to the first, with T_k what reaches a Gaussian,
v_k = c_k · ∂L/∂C for a pixel, and D_k what L gains by the T behind it,

    ∂L/∂c_k = Σ α_k T_k ∂L/∂C over the pixels
    ∂L/∂α_k = T_k (v_k − D_k)
    D_{k−1} = D_k + α_k (v_k − D_k)

so that nothing is divided by 1 − α. As α depends on its Gaussian through y1 and y2
alone (see `Projected`), and both are linear over a tile, all that comes back to a
Gaussian are six moments of q = α ∂L/∂α over the pixels: of 1, y1, y2, y1², y1 y2, y2².
They are added up over its tiles, and turned into derivatives at the end.

Axis legend: T tiles, P pixels of a tile, C channels, R ranks, L looks.
"""

from functools import partial

import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.raster.compositing import fused
from gsjax.raster.compositing.blending import pass_through
from gsjax.raster.compositing.fused import LOOK, Residuals, number_at, reading_of
from gsjax.raster.lists.binning import Grid, Lists
from gsjax.raster.types import Array, Projected, RasterConfig
from gsjax.runtime.devices import KERNEL_BYTES
from gsjax.runtime.loops import part_at, with_part

TURN = 2  # Gaussians, as in `single`; LOOK is a multiple
_MOMENTS = 6
_product = partial(jnp.matmul, precision=lax.Precision.HIGHEST)
# What a turn touches at most; see `single`: arrays [P] without channels, and for each.
_ARRAYS, _OF_CHANNEL = 108, 7


def suits(colors: int, width: int, grid: Grid, config: RasterConfig) -> bool:
    """Whether `vjp` is one kernel here and gives all that is asked for;
    ``width`` is the bytes of a number."""
    channels = colors + 2  # depth, ones
    touched = width * grid.tile**2 * (_ARRAYS + _OF_CHANNEL * channels)
    given = not config.absgrad and "median_depth" not in config.outputs
    return given and touched <= KERNEL_BYTES and fused.suits(colors, width, grid)


def vjp(
    projected: Projected,
    lists: Lists,
    device: Array,
    kept: Residuals,
    cotangent: Array,
    grid: Grid,
    config: RasterConfig,
    by: frozenset[str] = frozenset({"splats", "channels"}),
) -> Projected:
    """∂L/∂projected, given ∂L/∂"sums" [T, C, P] of one device's tiles.

    No derivative can be taken of it backward. Of what ``by`` does not name, "splats"
    (their place, shape and opacity) or "channels" (colours and depth), it is 0.
    """
    read = reading_of(projected, lists, device, grid, config)
    ranks, _ = read.rows.shape
    channels, pixels = cotangent.shape[1:]
    empty = jnp.zeros_like(read.ones)
    zero = jnp.int32(0)
    monomials = _monomials(read.pixels - grid.tile / 2)

    def blended(on, values):
        return jnp.where(on, values, 0) if config.stop_rule == "before" else values

    def of_tile(tile, sums):
        start, end = number_at(read.start, tile), number_at(read.end, tile)
        first = number_at(kept.first, tile)
        image = part_at(cotangent, (tile, zero, zero), (1, channels, pixels))[0]
        half = grid.tile / 2
        middle = number_at(read.left, tile) + half, number_at(read.top, tile) + half

        def ahead(state):
            """α and T of the next Gaussians of a look."""
            at, base, carried, alphas, reached = state
            for _ in range(TURN):
                _, row = read.row(base + at, end)
                alpha = read.alpha(row[:6], tile, config)
                alphas = with_part(alphas, alpha[None], (at[0], zero))
                reached = with_part(reached, carried[None], (at[0], zero))
                passed = pass_through(carried, alpha)
                carried = jnp.where(passed > config.stop, passed, 0)
                at = at + 1
            return at, base, carried, alphas, reached

        def back(state):
            """From the Gaussians behind to those before them."""
            at, base, behind, gained, alphas, reached, image, sums = state
            for _ in range(TURN):
                at = at - 1
                rank, row = read.row(base + at, end)
                alpha = part_at(alphas, (at[0], zero), (1, pixels))[0]
                carried = part_at(reached, (at[0], zero), (1, pixels))[0]
                on, more = behind > 0, []
                if "splats" in by:
                    gained = jnp.where(on, gained, 0)
                    slope = blended(on, _product(row[6:], image) - gained)
                    free = jnp.where(alpha < config.alpha_max, alpha, 0)
                    moments = _product(monomials, free * carried * slope)
                    more.append(_about(row, middle, moments))
                    gained = gained + alpha * slope
                if "channels" in by:
                    more.append(_product(image, blended(on, carried * alpha)))
                behind = carried
                more = jnp.concatenate(more)
                old = part_at(sums, (rank[0], zero), (1, len(more)))
                sums = with_part(sums, old + more, (rank[0], zero))
            return at, base, behind, gained, alphas, reached, image, sums

        def look(state):
            number, gained, alphas, reached, sums = state
            base = start + number * LOOK
            carried = part_at(kept.carried, ((first + number)[0], zero), (1, pixels))[0]
            begun = jnp.zeros(1, jnp.int32), base, carried, alphas, reached
            at, _, behind, alphas, reached = lax.while_loop(
                lambda state: state[0][0] < LOOK, ahead, begun
            )
            begun = at, base, behind, gained, alphas, reached, image, sums
            *_, gained, alphas, reached, _, sums = lax.while_loop(
                lambda state: state[0][0] > 0, back, begun
            )
            return number - 1, gained, alphas, reached, sums

        room = jnp.zeros((LOOK, pixels), empty.dtype)
        begun = number_at(kept.looks, tile) - 1, empty, room, room, sums
        return lax.while_loop(lambda state: state[0][0] >= 0, look, begun)[-1]

    columns = ("splats" in by) * _MOMENTS + ("channels" in by) * channels
    sums = jnp.zeros((ranks, columns), read.rows.dtype)
    sums = lax.fori_loop(zero, jnp.int32(grid.tiles), of_tile, sums)[:-1].T
    if "splats" not in by:
        sums = jnp.pad(sums, ((_MOMENTS, 0), (0, 0)))
    if "channels" not in by:
        sums = jnp.pad(sums, ((0, channels), (0, 0)))
    return _derivatives(projected, sums, config)


def _monomials(pixels: np.ndarray) -> np.ndarray:
    """[6, P]: 1, x, y, x², xy, y² of pixels [2, P], from the middle of the tile."""
    x, y = pixels
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])


def _about(row: Array, middle: tuple[Array, Array], moments: Array) -> Array:
    """[6] moments in y1 and y2 of a Gaussian, given those of `_monomials`.

    y1 and y2 are a few standard deviations in the middle of any tile that the Gaussian
    touches, and what is added to them within the tile is no more: so little cancels,
    however far away its mean is.
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


def _derivatives(p: Projected, sums: Array, config: RasterConfig) -> Projected:
    """∂L/∂projected from moments and, of each channel, Σ α T ∂L/∂C; [6 + C, R].

    As d log α = d log opacity − y1 dy1 − y2 dy2.
    """
    one, y1, y2, y11, y12, y22 = sums[:_MOMENTS]
    channels = list(sums[_MOMENTS:-1])  # the last are ones
    nothing = jnp.zeros_like(one)

    def over(moment, number):
        # What is not drawn may be anything, and has no moments.
        return jnp.where(number != 0, moment / jnp.where(number != 0, number, 1), 0)

    colors = jnp.zeros_like(p.colors)
    if "rgb" in config.outputs:
        count = len(p.colors)
        colors, channels = jnp.stack(channels[:count]), channels[count:]
    return Projected(
        u=p.inv_sx * y1 - p.inv_sy * p.slope * y2,
        v=p.inv_sy * y2,
        depth=channels[0] if "depth" in config.outputs else nothing,
        inv_sx=-over(y11, p.inv_sx),
        slope=over(p.inv_sy * y12, p.inv_sx),
        inv_sy=-over(y22, p.inv_sy),
        var_y=nothing,
        det=nothing,
        opacity=over(one, p.opacity),
        reach=nothing,
        colors=colors,
        compensation=nothing,
        probe=None,
    )
