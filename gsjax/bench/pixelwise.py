"""What theory allows a setting to change at single pixels, in float64.

The same argument as in `gsjax.planning.bounds`, with the α of every splat at the pixel
at hand: dense, so for some pixels only.

Axis legend: N Gaussians, front to back, P pixels.
"""

from typing import NamedTuple

import jax
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians, with_sh_degree
from gsjax.raster.reference import reference_colors, reference_project
from gsjax.raster.types import RasterConfig

# What rounding may do, as a share of the largest colour.
ROUNDING = {"float32": 1e-4, "float64": 1e-9}
_SEEN = 1e-14


class Dense(NamedTuple):
    """All splats at some pixels.

    Attributes:
      order: [N] their slots.
      alpha: [N, P] without cut and cap.
      colors: [N, 3].
      spread: [P] range of the colours there, of the channel with the largest.
      largest: [P] of the colours there, the background's among them.
      picture: [P, 3] rgb.
    """

    order: np.ndarray
    alpha: np.ndarray
    colors: np.ndarray
    spread: np.ndarray
    largest: np.ndarray
    picture: np.ndarray


def dense(
    gaussians: Gaussians, camera: Camera, background, pixels: np.ndarray
) -> Dense:
    """Splats at ``pixels`` [P, 2] (column, row); call it with float64 on, for single
    cameras without antialiasing and with the dilation of 0.3."""
    projected = jax.jit(reference_project)(gaussians, camera)
    means2d, depth, cov2d, _, seen = (np.asarray(a) for a in projected)
    seen = seen & np.asarray(gaussians.active)
    order = np.flatnonzero(seen)[np.argsort(depth[seen], kind="stable")]
    colors = np.asarray(jax.jit(reference_colors)(gaussians, camera))[order]
    inverse = np.linalg.inv(cov2d[order])
    logits = np.asarray(gaussians.params.logit_opacities, np.float64)[order]
    opacity = 1 / (1 + np.exp(-logits))
    alpha = np.empty((len(order), len(pixels)))
    for index, pixel in enumerate(np.asarray(pixels) + 0.5):
        offset = pixel - means2d[order]
        power = np.einsum("ni,nij,nj->n", offset, inverse, offset)
        alpha[:, index] = opacity * np.exp(-0.5 * power)
    behind = np.asarray(background, np.float64)
    there = (alpha > _SEEN)[..., None]
    low = np.minimum(
        np.where(there, colors[:, None], np.inf).min(0, initial=np.inf), behind
    )
    high = np.maximum(
        np.where(there, colors[:, None], -np.inf).max(0, initial=-np.inf), behind
    )
    weight, left = _weights(alpha)
    picture = weight.T @ colors + left[:, None] * behind
    spread = (high - low).max(axis=1)
    largest = np.maximum(np.abs(low), np.abs(high)).max(axis=1)
    return Dense(order, alpha, colors, spread, largest, picture)


def _weights(alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """α T [N, P], and the T that is left [P]."""
    after = np.cumprod(1 - alpha, axis=0)
    before = np.concatenate([np.ones_like(after[:1]), after[:-1]])
    return alpha * before, np.prod(1 - alpha, axis=0)


def allowed(
    found: Dense,
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig,
    *,
    degree: int,
    dtype: str,
) -> np.ndarray:
    """[P] how far a channel may be off at the pixels, one knob after another.

    Cap, cut, stop and SH degree as in `gsjax.planning.bounds`; rounding by `ROUNDING`.
    """
    alpha, spread = found.alpha, found.spread
    capped = np.minimum(alpha, config.alpha_max)
    over = (alpha > config.alpha_max).any(axis=0)
    cap = over * (1 - config.alpha_max) / config.alpha_max
    low = capped < config.alpha_min * (1 + 1e-3)
    cut = -np.expm1(np.log1p(-np.where(low, capped, 0)).sum(axis=0))
    kept = np.where(low, 0, capped)
    _, left = _weights(kept)
    most = config.stop
    if config.stop_rule == "before":
        most = config.stop / np.maximum(1 - kept.max(axis=0), 1e-16)
    stop = np.where(left <= config.stop * (1 + 1e-3), np.minimum(most, 1), 0)
    total = spread * (cap + cut + stop) + ROUNDING[dtype] * found.largest
    if degree < gaussians.sh_degree:
        total = total + _band_change(found, gaussians, camera, degree)
    return total


def _band_change(
    found: Dense, gaussians: Gaussians, camera: Camera, degree: int
) -> np.ndarray:
    """Σ w_i |change of the colour|, the largest channel, [P]."""
    fewer = jax.jit(reference_colors)(with_sh_degree(gaussians, degree), camera)
    change = np.abs(np.asarray(fewer)[found.order] - found.colors)
    return (_weights(found.alpha)[0].T @ change).max(axis=1)
