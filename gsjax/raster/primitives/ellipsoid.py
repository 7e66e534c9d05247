"""Ellipsoids by EWA splatting (Zwicker et al. 2001), or by the unscented transform.

The default primitive.

Axis legend: N Gaussians (capacity), R ranks (front to back), K slots, C channels.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import LENS_RANGE, NEAREST, Camera, camera_centre
from gsjax.cameras.lenses import everywhere, z_depth
from gsjax.cameras.shutter import (
    Exposure,
    Moment,
    centre,
    expose,
    exposed_at,
    image_rows,
)
from gsjax.math import sh as sh_lib
from gsjax.math.numerics import (
    exp_log_scale,
    materialize,
    materialize_mask,
    near_one,
    safe_normalize,
)
from gsjax.raster.lists.occlusion_culling import is_wide
from gsjax.raster.primitives.ewa import covariance_factor, dilated, ewa_jacobian, once
from gsjax.raster.primitives.unscented import unscented_image
from gsjax.raster.size_buckets import run_at_bucket
from gsjax.raster.types import (
    COLOR_LIMIT,
    Array,
    Bounds,
    Box,
    Channels,
    Footprint,
    Inputs,
    Primitive,
    Projection,
    RasterConfig,
    Splat,
)
from gsjax.raster.vmap_branching import any_in_batch

_FASTEST = 1e4  # rad of rotation in an exposure; squares then fit float32


def usable(camera: Camera) -> Array:
    """Return whether a camera can draw; under jit a bad one cannot be rejected."""
    low, high = LENS_RANGE
    focal = jnp.stack([camera.K[0, 0], camera.K[1, 1]])
    centre = jnp.abs(jnp.stack([camera.K[0, 2], camera.K[1, 2]]))
    good = jnp.all(jnp.isfinite(camera.viewmat[:3]))
    for extra in (camera.coefficients, camera.twist):
        if extra is not None:
            good &= jnp.all(jnp.isfinite(extra))
    if camera.twist is not None:
        good &= jnp.all(jnp.abs(camera.twist[:3]) < _FASTEST)
    return good & jnp.all((focal > low) & (focal < high) & (centre < high))


def in_depth_range(camera: Camera, depth: Array) -> Array:
    """Return where a depth is drawn; False for NaN."""
    return (depth > camera.near) & (depth > NEAREST) & (depth < camera.far)


def reach_of(opacity: Array, alpha_min: float | Array) -> Array:
    """Return Q = 2 ln(opacity / alpha_min), where α meets the limit; else 0."""
    seen = opacity > alpha_min
    return 2 * jnp.log(jnp.where(seen, opacity / alpha_min, 1))


def _alpha_min(alpha_min: Array | None, config: RasterConfig) -> float | Array:
    return config.alpha_min if alpha_min is None else alpha_min


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
    exposure = expose(camera, tuple(means))
    x, y, z = exposure.point
    depth = camera.lens.depth((x, y, z))
    if depth.dtype == jnp.float32:
        # Rounded once, so that a Gaussian behind another one is not before it.
        with jax.enable_x64(True):
            depth = _wide_depth(means, camera, exposure.moment)
            depth = lax.convert_element_type(depth, jnp.float32)
    live = active & in_depth_range(camera, depth) & jnp.isfinite(logits)
    live &= usable(camera)
    for value in (*means, *log_scales):
        live &= jnp.isfinite(value)
    if camera.lens.valid is not everywhere:
        live &= camera.lens.valid(camera.K, camera.coefficients, (x, y, z))
    z = depth if camera.lens.depth is z_depth else z
    point = (jnp.where(live, x, 0), jnp.where(live, y, 0), jnp.where(live, z, 1))
    centres = camera.project(point)
    a, b, c = (jnp.where(live, s, 0) for s in log_scales)
    low, high = jnp.minimum(a, b), jnp.maximum(a, b)
    largest = exp_log_scale(jnp.maximum(high, c))
    middle = exp_log_scale(jnp.maximum(low, jnp.minimum(high, c)))
    gains = _gains(camera, exposure._replace(point=point))
    squares = [largest * largest * gain for gain in gains]
    if config.projection == "unscented":
        centres, squares = _unscented_bounds(
            values, live, camera, config, centres, squares
        )
    opacity = jax.nn.sigmoid(logits)
    reach = reach_of(opacity, _alpha_min(alpha_min, config))
    extents, wide = [], jnp.zeros_like(live)
    for place, gain, square, size in zip(centres, gains, squares, camera.visible):
        extent = jnp.sqrt(reach * (square + config.dilation))
        extent = extent * 1.001 + 0.01  # room for rounding
        # Phrased so that neither an overflow nor a NaN gets through.
        live &= (square < jnp.inf) & (jnp.abs(place) < jnp.inf)
        live &= (place + extent >= 0.5) & (place - extent <= size - 0.5)
        extents.append(extent)
        wide |= is_wide(middle * middle * gain, opacity)
    live &= reach > 0
    box = Box(*centres, *extents)
    return Bounds(jnp.where(live, depth, jnp.inf), box, live & wide)


def _gains(camera: Camera, exposure: Exposure) -> list[Array]:
    """Return the largest squared stretch of world lengths along u and v."""
    jacobian = ewa_jacobian(camera, exposure.point)
    if exposure.velocity is not None:
        rows = image_rows(camera, exposure, jacobian)
        return [a * a + b * b + c * c for a, b, c in rows]
    # A view matrix that scales, as one being optimised may, enlarges what it shows.
    rotation = camera.viewmat[:3, :3]
    gram = jnp.sum(rotation[:, None] * rotation[None], axis=-1)
    stretch = jnp.maximum(jnp.max(jnp.sum(jnp.abs(gram), axis=1)), 1)
    return [stretch * sum(j * j for j in row) for row in jacobian]


def _unscented_bounds(values, live: Array, camera: Camera, config, centres, squares):
    """Return centres and variances of the transform, where it holds."""
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


def order_depth(means: Array, camera: Camera) -> Array:
    """Return the float64 depth [K] of means [K, 3]; call within `jax.enable_x64`."""
    return _wide_depth(means.T, camera)


def _wide_depth(means, camera: Camera, moment: Moment | None = None) -> Array:
    """Depth [K] in float64 of components; within `jax.enable_x64(True)`.

    Args:
      means: components [K] in world coordinates.
      camera: a single camera.
      moment: from `expose`, or None.
    """

    def wide(value: Array) -> Array:
        return lax.convert_element_type(value, jnp.float64)

    if camera.shutter.rolling:
        exact = jax.tree.map(wide, camera)
        means = tuple(wide(m) for m in means)
        if moment is None:
            return camera.lens.depth(expose(exact, means).point)
        exactly = jax.tree.map(wide, moment)
        return camera.lens.depth(exposed_at(exact, means, exactly))

    def coordinate(i: int) -> Array:
        row = camera.viewmat[i]
        return sum(wide(row[j]) * wide(means[j]) for j in range(3)) + wide(row[3])

    if camera.lens.depth is z_depth:
        return coordinate(2)
    return camera.lens.depth((coordinate(0), coordinate(1), coordinate(2)))


def project(
    inputs: Inputs, config: RasterConfig, order: Array, count: Array
) -> Projection:
    """Project the slots ``order`` [R], of which the first ``count`` are used.

    Every input of an unused rank is replaced before use, so that neither its values nor
    its derivatives can leak, whatever the slot holds.

    Args:
      inputs: Gaussians, camera, features and probe.
      config: dilation, antialias, alpha_min and num_size_buckets are used.
      order, count: from `gsjax.raster.lists.depth_order`.
    """
    gaussians, camera = inputs.gaussians, inputs.camera
    features, probe = inputs.features, inputs.probe
    room = order.shape[0]
    order = jnp.minimum(order, gaussians.capacity - 1)
    rows = jax.tree.map(lambda a: a[order], gaussians.params)
    color_rows = rows.sh if features is None else features[order]
    shift = None if probe is None or config.absgrad else _columns(probe[order])
    components = _Components(
        means=_columns(rows.means),
        quats=_columns(rows.quats),
        log_scales=_columns(rows.log_scales),
        logit_opacities=rows.logit_opacities,
        colors=_blocks(color_rows.reshape(room, -1), color_rows.shape[-1]),
        shift=shift,
        alpha_min=inputs.alpha_min,
    )

    def some(size: int, components: _Components, camera, count) -> _Projected:
        live = lax.iota(jnp.int32, size) < count
        front = jax.tree.map(lambda a: a[..., :size] if a.ndim else a, components)
        out = _project_components(front, camera, config, live, features is None)
        if size == room:
            return out

        # An update at a place that XLA (jax 0.10.2) does not know to be 0: else it
        # makes a pad of it, fuses that with everything that leads to ``a``, and
        # evaluates it element by element over the whole room.
        zero = jnp.minimum(count, 0)

        def among(unseen: Array, a: Array) -> Array:
            return lax.dynamic_update_slice(unseen, a, (zero,) * a.ndim)

        return jax.tree.map(among, _unseen(out, room), out)

    def none(*operands) -> _Projected:
        return _unseen(jax.eval_shape(partial(some, room), *operands), room)

    def run(size: int) -> _Projected:
        project_some = jax.checkpoint(partial(some, size))
        some_live = any_in_batch(count > 0)
        return lax.cond(some_live, project_some, none, components, camera, count)

    # Two sizes at most: each further one costs seconds of compiling.
    out = run_at_bucket(count, room, min(config.num_size_buckets, 2), run, step=16)
    absolute = probe if config.absgrad else None
    return Projection(
        footprint=Footprint(
            out.u, out.v, out.inv_sx, out.slope, out.var_y, out.det, out.reach
        ),
        splat=out.splat,
        channels=Channels(
            colors=out.colors,
            depth=out.depth,
            probe=None if absolute is None else absolute[order].T,
            alpha_min=inputs.alpha_min,
        ),
    )


def occluders(
    inputs: Inputs, config: RasterConfig, slots: Array, count: Array
) -> Splat:
    """Return the splats [K] of ``slots``, of which the first ``count`` are used.

    Quick to compile, for a few slots. Colours are only checked for being drawable. No
    derivative is taken.
    """
    gaussians, camera, features = inputs.gaussians, inputs.camera, inputs.features
    params = gaussians.params
    rows = jax.tree.map(
        lambda a: a.at[slots].get(mode="clip").T,
        (params.means, params.quats, params.log_scales, params.logit_opacities),
    )
    means, quats, log_scales, logits = rows
    components = _Components(
        means=tuple(means),
        quats=tuple(quats),
        log_scales=tuple(log_scales),
        logit_opacities=logits,
        colors=(jnp.zeros_like(logits)[None],),
        shift=None,
    )
    live = lax.iota(jnp.int32, slots.shape[0]) < count
    colors = params.sh if features is None else features
    rows = colors.at[slots].get(mode="clip").reshape(slots.shape[0], -1)
    live &= jnp.all(jnp.abs(rows) < COLOR_LIMIT, axis=1)
    return _project_components(components, camera, config, live, harmonic=False).splat


def _columns(rows: Array) -> tuple[Array, ...]:
    """Return the columns of [R, M], [R] each."""
    return tuple(block[0] for block in _blocks(rows, 1))


def _blocks(rows: Array, width: int) -> tuple[Array, ...]:
    """Return the columns of [R, M], ``width`` at a time: [width, R] each.

    `lax.split` has a transpose that puts M derivatives side by side. The transpose of M
    slices is a sum of M padded arrays, which XLA's CPU backend (jax 0.10.2) forms with
    M² operations a row.
    """
    return tuple(lax.split(rows.T, (width,) * (rows.shape[1] // width), axis=0))


class _Components(NamedTuple):
    """Parameters of the ranks, [R] each; see `GaussianParams`.

    Attributes:
      colors: K coefficients [3, R] each, or features, one [C, R].
      shift: added to the projected mean, px; or None.
      alpha_min: [] in place of that of the config, or None.
    """

    means: tuple[Array, ...]
    quats: tuple[Array, ...]
    log_scales: tuple[Array, ...]
    logit_opacities: Array
    colors: tuple[Array, ...]
    shift: tuple[Array, ...] | None
    alpha_min: Array | None = None


class _Projected(NamedTuple):
    """Results of the arithmetic, [R], colors [C, R]; see `Footprint` and `Splat`."""

    u: Array
    v: Array
    depth: Array
    inv_sx: Array
    slope: Array
    inv_sy: Array
    var_y: Array
    det: Array
    opacity: Array
    reach: Array
    colors: Array

    @property
    def splat(self) -> Splat:
        shape = (self.inv_sx, self.slope, self.inv_sy, self.opacity)
        return Splat(self.u, self.v, shape)


def _unseen(like: _Projected, count: int) -> _Projected:
    """Return ranks that show nothing, of the types and channels of ``like``."""
    empty = jax.tree.map(lambda a: jnp.zeros((*a.shape[:-1], count), a.dtype), like)
    ones = jnp.ones_like(empty.u)
    return empty._replace(inv_sx=ones, inv_sy=ones, det=ones)


def _project_components(
    rows: _Components,
    camera: Camera,
    config: RasterConfig,
    live: Array,
    harmonic: bool,
) -> _Projected:
    """Do the arithmetic of `project`, on components.

    `project` runs it in a branch of its own, for two reasons. How it is fused, and so
    rounded, then does not depend on its users: images are the same bits whatever the
    capacity and the devices. And XLA's CPU backend evaluates a shared value again for
    each use that indexes it differently (jax 0.10.2). It is recomputed in the backward
    pass instead of stored.
    """
    for values in rows.colors:
        for value in values:
            live &= jnp.abs(value) < COLOR_LIMIT
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
    alpha_min = _alpha_min(rows.alpha_min, config)
    reach = jnp.where(live, reach_of(lax.stop_gradient(opacity), alpha_min), 0)
    if harmonic:
        colors = _sh_colors(camera, exposure, means, rows.colors, live)
    else:
        (features,) = rows.colors
        colors = jnp.where(live, features, 0)
    return _Projected(
        u=u,
        v=v,
        depth=camera.lens.depth((x, y, z)),
        inv_sx=1 / jnp.sqrt(a),
        slope=b / a,
        inv_sy=jnp.sqrt(a / det),
        var_y=c,
        det=det,
        opacity=jnp.where(live, opacity, 0),
        reach=reach,
        colors=colors,
    )


def _either(holds: Array, wide, narrow) -> tuple[Array, ...]:
    """Return a row of seven columns, or one of three where that does not hold."""
    zeros = (jnp.zeros_like(narrow[0]),) * (len(wide) - len(narrow))
    return tuple(jnp.where(holds, w, n) for w, n in zip(wide, (*narrow, *zeros)))


def _sh_colors(
    camera: Camera, exposure: Exposure, means, coefficients, live: Array
) -> Array:
    """Return the colour [3, R] of K coefficients [3, R]: 0.5 + Σ, at least 0.

    The channels are handled together: a third as many derivatives, each a kernel to
    compile. The sum over K is written out: as a reduction of [K, 1, R] · [K, 3, R],
    XLA's CPU backend (jax 0.10.2) gets it wrong from some 10⁴ Gaussians on.
    """
    degree = sh_lib.degree_of(len(coefficients))
    if degree == 0:
        basis = [sh_lib.C0]
    else:
        eye = camera_centre(camera.viewmat)
        if exposure.velocity is not None:
            eye = centre(exposure)
        offset = tuple(m - c for m, c in zip(means, eye))
        direction, _ = safe_normalize(offset, (0.0, 0.0, 1.0))
        basis = sh_lib.sh_basis(degree, *direction)
    raw = sum(value * jnp.where(live, c, 0) for value, c in zip(basis, coefficients))
    raw = raw + 0.5
    return jnp.where(raw > 0, raw, 0)


ELLIPSOID = Primitive("ellipsoid", bounds, order_depth, project, occluders)
