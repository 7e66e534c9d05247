"""Adaptive density control: clone, split, prune, reset (Kerbl et al. 2023, Sec. 5).

Axis legend: N Gaussians (capacity), B cameras.

Where the image wants to move a Gaussian, on average over the views that show it,
there are too few of them: a small one is cloned, a large one split in two. What is
nearly transparent goes, or too large, and of what is split its halves would be. If
there are fewer free slots than candidates, those with the largest gradient get them,
and the count wanted is reported, also beyond the most that there may be.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp

from gsjax.densify.penalties import mean_penalty
from gsjax.densify.schedule import edits_between, grown, is_due
from gsjax.densify.slots import assign, copy_into, where_slots
from gsjax.densify.types import Densifier, Observation, SlotEdit
from gsjax.gaussians import Gaussians
from gsjax.math.numerics import exp_log_scale, logit
from gsjax.math.rotations import quaternion_to_matrix
from gsjax.runtime.settings import require_ranges, settle

Array = jax.Array

# Of an edit while a scene grows; what is known before is only the most there may be.
_LIKELY_GROWTH = 1.3


@dataclass(frozen=True)
class AdaptiveSettings:
    """Steps are counted from 1; the defaults are those of the paper and its code.

    Attributes:
      start, stop, every: densify after every ``every``-th step in (start, stop].
      threshold: of the mean gradient by the projected mean, in units of half the
        image (normalised device coordinates); with ``absgrad`` 8e-4 is usual.
      absgrad: use the sum over pixels of absolute gradients (Ye et al. 2024).
      clone_below: largest scale, as a share of the extent, that is cloned; what is
        larger is split.
      shrink: what the scales of a split are divided by.
      revised_opacity: give clones and splits 1 − √(1 − o) each (Rota Bulò et al.
        2024), so that the pair is as opaque as the one was.
      prune_opacity: below it a Gaussian goes.
      prune_scale: above it, as a share of the extent, it goes, after the first reset.
      prune_radius: above it, as a share of the longer side of the image, it goes,
        after the first reset; None never.
      reset_every: bring all opacities down to ``reset_opacity``, so that what is not
        needed shows, at the first edit from every so many-th step on; 0 never. Not at
        the last edit, which no pruning follows.
      opacity_penalty, scale_penalty: weights of the means over all Gaussians, see
        `gsjax.densify.penalties`; 0 in the paper.
      max_gaussians: never more than that.
      initial_opacity: of the Gaussians that a run starts from.
      initial_scale: of those, times the distance to the nearest neighbours.

    Raises:
      InputError: if a setting is out of its range.
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
        settle(self)
        checks = {
            "start": self.start >= 0,
            "every": self.every >= 1,
            "threshold": self.threshold > 0,
            "shrink": self.shrink > 0,
            "prune_opacity": 0 <= self.prune_opacity < 1,
            "reset_every": self.reset_every >= 0,
            "reset_opacity": 0 < self.reset_opacity < 1,
            "opacity_penalty": self.opacity_penalty >= 0,
            "scale_penalty": self.scale_penalty >= 0,
            "max_gaussians": self.max_gaussians >= 1,
        }
        require_ranges(self, checks)

    def likely(self, count: int, since: int, until: int) -> int:
        """How many ``count`` Gaussians may be by step ``until``, from ``since`` on."""
        edits = edits_between(since, until, self.start, self.stop, self.every)
        return grown(count, edits, _LIKELY_GROWTH, self.max_gaussians)


class AdaptiveStats(NamedTuple):
    """Since the last edit.

    Attributes:
      gradient: [N] sum of the gradients' norms.
      views: [N] in how many views the Gaussian was seen.
      radius: [N] largest radius, as a share of the image's longer side.
    """

    gradient: Array
    views: Array
    radius: Array


def adaptive(settings: AdaptiveSettings, extent: float) -> Densifier:
    """The strategy, for `TrainConfig.densifier` and tests.

    Args:
      settings: see there.
      extent: of the scene, in its units; see `gsjax.init.gaussians.scene_extent`.
    """

    def init(gaussians: Gaussians) -> AdaptiveStats:
        def zeros():  # each its own: a step that is donated takes no array twice
            return jnp.zeros(gaussians.capacity, gaussians.params.means.dtype)

        return AdaptiveStats(zeros(), zeros(), zeros())

    def observe(stats: AdaptiveStats, seen: Observation) -> AdaptiveStats:
        sides = [jnp.atleast_1d(side) for side in (seen.width, seen.height)]
        size = jnp.stack(sides, -1)[:, None]  # [B, 1, 2]; of one if all are the same
        half = (size / 2).astype(seen.gradient.dtype)
        norm = jnp.linalg.norm(seen.gradient * half, axis=-1)
        visible = seen.radii > 0
        longer = jnp.max(size, -1).astype(seen.radii.dtype)
        share = jnp.max(seen.radii / longer, 0)
        seen_now = AdaptiveStats(
            gradient=stats.gradient + jnp.sum(jnp.where(visible, norm, 0), 0),
            views=stats.views + jnp.sum(visible, 0),
            radius=jnp.maximum(stats.radius, share),
        )
        # Cameras may be of a wider type, which is not to widen the statistics.
        return jax.tree.map(lambda new, old: new.astype(old.dtype), seen_now, stats)

    def due(step: Array) -> Array:
        return is_due(step, settings.start, settings.stop, settings.every)

    def plan(key: Array, step: Array, gaussians: Gaussians, stats: AdaptiveStats):
        dense = _densified(settings, extent, key, step, gaussians, stats)
        return _reset(settings, step, dense), init(gaussians)

    weights = settings.opacity_penalty, settings.scale_penalty

    def penalty(gaussians: Gaussians) -> Array:
        return mean_penalty(gaussians, *weights, extent)

    return Densifier(
        init=init,
        observe=observe,
        due=due,
        plan=plan,
        penalty=penalty if any(weights) else None,
        absgrad=settings.absgrad,
    )


def _densified(
    settings: AdaptiveSettings,
    extent: float,
    key: Array,
    step: Array,
    gaussians: Gaussians,
    stats: AdaptiveStats,
) -> SlotEdit:
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
    # As big as they will be. Phrased positively: what is not a number goes too.
    kept = active & (opacity >= settings.prune_opacity)
    kept &= ~too_big(jnp.where(hot & large, settings.shrink, 1))
    hot &= kept
    remaining = jnp.sum(kept, dtype=jnp.int32)
    room = jnp.maximum(settings.max_gaussians - remaining, 0)
    new = assign(hot, mean, ~kept, room)
    split, cloned = new.chosen & large, new.chosen & ~large
    kept &= split | ~too_big(1)  # for which there was no room

    noise = jax.random.normal(key, (2, *scales.shape), scales.dtype)
    rotations = quaternion_to_matrix(params.quats)
    shifts = jnp.einsum("nij,knj->kni", rotations, noise * scales, precision="highest")
    smaller = params.log_scales - jnp.log(settings.shrink)
    halves = logit(-jnp.expm1(0.5 * jnp.log1p(-opacity)))
    revised = params.logit_opacities
    if settings.revised_opacity:
        revised = jnp.where(split | cloned, halves, revised)

    def child(shift):
        wide = split[:, None]
        means = jnp.where(wide, params.means + shift, params.means)
        scales = jnp.where(wide, smaller, params.log_scales)
        changes = {"means": means, "log_scales": scales, "logit_opacities": revised}
        return params.replace(**changes)  # pyright: ignore

    in_place = where_slots(new.chosen, child(shifts[0]), params)
    born = new.source < active.shape[0]
    return SlotEdit(
        params=copy_into(in_place, new.source, child(shifts[1])),
        active=kept | born,
        cleared=born | split | ~kept,
        opacities_reset=jnp.asarray(False),
        wanted=remaining + jnp.sum(hot, dtype=jnp.int32),
    )


def _reset(settings: AdaptiveSettings, step: Array, edit: SlotEdit) -> SlotEdit:
    """With opacities brought down where it is time."""
    if settings.reset_every <= 0:
        return edit
    # Edits need not fall on its multiples: at the first one after.
    now = step % settings.reset_every < settings.every
    now &= step + settings.every <= settings.stop
    opacities = edit.params.logit_opacities
    low = logit(jnp.asarray(settings.reset_opacity, opacities.dtype))
    lowered = jnp.where(now, jnp.minimum(opacities, low), opacities)
    params = edit.params.replace(logit_opacities=lowered)  # pyright: ignore
    return edit._replace(params=params, opacities_reset=now)
