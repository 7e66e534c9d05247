"""Front-to-back compositing of sorted tile lists, chunk by chunk.

    C = Σ_k c_k α_k T_k,   T_k = Π_{j<k} (1 − α_j)

Axis legend: S steps, G tiles of a step, K Gaussians of a chunk, P pixels of a tile,
C channels (colour, then depth where asked for, then ones, whose sum is alpha).

How it is laid out, and why (measured on two cores): the exponent Q = y1² + y2² has
y1, y2 linear in the pixel. Forward they are part of one elementwise kernel with α;
backward they are the transpose of a matrix product [P, 3] × [3, K], as is the sum over
colours both ways. What is left is the running product. Chunks are recomputed in the
backward pass instead of kept. A chunk behind pixels that have all stopped is skipped,
in both directions, by `lax.cond`.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.raster.bins import Grid, Schedule, Work, tile_origins
from gsjax.raster.counts import running_total
from gsjax.raster.types import Array, Projected, RasterConfig

_einsum = partial(jnp.einsum, precision=lax.Precision.HIGHEST)


def _running_product(alpha: Array) -> tuple[Array, Array]:
    """(Π over all K, Π over those before k [G, K, P]) of 1 − alpha [G, K, P]."""
    product, before = jnp.ones_like(alpha[:, :1]), []
    for part in _parts(alpha):
        before.append(product)
        product = product * (1 - part)
    return product[:, 0], lax.concatenate(before, 1)


def _running_sum(values: Array) -> tuple[Array, Array]:
    """(Σ over all K, Σ over those before k [G, K, P]) of values [G, K, P]."""
    total, before = jnp.zeros_like(values[:, :1]), []
    for part in _parts(values):
        before.append(total)
        total = total + part
    return total[:, 0], lax.concatenate(before, 1)


def _parts(values: Array) -> list[Array]:
    """[G, 1, P] for each k. By `lax.split`, whose transpose is one concatenation; that
    of K slices would be a sum of K padded arrays.
    """
    return list(lax.split(values, [1] * values.shape[1], axis=1))


@jax.custom_jvp
def transmittance(alpha: Array) -> tuple[Array, Array]:
    """As `_running_product`, for alpha < 1, with its derivative as a running *sum*.

    dT_k = −T_k Σ_{j<k} dα_j / (1 − α_j). The transpose of a sum costs half of what
    that of a product does; tested against plain differentiation. The division is
    safe because α is capped below 1.
    """
    return _running_product(alpha)


@transmittance.defjvp
def _transmittance_jvp(primals, tangents):
    (alpha,), (d_alpha,) = primals, tangents
    total, before = transmittance(alpha)
    summed, sums = _running_sum(d_alpha / (1 - alpha))
    return (total, before), (-total * summed, -before * sums)


@jax.custom_vjp
def _collect_absolute(y1, y2, factors, probe):
    """(y1, y2) unchanged; ``probe`` receives Σ over pixels of |∂L/∂mean|."""
    del factors, probe
    return y1, y2


def _collect_forward(y1, y2, factors, probe):
    return (y1, y2), (factors, probe)


def _collect_backward(residuals, cotangents):
    (inv_sx, slope, inv_sy), _ = residuals
    ct1, ct2 = cotangents
    wide = [f[..., None] for f in (inv_sx, slope, inv_sy)]
    by_u = -wide[0] * ct1 + wide[2] * wide[1] * ct2
    by_v = -wide[2] * ct2
    absolute = jnp.stack([jnp.sum(jnp.abs(g), -1) for g in (by_u, by_v)])
    zeros = tuple(jnp.zeros_like(f) for f in (inv_sx, slope, inv_sy))
    return ct1, ct2, zeros, absolute


_collect_absolute.defvjp(_collect_forward, _collect_backward)


@jax.custom_jvp
def _offsets(ellipse: tuple[Array, ...], pixels: np.ndarray) -> tuple[Array, Array]:
    """y1, y2 [G, K, P] of Gaussians at the pixels [3, P], x, y and 1.

    Args:
      ellipse: [G, K] each: inv_sx, inv_sy, slope, and the mean x, y relative to the
        tile's corner.
    """
    inv_sx, inv_sy, slope, x, y = (value[..., None] for value in ellipse)
    dx, dy = pixels[0] - x, pixels[1] - y
    return inv_sx * dx, inv_sy * (dy - slope * dx)


def _linear_forms(*ellipse: Array) -> tuple[Array, Array]:
    """[G, 3, K] each, whose products with the pixels are y1 and y2."""
    inv_sx, inv_sy, slope, x, y = ellipse
    return (
        jnp.stack([inv_sx, jnp.zeros_like(x), -inv_sx * x], -2),
        jnp.stack([-inv_sy * slope, inv_sy, -inv_sy * (y - slope * x)], -2),
    )


@_offsets.defjvp
def _offsets_jvp(primals, tangents):
    """By matrix products: their transposes sum over the pixels. Those do not vary."""
    ellipse, pixels = primals
    _, forms = jax.jvp(_linear_forms, ellipse, tangents[0])
    by1, by2 = (_einsum("fp,gfk->gkp", pixels, form) for form in forms)
    return _offsets(ellipse, pixels), (by1, by2)


def _alphas(chunk: dict[str, Array], pixels: np.ndarray, config: RasterConfig) -> Array:
    """α [G, K, P] of a chunk of Gaussians at the pixels [3, P], x, y and 1."""
    ellipse = tuple(chunk[name] for name in ("inv_sx", "inv_sy", "slope", "x", "y"))
    y1, y2 = _offsets(ellipse, pixels)
    if config.absgrad and "probe" in chunk:
        factors = (chunk["inv_sx"], chunk["slope"], chunk["inv_sy"])
        y1, y2 = _collect_absolute(y1, y2, factors, chunk["probe"])
    raw = chunk["opacity"][..., None] * jnp.exp(-0.5 * (y1 * y1 + y2 * y2))
    # At the tie, and above, the derivative is that of the cap: zero.
    capped = jnp.where(raw < config.alpha_cap, raw, config.alpha_cap)
    return jnp.where(capped >= config.alpha_cut, capped, 0)


def _composite_chunk(
    carried: Array, chunk: dict[str, Array], pixels: np.ndarray, config: RasterConfig
) -> tuple[Array, dict[str, Array]]:
    """Blend one chunk behind the transmittance ``carried`` [G, P].

    Returns:
      The transmittance behind the chunk *as if nothing stopped* (what has fallen to
      the limit never rises again, so it still tells who has stopped), and the sums
      to add: "sums" [G, C, P], "median" [G, P] where asked for.
    """
    alpha = _alphas(chunk, pixels, config)
    # A cap of 1 needs the rule that does not divide.
    product = transmittance if config.alpha_cap < 1 else _running_product
    total, before = product(alpha)
    reached = carried[:, None] * before
    if config.stop_rule == "before":
        blended = lax.stop_gradient(reached * (1 - alpha)) > config.stop
    else:
        blended = lax.stop_gradient(reached) > config.stop
    weight = jnp.where(blended, alpha * reached, 0)
    out = {"sums": _einsum("gkp,cgk->gcp", weight, chunk["channels"])}
    if "median_depth" in config.outputs:
        half = lax.stop_gradient(
            (reached > 0.5) & (reached * (1 - alpha) <= 0.5) & blended
        )
        out["median"] = jnp.sum(jnp.where(half, chunk["depth"][..., None], 0), axis=1)
    return carried * total, out


def _gather(
    projected: Projected, work: Work, tiles: Array, grid: Grid, device: Array, config
) -> dict[str, Array]:
    """Parameters of every chunk, [S, G, K] each, ahead of the loop.

    So that the transpose is one scatter-add and not one a step. Null ranks read
    zeros: opacity 0, and a position at their tile's corner.
    """

    def take(values):
        return values.at[work.ranks].get(mode="fill", fill_value=0)

    corner_x, corner_y = tile_origins(grid, tiles[work.block], device)
    real = work.ranks < projected.u.shape[0]
    dtype = projected.u.dtype

    def relative(values, corner):
        return jnp.where(real, take(values) - corner.astype(dtype)[..., None], 0)

    chunks = {
        "x": relative(projected.u, corner_x),
        "y": relative(projected.v, corner_y),
        "inv_sx": take(projected.inv_sx),
        "slope": take(projected.slope),
        "inv_sy": take(projected.inv_sy),
        "opacity": take(projected.opacity),
    }
    channels = [take(c) for c in projected.colors] if "rgb" in config.outputs else []
    if {"depth", "median_depth"} & set(config.outputs):
        depth = take(projected.depth)
        if "depth" in config.outputs:
            channels.append(depth)
        if "median_depth" in config.outputs:
            chunks["depth"] = depth
    channels.append(jnp.ones_like(chunks["opacity"]))
    chunks["channels"] = jnp.stack(channels, 1)
    if projected.probe is not None:
        chunks["probe"] = jnp.stack([take(p) for p in projected.probe], 1)
    return chunks


def composite(
    projected: Projected,
    work: Work,
    schedule: Schedule,
    grid: Grid,
    device: Array,
    config: RasterConfig,
) -> dict[str, Array]:
    """Images of one device's tiles, before the background.

    Returns:
      "sums" [T, C, P]: colour, depth where asked for, alpha; "median" [T, P] where
      asked for. T in the grid's order.
    """
    group = schedule.tiles.shape[1]
    dtype = projected.u.dtype
    pixels = _pixel_rows(grid.tile, dtype)
    count = pixels.shape[1]
    chunks = _gather(projected, work, schedule.tiles, grid, device, config)

    fresh = {"sums": jnp.zeros((group, chunks["channels"].shape[1], count), dtype)}
    if "median_depth" in config.outputs:
        fresh["median"] = jnp.zeros((group, count), dtype)

    # In the branch as well: what the backward pass recomputes there is compiled
    # together with what uses it, and nothing but the inputs crosses the `cond`.
    blend = jax.checkpoint(partial(_composite_chunk, pixels=pixels, config=config))

    def skip(carried, _):
        return carried, jax.tree.map(jnp.zeros_like, fresh)

    @jax.checkpoint
    def advance(go, carried, chunk):
        return lax.cond(go, blend, skip, carried, chunk)

    # Every step hands out what its block has summed so far, and the last one of the
    # block is picked afterwards. An image carried along and updated in place would
    # be copied at every step of the backward pass.
    def step(carry, inputs):
        carried, summed = carry
        first, live, chunk = inputs
        carried = jnp.where(first, 1, carried)
        go = live & jnp.any(lax.stop_gradient(carried) > config.stop)
        carried, added = advance(go, carried, chunk)
        summed = jax.tree.map(lambda s, a: jnp.where(first, a, s + a), summed, added)
        return (carried, summed), summed

    init = (jnp.ones((group, count), dtype), fresh)
    _, summed = lax.scan(step, init, (work.first, work.live, chunks))
    step_rows = _last_rows(schedule, grid, work.live.shape[0])
    return {name: _take_rows(value, step_rows) for name, value in summed.items()}


def _last_rows(schedule: Schedule, grid: Grid, steps: int) -> Array:
    """[T] where the sums of each tile are complete, as a row of [S · G]; past the end
    for a tile that nothing covers.
    """
    group = schedule.tiles.shape[1]
    last = running_total(schedule.levels) - 1
    last = jnp.where(schedule.levels > 0, last, steps)
    rows = last[:, None] * group + lax.iota(jnp.int32, group)
    none = jnp.zeros(grid.tiles, jnp.int32)
    return none.at[schedule.tiles].set(rows, mode="drop")


def _take_rows(values: Array, rows: Array) -> Array:
    """[T, …] of values [S, G, …]; zeros where there is no such row."""
    flat = values.reshape(-1, *values.shape[2:])
    return flat.at[rows].get(mode="fill", fill_value=0)


def _pixel_rows(tile: int, dtype) -> np.ndarray:
    """[3, P] rows x, y, 1: pixel centres relative to the tile's corner.

    A constant, each row contiguous: as part of the kernels it costs nothing.
    """
    centre = np.arange(tile) + 0.5
    y, x = np.meshgrid(centre, centre, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.ones(tile * tile)]).astype(dtype)
