"""Adam with a learning rate for each label of parameters.

A label is the name of a field, such as "means" or "turns", or "model.NAME" for what a
scene model adds. Adam is the same for all labels, so one state holds all moments; its
leaves have the shapes of the parameters, and an edit of the slots edits them alike.
"""

from collections.abc import Callable, Hashable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from gsjax.errors import InputError

Array = jax.Array
# A constant learning rate, or a function of the completed fraction of the run.
Rate = float | Callable[[Array], Array]


class Rates(NamedTuple):
    """Learning rates of the Gaussians; the defaults are those of Kerbl et al. 2023.

    Attributes:
      means: at the first and the last step, log-linear in between, in scene extents.
        Both above 0, or equal.
      log_scales, quats, logit_opacities: of each number.
      sh_dc, sh_rest: of the coefficients of degree 0, and of all above.
      cooling: factor reached at the last step by all rates but that of the means; 1
        keeps them constant.
      cooling_from: fraction of the run, 0 to below 1, after which they fall
        log-linearly.
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
        """Return all rates multiplied by a factor, with the same cooling."""
        first, last = self.means
        others = [name for name in self._fields[1:] if "cooling" not in name]
        return self._replace(
            means=(factor * first, factor * last),
            **{name: factor * getattr(self, name) for name in others},
        )


def means_rate(rates: Rates, fraction: Array, extent: float | Array) -> Array:
    """Return the learning rate of the means at ``fraction`` (0 to 1) of the run."""
    first, last = rates.means
    fraction = jnp.clip(fraction, 0, 1)
    if first == last:  # includes 0, which keeps the means fixed
        return extent * first * jnp.ones_like(fraction)
    return extent * first * (last / first) ** fraction


def cooling_factor(rates: Rates, fraction: Array) -> Array:
    """Return the factor on the rates other than that of the means."""
    late = (jnp.clip(fraction, 0, 1) - rates.cooling_from) / (1 - rates.cooling_from)
    return rates.cooling ** jnp.maximum(late, 0)


def scale_by_rate(
    rate: Rate, shrinkage: float = 0.0
) -> optax.GradientTransformationExtraArgs:
    """Return a transformation that multiplies updates by the negative learning rate.

    Args:
      rate: the learning rate.
      shrinkage: pull towards 0, added to the update before. Adam's updates are about
        the mean of a gradient over its spread, so numbers stay at 0 unless that exceeds
        the shrinkage: L1 regularisation that is decoupled from the gradient, as weight
        decay is in Loshchilov and Hutter, "Decoupled Weight Decay Regularization",
        2019.
    """
    return _scale(
        lambda fraction, _: rate(fraction) if callable(rate) else rate, shrinkage
    )


def _scale(
    rate_of: Callable[[Array, Array], Array | float], shrinkage: float = 0.0
) -> optax.GradientTransformationExtraArgs:
    """Return `scale_by_rate` for a rate by fraction and update."""

    def update(updates, state, params=None, **extra):
        if shrinkage:
            updates = jax.tree.map(
                lambda u, p: u + shrinkage * jnp.sign(p), updates, params
            )
        rates = jax.tree.map(lambda u: rate_of(extra["fraction"], u), updates)
        scaled = jax.tree.map(lambda u, r: -(u * r).astype(u.dtype), updates, rates)
        return scaled, state

    return optax.GradientTransformationExtraArgs(optax.identity().init, update)


def gaussian_rates(
    rates: Rates, extent: float
) -> dict[Hashable, optax.GradientTransformation]:
    """Return the transformations of the Gaussians' parameters by label.

    The scene extent is in world units.
    """

    def cooled(name: str):
        rate = getattr(rates, name)
        return scale_by_rate(lambda fraction: cooling_factor(rates, fraction) * rate)

    def sh_rate(fraction: Array, update: Array) -> Array:
        first = jnp.arange(update.shape[-2]) == 0
        band = jnp.where(first, rates.sh_dc, rates.sh_rest)
        return cooling_factor(rates, fraction) * band[:, None]

    return {
        "means": scale_by_rate(lambda fraction: means_rate(rates, fraction, extent)),
        **{name: cooled(name) for name in ("quats", "log_scales", "logit_opacities")},
        "sh": _scale(sh_rate),
    }


def make_optimiser(
    table: Mapping[Hashable, optax.GradientTransformation],
) -> optax.GradientTransformationExtraArgs:
    """Return Adam (β 0.9 and 0.999, ε 1e-15) followed by a transformation per label.

    Kingma and Ba, "Adam: A Method for Stochastic Optimization", 2015. Its ``update``
    takes the completed fraction of the run, 0 to 1, as ``fraction=``.

    Args:
      table: transformation of the updates of each label, such as `scale_by_rate`.
        Usually `gaussian_rates`, extended by further labels.
    """

    def labels(params) -> Any:
        found = jax.tree_util.tree_map_with_path(lambda path, _: _label(path), params)
        unknown = {*jax.tree.leaves(found)} - {*table}
        if unknown:
            raise InputError(
                "optimiser: expected a learning rate for each label, got none for "
                f"{sorted(map(str, unknown))}; add one, such as Model(rates={{...}})"
            )
        return found

    adam = optax.scale_by_adam(b1=0.9, b2=0.999, eps=1e-15)
    by_label = optax.partition(table, labels)
    return optax.chain(adam, by_label)  # pyright: ignore


def _label(path) -> str:
    names = jax.tree_util.keystr(path, simple=True, separator="\n").split("\n")
    return ".".join(names[:2]) if names[0] == "model" else names[-1]
