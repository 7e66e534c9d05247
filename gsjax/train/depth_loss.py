"""Depth supervision: a loss against depth images, such as the ranges of a lidar.

Axis legend: V views, B images, H W image.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import ArrayLike

from gsjax.cameras.camera import NEAREST
from gsjax.errors import InputError
from gsjax.math.numerics import safe_divide
from gsjax.raster.types import Render
from gsjax.train.frames import Batch
from gsjax.train.losses import LossTerm
from gsjax.train.models import SceneParams

Array = jax.Array


def depth_loss(
    depth: Array,
    alpha: Array,
    target: Array,
    weight: Array | None = None,
    *,
    hit_weight: float = 0.0,
) -> Array:
    """Return the mean relative error [] of a depth image, and of the hits.

    The error of a pixel with a return is α |depth − target| / target. No derivative is
    taken of this α, so the gradient stays bounded where α is small, and hiding a pixel
    does not lower the loss. All gradients are finite.

    Args:
      depth: [..., H, W] expected depth, `Render.depth`.
      alpha: [..., H, W] hit probability, `Render.alpha`.
      target: [..., H, W] depth of the same kind: z for lenses of less than 180°, the
        distance to the camera for others. A pixel that is at most 1e-12 or not finite
        has no return; its depth does not count.
      weight: [..., H, W], 0 for excluded pixels; or None.
      hit_weight: weight of the mean |α − hit|, where hit is 1 for pixels with a return
        and 0 for others. At 0, pixels without a return do not count at all.
    """
    depth, alpha, target = map(jnp.asarray, (depth, alpha, target))
    hit = (target > NEAREST) & (target < jnp.inf)
    weight = (
        jnp.ones_like(depth) if weight is None else jnp.asarray(weight, depth.dtype)
    )
    measured = hit & (weight > 0)
    target = jnp.where(measured, target, 1).astype(depth.dtype)
    difference = jnp.where(measured, depth, target) - target
    # |x| with slope 0 at 0.
    absolute = difference * lax.stop_gradient(jnp.sign(difference))
    error = lax.stop_gradient(alpha) * absolute / target
    loss = _mean(error, jnp.where(measured, weight, 0))
    if hit_weight > 0:
        loss += hit_weight * _mean(jnp.where(hit, 1 - alpha, alpha), weight)
    return loss


def _mean(values: Array, weight: Array) -> Array:
    """Return the weighted mean [] of finite values; 0 if all weights are 0."""
    total = jnp.sum(weight)
    return safe_divide(jnp.sum(values * weight), total, total > 0)


def depth_term(
    targets: Sequence[ArrayLike] | np.ndarray,
    *,
    weight: float | Callable[[Array], Array] = 1.0,
    hit_weight: float = 0.0,
    start: int = 0,
) -> LossTerm:
    """Return `depth_loss` against a depth image of each view as a loss term.

    Pixels that a photograph excludes do not count. Where training renders at another
    resolution, the nearest pixel of the depth image counts. The images become constants
    of the compiled step.

    Args:
      targets: V depth or range images [H, W], in the order of the dataset's views and
        with the coverage of its photographs; see `depth_loss` for pixels without a
        return.
      weight: factor, or a function of the step, see `LossTerm`.
      hit_weight: as `depth_loss` takes it, relative to the error of the depth.
      start: first step at which the term counts.

    Raises:
      InputError: if an image is not an array [H, W] of real numbers, or ``hit_weight``
        is negative; in a step, if the images have another aspect ratio than the render.
    """
    images = stack_images(targets)
    if not hit_weight >= 0:
        raise InputError(f"hit_weight: expected a number ≥ 0, got {hit_weight}")

    def function(render: Render, batch: Batch, params: SceneParams) -> Array:
        del params
        depth, alpha = render.depth, render.alpha
        assert depth is not None
        assert alpha is not None
        target = jnp.asarray(resampled(images, depth.shape[-2:]))[batch.view]
        return depth_loss(depth, alpha, target, batch.valid, hit_weight=hit_weight)

    return LossTerm("depth", function, weight, start, ("alpha", "depth"))


def stack_images(
    targets: Sequence[ArrayLike] | np.ndarray, channels: tuple[int, ...] = ()
) -> np.ndarray:
    """Return images [V, H, W, *channels] float32, padded with 0 at right and bottom.

    Raises:
      InputError: if there is none, or one has another shape or no real numbers.
    """
    images = [np.asarray(image) for image in targets]
    if not images:
        raise InputError("targets: expected an image for each view, got none")
    for index, image in enumerate(images):
        fits = image.ndim == 2 + len(channels) and image.shape[2:] == channels
        if not fits or image.size == 0 or image.dtype.kind not in "fiu":
            shape = ", ".join(["H", "W", *map(str, channels)])
            raise InputError(
                f"targets[{index}]: expected real numbers of shape [{shape}], got "
                f"{image.dtype} of shape {image.shape}"
            )
    height, width = np.max([image.shape[:2] for image in images], axis=0)
    out = np.zeros((len(images), height, width, *channels), np.float32)
    for row, image in zip(out, images):
        row[: image.shape[0], : image.shape[1]] = image
    return out


def resampled(images: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Return the nearest pixels of images [V, H, W, ...] at another size.

    Raises:
      InputError: if the size has another aspect ratio.
    """
    given = images.shape[1:3]
    if given == size:
        return images
    # Half a pixel of rounding on both sides.
    if abs(given[0] * size[1] - given[1] * size[0]) > 0.5 * sum(given):
        raise InputError(
            f"targets: expected depth images of the aspect ratio of the photographs, "
            f"{size[0]} × {size[1]}, got {given[0]} × {given[1]} (height × width)"
        )
    rows, columns = (
        ((np.arange(new) + 0.5) * old / new).astype(int)
        for new, old in zip(size, given)
    )
    return images[:, rows[:, None], columns]
