"""Ellipsoids by EWA splatting (Zwicker et al. 2001), or by the unscented transform.

The default primitive.

Axis legend: N Gaussians (capacity), R ranks (front to back), K slots, C channels.
"""

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.cameras.shutter import Exposure, expose, image_rows
from gsjax.errors import InputError
from gsjax.math.numerics import exp_log_scale, materialize, materialize_mask, near_one
from gsjax.raster.primitives.ellipsoid_depth import (
    RAY_FORM,
    key_numbers,
    ray_key,
    ray_normals,
    ray_numbers,
)
from gsjax.raster.primitives.ewa import covariance_factor, dilated, ewa_jacobian, once
from gsjax.raster.primitives.rows import (
    Components,
    Projected,
    Size,
    alpha_limit,
    boxes,
    candidates,
    colors_of,
    order_depth,
    project_rows,
    reach_of,
    seen_slots,
)
from gsjax.raster.primitives.unscented import unscented_image
from gsjax.raster.types import (
    Array,
    Bounds,
    Footprint,
    Inputs,
    Primitive,
    Projection,
    RasterConfig,
    Splat,
)


def bounds(
    active: Array,
    values: tuple[Array, ...],
    camera: Camera,
    config: RasterConfig,
    alpha_min: Array | None = None,
) -> Bounds:
    """Return conservative bounds of slots [K]; no derivative is taken.

    Args:
      active: [K] bool.
      values: means [K, 3], log scales [K, 3] and logits of the opacities [K]; for the
        unscented transform, the quaternions [K, 4] too.
      camera: a single camera.
      config: dilation and alpha_min are used.
      alpha_min: [] in place of that of ``config``, or None.
    """
    means, log_scales, logits = values[0].T, values[1].T, values[2]
    seen = seen_slots(active, means, (*log_scales, logits), camera)
    a, b, c = (jnp.where(seen.live, s, 0) for s in log_scales)
    low, high = jnp.minimum(a, b), jnp.maximum(a, b)
    largest = exp_log_scale(jnp.maximum(high, c))
    middle = exp_log_scale(jnp.maximum(low, jnp.minimum(high, c)))
    gains = _gains(camera, seen.exposure)
    squares = [largest * largest * gain for gain in gains]
    if config.projection == "unscented":
        centres, squares = _unscented_bounds(values, seen, camera, config, squares)
        seen = seen._replace(centres=centres)
    opacity = jax.nn.sigmoid(logits)
    size = Size(squares, [middle * middle * gain for gain in gains], config.dilation)
    reach = reach_of(opacity, alpha_limit(alpha_min, config))
    return boxes(seen, size, opacity, reach, camera)


def _gains(camera: Camera, exposure: Exposure) -> list[Array]:
    """Return the largest squared stretch of world lengths along u and v."""
    return gains_of(camera, exposure, ewa_jacobian(camera, exposure.point))


def gains_of(camera: Camera, exposure: Exposure, jacobian) -> list[Array]:
    """Return the largest squared stretch of world lengths along u and v.

    Args:
      camera: a single camera.
      exposure: from `expose`.
      jacobian: rows (du/d·, dv/d·) of the lens.
    """
    if exposure.velocity is not None:
        rows = image_rows(camera, exposure, jacobian)
        return [a * a + b * b + c * c for a, b, c in rows]
    # A view matrix that scales, as one being optimised may, enlarges what it shows.
    rotation = camera.viewmat[:3, :3]
    gram = jnp.sum(rotation[:, None] * rotation[None], axis=-1)
    stretch = jnp.maximum(jnp.max(jnp.sum(jnp.abs(gram), axis=1)), 1)
    return [stretch * sum(j * j for j in row) for row in jacobian]


def _unscented_bounds(values, seen, camera: Camera, config, squares):
    """Return centres and variances of the transform, where it holds."""
    live, centres = seen.live, seen.centres
    means, log_scales, _, quats = values
    quat, good = near_one(
        tuple(jnp.where(live, q, 1) for q in quats.T), (1.0, 0.0, 0.0, 0.0)
    )
    means = [jnp.where(live, m, 0) for m in means.T]
    scales = [exp_log_scale(jnp.where(live, s, 0)) for s in log_scales.T]
    shift, factor, holds = unscented_image(camera, config, means, quat, scales)
    holds &= good
    centres = [jnp.where(holds, a + d, a) for a, d in zip(centres, shift)]
    sums = [sum(m * m for m in row) for row in factor]
    return centres, [jnp.where(holds, s, e) for s, e in zip(sums, squares)]


def project(
    inputs: Inputs, config: RasterConfig, order: Array, count: Array
) -> Projection:
    """Project the slots ``order`` [R], of which the first ``count`` are used.

    Args:
      inputs: Gaussians, camera, features and probe.
      config: dilation, antialias, alpha_min, outputs and num_size_buckets are used.
      order, count: from `gsjax.raster.lists.depth_order`.

    Raises:
      InputError: if each pixel is to sort and rays are parallel.
    """
    if config.sorts_pixels and inputs.camera.lens.name == "orthographic":
        raise InputError(
            f'RasterConfig.order: expected "center" for an orthographic lens, got '
            f'"{config.order}"; move a pinhole camera far away and lengthen its focal '
            "length"
        )
    return project_rows(_project_components, _footprint, inputs, config, order, count)


def _footprint(out: Projected) -> Footprint:
    (inv_sx, slope, *_), (var_y, det) = out.shape, out.outline
    return Footprint(out.u, out.v, inv_sx, slope, var_y, det, out.reach)


def occluders(
    inputs: Inputs, config: RasterConfig, slots: Array, count: Array
) -> Splat:
    """Return the splats [K] of ``slots``, of which the first ``count`` are used.

    No derivative is taken.
    """
    components, live = candidates(inputs, slots, count)
    out = _project_components(components, inputs.camera, config, live)
    return Splat(out.u, out.v, out.shape)


def _project_components(
    rows: Components, camera: Camera, config: RasterConfig, live: Array
) -> Projected:
    """Do the arithmetic of `project`, on components.

    `project` runs it in a branch of its own, for two reasons. How it is fused, and so
    rounded, then does not depend on its users: images are the same bits whatever the
    capacity and the devices. And XLA's CPU backend evaluates a shared value again for
    each use that indexes it differently (jax 0.10.2). It is recomputed in the backward
    pass instead of stored.
    """
    live &= rows.drawable
    quat, good = near_one(
        tuple(jnp.where(live, q, 1) for q in rows.quats), (1.0, 0.0, 0.0, 0.0)
    )
    live = materialize_mask(live & good)
    means = tuple(jnp.where(live, m, 0) for m in rows.means)
    scales = tuple(exp_log_scale(jnp.where(live, s, 0)) for s in rows.log_scales)
    exposure = expose(camera, means)
    x, y, z = exposure.point
    # Far from the world's origin, float32 may put a Gaussian elsewhere: not at the
    # lens.
    live &= camera.lens.depth((x, y, z)) > 0.5 * camera.near
    # The mean of a dead rank is the origin, which may lie anywhere: move it to z = 1.
    x, y, z = jnp.where(live, x, 0), jnp.where(live, y, 0), jnp.where(live, z, 1)
    x, y, z = materialize((x, y, z), live)
    u, v = once(camera, camera.project((x, y, z)))
    exposure = exposure._replace(point=(x, y, z))
    m1, m2 = covariance_factor(camera, exposure, quat, scales)
    if config.projection == "unscented":
        shift, (w1, w2), holds = unscented_image(camera, config, means, quat, scales)
        u, v = (a + jnp.where(holds, d, 0) for a, d in zip((u, v), shift))
        m1, m2 = _either(holds, w1, m1), _either(holds, w2, m2)
    if rows.shift is not None:
        u, v = (a + b.astype(a.dtype) for a, b in zip((u, v), rows.shift))
    live = materialize_mask(live & (jnp.abs(u) < jnp.inf) & (jnp.abs(v) < jnp.inf))

    m1, m2 = materialize(m1, live), materialize(m2, live)
    a, b, c, det, det_sharp = dilated(m1, m2, config.dilation)
    live = materialize_mask(
        live & (det > 0) & (det < jnp.inf) & (a < jnp.inf) & (c < jnp.inf)
    )
    a, b, c = jnp.where(live, a, 1), jnp.where(live, b, 0), jnp.where(live, c, 1)
    det = jnp.where(live, det, 1)
    opacity = jax.nn.sigmoid(jnp.where(live, rows.logit_opacities, 0))
    if config.antialias:
        # sqrt(max(0.005², ratio)): the floor of Mip-Splatting and gsplat.
        ratio = jnp.where(live, det_sharp, 1) / det
        floor = 0.005**2
        opacity = opacity * jnp.sqrt(jnp.where(ratio > floor, ratio, floor))
    alpha_min = alpha_limit(rows.alpha_min, config)
    reach = jnp.where(live, reach_of(lax.stop_gradient(opacity), alpha_min), 0)
    colors = colors_of(rows._replace(means=means), camera, exposure, live)
    shape = (1 / jnp.sqrt(a), b / a, jnp.sqrt(a / det))
    if config.blends_ray_depth:
        filtered = a, b, c, det, config.dilation
        numbers = ray_numbers(camera, exposure, quat, scales, filtered)
        shape = (*shape, *(jnp.where(live, number, 1) for number in numbers))
    key, normals = (), None
    if config.sorts_pixels:
        key = key_numbers(camera, exposure, quat, scales)
        key = tuple(jnp.where(live, number, 1) for number in key)
    if "normals" in config.outputs:
        normals = ray_normals(exposure, quat, scales)
        normals = tuple(jnp.where(live, n, 0) for n in normals)
    return Projected(
        u=u,
        v=v,
        depth=camera.lens.depth((x, y, z)),
        shape=(*shape, jnp.where(live, opacity, 0)),
        outline=(c, det),
        reach=reach,
        colors=colors,
        normals=normals,
        key=key,
    )


def _either(holds: Array, wide, narrow) -> tuple[Array, ...]:
    """Return a row of seven columns, or one of three where that does not hold."""
    zeros = (jnp.zeros_like(narrow[0]),) * (len(wide) - len(narrow))
    return tuple(jnp.where(holds, w, n) for w, n in zip(wide, (*narrow, *zeros)))


ELLIPSOID = Primitive(
    name="ellipsoid",
    bounds=bounds,
    order_depth=order_depth,
    project=project,
    occluders=occluders,
    ray_form=RAY_FORM,
    key=ray_key,
)
