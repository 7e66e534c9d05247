"""No density control: the slots stay as they are."""

import jax.numpy as jnp

from gsjax.densify.types import SlotEdit, Strategy
from gsjax.gaussians import num_active


def _plan(key, step, gaussians, stats):
    del key, step
    unchanged = SlotEdit(
        params=gaussians.params,
        active=gaussians.active,
        cleared=jnp.zeros_like(gaussians.active),
        opacities_reset=jnp.asarray(False),
        wanted=num_active(gaussians),
    )
    return unchanged, stats


FIXED = Strategy(
    init=lambda _: (),
    observe=lambda stats, _: stats,
    due=lambda step: step < 0,
    plan=_plan,
)
