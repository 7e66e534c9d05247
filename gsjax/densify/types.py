"""Protocol of density-control strategies, and the edit of slots that they plan.

Axis legend: N Gaussians (capacity), B cameras.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from gsjax.densify.schedule import EditSchedule
from gsjax.densify.slots import copy_into, slot_mask
from gsjax.gaussians import GaussianParams, Gaussians

Array = jax.Array
Tree = TypeVar("Tree")


class Observation(NamedTuple):
    """Screen-space quantities of one training step.

    Attributes:
      gradient: [B, N, 2] gradient of the loss with respect to the projected means, in
        1/px (the gradient of ``probe`` of `gsjax.render`); for strategies with
        ``absgrad`` the sum over pixels of its absolute values.
      radii: [B, N] px, `Render.radii`; 0 where the Gaussian is not in view.
      width, height: image size in px; [B] if the images differ.
    """

    gradient: Array
    radii: Array
    width: int | Array
    height: int | Array


class SlotEdit(NamedTuple):
    """New contents of all slots.

    Attributes:
      params: parameters of every slot after the edit.
      active: [N] bool, the slots that hold a Gaussian afterwards.
      cleared: [N] bool, slots whose optimiser state is reset to zero.
      opacities_reset: [] bool, whether the optimiser state of all opacities is reset.
      wanted: [] int32, number of Gaussians if the capacity had sufficed.
      source: [N] int32, the slot that each slot was copied from, N if it was not; None
        if none was. Other arrays with a slot axis follow it: see `copy_rows`.
    """

    params: GaussianParams
    active: Array
    cleared: Array
    opacities_reset: Array
    wanted: Array
    source: Array | None = None


class Strategy(NamedTuple):
    """A density-control strategy, as pure functions that are traced under jit.

    `gsjax.fit`, `gsjax.init_state` and `gsjax.make_train_step` take one as
    ``strategy=``. In a training loop of your own, call the functions around the update
    (``step`` is counted from 1)::

        stats = strategy.init(gaussians)
        ...                                  # gradients, with probe=zeros [N, 2]
        params = optax.apply_updates(gaussians.params, updates)
        gaussians = gaussians.replace(params=params)
        if strategy.perturb is not None:
            params = strategy.perturb(key, gaussians, rate)
            gaussians = gaussians.replace(params=params)
        stats = strategy.observe(stats, Observation(by_probe, radii, width, height))
        if strategy.due(step):
            edit, stats = strategy.plan(key, step, gaussians, stats)
            gaussians, optimiser_state = apply_edit(edit, optimiser_state)

    Attributes:
      init: ``gaussians → stats``, any pytree.
      observe: ``(stats, Observation) → stats``; called at every step.
      due: ``step → bool``, whether to edit after that step; elementwise.
      plan: ``(key, step, gaussians, stats) → (SlotEdit, stats)``.
      penalty: ``gaussians → []`` added to the loss, or None.
      perturb: ``(key, gaussians, learning rate of the means) → parameters``, called
        after each update, or None.
      absgrad: whether `Observation.gradient` holds absolute gradients.
      schedule: forecast by which `gsjax.fit` plans capacity; by default it is derived
        from ``due``.
    """

    init: Callable[[Gaussians], Any]
    observe: Callable[[Any, Observation], Any]
    due: Callable[[Array], Array]
    plan: Callable[[Array, Array, Gaussians, Any], tuple[SlotEdit, Any]]
    penalty: Callable[[Gaussians], Array] | None = None
    perturb: Callable[[Array, Gaussians, Array], GaussianParams] | None = None
    absgrad: bool = False
    schedule: EditSchedule | None = None


def apply_edit(edit: SlotEdit, optimiser_state: Tree) -> tuple[Gaussians, Tree]:
    """Return the Gaussians and the optimiser state after an edit.

    Args:
      edit: new contents of N slots.
      optimiser_state: any pytree, such as the state of an optax optimiser. In leaves
        whose first axis has length N, the rows of ``edit.cleared`` are set to zero; if
        ``edit.opacities_reset``, all rows of those named ``logit_opacities`` are. Other
        leaves are kept.
    """
    slots = edit.active.shape[0]

    def clear(path, value):
        if value.ndim == 0 or value.shape[0] != slots:
            return value
        value = jnp.where(slot_mask(edit.cleared, value), 0, value)
        if any(getattr(key, "name", None) == "logit_opacities" for key in path):
            value = jnp.where(edit.opacities_reset, 0, value)
        return value

    gaussians = Gaussians(params=edit.params, active=edit.active)  # pyright: ignore
    return gaussians, jax.tree_util.tree_map_with_path(clear, optimiser_state)


def copy_rows(edit: SlotEdit, tree: Tree) -> Tree:
    """Return further arrays [N, …] of the Gaussians after an edit.

    Copied Gaussians take the rows of the slot that they were copied from.
    """
    return tree if edit.source is None else copy_into(tree, edit.source, tree)
