"""Parts that primitives share: checks of slots, bounds, the frame of `project`.

Axis legend: N Gaussians (capacity), R ranks (front to back), K slots, C channels.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import LENS_RANGE, NEAREST, Camera, camera_centre
from gsjax.cameras.lenses import everywhere, z_depth
from gsjax.cameras.shutter import (
    Exposure,
    Moment,
    centre,
    entry,
    expose,
    exposed_at,
)
from gsjax.math import sh as sh_lib
from gsjax.math.numerics import safe_normalize
from gsjax.raster.lists.occlusion_culling import is_wide
from gsjax.raster.size_buckets import run_at_bucket
from gsjax.raster.types import (
    COLOR_LIMIT,
    Array,
    Bounds,
    Box,
    Channels,
    Footprint,
    Inputs,
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


def alpha_limit(alpha_min: Array | None, config: RasterConfig) -> float | Array:
    """Return the lower limit of α."""
    return config.alpha_min if alpha_min is None else alpha_min


def reach_of(opacity: Array, alpha_min: float | Array) -> Array:
    """Return Q = 2 ln(opacity / alpha_min), where α meets the limit; else 0."""
    seen = opacity > alpha_min
    return 2 * jnp.log(jnp.where(seen, opacity / alpha_min, 1))


class Seen(NamedTuple):
    """Slots in camera coordinates, [K] each, for bounds.

    Attributes:
      live: whether a slot may be visible.
      depth: by which it is ordered.
      exposure: from `expose`; ``point`` is (0, 0, 1) where not ``live``.
      centres: (u, v) in px.
    """

    live: Array
    depth: Array
    exposure: Exposure
    centres: tuple[Array, ...]


def seen_slots(
    active: Array, means: Array, numbers: Sequence[Array], camera: Camera
) -> Seen:
    """Return slots as a camera sees them; no derivative is taken.

    Args:
      active: [K] bool.
      means: [3, K].
      numbers: [K] each, which must be finite.
      camera: a single camera.
    """
    exposure = expose(camera, tuple(means))
    x, y, z = exposure.point
    depth = camera.lens.depth((x, y, z))
    if depth.dtype == jnp.float32:
        # Rounded once, so that a Gaussian behind another one is not before it.
        with jax.enable_x64(True):
            depth = _wide_depth(means, camera, exposure.moment)
            depth = lax.convert_element_type(depth, jnp.float32)
    live = active & in_depth_range(camera, depth)
    live &= usable(camera)
    for value in (*means, *numbers):
        live &= jnp.isfinite(value)
    if camera.lens.valid is not everywhere:
        live &= camera.lens.valid(camera.K, camera.coefficients, (x, y, z))
    z = depth if camera.lens.depth is z_depth else z
    point = (jnp.where(live, x, 0), jnp.where(live, y, 0), jnp.where(live, z, 1))
    centres = camera.project(point)
    return Seen(live, depth, exposure._replace(point=point), centres)


class Size(NamedTuple):
    """Sizes of slots in the image, px², [K] each.

    Attributes:
      squares: largest variances along u and v.
      middles: the second largest.
      dilation: added to ``squares``.
    """

    squares: Sequence[Array]
    middles: Sequence[Array]
    dilation: float | Array


def boxes(
    seen: Seen, size: Size, opacity: Array, reach: Array, camera: Camera
) -> Bounds:
    """Return `Bounds` of ``reach`` standard deviations, squared."""
    live, extents, wide = seen.live, [], jnp.zeros_like(seen.live)
    sides = zip(seen.centres, size.squares, size.middles, camera.visible)
    for place, square, middle, length in sides:
        extent = jnp.sqrt(reach * (square + size.dilation))
        extent = extent * 1.001 + 0.01  # room for rounding
        # Phrased so that neither an overflow nor a NaN gets through.
        live &= (square < jnp.inf) & (jnp.abs(place) < jnp.inf)
        live &= (place + extent >= 0.5) & (place - extent <= length - 0.5)
        extents.append(extent)
        wide |= is_wide(middle, opacity)
    live &= reach > 0
    box = Box(*seen.centres, *extents)
    return Bounds(jnp.where(live, seen.depth, jnp.inf), box, live & wide)


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


def dot(a: Sequence[Any], b: Sequence[Any]) -> Array:
    """Return the inner product of vectors of components."""
    total = a[0] * b[0]
    for p, q in zip(a[1:], b[1:]):
        total = total + p * q
    return total


def cross(a: Sequence[Any], b: Sequence[Any]) -> Sequence[Array]:
    """Return the cross product of vectors of components."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


def depth_slopes(camera: Camera, exposure: Exposure) -> tuple[Array, ...]:
    """Return the derivative of depth by a world point, [R] components.

    Of the depth along the ray of the mean, for lenses that order by distance.
    """
    view = exposure.viewmat
    if camera.lens.depth is z_depth:
        return tuple(entry(view, 2, j) for j in range(3))
    depth = camera.lens.depth(exposure.point)
    ray = [p / depth for p in exposure.point]
    return tuple(dot(ray, [entry(view, i, j) for i in range(3)]) for j in range(3))


class Components(NamedTuple):
    """Parameters of the ranks, [R] each; see `GaussianParams`.

    Attributes:
      colors: K coefficients [3, R] each; none without SH colours.
      features: [C, R], or None.
      shift: added to the projected mean, px; or None.
      alpha_min: [] in place of that of the config, or None.
    """

    means: tuple[Array, ...]
    quats: tuple[Array, ...]
    log_scales: tuple[Array, ...]
    logit_opacities: Array
    colors: tuple[Array, ...]
    features: Array | None
    shift: tuple[Array, ...] | None
    alpha_min: Array | None = None

    @property
    def drawable(self) -> Array:
        """True [R] where all colours and features are finite, and of a sane size."""
        more = () if self.features is None else (self.features,)
        good = None
        for values in (*self.colors, *more):
            for value in values:
                some = jnp.abs(value) < COLOR_LIMIT
                good = some if good is None else good & some
        assert good is not None
        return good


class Projected(NamedTuple):
    """Results of the arithmetic of a primitive, [R] each.

    Attributes:
      u, v, shape, key: see `Splat`.
      depth: see `Channels`.
      outline: further numbers from which the primitive makes the `Footprint`.
      reach: see `Footprint`.
      colors: [C, R].
      normals: three numbers, or None.
    """

    u: Array
    v: Array
    depth: Array
    shape: tuple[Array, ...]
    outline: tuple[Array, ...]
    reach: Array
    colors: Array
    normals: tuple[Array, ...] | None = None
    key: tuple[Array, ...] = ()


Arithmetic = Callable[[Components, Camera, RasterConfig, Array], Projected]


def project_rows(
    arithmetic: Arithmetic,
    footprint: Callable[[Projected], Footprint],
    inputs: Inputs,
    config: RasterConfig,
    order: Array,
    count: Array,
) -> Projection:
    """Project the slots ``order`` [R], of which the first ``count`` are used.

    Every input of an unused rank is to be replaced before use, so that neither its
    values nor its derivatives can leak, whatever the slot holds.

    Args:
      arithmetic: (components, camera, config, live [R]) → `Projected`.
      footprint: makes the `Footprint`.
      inputs: Gaussians, camera, features and probe.
      config: num_size_buckets and absgrad are used here.
      order, count: from `gsjax.raster.lists.depth_order`.
    """
    gaussians, camera, probe = inputs.gaussians, inputs.camera, inputs.probe
    room = order.shape[0]
    order = jnp.minimum(order, gaussians.capacity - 1)
    components = _components(inputs, config, order)

    def some(size: int, components: Components, camera, count) -> Projected:
        live = lax.iota(jnp.int32, size) < count
        front = jax.tree.map(lambda a: a[..., :size] if a.ndim else a, components)
        out = arithmetic(front, camera, config, live)
        if size == room:
            return out

        # An update at a place that XLA (jax 0.10.2) does not know to be 0: else it
        # makes a pad of it, fuses that with everything that leads to ``a``, and
        # evaluates it element by element over the whole room.
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

    # Two sizes at most: each further one costs seconds of compiling.
    out = run_at_bucket(count, room, min(config.num_size_buckets, 2), run, step=16)
    absolute = probe if config.absgrad else None
    return Projection(
        footprint=footprint(out),
        splat=Splat(out.u, out.v, out.shape, lax.stop_gradient(out.key)),
        channels=Channels(
            colors=out.colors,
            depth=out.depth,
            probe=None if absolute is None else absolute[order].T,
            alpha_min=inputs.alpha_min,
            normals=None if out.normals is None else jnp.stack(out.normals),
        ),
    )


def _components(inputs: Inputs, config: RasterConfig, order: Array) -> Components:
    """Return the parameters of the ranks."""
    features, probe = inputs.features, inputs.probe
    rows = jax.tree.map(lambda a: a[order], inputs.gaussians.params)
    color_rows = None if inputs.replaces_colors(config) else rows.sh
    colors = ()
    if color_rows is not None:
        colors = _blocks(color_rows.reshape(len(order), -1), color_rows.shape[-1])
    if features is not None:
        features = features[order]
        (features,) = _blocks(features, features.shape[-1])
    shift = None if probe is None or config.absgrad else _columns(probe[order])
    return Components(
        means=_columns(rows.means),
        quats=_columns(rows.quats),
        log_scales=_columns(rows.log_scales),
        logit_opacities=rows.logit_opacities,
        colors=colors,
        features=features,
        shift=shift,
        alpha_min=inputs.alpha_min,
    )


def candidates(inputs: Inputs, slots: Array, count: Array) -> tuple[Components, Array]:
    """Return the parameters of a few slots [K] for occlusion culling, and which count.

    Quick to compile. Colours are only checked for being drawable.
    """
    gaussians, features = inputs.gaussians, inputs.features
    params = gaussians.params
    rows = jax.tree.map(
        lambda a: a.at[slots].get(mode="clip").T,
        (params.means, params.quats, params.log_scales, params.logit_opacities),
    )
    means, quats, log_scales, logits = rows
    components = Components(
        means=tuple(means),
        quats=tuple(quats),
        log_scales=tuple(log_scales),
        logit_opacities=logits,
        colors=(),
        features=jnp.zeros_like(logits)[None],
        shift=None,
    )
    live = lax.iota(jnp.int32, slots.shape[0]) < count
    for colors in (params.sh,) if features is None else (params.sh, features):
        rows = colors.at[slots].get(mode="clip").reshape(slots.shape[0], -1)
        live &= jnp.all(jnp.abs(rows) < COLOR_LIMIT, axis=1)
    return components, live


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


def _unseen(like: Projected, count: int) -> Projected:
    """Return ranks that show nothing, of the types and channels of ``like``.

    Ones instead of zeros where the numbers are divided by.
    """
    empty = jax.tree.map(lambda a: jnp.zeros((*a.shape[:-1], count), a.dtype), like)
    ones = jnp.ones_like(empty.u)
    *shape, opacity = empty.shape
    return empty._replace(
        shape=(*(ones for _ in shape), opacity),
        outline=tuple(ones for _ in empty.outline),
    )


def colors_of(
    rows: Components, camera: Camera, exposure: Exposure, live: Array
) -> Array:
    """Return the colours [C, R] that are blended: SH colours, then features.

    The means of ``rows`` must be finite.
    """
    parts = []
    if rows.colors:
        parts.append(_sh_colors(camera, exposure, rows.means, rows.colors, live))
    if rows.features is not None:
        parts.append(jnp.where(live, rows.features, 0))
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts)


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
        basis: Any = [sh_lib.C0]
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
