"""Losses of geometry: depth distortion, consistent normals, and decided opacities.

Huang et al., "2D Gaussian Splatting for Geometrically Accurate Radiance Fields", 2024.

Axis legend: B images, H W image, N Gaussians.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.math.numerics import safe_divide
from gsjax.raster.types import Render
from gsjax.train.config import TrainConfig
from gsjax.train.frames import Batch
from gsjax.train.losses import LossTerm
from gsjax.train.models import SceneParams

Array = jax.Array
Weight = float | Callable[[Array], Array]

_SMALL = 1e-12


def normals_of_depth(depth: Array, camera: Camera) -> Array:
    """Return normals [H, W, 3] of a depth image in camera coordinates.

    They face the camera, and follow from the differences between the points of the
    neighbours on both sides. At the border, and where a neighbour has no depth, they
    are 0.

    Args:
      depth: [H, W] of the lens: z below 180°, else the distance; 0 where nothing is.
      camera: a single camera of that image.
    """
    rays = _rays(camera, depth)
    points = depth[..., None] * rays
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    normal = jnp.cross(down, across)  # towards the camera, for y downwards
    square = jnp.sum(normal * normal, axis=-1)
    there = depth > 0
    sides = there[1:-1, 2:] & there[1:-1, :-2] & there[2:, 1:-1] & there[:-2, 1:-1]
    good = sides & (square > _SMALL**2)
    length = jnp.sqrt(jnp.where(good, square, 1))
    normal = jnp.where(good[..., None], normal / length[..., None], 0)
    return jnp.pad(normal, ((1, 1), (1, 1), (0, 0)))


def _rays(camera: Camera, depth: Array) -> Array:
    """Return rays [H, W, 3] that a depth is multiplied by."""
    ys, xs = jnp.mgrid[: camera.height, : camera.width] + jnp.asarray(0.5, depth.dtype)
    ray = camera.lens.unproject(camera.K, camera.coefficients, (xs, ys))
    length = camera.lens.depth(ray)
    return jnp.stack(jnp.broadcast_arrays(*ray), -1) / length[..., None]


def normal_consistency(
    normals: Array, alpha: Array, depth: Array, camera: Camera
) -> Array:
    """Return the mean of Σ w (1 − n · N) over the pixels [] of an image.

    N is the normal of the depth image, where it has one.

    Args:
      normals: [H, W, 3] `Render.normals`.
      alpha, depth: [H, W] of the same render.
      camera: a single camera.
    """
    of_depth = normals_of_depth(depth, camera)
    there = jnp.any(of_depth != 0, axis=-1)
    apart = alpha - jnp.sum(normals * of_depth, axis=-1)
    return jnp.mean(jnp.where(there, apart, 0))


def normal_term(weight: Weight = 0.05, start: int = 0) -> LossTerm:
    """Return `normal_consistency` of the views of a step as a loss term."""

    def function(render: Render, batch: Batch, params: SceneParams) -> Array:
        del params
        normals, alpha, depth = render.normals, render.alpha, render.depth
        assert normals is not None
        assert alpha is not None
        assert depth is not None
        each = jax.vmap(normal_consistency)(normals, alpha, depth, batch.camera)
        return jnp.mean(each)

    return LossTerm("normals", function, weight, start, ("normals", "alpha", "depth"))


def relative_distortion(distortion: Array, depth: Array) -> Array:
    """Return Σ w w′ (z̄ / z − z̄ / z′)² over the pairs of each pixel [...].

    Each pair counts once. z̄ is the expected depth of the pixel; no derivative passes
    through it. Huang et al. have a constant in its place, so that the effect of their
    weight depends on the size of the scene.

    Args:
      distortion: [...] `Render.distortion`.
      depth: [...] expected depth of the same render.
    """
    return distortion * jnp.square(lax.stop_gradient(depth))


def distortion_term(weight: Weight = 10.0, start: int = 0) -> LossTerm:
    """Return the mean `relative_distortion` of the views of a step as a loss term."""

    def function(render: Render, batch: Batch, params: SceneParams) -> Array:
        del batch, params
        distortion, depth = render.distortion, render.depth
        assert distortion is not None
        assert depth is not None
        return jnp.mean(relative_distortion(distortion, depth))

    return LossTerm("distortion", function, weight, start, ("distortion", "depth"))


def opacity_entropy(opacity: Array, active: Array) -> Array:
    """Return the mean of −o ln o − (1 − o) ln (1 − o) over active Gaussians [].

    Args:
      opacity: [N] in 0 … 1.
      active: [N] bool.
    """
    inside = (opacity > _SMALL) & (opacity < 1 - 1e-7)
    safe = jnp.where(inside, opacity, 0.5)
    entropy = -safe * jnp.log(safe) - (1 - safe) * jnp.log1p(-safe)
    total = jnp.sum(jnp.where(inside & active, entropy, 0))
    count = jnp.sum(active)
    return safe_divide(total, count.astype(total.dtype), count > 0)


def entropy_term(weight: Weight = 0.01, start: int = 0) -> LossTerm:
    """Return `opacity_entropy` of the scene as a loss term: solid, or not there."""

    def function(render: Render, batch: Batch, params: SceneParams) -> Array:
        del render, batch
        gaussians = params.gaussians
        opacity = jax.nn.sigmoid(gaussians.params.logit_opacities)
        return opacity_entropy(opacity, lax.stop_gradient(gaussians.active))

    return LossTerm("entropy", function, weight, start)


def geometry_terms(config: TrainConfig) -> tuple[LossTerm, ...]:
    """Return the terms of a training run that have a weight."""
    given = (
        (normal_term, config.normal_weight, config.normal_from),
        (distortion_term, config.distortion_weight, config.distortion_from),
        (entropy_term, config.entropy_weight, config.entropy_from),
    )
    return tuple(
        term(weight, round(share * config.steps))
        for term, weight, share in given
        if weight > 0
    )
