"""Penalties that free what a scene does not need."""

import jax
import jax.numpy as jnp

from gsjax.cameras.camera import USUAL_EXTENT
from gsjax.gaussians import Gaussians
from gsjax.math.numerics import exp_log_scale


def mean_penalty(
    gaussians: Gaussians, by_opacity: float, by_scale: float, extent: float
) -> jax.Array:
    """Weighed means of opacity and scale over the active (Kheradmand et al. 2024).

    The gradient of what is not needed is then theirs alone: it fades and shrinks.

    Args:
      gaussians: capacity N.
      by_opacity: weight of the mean opacity.
      by_scale: weight of the mean scale, in fifths of ``extent``.
      extent: of the scene, in its units.

    Returns:
      [] to add to the loss; 0 of none.
    """
    params, active = gaussians.params, gaussians.active
    count = jnp.maximum(jnp.sum(active), 1)
    opacity = jax.nn.sigmoid(jnp.where(active, params.logit_opacities, 0))
    scales = exp_log_scale(jnp.where(active[:, None], params.log_scales, 0))
    of_opacity = jnp.sum(jnp.where(active, opacity, 0)) / count
    of_scale = jnp.sum(jnp.where(active[:, None], scales, 0)) / (3 * count)
    unit = extent / USUAL_EXTENT
    return by_opacity * of_opacity + by_scale / unit * of_scale
