"""Gaussians that move by themselves: polynomials in time, and a lifetime.

After Li et al., "Spacetime Gaussian Feature Splatting", CVPR 2024: polynomials of mean
and rotation, and an opacity that fades around a time.

Axis legend: N Gaussians (capacity), D degree.
"""

from collections.abc import Sequence
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians
from gsjax.train.models import Model, ModelParams, Refresh, SceneParams, ViewInfo
from gsjax.train.motion.neighbours import neighbours
from gsjax.train.motion.settings import TrajectorySettings
from gsjax.train.motion.stillness import refreshed
from gsjax.train.optimiser import Rate, Rates, means_rate, scale_by_rate

Array = jax.Array

# Not 0, where a duration has no gradient; too little to change an opacity.
_LONGEST = 1e-4
_MOST_LOGIT = 60.0  # its sigmoid is 1


def chebyshev(time: Array, degree: int) -> list[Array]:
    """Return the Chebyshev polynomials of degree 1 to D at a time from 0 to 1."""
    x = 2 * time - 1
    found = [jnp.ones_like(x), x]
    while len(found) <= degree:
        found.append(2 * x * found[-1] - found[-2])
    return found[1 : degree + 1]


def series(coefficients: Sequence[Array], time: Array) -> Array:
    """Return Σ cₖ Tₖ(t) / k of coefficients cₖ [N, …], k from 1; 0 at rest."""
    total = jnp.zeros_like(coefficients[0])
    for k, term in enumerate(chebyshev(time, len(coefficients))):
        total += coefficients[k] * (term / (k + 1))
    return total


def faded(logits: Array, loss: Array) -> Array:
    """Return the logits [N] of opacities multiplied by e^−loss, loss ≥ 0."""
    weight = jnp.exp(-loss)
    # A loss that leaves the weight 1 changes no bit, but keeps its derivative.
    whole = lax.stop_gradient(weight) == 1
    loss = loss - lax.stop_gradient(jnp.where(whole, loss, 0))
    start = jnp.where(whole, logits, jnp.minimum(logits, _MOST_LOGIT))
    # logit(p w) = l + ln w − ln(1 + e^l (1 − w)).
    least = jnp.minimum(start, _MOST_LOGIT)
    return start - loss - jnp.log1p(jnp.exp(least) * (1 - weight))


def moved(params: SceneParams, time: Array) -> Gaussians:
    """Return the Gaussians at a time []; N slots.

    Differentiable in time and in all parameters.
    """
    gaussians, slots = params.gaussians, params.model.slots
    still = gaussians.params
    time = jnp.asarray(time, still.means.dtype)
    moving = params.model.buffers["moving"]
    changes: dict[str, Any] = {}

    def change(name: str) -> Array:
        return moving[:, None] * series(slots[name], time)

    if "paths" in slots:
        changes["means"] = still.means + change("paths")
    if "turns" in slots:
        changes["quats"] = still.quats + change("turns")
    if "shades" in slots:
        dc = still.sh[:, :1] + change("shades")[:, None]
        changes["sh"] = jnp.concatenate([dc, still.sh[:, 1:]], 1)
    if "centres" in slots:
        loss = jnp.square((time - slots["centres"]) * slots["fades"]) / 2
        changes["logit_opacities"] = faded(still.logit_opacities, moving * loss)
    return gaussians.replace(params=still.replace(**changes))  # pyright: ignore


def _init(settings: TrajectorySettings, gaussians: Gaussians) -> ModelParams:
    """Return parameters at rest."""
    means, count = gaussians.params.means, gaussians.capacity

    def zeros(*shape: int) -> Array:
        return jnp.zeros((count, *shape), means.dtype)

    degrees = {
        "paths": (settings.path_degree, 3),
        "turns": (settings.turn_degree, 4),
        "shades": (settings.shade_degree, 3),
    }
    # An array for each degree: sums of slices would take longer.
    slots: dict[str, Any] = {
        name: tuple(zeros(wide) for _ in range(degree))
        for name, (degree, wide) in degrees.items()
        if degree
    }
    if settings.fades:
        slots["centres"] = zeros() + 0.5
        slots["fades"] = zeros() + _LONGEST
    buffers = {"moving": zeros() + 1, "order": jnp.arange(count), "near": zeros()}
    return ModelParams(slots=slots, buffers=buffers)


def roughness(params: SceneParams, time: Array, extent: float) -> Array:
    """Return the mean difference [] of the motion of neighbours at a time.

    It is the sum over components of |dᵢ − dⱼ|, d being path (in scene extents), turn
    and shade, weighted by how near the pair is, see `neighbours`.
    """
    slots, buffers = params.model.slots, params.model.buffers
    units = {"paths": 1 / extent, "turns": 1.0, "shades": 1.0}
    time = jnp.asarray(time, params.gaussians.params.means.dtype)
    offsets = [unit * series(slots[n], time) for n, unit in units.items() if n in slots]
    if not offsets:
        return jnp.zeros((), params.gaussians.params.means.dtype)
    offset = jnp.concatenate(offsets, 1)
    placed = offset.at[buffers["order"]].get(mode="promise_in_bounds")
    gap = jnp.sum(jnp.abs(placed[1:] - placed[:-1]), 1)
    count = jnp.maximum(jnp.sum(params.gaussians.active), 1)
    return jnp.sum(buffers["near"][:-1] * gap) / count


@cache
def trajectory_model(
    settings: TrajectorySettings, rates: Rates, extent: float
) -> Model:
    """Return the model of Gaussians with trajectories.

    Its ``slots`` are D arrays each of ``paths`` [N, 3] in world units, ``turns`` [N, 4]
    and ``shades`` [N, 3], one for each degree, ``centres`` [N] in time, and ``fades``
    [N], the inverse standard deviations in time. Its buffer ``moving`` [N] is 0 for
    Gaussians kept still; ``order`` and ``near`` are those of `neighbours`.

    Args:
      settings: degrees, rates and weights.
      rates: learning rates of the Gaussians.
      extent: scene extent in world units.
    """

    def late(rate: Rate, shrinkage: float = settings.stillness):
        def of(fraction: Array) -> Array:
            value = rate(fraction) if callable(rate) else rate
            return jnp.where(fraction < settings.start, 0, value)

        return scale_by_rate(of, shrinkage)

    def path_rate(fraction: Array) -> Array:
        return settings.path_rate * means_rate(rates, fraction, extent)

    def penalty(params: SceneParams, view: ViewInfo) -> Array:
        return settings.rigidity * roughness(params, view.time, extent)

    def update(params: SceneParams, cameras: Camera, fraction: Array):
        gaussians = params.gaussians
        moving = refreshed(moved, settings.freeze, params, cameras, fraction)
        number = (fraction * 1e6).astype(jnp.int32)
        key = jax.random.fold_in(jax.random.key(0), number)
        order, near = neighbours(key, gaussians.params.means, gaussians.active)
        return {"moving": moving, "order": order, "near": near}

    return Model(
        init=partial(_init, settings),
        apply=lambda params, view: moved(params, view.time),
        rates={
            "paths": late(path_rate),
            "turns": late(settings.turn_rate),
            "shades": late(settings.shade_rate),
            "centres": late(settings.fade_rate, 0.0),
            "fades": late(settings.fade_rate),
        },
        refresh=Refresh(update),
        at=moved,
        penalty=penalty if settings.rigidity else None,
    )
