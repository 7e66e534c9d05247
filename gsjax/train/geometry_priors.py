"""Losses against normals and monocular depth that other programs have estimated.

Axis legend: V views, B images, H W image.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import ArrayLike

from gsjax.math.numerics import safe_divide
from gsjax.raster.types import Render
from gsjax.train.depth_loss import resampled, stack_images
from gsjax.train.frames import Batch
from gsjax.train.losses import LossTerm
from gsjax.train.models import SceneParams

Array = jax.Array
Images = Sequence[ArrayLike] | np.ndarray
Weight = float | Callable[[Array], Array]

_SMALL = 1e-9


def given_normals_loss(
    normals: Array, alpha: Array, target: Array, valid: Array | None = None
) -> Array:
    """Return the mean of Σ w (1 − n · N) [] over the pixels that have a target N.

    Args:
      normals: [..., H, W, 3] `Render.normals`, camera coordinates.
      alpha: [..., H, W] of the same render.
      target: [..., H, W, 3] normals of any length, camera coordinates (x right, y down,
        z forward), that face the camera; 0 or not finite where there is none.
      valid: [..., H, W], 0 or False for excluded pixels; or None.
    """
    square = jnp.sum(target * target, -1)
    there = (square > _SMALL) & (square < jnp.inf)
    if valid is not None:
        there &= valid > 0
    target = jnp.where(there[..., None], target, 0)
    length = jnp.sqrt(jnp.where(there, square, 1))
    apart = alpha - jnp.sum(normals * target, -1) / length
    return _mean(apart, there)


def monocular_depth_loss(
    depth: Array, alpha: Array, target: Array, valid: Array | None = None
) -> Array:
    """Return the mean error [] of inverse depth after the best affine fit of a target.

    Monocular estimates know inverse depth up to scale and shift (Ranftl et al. 2020,
    "MiDaS"). Both are fitted to the render by least squares, without derivatives. The
    error is relative to the mean inverse depth of the image. The render takes part
    where its α is above 0.5.

    Args:
      depth: [H, W] expected depth, `Render.depth`.
      alpha: [H, W] of the same render.
      target: [H, W] inverse depth, up to scale and shift; 0 or not finite where there
        is none.
      valid: [H, W], 0 or False for excluded pixels; or None.
    """
    there = jnp.isfinite(target) & (target != 0) & (alpha > 0.5) & (depth > _SMALL)
    if valid is not None:
        there &= valid > 0
    inverse = safe_divide(jnp.ones_like(depth), depth, there)
    target = jnp.where(there, target, 0)
    fixed = lax.stop_gradient(inverse)
    mean, mean_target = _mean(fixed, there), _mean(target, there)
    centred = jnp.where(there, target - mean_target, 0)
    spread = jnp.sum(centred * centred)
    product = jnp.sum(centred * jnp.where(there, fixed - mean, 0))
    scale = jnp.maximum(safe_divide(product, spread, spread > 0), 0)
    difference = inverse - (mean + scale * centred)
    # |x| with slope 0 at 0.
    absolute = difference * lax.stop_gradient(jnp.sign(difference))
    return safe_divide(_mean(absolute, there), mean, mean > 0)


def _mean(values: Array, there: Array) -> Array:
    """Return the mean [] where ``there``; 0 if it is nowhere."""
    count = jnp.sum(there).astype(values.dtype)
    return safe_divide(jnp.sum(jnp.where(there, values, 0)), count, count > 0)


def given_normals_term(
    targets: Images, *, weight: Weight = 0.05, start: int = 0
) -> LossTerm:
    """Return `given_normals_loss` against an image of each view as a loss term.

    Args:
      targets: V images [H, W, 3], in the order of the dataset's views and with the
        coverage of its photographs. They become constants of the compiled step.
      weight: factor, or a function of the step, see `LossTerm`.
      start: first step at which the term counts.

    Raises:
      InputError: if an image is not an array [H, W, 3] of real numbers; in a step, if
        the images have another aspect ratio than the render.
    """
    images = stack_images(targets, (3,))

    def function(render: Render, batch: Batch, params: SceneParams) -> Array:
        del params
        normals, alpha = render.normals, render.alpha
        assert normals is not None
        assert alpha is not None
        target = jnp.asarray(resampled(images, alpha.shape[-2:]))[batch.view]
        return given_normals_loss(normals, alpha, target, batch.valid)

    return LossTerm("given_normals", function, weight, start, ("normals", "alpha"))


def monocular_depth_term(
    targets: Images, *, weight: Weight = 0.1, start: int = 0
) -> LossTerm:
    """Return `monocular_depth_loss` against an image of each view as a loss term.

    Args:
      targets: V images [H, W] of inverse depth up to scale and shift, in the order of
        the dataset's views and with the coverage of its photographs. They become
        constants of the compiled step.
      weight: factor, or a function of the step, see `LossTerm`.
      start: first step at which the term counts.

    Raises:
      InputError: if an image is not an array [H, W] of real numbers; in a step, if the
        images have another aspect ratio than the render.
    """
    images = stack_images(targets)

    def function(render: Render, batch: Batch, params: SceneParams) -> Array:
        del params
        depth, alpha, valid = render.depth, render.alpha, batch.valid
        assert depth is not None
        assert alpha is not None
        target = jnp.asarray(resampled(images, alpha.shape[-2:]))[batch.view]
        valid = jnp.ones_like(alpha) if valid is None else valid
        return jnp.mean(jax.vmap(monocular_depth_loss)(depth, alpha, target, valid))

    return LossTerm("monocular", function, weight, start, ("depth", "alpha"))
