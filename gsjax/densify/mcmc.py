"""Density control by Markov chain Monte Carlo.

Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", 2024.
Lengths are in fifths of the scene extent, so that a run does not depend on the unit.

Axis legend: N Gaussians (capacity).
"""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import USUAL_EXTENT
from gsjax.densify.penalties import mean_penalty
from gsjax.densify.schedule import EditSchedule
from gsjax.densify.slots import copy_into
from gsjax.densify.types import SlotEdit, Strategy
from gsjax.gaussians import Gaussians
from gsjax.math.numerics import exp_log_scale, logit
from gsjax.math.rotations import times_covariance
from gsjax.runtime.settings import convert_fields, require_ranges

Array = jax.Array

# Trapezoidal rule on [0, 5]. The integrand is entire, so it converges faster than any
# power of the step: relative error 3e-7 for counts up to 51 (tested).
_NODES, _REACH = 51, 5.0


@dataclass(frozen=True)
class McmcSettings:
    """Settings of MCMC density control; the defaults are those of Kheradmand et al.

    Dead Gaussians move onto live ones, which are drawn by opacity. The number of
    Gaussians grows to a limit in the same way. Noise on the means explores space, and
    penalties on opacity and scale free Gaussians that are not needed.

    Attributes:
      start, stop, every: edits follow the steps in (start, stop] that are multiples of
        ``every``; steps are counted from 1.
      max_gaussians: upper limit of the number of Gaussians.
      growth: factor on the number of Gaussians at each edit; above 1, each edit adds at
        least one.
      dead_opacity: Gaussians of at most this opacity are dead.
      noise: strength of the noise, as a multiple of the learning rate of the means.
      opacity_penalty, scale_penalty: weights in the loss of the mean opacity and the
        mean scale.
      initial_opacity: opacity of the initial Gaussians.
      initial_scale: scale of the initial Gaussians, as a multiple of the distance to
        their nearest neighbours.

    Raises:
      InputError: if a setting is out of range.
    """

    start: int = 500
    stop: int = 25_000
    every: int = 100
    max_gaussians: int = 1_000_000
    growth: float = 1.05
    dead_opacity: float = 0.005
    noise: float = 5e5
    opacity_penalty: float = 0.01
    scale_penalty: float = 0.01
    initial_opacity: float = 0.5
    initial_scale: float = 0.1

    def __post_init__(self):
        convert_fields(self)
        require_ranges(self, {
            **dict.fromkeys(("every", "max_gaussians", "growth"), "[1, inf)"),
            **dict.fromkeys(("start", "noise"), "[0, inf)"),
            **dict.fromkeys(("opacity_penalty", "scale_penalty"), "[0, inf)"),
            "dead_opacity": "(0, 1)",
        })  # fmt: skip

    @property
    def schedule(self) -> EditSchedule:
        """When edits are due, and the growth to expect."""
        return EditSchedule(
            self.start, self.stop, self.every, self.growth, self.max_gaussians
        )


def mcmc(settings: McmcSettings, extent: float = USUAL_EXTENT) -> Strategy:
    """Return MCMC density control for a scene extent in world units."""
    unit = extent / USUAL_EXTENT

    def plan(key: Array, step: Array, gaussians: Gaussians, stats: tuple):
        del step
        move_key, growth_key = jax.random.split(key)
        params, active = gaussians.params, gaussians.active
        opacity = jax.nn.sigmoid(params.logit_opacities)
        alive = active & (opacity > settings.dead_opacity)
        moved = spawn(move_key, gaussians, active & ~alive, alive, settings)
        count = jnp.sum(active, dtype=jnp.int32)
        grown = jnp.floor(settings.growth * count.astype(jnp.float32))
        # The factor alone rounds down to no growth for small counts.
        least = count + jnp.minimum(count, 1) if settings.growth > 1 else count
        target = jnp.clip(grown.astype(jnp.int32), least, settings.max_gaussians)
        free = ~active
        chosen = free & (jnp.cumsum(free, dtype=jnp.int32) <= target - count)
        after = Gaussians(params=moved.params, active=active)  # pyright: ignore
        born = spawn(growth_key, after, chosen, active, settings)
        cleared = moved.cleared | born.cleared
        source = _compose(moved.source, born.source)
        return born._replace(cleared=cleared, wanted=target, source=source), stats

    def penalty(gaussians: Gaussians) -> Array:
        weights = settings.opacity_penalty, settings.scale_penalty
        return mean_penalty(gaussians, *weights, extent)

    def perturb(key: Array, gaussians: Gaussians, rate: Array):
        params = gaussians.params
        opacity = jax.nn.sigmoid(params.logit_opacities)
        gate = jax.nn.sigmoid(-100 * (opacity - 0.005))
        noise = jax.random.normal(key, params.means.shape, params.means.dtype)
        shift = times_covariance(params.quats, exp_log_scale(params.log_scales), noise)
        # The rate may be float64 while the parameters are float32.
        strength = settings.noise / unit**2 * rate.astype(gate.dtype)
        moved = params.means + shift * (gate * strength)[:, None]
        good = gaussians.active[:, None] & jnp.isfinite(moved)
        means = jnp.where(good, moved, params.means)
        return params.replace(means=means)  # pyright: ignore

    return Strategy(
        init=lambda _: (),
        observe=lambda stats, _: stats,
        due=settings.schedule.due,
        plan=plan,
        penalty=penalty,
        perturb=perturb,
        schedule=settings.schedule,
    )


def _compose(first: Array | None, second: Array | None) -> Array:
    """Return the sources [N] of two copies in a row."""
    assert first is not None
    assert second is not None
    slots = first.shape[0]
    via = first.at[second].get(mode="fill", fill_value=slots)
    return jnp.where(second < slots, jnp.where(via < slots, via, second), first)


def spawn(
    key: Array, gaussians: Gaussians, slots: Array, alive: Array, settings: McmcSettings
) -> SlotEdit:
    """Fill slots with copies of live Gaussians, which are drawn by opacity.

    A Gaussian that is drawn n − 1 times shares its opacity and scale among n: see
    `shared_opacity` and `shared_scale`.

    Args:
      key, gaussians, settings: random key, N slots, settings of the strategy.
      slots, alive: [N] bool, the slots to fill, and the Gaussians to draw from.
    """
    params = gaussians.params
    size = slots.shape[0]
    opacity = jax.nn.sigmoid(params.logit_opacities)
    weights = jnp.where(alive, opacity, 0)
    cumulative = jnp.cumsum(weights)
    draws = jax.random.uniform(key, (size,), weights.dtype) * cumulative[-1]
    drawn = jnp.searchsorted(cumulative, draws, side="right").astype(jnp.int32)
    drawn = jnp.minimum(drawn, size - 1)
    possible = cumulative[-1] > 0
    source = jnp.where(slots & possible & alive[drawn], drawn, size)
    copies = jnp.zeros(size, jnp.int32).at[source].add(1, mode="drop")
    parents = copies > 0
    shared = shared_opacity(opacity, copies + 1)
    factor = shared_scale(opacity, shared, copies + 1)
    shared = jnp.clip(shared, settings.dead_opacity, None)
    logits = jnp.where(parents, logit(shared), params.logit_opacities)
    widened = parents[:, None], params.log_scales + jnp.log(factor)[:, None]
    edited = params.replace(  # pyright: ignore
        logit_opacities=logits, log_scales=jnp.where(*widened, params.log_scales)
    )
    born = source < size
    return SlotEdit(
        params=copy_into(edited, source, edited),
        active=gaussians.active | born,
        cleared=parents | born,
        opacities_reset=jnp.asarray(False),
        wanted=jnp.sum(gaussians.active | slots, dtype=jnp.int32),
        source=source,
    )


def shared_opacity(opacity: Array, count: Array) -> Array:
    """Return 1 − (1 − o)^(1/n), the opacity of each of n Gaussians in place of one."""
    below = jnp.minimum(opacity, 1 - jnp.finfo(opacity.dtype).eps)
    return -jnp.expm1(jnp.log1p(-below) / count)


def shared_scale(opacity: Array, shared: Array, count: Array) -> Array:
    """Return the factor on the scales of n Gaussians in place of one (Eq. 9).

    The denominator of the equation, Σᵢ Σₖ C(i−1, k) (−1)ᵏ o'^(k+1) / √(k+1), equals the
    integral of the coverage of n coincident Gaussians,

        1/√π ∫ 1 − (1 − o' exp(−t²))ⁿ dt,

    because 1/√(k+1) = 1/√π ∫ exp(−(k+1) t²) dt and the sums are then binomial and
    geometric. The integral avoids the cancellation of the alternating sum, whose terms
    reach 1e14 at n = 51. All arguments have shape [N]: o, o' and n.
    """
    step = _REACH / (_NODES - 1)

    def add(index, total):
        fade = jnp.exp(-jnp.square(index.astype(opacity.dtype) * step))
        cover = -jnp.expm1(count * jnp.log1p(-shared * fade))
        return total + jnp.where(index == 0, 0.5, 1.0) * cover

    total = lax.fori_loop(0, _NODES, add, jnp.zeros_like(opacity))
    area = 2 * step / math.sqrt(math.pi) * total
    good = (area > 0) & (opacity > 0)
    return jnp.where(good, opacity / jnp.where(good, area, 1), 1)
