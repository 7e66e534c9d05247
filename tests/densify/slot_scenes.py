"""Gaussians in some of the slots, and garbage in the others."""

import jax.numpy as jnp
import numpy as np

import gsjax


def scene_in(active, opacities=0.5, scales=0.1, *, spread=0.3, garbage=0.0):
    """Return Gaussians in the slots ``active``; ``spread`` is that of log scales."""
    rng, active = np.random.default_rng(0), np.asarray(active)
    slots = len(active)
    opacities = np.broadcast_to(opacities, slots)
    log_scales = np.log(np.broadcast_to(scales, (slots, 3)))
    fields = {
        "means": rng.normal(size=(slots, 3)),
        "quats": rng.normal(size=(slots, 4)),
        "log_scales": log_scales + spread * rng.normal(size=(slots, 3)),
        "logit_opacities": np.log(opacities) - np.log1p(-opacities),
        "sh": rng.normal(size=(slots, 4, 3)),
    }
    for value in fields.values():
        value[~active] = garbage
    return gsjax.make_gaussians(**fields).replace(active=jnp.asarray(active))
