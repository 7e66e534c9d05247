"""The 3D smoothing filter of Mip-Splatting, as a scene model.

Yu et al., "Mip-Splatting: Alias-free 3D Gaussian Splatting", CVPR 2024. A photograph
shows nothing finer than its pixels, so each Gaussian is convolved with an isotropic one
as wide as the finest pixels that sampled it. The 2D filter of the paper is
``RasterConfig(dilation=0.1, antialias=True)``.

Axis legend: N Gaussians (capacity), V cameras.
"""

import math
from functools import cache

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import USUAL_EXTENT, Camera
from gsjax.cameras.lenses import PINHOLE
from gsjax.gaussians import Gaussians
from gsjax.train.models import Model, ModelParams, Refresh, SceneParams

Array = jax.Array

VARIANCE = 0.2  # of the filter, in squares of the interval between samples
_MARGIN = 0.15  # of the image, beyond each side
NEAREST = 0.2  # smallest depth of a Gaussian that a camera samples


def filter_radii(
    means: Array, active: Array, cameras: Camera, nearest: float = NEAREST
) -> Array:
    """Return the standard deviation of the 3D filter of each Gaussian.

    It is √0.2 times the interval between samples in the camera that samples the
    Gaussian most finely: z / fx for a pinhole, as in the paper. For other lenses it is
    the inverse of the smaller stretch (singular value) of the projection at the mean.
    A camera samples the Gaussians whose means it projects to its image, or to a margin
    of 15 % around it. Gaussians that no camera samples take the largest radius of the
    others. Cameras are visited one after the other, so memory is that of one.

    Motion during a rolling shutter is ignored. No derivative is taken.

    Args:
      means: [N, 3].
      active: [N] bool.
      cameras: batch of V cameras.
      nearest: smallest depth that counts, in world units.

    Returns:
      [N] radii in world units; 0 if no camera samples any Gaussian.
    """
    points = tuple(lax.stop_gradient(means).T)

    def visit(least: Array, camera: Camera) -> tuple[Array, None]:
        interval = _sampling_interval(points, camera, nearest)
        return jnp.minimum(least, interval.astype(least.dtype)), None

    unseen = jnp.full(means.shape[0], jnp.inf, means.dtype)
    least, _ = lax.scan(visit, unseen, lax.stop_gradient(cameras))
    seen = active & (least < jnp.inf)
    largest = jnp.max(jnp.where(seen, least, 0), initial=0)
    return math.sqrt(VARIANCE) * jnp.where(seen, least, largest)


def _sampling_interval(
    points: tuple[Array, ...], camera: Camera, nearest: float
) -> Array:
    """Return the distance [N] between samples at points; inf if not in view."""
    # Sums instead of a product of matrices, whose precision depends on the platform.
    rows = camera.viewmat[:3]
    x, y, z = (sum(r[i] * points[i] for i in range(3)) + r[3] for r in rows)
    depth = camera.lens.depth((x, y, z))
    seen = (depth > nearest) & camera.lens.valid(
        camera.K, camera.coefficients, (x, y, z)
    )
    point = jnp.where(seen, x, 0), jnp.where(seen, y, 0), jnp.where(seen, z, 1)
    place = camera.project(point)
    for at, size in zip(place, camera.visible):
        seen &= (at >= -_MARGIN * size) & (at <= (1 + _MARGIN) * size)
    if camera.lens is PINHOLE:
        interval = point[2] / camera.K[0, 0]
    else:
        interval = 1 / _smaller_stretch(camera, point)
    return jnp.where(seen & (interval > 0), interval, jnp.inf)


def _smaller_stretch(camera: Camera, point: tuple[Array, Array, Array]) -> Array:
    """Return the smaller singular value [N] of the derivative of the projection."""
    zeros, ones = jnp.zeros_like(point[0]), jnp.ones_like(point[0])
    axes = [tuple(ones if i == k else zeros for i in range(3)) for k in range(3)]
    columns = [jax.jvp(camera.project, (point,), (axis,))[1] for axis in axes]
    rows = [sum(c[i] * c[j] for c in columns) for i, j in ((0, 0), (0, 1), (1, 1))]
    half, apart = (rows[0] + rows[2]) / 2, (rows[0] - rows[2]) / 2
    largest = half + jnp.hypot(apart, rows[1])
    minors = ((0, 1), (0, 2), (1, 2))
    u, v = zip(*columns)
    squares = sum((u[i] * v[j] - u[j] * v[i]) ** 2 for i, j in minors)
    return jnp.sqrt(squares / largest)


def smoothed(gaussians: Gaussians, radii: Array) -> Gaussians:
    """Convolve Gaussians with isotropic ones; opacities keep the integral.

    Scales s become √(s² + r²), and opacities are multiplied by √(Π s² / Π (s² + r²)),
    equation 9 of the paper. The result is what renderers and files take. Differentiable
    in the Gaussians; slots that are not active are left unchanged.

    Args:
      gaussians: N slots.
      radii: [N] standard deviations r in world units; 0 changes nothing.
    """
    active, params = gaussians.active, gaussians.params
    logs = jnp.where(active[:, None], params.log_scales, 0)
    logits = jnp.where(active, params.logit_opacities, 0)
    log_radii = jnp.log(lax.stop_gradient(radii))[:, None]
    wide = jnp.logaddexp(2 * logs, 2 * log_radii) / 2
    # Logarithm of the factor of the opacity, without the difference of large numbers.
    loss = -jnp.sum(jax.nn.softplus(2 * (log_radii - logs)), -1) / 2
    # logit(p e^loss) = loss + l − log(1 + e^l (1 − e^loss)), scaled against overflow.
    top = lax.stop_gradient(jnp.maximum(logits, 0))
    rest = jnp.exp(-top) - jnp.expm1(loss) * jnp.exp(logits - top)
    faint = loss + (logits - top) - jnp.log(rest)
    return gaussians.replace(  # pyright: ignore
        params=params.replace(  # pyright: ignore
            log_scales=jnp.where(active[:, None], wide, params.log_scales),
            logit_opacities=jnp.where(active, faint, params.logit_opacities),
        )
    )


@cache
def mip_model(extent: float = USUAL_EXTENT) -> Model:
    """Return the model that trains Gaussians behind their 3D filters.

    Its buffer ``radii`` [N] comes from `filter_radii`. Published constants in world
    units assume a scene extent of 5: the smallest depth scales with it.

    Args:
      extent: scene extent in world units.
    """
    nearest = NEAREST * extent / USUAL_EXTENT

    def init(gaussians: Gaussians) -> ModelParams:
        like = gaussians.params.means
        return ModelParams(buffers={"radii": jnp.zeros(like.shape[0], like.dtype)})

    def scene(params: SceneParams) -> Gaussians:
        return smoothed(params.gaussians, params.model.buffers["radii"])

    def update(
        params: SceneParams, cameras: Camera, fraction: Array
    ) -> dict[str, Array]:
        del fraction
        gaussians = params.gaussians
        means, active = gaussians.params.means, gaussians.active
        return {"radii": filter_radii(means, active, cameras, nearest)}

    return Model(
        init=init,
        apply=lambda params, _: scene(params),
        scene=scene,
        refresh=Refresh(update),
    )
