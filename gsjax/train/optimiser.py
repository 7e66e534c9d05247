"""Adam on the parameters of Gaussians, a rate for each kind of number.

The moments are pytrees like the parameters, slot by slot, so that an edit of the
slots is the same edit of the moments.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from gsjax.gaussians import GaussianParams

Array = jax.Array
_ADAM = optax.scale_by_adam(b1=0.9, b2=0.999, eps=1e-15)


class Rates(NamedTuple):
    """Learning rates; the defaults are those of Kerbl et al. 2023.

    Attributes:
      means: at the first and the last step, log-linear between, both above 0 or
        equal; times the extent of the scene.
      log_scales, quats, logit_opacities: of each number.
      sh_dc, sh_rest: of degree 0, and of all above.
      cooling: share of all but the means' that is left at the last step: constant at
        first, log-linear from there; 1 is constant throughout.
      cooling_from: share of the run after which they fall, 0 to below 1.
    """

    means: tuple[float, float] = (1.6e-4, 1.6e-6)
    log_scales: float = 5e-3
    quats: float = 1e-3
    logit_opacities: float = 0.05
    sh_dc: float = 2.5e-3
    sh_rest: float = 1.25e-4
    cooling: float = 1.0
    cooling_from: float = 0.6

    def times(self, factor: float) -> "Rates":
        """All rates, multiplied; the cooling as it was."""
        first, last = self.means
        others = [name for name in self._fields[1:] if "cooling" not in name]
        return self._replace(
            means=(factor * first, factor * last),
            **{name: factor * getattr(self, name) for name in others},
        )


def means_rate(rates: Rates, fraction: Array, extent: float | Array) -> Array:
    """Rate of the means at ``fraction`` (0 to 1) of the run."""
    first, last = rates.means
    fraction = jnp.clip(fraction, 0, 1)
    if first == last:  # (0, 0) holds the means where they are
        return extent * first * jnp.ones_like(fraction)
    return extent * first * (last / first) ** fraction


def cooled(rates: Rates, fraction: Array) -> Array:
    """Share of the rates but the means' that is left at ``fraction`` of the run."""
    late = (jnp.clip(fraction, 0, 1) - rates.cooling_from) / (1 - rates.cooling_from)
    return rates.cooling ** jnp.maximum(late, 0)


def init_moments(params: GaussianParams) -> optax.ScaleByAdamState:
    """Zero moments."""
    return _ADAM.init(params)  # pyright: ignore


def adam_step(
    params: GaussianParams,
    grads: GaussianParams,
    moments: optax.ScaleByAdamState,
    rates: Rates,
    fraction: Array,
    extent: float | Array,
) -> tuple[GaussianParams, optax.ScaleByAdamState]:
    """One step of Adam (Kingma & Ba 2015; β 0.9 and 0.999, ε 1e-15).

    Args:
      params, grads: as `Gaussians.params`.
      moments: of the steps before; see `init_moments`.
      rates: see `Rates`.
      fraction: how far the run has come, 0 to 1.
      extent: of the scene, in its units.
    """
    updates, moments = _ADAM.update(grads, moments)  # pyright: ignore
    bases = params.sh.shape[-2]
    by_band = jnp.where(jnp.arange(bases) == 0, rates.sh_dc, rates.sh_rest)
    share = cooled(rates, fraction)
    rate = GaussianParams(
        **{
            "means": means_rate(rates, fraction, extent),
            "quats": share * rates.quats,
            "log_scales": share * rates.log_scales,
            "logit_opacities": share * rates.logit_opacities,
            "sh": share * by_band[:, None],
        }
    )
    moved = jax.tree.map(
        lambda p, u, r: p - (u * r).astype(p.dtype), params, updates, rate
    )
    return moved, moments  # pyright: ignore
