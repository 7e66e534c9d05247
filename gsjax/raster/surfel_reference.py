"""Dense reference of surfels, and of the depth of ellipsoids along each ray.

Every Gaussian at every pixel, in float64. Rays are cut with planes by a linear solve,
and with ellipsoids by the inverse of the covariance; the renderer uses neither. Of the
renderer it takes the parameters, the lens and the SH colours. Pinholes only.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians
from gsjax.math.rotations import covariance, quaternion_to_matrix
from gsjax.raster.reference import (
    ordered_weights,
    reference_colors,
    reference_project,
)
from gsjax.raster.types import Array, RasterConfig


class DensePixels(NamedTuple):
    """Gaussians at pixels, [N, P] each, before the limits of α.

    Attributes:
      alpha: opacity · exp(power).
      depth: of the point that a pixel shows.
      normals: [N, 3] in camera coordinates, towards the camera.
    """

    alpha: Array
    depth: Array
    normals: Array


def pixel_rays(camera: Camera) -> Array:
    """Return points [P, 3] at z = 1 on the rays of all pixels, row by row."""
    ys, xs = jnp.mgrid[: camera.height, : camera.width] + 0.5
    return _rays_through(camera, jnp.stack([xs.ravel(), ys.ravel()], -1))


def _rays_through(camera: Camera, pixels: Array) -> Array:
    """Return points [..., 3] at z = 1 on the rays of places [..., 2] of the image."""
    x = (pixels[..., 0] - camera.K[0, 2]) / camera.K[0, 0]
    y = (pixels[..., 1] - camera.K[1, 2]) / camera.K[1, 1]
    return jnp.stack([x, y, jnp.ones_like(x)], -1)


def _seen(gaussians: Gaussians, camera: Camera):
    rotation, translation = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    axes = rotation @ quaternion_to_matrix(gaussians.params.quats)
    means = gaussians.params.means @ rotation.T + translation
    return means, axes


def dense_surfels(
    gaussians: Gaussians, camera: Camera, dilation: float | None, antialias: bool
) -> DensePixels:
    """Return surfels at every pixel.

    Args:
      gaussians: N of them.
      camera: a single pinhole.
      dilation: None for the floor of Huang et al. (2024), else px² by which the image
        of a surfel is dilated.
      antialias: whether the opacity makes up for the dilation.
    """
    params = gaussians.params
    means, axes = _seen(gaussians, camera)
    scales = jnp.exp(params.log_scales[:, :2])
    opacity = jax.nn.sigmoid(params.logit_opacities)
    rays = pixel_rays(camera)

    def on_plane(mean, axis, scale, ray):
        """Solve mean + a s_u t_u + b s_v t_v = z ray for (a, b, z)."""
        matrix = jnp.stack([axis[:, 0] * scale[0], axis[:, 1] * scale[1], -ray], -1)
        return jnp.linalg.solve(matrix, -mean)

    by_pixel = jax.vmap(on_plane, (None, None, None, 0))
    hits = jax.vmap(by_pixel, (0, 0, 0, None))(means, axes, scales, rays)
    depth = hits[..., 2]
    meets = depth >= camera.near
    square = hits[..., 0] ** 2 + hits[..., 1] ** 2
    pixels = rays[:, :2] * camera.K[(0, 1), (0, 1)]
    offset = (
        pixels - (means[:, None, :2] / means[:, None, 2:]) * camera.K[(0, 1), (0, 1)]
    )
    if dilation is None:
        blob = 2 * jnp.sum(offset * offset, -1)
        depth = jnp.where(square <= blob, depth, means[:, None, 2])
        square = jnp.minimum(square, blob)
    else:
        jacobian, pull = _linear_image(means, axes, scales, camera)
        sharp = jacobian @ jnp.swapaxes(jacobian, -1, -2)
        wide = sharp + dilation * jnp.eye(2)
        inverse = jnp.linalg.inv(wide)
        expected = jnp.einsum("nij,npj->npi", inverse, offset)
        e = 1 + jnp.einsum("npi,nij,nj->np", expected, jacobian, pull)
        square = jnp.einsum("npi,npi->np", offset, expected) / (e * e)
        depth = means[:, 2:] / e
        meets = (e > 0) & (depth >= camera.near)
        if antialias:
            ratio = jnp.linalg.det(sharp) / jnp.linalg.det(wide)
            opacity = opacity * jnp.sqrt(ratio)
    alpha = jnp.where(meets, opacity[:, None] * jnp.exp(-0.5 * square), 0)
    normals = axes[:, :, 2]
    facing = jnp.sign(jnp.sum(normals * means, -1, keepdims=True))
    return DensePixels(alpha, jnp.where(meets, depth, 0), -facing * normals)


def _linear_image(means, axes, scales, camera: Camera):
    """Return d(u, v) / d(a, b) [N, 2, 2] and −d log z / d(a, b) [N, 2]."""

    def image(place, mean, axis, scale):
        point = mean + axis[:, :2] @ (place * scale)
        u, v = camera.project(tuple(point))
        return jnp.stack([u, v, -jnp.log(point[2])])

    slopes = jax.vmap(jax.jacfwd(image), (None, 0, 0, 0))
    found = slopes(jnp.zeros(2), means, axes, scales)
    return found[:, :2], found[:, 2]


def dense_ellipsoids(
    gaussians: Gaussians, camera: Camera, config: RasterConfig
) -> DensePixels:
    """Return ellipsoids at every pixel, with the depth of a ray's densest point."""
    means, _ = _seen(gaussians, camera)
    params = gaussians.params
    rotation = camera.viewmat[:3, :3]
    world = covariance(params.quats, jnp.exp(params.log_scales))
    inverse = jnp.linalg.inv(rotation @ world @ rotation.T)
    pulled = jnp.einsum("nij,nj->ni", inverse, means)
    means2d, _, cov2d, *_ = reference_project(gaussians, camera, config.dilation)
    ys, xs = jnp.mgrid[: camera.height, : camera.width] + 0.5
    offset = jnp.stack([xs, ys], -1).reshape(-1, 2) - means2d[:, None]
    # Where a pixel is expected to lie before the dilation.
    sharp = cov2d - config.dilation * jnp.eye(2)
    expected = jnp.einsum("nij,njk,npk->npi", sharp, jnp.linalg.inv(cov2d), offset)
    rays = _rays_through(camera, means2d[:, None] + expected)
    across = jnp.einsum("npi,nij,npj->np", rays, inverse, rays)
    depth = jnp.einsum("ni,npi->np", pulled, rays) / across
    depth = jnp.where(depth > 1e-3 * means[:, 2:], depth, means[:, 2:])
    power = jnp.einsum("npi,nij,npj->np", offset, jnp.linalg.inv(cov2d), offset)
    opacity = jax.nn.sigmoid(params.logit_opacities)
    normals = -pulled / jnp.linalg.norm(pulled, axis=-1, keepdims=True)
    return DensePixels(opacity[:, None] * jnp.exp(-0.5 * power), depth, normals)


def dense_geometry(
    gaussians: Gaussians, camera: Camera, config: RasterConfig, features=None
) -> dict[str, Array]:
    """Composite every active Gaussian at every pixel, with the limits of ``config``.

    Args:
      gaussians: the active mask must be concrete.
      camera: a single pinhole.
      config: ``primitive`` is a name.
      features: [N, C] in place of the SH colour.

    Returns:
      The images of `RasterConfig.outputs`, and "margin" [H, W]: the smallest relative
      distance of a pixel from a threshold.
    """
    slots = np.flatnonzero(np.asarray(gaussians.active))
    gaussians = jax.tree.map(lambda a: a[slots], gaussians)
    if config.primitive in (None, "ellipsoid"):
        dense = dense_ellipsoids(gaussians, camera, config)
    else:
        dilation = None if config.primitive == "surfel" else config.dilation
        dense = dense_surfels(gaussians, camera, dilation, config.antialias)
    centre = _seen(gaussians, camera)[0][:, 2]
    drawn = (centre > camera.near) & (centre < camera.far)
    order = jnp.argsort(jnp.where(drawn, centre, jnp.inf), stable=True)
    colors = (
        reference_colors(gaussians, camera) if features is None else features[slots]
    )
    alpha, depth = jnp.where(drawn[:, None], dense.alpha, 0)[order], dense.depth[order]
    limits = jnp.abs(alpha / config.alpha_min - 1)
    alpha = jnp.where(alpha < config.alpha_max, alpha, config.alpha_max)
    alpha = jnp.where(alpha >= config.alpha_min, alpha, 0)
    weight, half, stops = ordered_weights(
        alpha, config, depth if config.order == "pixel" else None
    )
    shape = camera.height, camera.width
    total = weight.sum(0)
    inverse = jnp.where(weight > 0, 1 / jnp.where(weight > 0, depth, 1), 0)
    apart = jnp.square(inverse[:, None] - inverse[None])
    pairs = jnp.einsum("ip,jp,ijp->p", weight, weight, apart) / 2
    images = {
        "rgb": weight.T @ colors[order],
        "normals": weight.T @ dense.normals[order],
        "alpha": total,
        "depth": (weight * depth).sum(0) / jnp.where(total > 1e-10, total, 1),
        "median_depth": jnp.where(half, depth, 0).sum(0),
        "distortion": pairs,
        "margin": jnp.minimum(limits.min(0), stops),
    }
    return {
        name: image.reshape(*shape, *image.shape[1:]) for name, image in images.items()
    }
