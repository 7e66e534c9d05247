"""3D Gaussian splatting as Markov chain Monte Carlo (Kheradmand et al. 2024).

Axis legend: N Gaussians (capacity).

Dead Gaussians are moved onto live ones, drawn by opacity, and the count grows to a
cap in the same way; noise explores, and two penalties free what is not needed. The
noise goes with the square of the scales and one penalty with them, in world units: here
in units of a fifth of the scene's extent, so that a run does not depend on the unit.
"""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import USUAL_EXTENT
from gsjax.densify.penalties import mean_penalty
from gsjax.densify.schedule import edits_between, grown, is_due
from gsjax.densify.slots import copy_into
from gsjax.densify.types import Densifier, SlotEdit
from gsjax.gaussians import Gaussians
from gsjax.math.numerics import exp_log_scale, logit
from gsjax.math.rotations import times_covariance
from gsjax.runtime.settings import require_ranges, settle

Array = jax.Array

# Trapezoid of ∫ over [0, 5]; the integrand is entire, so it converges faster than
# any power of the step: 3e-7 relative for n up to 51 (tested).
_NODES, _REACH = 51, 5.0


@dataclass(frozen=True)
class McmcSettings:
    """Steps are counted from 1; the defaults are those of the paper and its code.

    Attributes:
      start, stop, every: relocate and grow after every ``every``-th step in
        (start, stop].
      max_gaussians: the cap.
      growth: factor of the count at each edit; above 1, it grows by one at least.
      dead_opacity: at or below it a Gaussian is dead.
      noise: factor on the rate of the means.
      opacity_penalty, scale_penalty: weights of the means over all Gaussians.
      initial_opacity: of the Gaussians that a run starts from.
      initial_scale: of those, times the distance to the nearest neighbours.

    Raises:
      InputError: if a setting is out of its range.
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
        settle(self)
        checks = {
            "start": self.start >= 0,
            "every": self.every >= 1,
            "max_gaussians": self.max_gaussians >= 1,
            "growth": self.growth >= 1,
            "dead_opacity": 0 < self.dead_opacity < 1,
            "noise": self.noise >= 0,
            "opacity_penalty": self.opacity_penalty >= 0,
            "scale_penalty": self.scale_penalty >= 0,
        }
        require_ranges(self, checks)

    def likely(self, count: int, since: int, until: int) -> int:
        """How many ``count`` Gaussians will be by step ``until``, from ``since`` on."""
        edits = edits_between(since, until, self.start, self.stop, self.every)
        return grown(count, edits, self.growth, self.max_gaussians)


def mcmc(settings: McmcSettings, extent: float = USUAL_EXTENT) -> Densifier:
    """The strategy.

    Args:
      settings: see there.
      extent: of the scene, in its units; see `gsjax.init.gaussians.scene_extent`.
    """
    unit = extent / USUAL_EXTENT

    def plan(key: Array, step: Array, gaussians: Gaussians, stats: tuple):
        del step
        by_move, by_growth = jax.random.split(key)
        params, active = gaussians.params, gaussians.active
        opacity = jax.nn.sigmoid(params.logit_opacities)
        alive = active & (opacity > settings.dead_opacity)
        moved = spawn(by_move, gaussians, active & ~alive, alive, settings)
        count = jnp.sum(active, dtype=jnp.int32)
        grown = jnp.floor(settings.growth * count.astype(jnp.float32))
        # By one at least, where there is any: of few, a factor alone makes no more.
        least = count + jnp.minimum(count, 1) if settings.growth > 1 else count
        target = jnp.clip(grown.astype(jnp.int32), least, settings.max_gaussians)
        free = ~active
        chosen = free & (jnp.cumsum(free, dtype=jnp.int32) <= target - count)
        after = Gaussians(params=moved.params, active=active)  # pyright: ignore
        born = spawn(by_growth, after, chosen, active, settings)
        edit = born._replace(cleared=moved.cleared | born.cleared, wanted=target)
        return edit, stats

    def penalty(gaussians: Gaussians) -> Array:
        weights = settings.opacity_penalty, settings.scale_penalty
        return mean_penalty(gaussians, *weights, extent)

    def perturb(key: Array, gaussians: Gaussians, rate: Array):
        params = gaussians.params
        opacity = jax.nn.sigmoid(params.logit_opacities)
        gate = jax.nn.sigmoid(-100 * (opacity - 0.005))
        noise = jax.random.normal(key, params.means.shape, params.means.dtype)
        shift = times_covariance(params.quats, exp_log_scale(params.log_scales), noise)
        # The rate may be wider than the parameters, and must not widen them.
        strength = settings.noise / unit**2 * rate.astype(gate.dtype)
        shift = shift * (gate * strength)[:, None]
        moved = params.means + shift
        good = gaussians.active[:, None] & jnp.isfinite(moved)
        means = jnp.where(good, moved, params.means)
        return params.replace(means=means)  # pyright: ignore

    def due(step: Array) -> Array:
        return is_due(step, settings.start, settings.stop, settings.every)

    return Densifier(
        init=lambda _: (),
        observe=lambda stats, _: stats,
        due=due,
        plan=plan,
        penalty=penalty,
        perturb=perturb,
    )


def spawn(
    key: Array, gaussians: Gaussians, slots: Array, alive: Array, settings: McmcSettings
) -> SlotEdit:
    """Fill ``slots`` [N] with copies of ``alive`` ones [N], drawn by opacity.

    One that is drawn becomes n, itself included, which together look as it did: see
    `shared_opacity` and `shared_scale`.
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
    edited = params.replace(  # pyright: ignore
        logit_opacities=jnp.where(parents, logit(shared), params.logit_opacities),
        log_scales=jnp.where(
            parents[:, None], params.log_scales + jnp.log(factor)[:, None],
            params.log_scales,
        ),
    )  # fmt: skip
    born = source < size
    return SlotEdit(
        params=copy_into(edited, source, edited),
        active=gaussians.active | born,
        cleared=parents | born,
        opacities_reset=jnp.asarray(False),
        wanted=jnp.sum(gaussians.active | slots, dtype=jnp.int32),
    )


def shared_opacity(opacity: Array, count: Array) -> Array:
    """Opacity of each of n that are together as opaque: 1 − (1 − o)^(1/n)."""
    below = jnp.minimum(opacity, 1 - jnp.finfo(opacity.dtype).eps)
    return -jnp.expm1(jnp.log1p(-below) / count)


def shared_scale(opacity: Array, shared: Array, count: Array) -> Array:
    """Factor on the scales of ``count`` that take the place of one (Eq. 9).

    The equation's denominator, Σᵢ Σₖ C(i−1, k) (−1)ᵏ o'^(k+1) / √(k+1), is the
    integral of what n Gaussians in one place cover,

        1/√π ∫ 1 − (1 − o' exp(−t²))ⁿ dt,

    since 1/√(k+1) = 1/√π ∫ exp(−(k+1) t²) dt and the sums are then binomial and
    geometric. In this form nothing cancels: the alternating sum has terms of 1e14 at
    n = 51.
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
