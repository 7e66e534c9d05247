"""Error bounds of settings at single pixels, in float64.

The argument is that of `gsjax.planning.bounds`, with the α of every splat at the pixel
known: dense, so for a few pixels only.

Axis legend: N Gaussians, front to back, P pixels.
"""

from typing import NamedTuple

import jax
import numpy as np
from scipy.special import expit

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians, with_sh_degree
from gsjax.raster.reference import reference_colors, reference_project
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
