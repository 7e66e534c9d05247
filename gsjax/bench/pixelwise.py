"""Error bounds of settings at single pixels, in float64.

The argument is that of `gsjax.planning.bounds`, with the α of every splat at the pixel
known: dense, so for a few pixels only.

Axis legend: N Gaussians, front to back, P pixels.
"""

import heapq
from typing import NamedTuple

import jax
import numpy as np
from scipy.special import expit

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians, with_sh_degree
from gsjax.raster.reference import (
    reference_colors,
    reference_project,
    reference_ray_depths,
)
from gsjax.raster.types import RasterConfig

# Largest rounding error relative to the largest colour, by the use of float64.
_ROUNDING = {False: 1e-4, True: 1e-9}
_SEEN = 1e-14


class Dense(NamedTuple):
    """All splats at some pixels: slots [N], α [N, P] without cutoffs, colours [N, 3].

    ``spread`` [P] is the colour range there, of the channel where it is largest;
    ``largest`` [P] the largest absolute colour, with the background; ``rgb`` [P, 3].
    """

    order: np.ndarray
    alpha: np.ndarray
    colors: np.ndarray
    spread: np.ndarray
    largest: np.ndarray
    rgb: np.ndarray


def composite_dense(
    gaussians: Gaussians, camera: Camera, background, pixels: np.ndarray
) -> Dense:
    """Composite all splats at ``pixels`` [P, 2] (column, row).

    Call it with float64 enabled, for a single camera, without antialiasing and with the
    default dilation.
    """
    projected = jax.jit(reference_project)(gaussians, camera)
    means2d, depth, cov2d, _, seen = (np.asarray(a) for a in projected)
    seen = seen & np.asarray(gaussians.active)
    order = np.flatnonzero(seen)[np.argsort(depth[seen], kind="stable")]
    colors = np.asarray(jax.jit(reference_colors)(gaussians, camera))[order]
    inverse = np.linalg.inv(cov2d[order])
    opacity = expit(np.asarray(gaussians.params.logit_opacities, np.float64)[order])
    alpha = np.empty((len(order), len(pixels)))
    for index, pixel in enumerate(np.asarray(pixels) + 0.5):
        offset = pixel - means2d[order]
        power = np.einsum("ni,nij,nj->n", offset, inverse, offset)
        alpha[:, index] = opacity * np.exp(-0.5 * power)
    behind = np.asarray(background, np.float64)
    there = (alpha > _SEEN)[..., None]
    low = np.where(there, colors[:, None], np.inf).min(0, initial=np.inf)
    high = np.where(there, colors[:, None], -np.inf).max(0, initial=-np.inf)
    low, high = np.minimum(low, behind), np.maximum(high, behind)
    weight, left = _weights(alpha)
    rgb = weight.T @ colors + left[:, None] * behind
    spread = (high - low).max(axis=1)
    largest = np.maximum(np.abs(low), np.abs(high)).max(axis=1)
    return Dense(order, alpha, colors, spread, largest, rgb)


def _weights(alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights α T [N, P] and the final transmittance [P]."""
    after = np.cumprod(1 - alpha, axis=0)
    before = np.concatenate([np.ones_like(after[:1]), after[:-1]])
    return alpha * before, np.prod(1 - alpha, axis=0)


def error_bound(
    found: Dense,
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig,
    degree: int | None = None,
    double: bool = True,
) -> np.ndarray:
    """Bound the error of a channel at the pixels, [P]: the sum over all settings.

    Args:
      found: result of `composite_dense` for ``gaussians`` and ``camera``.
      config: its cutoffs count, see `gsjax.planning.bounds`.
      degree: SH degree that is rendered; None for that of the scene.
      double: rendered in float64, whose rounding is less.
    """
    alpha, spread = found.alpha, found.spread
    capped = np.minimum(alpha, config.alpha_max)
    over = (alpha > config.alpha_max).any(axis=0)
    by_alpha_max = over * (1 - config.alpha_max) / config.alpha_max
    low = capped < config.alpha_min * (1 + 1e-3)
    by_alpha_min = -np.expm1(np.log1p(-np.where(low, capped, 0)).sum(axis=0))
    kept = np.where(low, 0, capped)
    _, left = _weights(kept)
    threshold = most = config.transmittance_min
    if config.stop_rule == "before":
        most = threshold / np.maximum(1 - kept.max(axis=0), 1e-16)
    by_stop = np.where(left <= threshold * (1 + 1e-3), np.minimum(most, 1), 0)
    total = spread * (by_alpha_max + by_alpha_min + by_stop)
    total = total + _ROUNDING[double] * found.largest
    if degree is None or degree >= gaussians.sh_degree:
        return total
    # Σ w_i |change of the colour| of the channel where it is largest.
    fewer = jax.jit(reference_colors)(with_sh_degree(gaussians, degree), camera)
    change = np.abs(np.asarray(fewer)[found.order] - found.colors)
    return total + (_weights(alpha)[0].T @ change).max(axis=1)


def ray_depths(
    found: Dense, gaussians: Gaussians, camera: Camera, pixels: np.ndarray
) -> np.ndarray:
    """Return the depths [N, P] along the rays of pixels [P, 2], in the order of Dense.

    For pinholes, with float64 enabled.
    """
    depths = jax.jit(reference_ray_depths)(gaussians, camera, np.asarray(pixels) + 0.5)
    return np.asarray(depths)[found.order]


def in_ray_order(found: Dense, keys: np.ndarray, background) -> np.ndarray:
    """Return the colours [P, 3] if each pixel sorts by ``keys`` [N, P]."""
    rgb = []
    for alpha, key in zip(found.alpha.T, keys.T):
        order = np.argsort(key, kind="stable")
        weight, left = _weights(alpha[order, None])
        rgb.append(weight.T @ found.colors[order] + left[:, None] * background)
    return np.concatenate(rgb)


def order_bound(
    found: Dense, keys: np.ndarray, config: RasterConfig, double: bool = True
) -> np.ndarray:
    """Bound the error of a channel by blending in the order of ``config``, [P].

    Exchanging two neighbours i and j of an order changes a channel by at most D α_i α_j
    (see `gsjax.planning.bounds` for D). So an order costs at most D Σ α_i α_j over the
    pairs that it has the wrong way round, or whose depths rounding may exchange.

    Args:
      found: result of `composite_dense`.
      keys: [N, P] from `ray_depths`.
      config: order, order_window and alpha_min count.
      double: rendered in float64.
    """
    close, sums = (1e-12 if double else 1e-5), []
    for alpha, key in zip(found.alpha.T, keys.T):
        seen = np.flatnonzero(alpha >= config.alpha_min * (1 - 1e-3))
        order = seen[_emitted(key[seen], config)]
        deeper = key[order][:, None] > key[order][None] * (1 - close)
        pairs = alpha[order][:, None] * alpha[order][None]
        sums.append(np.sum(np.triu(deeper * pairs, 1)))
    return found.spread * np.minimum(sums, 1)


def _emitted(keys: np.ndarray, config: RasterConfig) -> np.ndarray:
    """Return the order [N] in which a pixel blends splats of depths [N]."""
    if config.order == "pixel":
        return np.argsort(keys, kind="stable")
    window = config.order_window if config.order == "window" else 0
    waiting: list[tuple[float, int]] = []
    out = []
    for number, key in enumerate(keys):
        heapq.heappush(waiting, (key, number))
        if len(waiting) > window:
            out.append(heapq.heappop(waiting)[1])
    out += [heapq.heappop(waiting)[1] for _ in range(len(waiting))]
    return np.asarray(out, int)
