"""What training minimises.

Axis legend: H W image, C channels.
"""

import jax
import jax.numpy as jnp

from gsjax.metrics import seen_only, ssim, weighted_mean

Array = jax.Array


def l1(image: Array, target: Array, weight: Array | None = None) -> Array:
    """Mean absolute difference, [].

    Args:
      image, target: [H, W, C].
      weight: [H, W], 0 where a pixel is to be left out; or None.
    """
    image, target = seen_only(image, target, weight)
    return weighted_mean(jnp.abs(image - target), weight)


def photometric(
    image: Array, target: Array, weight: Array | None = None, ssim_weight: float = 0.2
) -> Array:
    """(1 − λ) L1 + λ (1 − SSIM), Kerbl et al. 2023, Eq. 7 (their D-SSIM is this one).

    Args:
      image, target: [H, W, C] in [0, 1].
      weight: [H, W], 0 where a pixel is to be left out; or None.
      ssim_weight: λ; at 0 the SSIM is not in the program.
    """
    loss = (1 - ssim_weight) * l1(image, target, weight)
    if ssim_weight > 0:
        loss += ssim_weight * (1 - ssim(image, target, weight))
    return loss
