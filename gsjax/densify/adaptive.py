"""Adaptive density control: clone, split, prune and reset opacities.

Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023,
Sec. 5.

Axis legend: N Gaussians (capacity), B cameras.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from gsjax.densify.penalties import mean_penalty
from gsjax.densify.schedule import EditSchedule
from gsjax.densify.slots import assign, copy_into, where_slots
from gsjax.densify.types import Observation, SlotEdit, Strategy
from gsjax.gaussians import Gaussians
from gsjax.math.numerics import exp_log_scale, logit
from gsjax.math.rotations import quaternion_to_matrix
from gsjax.runtime.settings import convert_fields, require_ranges

Array = jax.Array

# Expected growth per edit while a scene grows. Only the upper limit is known.
_EXPECTED_GROWTH = 1.3


@dataclass(frozen=True)
class AdaptiveSettings:
    """Settings of adaptive density control; the defaults are those of Kerbl et al.

    Gaussians whose mean screen-space gradient exceeds a threshold are cloned if small
    and split in two if large. Nearly transparent and too large ones are removed. If
    free slots run out, the largest gradients take precedence.

    Attributes:
      start, stop, every: edits follow the steps in (start, stop] that are multiples of
        ``every``; steps are counted from 1.
      threshold: densification threshold of the mean positional gradient, in normalised
        device coordinates (half image sizes). 8e-4 is common with ``absgrad``.
      absgrad: use sums over pixels of absolute gradients (Ye et al., "AbsGS", 2024).
      clone_below: largest scale that is cloned, as a fraction of the extent; larger
        Gaussians are split.
      shrink: divisor of the scales of a split Gaussian.
      revised_opacity: give clones and splits the opacity 1 − √(1 − o), so that the pair
        is as opaque as the original (Rota Bulò et al., 2024).
      prune_opacity: remove Gaussians of lower opacity.
      prune_scale: after the first reset, remove Gaussians of larger scale, as a
        fraction of the extent.
      prune_radius: after the first reset, remove Gaussians of larger projected radius,
        as a fraction of the longer image side; None keeps them.
      reset_every: interval, in steps, of opacity resets; 0 disables them. A reset
        coincides with the first edit of an interval and never with the last edit.
      reset_opacity: upper limit of the opacities after a reset.
      opacity_penalty, scale_penalty: weights in the loss of the mean opacity and the
        mean scale; see `gsjax.densify.penalties`. 0 in the paper.
      max_gaussians: upper limit of the number of Gaussians.
      initial_opacity: opacity of the initial Gaussians.
      initial_scale: scale of the initial Gaussians, as a multiple of the distance to
        their nearest neighbours.

    Raises:
      InputError: if a setting is out of range.
    """

    start: int = 500
    stop: int = 15_000
    every: int = 100
    threshold: float = 2e-4
    absgrad: bool = False
    clone_below: float = 0.01
    shrink: float = 1.6
    revised_opacity: bool = False
    prune_opacity: float = 0.005
    prune_scale: float = 0.1
    prune_radius: float | None = None
    reset_every: int = 3000
    reset_opacity: float = 0.01
    opacity_penalty: float = 0.0
    scale_penalty: float = 0.0
    max_gaussians: int = 5_000_000
    initial_opacity: float = 0.1
    initial_scale: float = 1.0

    def __post_init__(self):
        convert_fields(self)
        require_ranges(self, {
            **dict.fromkeys(("start", "reset_every"), "[0, inf)"),
            **dict.fromkeys(("opacity_penalty", "scale_penalty"), "[0, inf)"),
            **dict.fromkeys(("every", "max_gaussians"), "[1, inf)"),
            **dict.fromkeys(("threshold", "shrink"), "(0, inf)"),
            "prune_opacity": "[0, 1)",
            "reset_opacity": "(0, 1)",
        })  # fmt: skip

    @property
    def schedule(self) -> EditSchedule:
        """When edits are due, and the growth to expect."""
        return EditSchedule(
            self.start, self.stop, self.every, _EXPECTED_GROWTH, self.max_gaussians
        )


class AdaptiveStats(NamedTuple):
    """Statistics since the last edit.

    Attributes:
      gradient: [N] sum of the norms of the positional gradients.
      views: [N] number of views in which the Gaussian was visible.
      radius: [N] largest projected radius, as a fraction of the longer image side.
    """

    gradient: Array
    views: Array
    radius: Array


def adaptive(settings: AdaptiveSettings, extent: float) -> Strategy:
    """Return adaptive density control for a scene extent in world units."""

    def init(gaussians: Gaussians) -> AdaptiveStats:
        shape, dtype = gaussians.capacity, gaussians.params.means.dtype
        # Distinct arrays: a buffer can be donated only once.
        return AdaptiveStats(*(jnp.zeros(shape, dtype) for _ in range(3)))

    def observe(stats: AdaptiveStats, observation: Observation) -> AdaptiveStats:
        gradient, radii, *sides = observation
        size = jnp.stack([jnp.atleast_1d(side) for side in sides], -1)
        size = size[:, None]  # [B or 1, 1, 2]
        norm = jnp.linalg.norm(gradient * (size / 2).astype(gradient.dtype), axis=-1)
        visible = radii > 0
        share = jnp.max(radii / jnp.max(size, -1).astype(radii.dtype), 0)
        updated = AdaptiveStats(
            gradient=stats.gradient + jnp.sum(jnp.where(visible, norm, 0), 0),
            views=stats.views + jnp.sum(visible, 0),
            radius=jnp.maximum(stats.radius, share),
        )
        # Cameras may be float64 while the Gaussians are float32.
        return jax.tree.map(lambda new, old: new.astype(old.dtype), updated, stats)

    def plan(key: Array, step: Array, gaussians: Gaussians, stats: AdaptiveStats):
        edit = _densify(settings, extent, key, step, gaussians, stats)
        return _reset_opacities(settings, step, edit), init(gaussians)

    weights = settings.opacity_penalty, settings.scale_penalty

    def penalty(gaussians: Gaussians) -> Array:
        return mean_penalty(gaussians, *weights, extent)

    return Strategy(
        init=init,
        observe=observe,
        due=settings.schedule.due,
        plan=plan,
        penalty=penalty if any(weights) else None,
        absgrad=settings.absgrad,
        schedule=settings.schedule,
    )


def _densify(
    settings: AdaptiveSettings,
    extent: float,
    key: Array,
    step: Array,
    gaussians: Gaussians,
    stats: AdaptiveStats,
) -> SlotEdit:
    """Plan which Gaussians are cloned, split and removed."""
    params, active = gaussians.params, gaussians.active
    scales = exp_log_scale(params.log_scales)
    opacity = jax.nn.sigmoid(params.logit_opacities)
    largest = jnp.max(scales, -1)

    late = (settings.reset_every > 0) & (step > settings.reset_every)

    def too_big(shrink):
        big = largest > shrink * settings.prune_scale * extent
        if settings.prune_radius is not None:
            big |= stats.radius > shrink * settings.prune_radius
        return late & big

    mean = stats.gradient / jnp.maximum(stats.views, 1)
    hot = mean >= settings.threshold
    large = largest > settings.clone_below * extent
    # A Gaussian about to be split is judged by its size afterwards. The comparisons
    # are phrased so that NaN removes.
    kept = active & (opacity >= settings.prune_opacity)
    kept &= ~too_big(jnp.where(hot & large, settings.shrink, 1))
    hot &= kept
    remaining = jnp.sum(kept, dtype=jnp.int32)
    limit = jnp.maximum(settings.max_gaussians - remaining, 0)
    new = assign(hot, mean, ~kept, limit)
    split, cloned = new.chosen & large, new.chosen & ~large
    kept &= split | ~too_big(1)  # too large, and no slot left to split it

    noise = jax.random.normal(key, (2, *scales.shape), scales.dtype)
    rotations = quaternion_to_matrix(params.quats)
    shifts = jnp.einsum("nij,knj->kni", rotations, noise * scales, precision="highest")
    smaller = params.log_scales - jnp.log(settings.shrink)
    revised = params.logit_opacities
    if settings.revised_opacity:
        halves = logit(-jnp.expm1(0.5 * jnp.log1p(-opacity)))
        revised = jnp.where(split | cloned, halves, revised)

    def child(shift):
        wide = split[:, None]
        return params.replace(  # pyright: ignore
            means=jnp.where(wide, params.means + shift, params.means),
            log_scales=jnp.where(wide, smaller, params.log_scales),
            logit_opacities=revised,
        )

    in_place = where_slots(new.chosen, child(shifts[0]), params)
    born = new.source < active.shape[0]
    return SlotEdit(
        params=copy_into(in_place, new.source, child(shifts[1])),
        active=kept | born,
        cleared=born | split | ~kept,
        opacities_reset=jnp.asarray(False),
        wanted=remaining + jnp.sum(hot, dtype=jnp.int32),
        source=new.source,
    )


def _reset_opacities(
    settings: AdaptiveSettings, step: Array, edit: SlotEdit
) -> SlotEdit:
    """Lower the opacities if a reset is due."""
    if settings.reset_every <= 0:
        return edit
    # Edits may miss the multiples of reset_every: use the first edit after each.
    now = step % settings.reset_every < settings.every
    now &= step + settings.every <= settings.stop
    opacities = edit.params.logit_opacities
    low = logit(jnp.asarray(settings.reset_opacity, opacities.dtype))
    lowered = jnp.where(now, jnp.minimum(opacities, low), opacities)
    params = edit.params.replace(logit_opacities=lowered)  # pyright: ignore
    return edit._replace(params=params, opacities_reset=now)
