"""Dense reference: every Gaussian at every pixel, without tiles or capacities.

Slow and simple; run it in float64. The limits and the order of a `RasterConfig` apply
only if one is given. It shares only the parameters and the lens with the renderer: it
uses matrices instead of components, and an inverse instead of factors.
"""

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera, camera_centre
from gsjax.gaussians import Gaussians
from gsjax.math import sh as sh_lib
from gsjax.math.rotations import covariance
from gsjax.raster.types import Array, RasterConfig


def reference_project(gaussians: Gaussians, camera: Camera, dilation: float = 0.3):
    """Project by matrices: means2d [N, 2], depth [N], cov2d [N, 2, 2], ratio [N], seen.

    ``cov2d`` includes the dilation; ``ratio`` is the determinant before it over that
    after it; ``seen`` [N] is True between near and far (others are moved to z = 1).
    """
    p = gaussians.params
    rotation, translation = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    points = jnp.einsum("ij,nj->ni", rotation, p.means, precision="highest")
    points = points + translation
    seen = (points[:, 2] > camera.near) & (points[:, 2] < camera.far)
    points = jnp.where(seen[:, None], points, jnp.asarray([0.0, 0.0, 1.0]))
    world = covariance(p.quats, jnp.exp(p.log_scales))

    def lens(point):
        return jnp.stack(camera.project(tuple(point)))

    def limited(point):
        return jnp.stack(camera.linearise(tuple(point)))

    jacobian = jax.vmap(lambda point: jax.jacfwd(lens)(limited(point)))(points)
    half = jnp.einsum("nij,jk->nik", jacobian, rotation, precision="highest")
    sharp = jnp.einsum("nij,njk,nlk->nil", half, world, half, precision="highest")
    cov2d = sharp + dilation * jnp.eye(2)
    ratio = jnp.linalg.det(sharp) / jnp.linalg.det(cov2d)
    return jax.vmap(lens)(points), points[:, 2], cov2d, ratio, seen


def reference_ray_depths(
    gaussians: Gaussians, camera: Camera, places: Array | None = None
) -> Array:
    """Return the depth [N, P] at which the ray of each place is densest.

    For pinholes; negative behind the camera. Scales below 1e-5 of the largest count as
    that.

    Args:
      gaussians: N slots.
      camera: a single camera.
      places: [P, 2] in px; None for the centres of all pixels, row by row.
    """
    p = gaussians.params
    least = jnp.max(p.log_scales, axis=1, keepdims=True) + jnp.log(1e-5)
    scales = jnp.exp(jnp.maximum(p.log_scales, least))
    rotation, translation = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    means = p.means @ rotation.T + translation
    inverse = jnp.linalg.inv(covariance(p.quats, scales))
    inverse = jnp.einsum("ij,njk,lk->nil", rotation, inverse, rotation)
    if places is None:
        ys, xs = jnp.mgrid[: camera.height, : camera.width] + 0.5
        places = jnp.stack([xs.ravel(), ys.ravel()], -1)
    x = (places[:, 0] - camera.K[0, 2]) / camera.K[0, 0]
    y = (places[:, 1] - camera.K[1, 2]) / camera.K[1, 1]
    rays = jnp.stack([x, y, jnp.ones_like(x)], -1)
    along = jnp.einsum("pi,nij,nj->np", rays, inverse, means)
    return along / jnp.einsum("pi,nij,pj->np", rays, inverse, rays)


def ordered_weights(
    alpha: Array, config: RasterConfig | None, keys: Array | None = None
) -> tuple[Array, Array, Array]:
    """Return weights [N, P], where T falls through 1/2 [N, P], and a margin [P].

    The margin is the smallest relative distance of T from ``transmittance_min``.

    Args:
      alpha: [N, P] in the order of the means.
      config: its rule to stop applies; None for none.
      keys: [N, P] depths by which each pixel sorts; None for the order of ``alpha``.
    """
    order = None if keys is None else jnp.argsort(keys, axis=0, stable=True)
    if order is not None:
        alpha = jnp.take_along_axis(alpha, order, 0)
    after = jnp.cumprod(1 - alpha, axis=0)
    before = jnp.concatenate([jnp.ones_like(after[:1]), after[:-1]])
    blended, margin = jnp.ones_like(after, bool), jnp.full(alpha.shape[1], jnp.inf)
    if config is not None:
        tested = after if config.stop_rule == "before" else before
        blended = tested > config.transmittance_min
        if config.transmittance_min > 0:
            near_stop = jnp.abs(tested / config.transmittance_min - 1)
            margin = jnp.min(near_stop, axis=0, initial=jnp.inf)
    weight = jnp.where(blended, alpha * before, 0)
    half = (before > 0.5) & (after <= 0.5) & blended
    if order is not None:
        back = jnp.argsort(order, axis=0)
        weight = jnp.take_along_axis(weight, back, 0)
        half = jnp.take_along_axis(half, back, 0)
    return weight, half, margin


def reference_colors(gaussians: Gaussians, camera: Camera) -> Array:
    """Return the SH colour [N, 3] of each Gaussian seen from the camera.

    A Gaussian at the camera itself is seen along the world's z axis.
    """
    offset = gaussians.params.means - camera_centre(camera.viewmat)
    there = jnp.any(offset != 0, axis=-1, keepdims=True)
    offset = jnp.where(there, offset, jnp.asarray([0.0, 0.0, 1.0]))
    directions = offset / jnp.linalg.norm(offset, axis=-1, keepdims=True)
    return jnp.maximum(sh_lib.eval_sh(gaussians.params.sh, directions) + 0.5, 0)


def reference_render(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig | None = None,
    background: Array | None = None,
    *,
    features: Array | None = None,
    dilation: float = 0.3,
    antialias: bool = False,
) -> dict[str, Array]:
    """Composite every active Gaussian at every pixel; O(N H W) memory.

    Args:
      gaussians: the active mask must be concrete (not traced).
      camera: a single camera; near and far cull.
      config: its limits, its dilation and the order "pixel" apply; None means no
        limits, with ``dilation`` and ``antialias`` as given.
      background: [C], default black.
      features: [N, C] in place of the SH colour.

    Returns:
      "rgb" [H, W, C], "alpha", "depth", "median_depth" [H, W], and "margin" [H, W]:
      the smallest relative distance of the pixel from any threshold (α from alpha_min,
      T from transmittance_min). Two renderers may differ by a Gaussian where it is 0.
    """
    if config is not None:
        dilation, antialias = config.dilation, config.antialias
    slots = np.flatnonzero(np.asarray(gaussians.active))
    gaussians = jax.tree.map(lambda a: a[slots], gaussians)
    means2d, depth, cov2d, ratio, inside = reference_project(
        gaussians, camera, dilation
    )
    opacity = jax.nn.sigmoid(gaussians.params.logit_opacities)
    if antialias:
        opacity = opacity * jnp.sqrt(jnp.maximum(ratio, 0.005**2))
    order = jnp.argsort(jnp.where(inside, depth, jnp.inf), stable=True)
    colors = (
        reference_colors(gaussians, camera) if features is None else features[slots]
    )
    colors, depth, inside = colors[order], depth[order], inside[order]
    colors = jnp.where(inside[:, None], colors, 0)  # never blended
    means2d, opacity = means2d[order], jnp.where(inside, opacity[order], 0)
    inverse = jnp.linalg.inv(cov2d[order])

    ys, xs = jnp.mgrid[: camera.height, : camera.width] + 0.5
    offset = jnp.stack([xs, ys], -1).reshape(-1, 2) - means2d[:, None]
    power = jnp.einsum("npi,nij,npj->np", offset, inverse, offset, precision="highest")
    alpha = opacity[:, None] * jnp.exp(-0.5 * power)  # [N, pixels]
    margin = jnp.full(alpha.shape[1], jnp.inf)
    if config is not None:
        from_limit = jnp.abs(alpha / config.alpha_min - 1)
        margin = jnp.min(from_limit, axis=0, initial=jnp.inf)
        alpha = jnp.where(alpha < config.alpha_max, alpha, config.alpha_max)
        alpha = jnp.where(alpha >= config.alpha_min, alpha, 0)
    keys = None
    if config is not None and config.order == "pixel":
        keys = reference_ray_depths(gaussians, camera)[order]
    weight, half, near_stop = ordered_weights(alpha, config, keys)
    margin = jnp.minimum(margin, near_stop)
    total = jnp.sum(weight, axis=0)
    rgb = jnp.einsum("np,nc->pc", weight, colors, precision="highest")
    if background is not None:
        rgb = rgb + (1 - total)[:, None] * jnp.asarray(background)
    shape = (camera.height, camera.width)
    expected = depth @ weight / jnp.where(total > 1e-10, total, 1)
    return {
        "rgb": rgb.reshape(*shape, -1),
        "alpha": total.reshape(shape),
        "depth": expected.reshape(shape),
        "median_depth": jnp.sum(jnp.where(half, depth[:, None], 0), 0).reshape(shape),
        "margin": margin.reshape(shape),
    }
