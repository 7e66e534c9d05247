"""Penalties that let Gaussians without support in the images fade and shrink."""

import jax
import jax.numpy as jnp

from gsjax.cameras.camera import USUAL_EXTENT
from gsjax.gaussians import Gaussians
from gsjax.math.numerics import exp_log_scale


def mean_penalty(
    gaussians: Gaussians, opacity_weight: float, scale_weight: float, extent: float
) -> jax.Array:
    """Return the weighted mean opacity and mean scale of the active Gaussians.

    Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", 2024.

    Args:
      gaussians: N slots.
      opacity_weight, scale_weight: weights; scales are in fifths of ``extent``.
      extent: scene extent in world units.

    Returns:
      [] to add to the loss; 0 if no Gaussian is active.
    """
    params, active = gaussians.params, gaussians.active
    count = jnp.maximum(jnp.sum(active), 1)
    opacity = jax.nn.sigmoid(jnp.where(active, params.logit_opacities, 0))
    scales = exp_log_scale(jnp.where(active[:, None], params.log_scales, 0))
    mean_opacity = jnp.sum(jnp.where(active, opacity, 0)) / count
    mean_scale = jnp.sum(jnp.where(active[:, None], scales, 0)) / (3 * count)
    unit = extent / USUAL_EXTENT
    return opacity_weight * mean_opacity + scale_weight / unit * mean_scale
