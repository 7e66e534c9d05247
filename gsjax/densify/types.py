"""What every strategy of density control consists of.

Axis legend: N Gaussians (capacity), B cameras.

A strategy sees what a training step saw (`observe`), and now and then *plans* an edit
of the slots. The same edit is then applied to parameters, mask and the optimiser's
moments, so that they cannot disagree. All of it runs under jit.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from gsjax.gaussians import GaussianParams, Gaussians

Array = jax.Array


class Observation(NamedTuple):
    """What one training step saw, for each of its cameras.

    Attributes:
      gradient: [B, N, 2] of the loss by the projected mean, px; or, for strategies
        with ``absgrad``, the sum over pixels of its absolute values.
      radii: [B, N] px, 0 where the Gaussian is out of the view.
      width, height: of the image, px; [B] where the images differ.
    """

    gradient: Array
    radii: Array
    width: int | Array
    height: int | Array


class SlotEdit(NamedTuple):
    """New contents of all slots.

    Attributes:
      params: every slot as it will be.
      active: [N] which of them hold a Gaussian.
      cleared: [N] slots whose moments start again from zero.
      opacities_reset: [] bool, whether the moments of all opacities do.
      wanted: [] int32, how many Gaussians there would be with room for all.
    """

    params: GaussianParams
    active: Array
    cleared: Array
    opacities_reset: Array
    wanted: Array


class Densifier(NamedTuple):
    """A strategy, as pure functions.

    Attributes:
      init: gaussians → stats, a pytree.
      observe: (stats, Observation) → stats; called at every step.
      due: step → [] bool, whether to plan after that step.
      plan: (key, step, gaussians, stats) → (SlotEdit, stats).
      penalty: gaussians → [] to add to the loss, or None.
      perturb: (key, gaussians, rate of the means) → parameters, or None; called at
        every step.
      absgrad: whether `Observation.gradient` is to be the absolute one.
    """

    init: Callable[[Gaussians], Any]
    observe: Callable[[Any, Observation], Any]
    due: Callable[[Array], Array]
    plan: Callable[[Array, Array, Gaussians, Any], tuple[SlotEdit, Any]]
    penalty: Callable[[Gaussians], Array] | None = None
    perturb: Callable[[Array, Gaussians, Array], GaussianParams] | None = None
    absgrad: bool = False


def apply_edit(
    edit: SlotEdit, moments: optax.ScaleByAdamState
) -> tuple[Gaussians, optax.ScaleByAdamState]:
    """The Gaussians and the moments after an edit."""

    def clear(moment: GaussianParams) -> GaussianParams:
        def leaf(value):
            wide = edit.cleared.reshape(-1, *(1,) * (value.ndim - 1))
            return jnp.where(wide, 0, value)

        kept = jax.tree.map(leaf, moment)
        opacities = jnp.where(edit.opacities_reset, 0, kept.logit_opacities)
        return kept.replace(logit_opacities=opacities)

    gaussians = Gaussians(params=edit.params, active=edit.active)  # pyright: ignore
    mu, nu = clear(moments.mu), clear(moments.nu)  # pyright: ignore
    return gaussians, moments._replace(mu=mu, nu=nu)  # pyright: ignore
