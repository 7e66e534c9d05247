"""Projection: Gaussians and a camera → `Projected`, by `gsjax.raster.primitives.ewa`.

Of the slots that `order.depth_order` found, and no others, front to back.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import LENS_RANGE, NEAREST, Camera, camera_centre
from gsjax.gaussians import Gaussians
from gsjax.math import sh as sh_lib
from gsjax.math.numerics import exp_log_scale, held, near_one, once, safe_normalize
from gsjax.raster.primitives.ewa import dilated, half_covariance, transform_point
from gsjax.raster.size_buckets import run_at_bucket
from gsjax.raster.types import COLOR_LIMIT, Array, Projected, RasterConfig
from gsjax.raster.vmap_branching import any_in_batch


def usable(camera: Camera) -> Array:
    """Whether a camera can draw at all; under jit a bad one cannot be refused."""
    low, high = LENS_RANGE
    focal = jnp.stack([camera.K[0, 0], camera.K[1, 1]])
    centre = jnp.abs(jnp.stack([camera.K[0, 2], camera.K[1, 2]]))
    good = jnp.all(jnp.isfinite(camera.viewmat[:3]))
    return good & jnp.all((focal > low) & (focal < high) & (centre < high))


def in_depth_range(camera: Camera, z: Array) -> Array:
    """Where camera z is drawn; a NaN is not."""
    return (z > camera.near) & (z > NEAREST) & (z < camera.far)


def reach_of(opacity: Array, config: RasterConfig) -> Array:
    """Q = 2 ln(opacity / cut) at which α meets the cut; 0 if it never does."""
    seen = opacity > config.alpha_min
    return 2 * jnp.log(jnp.where(seen, opacity / config.alpha_min, 1))


def project(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig,
    order: Array,
    count: Array,
    features: Array | None = None,
    probe: Array | None = None,
    abs_probe: Array | None = None,
) -> Projected:
    """Project the slots ``order`` [R], of which the first ``count`` are there.

    Every input of a dead rank is replaced before it is used, so that neither values
    nor derivatives can leak, whatever the slot holds.

    Args:
      gaussians: capacity N.
      camera: a single camera.
      config: dilation, antialias and alpha_min are used.
      order, count: from `order.depth_order`.
      features: [N, C] used in place of SH colour, or None.
      probe: [N, 2] added to the projected means; its gradient is the densification
        statistic. Or None.
      abs_probe: [N, 2] zeros that collect the absolute gradient. Or None.
    """
    room = order.shape[0]
    order = jnp.minimum(order, gaussians.capacity - 1)
    rows = jax.tree.map(lambda a: a[order], gaussians.params)
    colour_rows = rows.sh if features is None else features[order]
    components = _Components(
        means=_columns(rows.means),
        quats=_columns(rows.quats),
        log_scales=_columns(rows.log_scales),
        logit_opacities=rows.logit_opacities,
        colors=_blocks(colour_rows.reshape(room, -1), colour_rows.shape[-1]),
        shift=None if probe is None else _columns(probe[order]),
    )

    def some(size: int, components: _Components, camera, count) -> Projected:
        live = lax.iota(jnp.int32, size) < count
        front = jax.tree.map(lambda a: a[..., :size], components)
        out = _project_components(front, camera, config, live, features is None)
        if size == room:
            return out

        # As an update at a place that XLA (jax 0.10.2) does not know to be 0: else it
        # makes a pad of it, fuses that with all that leads to ``a``, and evaluates
        # this element by element over the whole room.
        zero = jnp.minimum(count, 0)

        def among(unseen: Array, a: Array) -> Array:
            return lax.dynamic_update_slice(unseen, a, (zero,) * a.ndim)

        return jax.tree.map(among, _unseen(out, room), out)

    def none(*operands) -> Projected:
        return _unseen(jax.eval_shape(partial(some, room), *operands), room)

    def run(size: int) -> Projected:
        project_some = jax.checkpoint(partial(some, size))
        some_live = any_in_batch(count > 0)
        return lax.cond(some_live, project_some, none, components, camera, count)

    # Two sizes: every one more costs seconds of compiling.
    out = run_at_bucket(count, room, min(config.num_size_buckets, 2), run, step=16)
    return out if abs_probe is None else out._replace(probe=abs_probe[order].T)


def ellipses(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig,
    slots: Array,
    count: Array,
    features: Array | None,
) -> tuple[Array, ...]:
    """u, v, inv_sx, slope, inv_sy, opacity [R] of slots, of which the first ``count``
    are there; see `Projected`.

    Of colours only whether they can be drawn, and quick to compile: for a few. No
    derivative is taken here.
    """
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
    p = _project_components(components, camera, config, live, harmonic=False)
    return p.u, p.v, p.inv_sx, p.slope, p.inv_sy, p.opacity


def _columns(rows: Array) -> tuple[Array, ...]:
    """The columns of [R, M], [R] each."""
    return tuple(block[0] for block in _blocks(rows, 1))


def _blocks(rows: Array, width: int) -> tuple[Array, ...]:
    """The columns of [R, M], ``width`` at a time: [width, R] each.

    By `lax.split`, whose transpose puts M derivatives side by side. That of M slices is
    the sum of M arrays of zeros with one column each, which XLA's CPU backend (jax
    0.10.2) forms number by number: M² operations a row.
    """
    return tuple(lax.split(rows.T, (width,) * (rows.shape[1] // width), axis=0))


class _Components(NamedTuple):
    """Parameters of the ranks, [R] each: see `GaussianParams`.

    Attributes:
      colors: K coefficients [3, R] each, or features, [C, R].
      shift: of the projected mean, px, or None.
    """

    means: tuple[Array, ...]
    quats: tuple[Array, ...]
    log_scales: tuple[Array, ...]
    logit_opacities: Array
    colors: tuple[Array, ...]
    shift: tuple[Array, ...] | None


def _unseen(like: Projected, count: int) -> Projected:
    """Ranks of which nothing shows, of the types and channels of others."""
    empty = jax.tree.map(lambda a: jnp.zeros((*a.shape[:-1], count), a.dtype), like)
    ones = jnp.ones_like(empty.u)
    return empty._replace(inv_sx=ones, inv_sy=ones, det=ones)


def _project_components(
    rows: _Components,
    camera: Camera,
    config: RasterConfig,
    live: Array,
    harmonic: bool,
) -> Projected:
    """The arithmetic of `project`, on components.

    `project` runs it in a branch of its own, for two reasons. How it is fused, and so
    rounded, then does not depend on what uses it: images are the same bits whatever
    the capacity and the devices. And XLA's CPU backend evaluates a shared value anew
    for each use that indexes it differently (jax 0.10.2): were the derivatives by x, y
    and z put into one array in the same loop, they would cost as much as all the rest
    of a render. It is recomputed in the backward pass rather than kept.
    """
    for values in rows.colors:
        for value in values:
            live &= jnp.abs(value) < COLOR_LIMIT
    quat, good = near_one(
        tuple(jnp.where(live, q, 1) for q in rows.quats), (1.0, 0.0, 0.0, 0.0)
    )
    live = held(live & good)
    means = tuple(jnp.where(live, m, 0) for m in rows.means)
    scales = tuple(exp_log_scale(jnp.where(live, s, 0)) for s in rows.log_scales)
    x, y, z = transform_point(camera.viewmat, means)
    # Where the world is far away it is off by as much as that: not at the lens.
    live &= z > 0.5 * camera.near
    # A dead rank's mean is the origin, which may lie anywhere: park it at z = 1.
    x, y, z = jnp.where(live, x, 0), jnp.where(live, y, 0), jnp.where(live, z, 1)
    x, y, z = once((x, y, z), live)
    u, v = camera.model.project(camera.K, (x, y, z))
    if rows.shift is not None:
        u, v = (a + b.astype(a.dtype) for a, b in zip((u, v), rows.shift))
    live = held(live & (jnp.abs(u) < jnp.inf) & (jnp.abs(v) < jnp.inf))

    m1, m2 = half_covariance(camera, (x, y, z), quat, scales)
    m1, m2 = once(m1, live), once(m2, live)
    a, b, c, det, det_sharp = dilated(m1, m2, config.dilation)
    live = held(live & (det > 0) & (det < jnp.inf) & (a < jnp.inf) & (c < jnp.inf))
    a, b, c = jnp.where(live, a, 1), jnp.where(live, b, 0), jnp.where(live, c, 1)
    det = jnp.where(live, det, 1)
    # sqrt(max(0.005², ratio)): the floor of Mip-Splatting and gsplat.
    ratio = jnp.where(live, det_sharp, 1) / det
    floor = 0.005**2
    compensation = jnp.sqrt(jnp.where(ratio > floor, ratio, floor))

    opacity = jax.nn.sigmoid(jnp.where(live, rows.logit_opacities, 0))
    if config.antialias:
        opacity = opacity * compensation
    reach = jnp.where(live, reach_of(lax.stop_gradient(opacity), config), 0)
    if harmonic:
        colors = _sh_colors(camera, means, rows.colors, live)
    else:
        (features,) = rows.colors
        colors = jnp.where(live, features, 0)
    return Projected(
        u=u,
        v=v,
        depth=z,
        inv_sx=1 / jnp.sqrt(a),
        slope=b / a,
        inv_sy=jnp.sqrt(a / det),
        var_y=c,
        det=det,
        opacity=jnp.where(live, opacity, 0),
        reach=reach,
        colors=colors,
        compensation=compensation,
        probe=None,
    )


def _sh_colors(camera: Camera, means, coefficients, live: Array) -> Array:
    """Colour [3, R] of K coefficients [3, R] seen from the camera; + 0.5, ≥ 0.

    The channels together: a third as many derivatives, each a kernel to compile. Over
    K summed in plain sight: as a reduction of [K, 1, R] · [K, 3, R], XLA's CPU backend
    (jax 0.10.2, YNNPACK) gets it wrong from some 10⁴ Gaussians on.
    """
    degree = sh_lib.degree_of(len(coefficients))
    if degree == 0:
        basis = [sh_lib.C0]
    else:
        centre = camera_centre(camera.viewmat)
        offset = tuple(m - c for m, c in zip(means, centre))
        direction, _ = safe_normalize(offset, (0.0, 0.0, 1.0))
        basis = sh_lib.sh_basis(degree, *direction)
    raw = sum(value * jnp.where(live, c, 0) for value, c in zip(basis, coefficients))
    raw = raw + 0.5
    return jnp.where(raw > 0, raw, 0)


def conics_of(projected: Projected) -> Array:
    """Inverse 2D covariances [R, 3] as (xx, xy, yy), for comparison with others."""
    var_x = 1 / (projected.inv_sx * projected.inv_sx)
    cov_xy = projected.slope * var_x
    entries = (projected.var_y, -cov_xy, var_x)
    return jnp.stack([entry / projected.det for entry in entries], -1)
