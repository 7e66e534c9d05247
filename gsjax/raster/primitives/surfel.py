"""Surfels: flat Gaussians in space, met by the ray of each pixel (Huang et al. 2024).

The first two scales are standard deviations along the first two axes of the rotation;
the third axis is the normal, and the third scale is not used.

With M [2 × 2] the derivative of the image by a and b, the place on the surfel in
standard deviations, and with L a triangular factor of M Mᵀ, y = L⁻¹ d of the offset d
of a pixel is (a, b) up to a rotation, to first order. In a perspective image it is

    (a, b) = y / e,   e = 1 + w · y = z₀ / z,

exactly, where z is the depth of the point that the pixel shows and
w = −L⁻¹ M ∂z/∂(a, b) / z₀. So α = opacity · exp(−½ |y|² / e²). No number diverges for a
surfel seen from its edge but L⁻¹, and a filter limits that one:

- "floor" (the paper's): ρ = min(|y|² / e², 2 |d|²). A surfel is at least a blob of
  standard deviation √½ px. One that is smaller covers more than its share.
- "area": the covariance M Mᵀ is dilated, and w with it is what the offset in front of
  the filter is expected to be. With antialias, the opacity makes up for the area.

Other lenses are perspective about the mean of each surfel, to first order.

Axis legend: N Gaussians (capacity), R ranks (front to back), K slots.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.cameras.shutter import entry, expose, image_rows
from gsjax.errors import InputError
from gsjax.math import rotations
from gsjax.math.numerics import (
    exp_log_scale,
    materialize,
    materialize_mask,
    near_one,
    safe_divide,
)
from gsjax.raster.forms import (
    AtPixel,
    Form,
    Numbers,
    Once,
    Parts,
    Plane,
)
from gsjax.raster.primitives.ellipsoid import gains_of
from gsjax.raster.primitives.ewa import lens_jacobian, once, shortened
from gsjax.raster.primitives.rows import (
    Components,
    Projected,
    Size,
    alpha_limit,
    boxes,
    candidates,
    colors_of,
    cross,
    depth_slopes,
    dot,
    order_depth,
    project_rows,
    reach_of,
    seen_slots,
)
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

FLOOR = 0.5  # px², variance of the low-pass filter of Huang et al.
# Cosine between the normal and the ray below which a surfel is seen from its edge and
# not drawn; smallest standard deviation in px, far below the filter.
_EDGE, _SMALLEST = 1e-5, 1e-3
_LEAST = 1e-6  # of e; behind the camera it is negative
_FAINT = -1e4  # a power at which nothing shows


def _parts(filter: str, shape: Numbers) -> Parts:
    inv_sx, slope, inv_sy, w1, w2, depth, nearest = shape
    by_y = w2 * inv_sy
    planes = (
        Plane(0.0, inv_sx, 0.0),
        Plane(0.0, -inv_sy * slope, inv_sy),
        Plane(1.0, w1 * inv_sx - by_y * slope, by_y),
    )
    if filter == "floor":
        planes += (Plane(0.0, 1.0, 0.0), Plane(0.0, 0.0, 1.0))
    return Parts(planes, depth, (nearest,))


def _evaluate(values: Numbers, depth, limits: Numbers, once: Once) -> AtPixel:
    """Return a surfel at a pixel.

    Args:
      values: y1, y2 and e; with a floor, the offset too.
      depth: z₀.
      limits: near / z₀.
    """
    y1, y2, e, *offset = values
    (nearest,) = limits
    depth = jnp.where(depth > 0, depth, 1)  # 0 where a list has ended
    over = _inverse(e)
    power = once(-0.5 * (y1 * y1 + y2 * y2) * (over * over))
    there = depth * over
    disparity = e / depth
    if offset:
        dx, dy = offset
        low = -(0.5 / FLOOR) * (dx * dx + dy * dy)
        by_ray = power >= low
        power = jnp.where(by_ray, power, low)
        there = jnp.where(by_ray, there, depth)
        disparity = jnp.where(by_ray, disparity, 1 / depth)
    # As a sum: no derivative passes where α is 0 anyway.
    missed = lax.stop_gradient(jnp.where(over > nearest, 0, _FAINT))
    return AtPixel(power + missed, there, disparity)


@jax.custom_jvp
def _inverse(e: Array) -> Array:
    """Return 1 / e where the ray meets the surfel in front of the camera; else −1."""
    return 1 / jnp.where(e > _LEAST, e, -1)


@_inverse.defjvp
def _inverse_jvp(primals, tangents):
    over = _inverse(*primals)
    return over, -over * over * tangents[0]


def bounds(
    filter: str,
    active: Array,
    values: tuple[Array, ...],
    camera: Camera,
    config: RasterConfig,
    alpha_min: Array | None = None,
) -> Bounds:
    """Return conservative bounds of slots [K]; see `ellipsoid.bounds`."""
    means, (a, b, _), logits = values[0].T, values[1].T, values[2]
    seen = seen_slots(active, means, (a, b, logits), camera)
    a, b = (exp_log_scale(jnp.where(seen.live, s, 0)) for s in (a, b))
    largest, smallest = jnp.maximum(a, b), jnp.minimum(a, b)
    opacity = jax.nn.sigmoid(logits)
    reach = reach_of(opacity, alpha_limit(alpha_min, config))
    # Perspective enlarges what is nearer than the mean, down to the near plane.
    depth = jnp.where(seen.live, seen.depth, 1)
    nearer = 1 - jnp.sqrt(reach) * largest / depth * 1.001
    grows = 1 / jnp.maximum(nearer, camera.near / depth)
    jacobian = lens_jacobian(camera, seen.exposure.point)
    gains = gains_of(camera, seen.exposure, jacobian)
    size = Size(
        squares=[(largest * grows) ** 2 * gain for gain in gains],
        middles=[smallest * smallest * gain for gain in gains],
        dilation=FLOOR if filter == "floor" else config.dilation * grows * grows,
    )
    return boxes(seen, size, opacity, reach, camera)


def project(
    filter: str, inputs: Inputs, config: RasterConfig, order: Array, count: Array
) -> Projection:
    """Project the slots ``order`` [R]; see `ellipsoid.project`.

    Raises:
      InputError: if rays are parallel.
    """
    if inputs.camera.lens.name == "orthographic":
        raise InputError(
            "camera: expected a lens whose rays meet for surfels, got orthographic; "
            "move a pinhole camera far away and lengthen its focal length"
        )
    arithmetic = partial(_project_components, filter)
    return project_rows(arithmetic, _footprint, inputs, config, order, count)


def occluders(
    filter: str, inputs: Inputs, config: RasterConfig, slots: Array, count: Array
) -> Splat:
    """Return splats [K] for occlusion culling, without the blobs of small surfels."""
    components, live = candidates(inputs, slots, count)
    out = _project_components(filter, components, inputs.camera, config, live)
    return Splat(out.u, out.v, out.shape)


def _project_components(
    filter: str, rows: Components, camera: Camera, config: RasterConfig, live: Array
) -> Projected:
    """Do the arithmetic of `project`, on components."""
    quat, good = near_one(
        tuple(jnp.where(live, q, 1) for q in rows.quats), (1.0, 0.0, 0.0, 0.0)
    )
    live = materialize_mask(live & good & rows.drawable)
    means = tuple(jnp.where(live, m, 0) for m in rows.means)
    exposure = expose(camera, means)
    x, y, z = exposure.point
    live &= camera.lens.depth((x, y, z)) > 0.5 * camera.near
    x, y, z = jnp.where(live, x, 0), jnp.where(live, y, 0), jnp.where(live, z, 1)
    x, y, z = materialize((x, y, z), live)
    point = x, y, z
    exposure = exposure._replace(point=point)
    depth = camera.lens.depth(point)
    u, v = once(camera, camera.project(point))
    if rows.shift is not None:
        u, v = (a + b.astype(a.dtype) for a, b in zip((u, v), rows.shift))
    live &= (jnp.abs(u) < jnp.inf) & (jnp.abs(v) < jnp.inf)

    axes, normal = _axes(quat)
    images = image_rows(camera, exposure, lens_jacobian(camera, point))
    images = [once(camera, row) for row in images]
    across = cross(*images)
    area = jnp.sqrt(dot(across, across))
    cosine = dot(across, normal) / area
    live = materialize_mask(live & (jnp.abs(cosine) > _EDGE) & (area < jnp.inf))
    smallest = _SMALLEST / jnp.sqrt(jnp.where(live, area, 1))
    scales = [exp_log_scale(jnp.where(live, s, 0)) for s in rows.log_scales[:2]]
    scales = [jnp.where(s > smallest, s, smallest) for s in scales]
    m1, m2 = (tuple(dot(row, a) * s for a, s in zip(axes, scales)) for row in images)
    m1, m2 = shortened(m1, m2)
    m1, m2 = materialize(m1, live), materialize(m2, live)
    away = depth_slopes(camera, exposure)
    pulls = tuple(-dot(away, a) * s / depth for a, s in zip(axes, scales))
    opacity = jax.nn.sigmoid(jnp.where(live, rows.logit_opacities, 0))
    minor = scales[0] * scales[1] * dot(across, normal)
    shape, live, ratio = _factored(filter, (m1, m2), pulls, minor, live, config)
    if filter == "area" and config.antialias:
        opacity = opacity * jnp.sqrt(ratio)
    opacity = jnp.where(live, opacity, 0)
    reach = reach_of(lax.stop_gradient(opacity), alpha_limit(rows.alpha_min, config))
    shape = (*shape, depth, jnp.where(live, camera.near / depth, 0.5))
    facing = jnp.where(cosine > 0, -1, 1)  # ``across`` leads away from the eye
    seen_from = [
        facing * sum(entry(exposure.viewmat, i, j) * normal[j] for j in range(3))
        for i in range(3)
    ]
    place = jnp.where(live, u, 0), jnp.where(live, v, 0)
    fixed = lax.stop_gradient((place, shape))
    outline = _outline(filter, *fixed, reach, camera)
    return Projected(
        u=u,
        v=v,
        depth=depth,
        shape=(*shape, opacity),
        outline=outline,
        reach=jnp.where(live, reach, 0),
        colors=colors_of(rows._replace(means=means), camera, exposure, live),
        normals=tuple(seen_from) if "normals" in config.outputs else None,
    )


def _axes(quat):
    """Return the two tangents and the normal in world coordinates, [R] components."""
    rotation = rotations.rotation_rows(*quat)
    over = 1 / sum(q * q for q in quat)
    columns = [tuple(row[j] * over for row in rotation) for j in range(3)]
    return columns[:2], columns[2]


def _factored(filter: str, m, pulls, minor: Array, live: Array, config: RasterConfig):
    """Return inv_sx, slope, inv_sy, w1, w2; what is live; and the ratio of areas.

    ``minor`` is the determinant of M.
    """
    m1, m2 = m
    dilation = config.dilation if filter == "area" else 0.0
    a, b, c = dot(m1, m1), dot(m1, m2), dot(m2, m2)
    sharp = minor * minor
    det = sharp + dilation * (a + c) + dilation * dilation
    a, c = a + dilation, c + dilation
    live = materialize_mask(
        live & (det > 0) & (det < jnp.inf) & (a > 0) & (a < jnp.inf) & (c < jnp.inf)
    )
    a, b, det = jnp.where(live, a, 1), jnp.where(live, b, 0), jnp.where(live, det, 1)
    inv_sx, slope = 1 / jnp.sqrt(a), b / a
    # The derivative of a / det has det⁻², which overflows for a small surfel seen from
    # its edge.
    root = jnp.abs(minor) if filter == "floor" else jnp.sqrt(det)
    inv_sy = jnp.sqrt(a) / jnp.where(live, root, 1)
    m1, m2 = ([jnp.where(live, n, 0) for n in row] for row in m)
    pulls = [jnp.where(live, p, 0) for p in pulls]
    w1 = inv_sx * dot(m1, pulls)
    if filter == "floor":  # the rows of L⁻¹ M are orthonormal
        side = jnp.where(minor > 0, inv_sx, -inv_sx)
        w2 = side * (m1[0] * pulls[1] - m1[1] * pulls[0])
    else:
        w2 = inv_sy * sum(p * (q - slope * r) for p, q, r in zip(pulls, m2, m1))
    return (inv_sx, slope, inv_sy, w1, w2), live, jnp.where(live, sharp, 1) / det


def _outline(
    filter: str, place: Numbers, shape: Numbers, reach: Array, camera: Camera
) -> tuple[Array, ...]:
    """Return shift of the centre (u, v) and covariance a, b, c, det of an ellipse.

    It holds all offsets in the image with |y| ≤ q e, q² = ``reach``, that meet the
    surfel beyond the near plane. In the direction of w, |y| ≤ q e is a conic with its
    focus at the centre and of eccentricity k = q |w|; from its vertex, at q / (1 + k)
    before the focus, its half width t at distance x is t² = 2 q x + (k² − 1) x². The
    ellipse is the conic itself, or the least one about its first part, to x = D, if
    that is smaller: of half axes 2 D / 3 and 2 t / √3, about x = 2 D / 3. With a floor
    it holds the blob, too.
    """
    inv_sx, slope, inv_sy, w1, w2, _, nearest = shape
    sx, sy = 1 / inv_sx, 1 / inv_sy
    steep = jnp.sqrt(w1 * w1 + w2 * w2)
    tilted = steep > 0
    n1 = jnp.where(tilted, safe_divide(w1, steep, tilted), 1)
    n2 = safe_divide(w2, steep, tilted)
    # L n, and L times the vector across.
    along = sx * n1, sx * slope * n1 + sy * n2
    across = -sx * n2, -sx * slope * n2 + sy * n1
    q = jnp.sqrt(reach)
    k = q * steep
    # Largest y · n in the image, and in front of the near plane, over q.
    v_side = inv_sy * n2
    u_side = inv_sx * n1 - slope * v_side
    end = _farthest(u_side, place[0], camera.width)
    end += _farthest(v_side, place[1], camera.height)
    end = safe_divide(jnp.maximum(end, 0), q, q > 0)
    near = safe_divide(1 / nearest - 1, k, k > 0)
    end = jnp.where(k > 0, jnp.minimum(end, near), end)
    first = 1 / (1 + k)
    length = end + first
    wide = k * length
    part = (3 - 2 * length + 2 * k * wide >= 0) | (k >= 1)
    square = jnp.where(part, 0, k * k)
    whole = 1 / (1 - square)
    shift = q * jnp.where(part, 2 / 3 * length - first, k * whole)
    long = jnp.where(part, jnp.square(2 / 3 * length), whole * whole)
    half = jnp.where(part, length * (2 - length) + wide * wide, 0)
    short = jnp.where(part, 4 / 3 * half, whole)
    a = long * along[0] ** 2 + short * across[0] ** 2
    b = long * along[0] * along[1] + short * across[0] * across[1]
    c = long * along[1] ** 2 + short * across[1] ** 2
    det = long * short * jnp.square(sx * sy)
    if filter == "floor":
        # An ellipse about the sum of the part, which holds the focus, and the blob.
        blob = FLOOR / jnp.square(1 - jnp.where(part, 0, k))
        more = jnp.maximum(blob - safe_divide(det, a + c, a + c > 0), 0)
        more = jnp.where(part, 5 * FLOOR, more)
        times = jnp.where(part, 1.25, 1)
        det = times * (times * det + more * (a + c)) + more * more
        a, b, c = times * a + more, times * b, times * c + more
    return shift * along[0], shift * along[1], a, b, c, det


def _farthest(side: Array, place: Array, size) -> Array:
    """Return the largest ``side`` · (x − place) of x in an image of that size."""
    return jnp.where(side > 0, side * (size - place), -side * place)


def _footprint(out: Projected) -> Footprint:
    du, dv, a, b, c, det = out.outline
    return Footprint(
        u=out.u + du,
        v=out.v + dv,
        inv_sx=1 / jnp.sqrt(a),
        slope=b / a,
        var_y=c,
        det=det,
        reach=out.reach,
    )


def _surfel(name: str, filter: str) -> Primitive:
    return Primitive(
        name=name,
        bounds=partial(bounds, filter),
        order_depth=order_depth,
        project=partial(project, filter),
        occluders=partial(occluders, filter),
        form=Form(
            parts=partial(_parts, filter),
            evaluate=_evaluate,
            has_depth=True,
            convex_parts=partial(_parts, "area"),
        ),
    )


SURFEL = _surfel("surfel", "floor")
SURFEL_AREA = _surfel("surfel_area", "area")
