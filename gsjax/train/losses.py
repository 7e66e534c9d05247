"""Loss terms of training: the photometric loss, and the protocol of further terms.

Axis legend: B images, H W image, C channels.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.math.numerics import safe_divide
from gsjax.raster.types import Render
from gsjax.runtime.devices import map_over_devices
from gsjax.train import ssim_window
from gsjax.train.frames import Batch, targets
from gsjax.train.metrics import (
    mask_excluded,
    ssim_map,
    weighted_mean,
    weighted_sum,
)
from gsjax.train.models import SceneParams

Array = jax.Array


class LossTerm(NamedTuple):
    """A term of the training loss.

    Attributes:
      name: for messages.
      function: ``(Render, Batch, SceneParams) → []``. The render has a leading axis B;
        its ``rgb`` is over the background of the step, with the exposure corrections.
        See `gsjax.train.frames.targets` for the photographs to compare it with.
      weight: factor, or a function of the step (counted from 1).
      start: first step at which the term counts; before, it is not computed.
      outputs: outputs of the render that the function uses besides "rgb".
    """

    name: str
    function: Callable[[Render, Batch, SceneParams], Array]
    weight: float | Callable[[Array], Array] = 1.0
    start: int = 0
    outputs: tuple[str, ...] = ()


def evaluate_terms(
    terms: Sequence[LossTerm], inputs: tuple[Render, Batch, SceneParams], step: Array
) -> Array:
    """Return the weighted sum [] of loss terms at ``step`` (counted from 1)."""

    def value_of(term: LossTerm) -> Array:
        with jax.named_scope(term.name):
            value = term.function(*inputs)
        weight = term.weight(step) if callable(term.weight) else term.weight
        return value if isinstance(weight, float) and weight == 1 else weight * value

    def scheduled(term: LossTerm) -> Array:
        if term.start <= 1:
            return value_of(term)
        shape = jax.eval_shape(lambda: value_of(term))
        return lax.cond(
            step >= term.start,
            lambda: value_of(term),
            lambda: jnp.zeros(shape.shape, shape.dtype),
        )

    total = scheduled(terms[0])
    for term in terms[1:]:
        total = total + scheduled(term)
    return total


def photometric_term(ssim_weight: float = 0.2, devices: int = 1) -> LossTerm:
    """Return `photometric_batch` against the photographs as a loss term."""

    def function(render: Render, batch: Batch, params: SceneParams) -> Array:
        del params
        assert render.rgb is not None
        target, weight = targets(batch, render.rgb.dtype)
        loss = photometric_batch(render.rgb, target, weight, ssim_weight, devices)
        return jnp.mean(loss)

    return LossTerm("loss", function)


def photometric(
    image: Array, target: Array, weight: Array | None = None, ssim_weight: float = 0.2
) -> Array:
    """Return the loss (1 − λ) L1 + λ (1 − SSIM) of Kerbl et al. 2023, Eq. 7.

    Args:
      image, target: [H, W, C] in [0, 1].
      weight: [H, W], 0 for excluded pixels; or None.
      ssim_weight: λ; at 0 the loss is the mean |x − y|, without SSIM.

    Raises:
      InputError: if an image holds integers.
    """
    return weighted_mean(_pixel_loss(image, target, weight, ssim_weight), weight)


def photometric_batch(
    images: Array,
    targets: Array,
    weights: Array | None = None,
    ssim_weight: float = 0.2,
    devices: int = 1,
) -> Array:
    """Return `photometric` of B images, [B], with their rows shared by the devices.

    Each device computes a band of rows. Beside a `jax.shard_map`, every device would
    otherwise compute the whole loss.

    Args:
      images, targets: [B, H, W, C] in [0, 1].
      weights: [B, H, W], 0 for excluded pixels; or None.
      ssim_weight: λ, see `photometric`.
      devices: number of devices.
    """
    height = images.shape[1]
    rows = -(-height // devices)
    margin = ssim_window.RADIUS if ssim_weight > 0 else 0
    if weights is None:
        weights = jnp.ones(images.shape[:-1], images.dtype)

    def band(device: Array, *arrays: Array) -> tuple[Array, Array]:
        def cut(array: Array) -> Array:
            below = margin + devices * rows - height
            padding = [(margin, below), *[(0, 0)] * (array.ndim - 1)]
            start, wide = device[0] * rows, jnp.pad(array, padding)
            return lax.dynamic_slice_in_dim(wide, start, rows + 2 * margin)

        def sums(*one: Array) -> tuple[Array, Array]:
            image, target, weight = map(cut, one)
            values = _pixel_loss(image, target, weight, ssim_weight)
            own = slice(margin, margin + rows)
            return weighted_sum(values[own], weight[own])

        return jax.tree.map(lambda x: x[None], jax.vmap(sums)(*arrays))

    sums = map_over_devices(band, devices, images, targets, weights)
    value, total = (jnp.sum(a, 0) for a in sums)
    return safe_divide(value, total, total > 0)


def _pixel_loss(
    image: Array, target: Array, weight: Array | None, ssim_weight: float
) -> Array:
    """Return the loss [H, W, C] that `photometric` averages."""
    image, target = mask_excluded(image, target, weight)
    difference = image - target
    # |x| with slope 0 at 0, so that equal pixels have no gradient.
    absolute = difference * lax.stop_gradient(jnp.sign(difference))
    loss = (1 - ssim_weight) * absolute
    if ssim_weight > 0:
        loss += ssim_weight * (1 - ssim_map(image, target))
    return loss
