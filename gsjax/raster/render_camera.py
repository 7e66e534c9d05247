"""The render of one camera: bounds, order, projection, tiles; then the background.

Axis legend: N Gaussians (capacity), H W image, B cameras, C channels.
"""

from itertools import accumulate

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.cameras.lens import copies
from gsjax.errors import InputError
from gsjax.math.numerics import safe_divide
from gsjax.raster.argument_checks import check_real
from gsjax.raster.compositing.types import Images, summed_channels
from gsjax.raster.lists import binning, occlusion_culling
from gsjax.raster.lists.blocks import by_blocks
from gsjax.raster.lists.depth_order import depth_order
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.primitives.unscented import period_of
from gsjax.raster.tile_render import device_count, render_tiles
from gsjax.raster.types import (
    COLOR_LIMIT,
    Array,
    Bounds,
    Demand,
    Inputs,
    Primitive,
    Projection,
    RasterConfig,
    Splat,
)
from gsjax.runtime.devices import on_cpu, shard_rows


def render_camera(
    inputs: Inputs, config: RasterConfig
) -> tuple[Images, Array, Demand, Array]:
    """Return images before the background, radii [N], demand and overflow.

    Args:
      inputs: Gaussians, a single camera and what is drawn with them.
      config: static settings.
    """
    gaussians, camera = inputs.gaussians, inputs.camera
    out, order, visible, wraps = project_camera(inputs, config)
    radii = jnp.zeros(gaussians.capacity, out.splat.u.dtype)
    seen = binning.radii(lax.stop_gradient(out.footprint), *camera.visible)
    size = camera.width, camera.height
    sums, demand, overflowed = render_tiles(out, size, config, inputs.mask)
    most = copies(camera.lens) * gaussians.capacity
    room = min(config.visible_capacity or most, most)
    radii = radii.at[order]
    return (
        sums,
        (radii.max if wraps else radii.set)(seen, mode="drop"),
        demand._replace(visible=visible),
        overflowed | (visible > room),
    )


def project_camera(
    inputs: Inputs, config: RasterConfig
) -> tuple[Projection, Array, Array, bool]:
    """Project what may be visible to a single camera.

    Returns:
      The projection, front to back; its slots [R], N where there is none; the number []
      of visible ones; and whether a slot may occur more than once, as in an image that
      wraps around.
    """
    gaussians = inputs.gaussians
    primitive = config.primitive or ELLIPSOID
    # The names that a profile shows.
    with jax.named_scope("order"):
        order, visible = visible_order(primitive, inputs, config)
        order, offset = _of_copies(order, inputs)
    if inputs.features is None and gaussians.sh_degree > 0 and on_cpu():
        # Colours that depend on the view are worth the cost of joining the parts again;
        # a mean and a covariance alone are not.
        order = shard_rows(order, device_count(config), fill=gaussians.capacity)
    with jax.named_scope("project"):
        out = primitive.project(inputs, config, order, visible)
        if offset is not None:
            out = out._replace(
                footprint=out.footprint._replace(u=out.footprint.u + offset),
                splat=out.splat._replace(u=out.splat.u + offset),
            )
    return out, order, visible, offset is not None


_TURNS = (0, -1, 1)


def _turn(order: Array, slots: int) -> Array:
    """Return the turn by which copies of slots are shifted."""
    copy = order // slots
    return jnp.where(copy == 1, -1, jnp.where(copy == 2, 1, 0))


def _of_copies(order: Array, inputs: Inputs) -> tuple[Array, Array | None]:
    """Return slots [R], N past the last, and their shifts in px or None."""
    period, slots = period_of(inputs.camera), inputs.gaussians.capacity
    if period is None:
        return order, None
    used = order < len(_TURNS) * slots
    return jnp.where(used, order % slots, slots), _turn(order, slots) * period


def visible_order(
    primitive: Primitive, inputs: Inputs, config: RasterConfig
) -> tuple[Array, Array]:
    """Return the slots that may be visible, front to back, and their number.

    Conservative: a slot that is left out has no pixel with α at or above the limit, or,
    with ``config.occlusion``, lies behind pixels that have all stopped. No derivative
    is taken. See `depth_order` for the shapes. An image that wraps around has three
    copies of each slot, a turn apart: slot + N and slot + 2 N are shifted.
    """
    inputs = lax.stop_gradient(inputs._replace(mask=None, probe=None))
    camera, params = inputs.camera, inputs.gaussians.params

    slots, period = inputs.gaussians.capacity, period_of(camera)
    values = (params.means, params.log_scales, params.logit_opacities)
    if config.projection == "unscented":
        values = (*values, params.quats)

    def bounds_of(camera: Camera) -> Bounds:
        def bound(active: Array, values) -> Bounds:
            return primitive.bounds(active, values, camera, config, inputs.alpha_min)

        def none(active: Array, values) -> Bounds:
            shapes = jax.eval_shape(bound, active, values)
            nothing = jax.tree.map(jnp.zeros_like, shapes)
            return nothing._replace(z=jnp.full_like(nothing.z, jnp.inf))

        return by_blocks(bound, none, inputs.gaussians.active, values)

    if period is None:
        bounds = bounds_of(camera)
    else:  # shifting the principal point shifts the image
        shifted = [camera.K.at[0, 2].add(turn * period) for turn in _TURNS]
        parts = [bounds_of(camera.replace(K=K)) for K in shifted]
        bounds = jax.tree.map(lambda *some: jnp.concatenate(some), *parts)
    z = bounds.z

    def occluders(some: Array, count: Array) -> Splat:
        assert primitive.occluders is not None
        splat = primitive.occluders(
            inputs, config, some if period is None else some % slots, count
        )
        if period is None:
            return splat
        return splat._replace(u=splat.u + _turn(some, slots) * period)

    if config.occlusion and primitive.occluders is not None:
        size = camera.width, camera.height
        z = occlusion_culling.cull(bounds, occluders, size, config)

    def exact_depth(some: Array | None) -> Array:
        if some is None:
            depth = primitive.order_depth(params.means, camera)
            return depth if period is None else jnp.tile(depth, len(_TURNS))
        means = params.means.at[some if period is None else some % slots]
        return primitive.order_depth(means.get(mode="clip"), camera)

    return depth_order(z, exact_depth, config)


def finish(
    sums: Images, inputs: Inputs, config: RasterConfig, background: Array | None
) -> Images:
    """Add the background and normalise: sums [B, H, W, C] to named images."""
    features = 0 if inputs.features is None else inputs.features.shape[1]
    shown = features if inputs.replaces_colors(config) else 3
    behind = features if "features" in config.outputs else 0
    colors = shown + behind if behind and "rgb" in config.outputs else shown
    parts = _parts(sums["sums"], summed_channels(config, colors))
    alpha = parts["ones"][..., 0]
    out = {}
    if "rgb" in config.outputs:
        out["rgb"] = _over(parts["colors"][..., :shown], alpha, background)
    if behind:
        out["features"] = parts["colors"][..., -behind:]
    if "normals" in config.outputs:
        out["normals"] = parts["normals"]
    if "alpha" in config.outputs:
        out["alpha"] = alpha
    if "depth" in config.outputs:
        depth = sums["depth"] if "depth" in sums else parts["depth"][..., 0]
        out["depth"] = safe_divide(depth, alpha, alpha > 1e-10)
    if "median_depth" in config.outputs:
        out["median_depth"] = sums["median"]
    if "distortion" in config.outputs:
        if "disparity" in sums:
            mean, square = sums["disparity"], sums["square"]
        else:
            mean, square = jnp.moveaxis(parts["disparities"], -1, 0)
        out["distortion"] = alpha * square - mean * mean
    return out


def _parts(total: Array, channels: dict[str, int]) -> Images:
    """Return the channels [..., C] by name."""
    ends = list(accumulate(channels.values()))
    starts = [end - count for end, count in zip(ends, channels.values())]
    spans = zip(channels, starts, ends)
    return {name: total[..., start:end] for name, start, end in spans}


def _over(rgb: Array, alpha: Array, background: Array | None) -> Array:
    """Return colours [B, H, W, C] over the background."""
    if background is None:
        return rgb
    cameras, *_, colors = rgb.shape
    check_real("background", background)
    background = jnp.asarray(background, rgb.dtype)
    if background.shape not in ((colors,), (cameras, colors)):
        raise InputError(
            f"background: expected shape ({colors},) or ({cameras}, {colors}), "
            f"got {background.shape}"
        )
    # A component that is not finite would show through the scene.
    background = jnp.where(jnp.abs(background) < COLOR_LIMIT, background, 0)
    background = jnp.broadcast_to(background, (cameras, colors))
    # As a product: its transpose is one too, not a sum over few channels.
    return rgb + jnp.einsum("bhw,bc->bhwc", 1 - alpha, background, precision="highest")


def mark_overflow(images: Images, overflowed: Array, config: RasterConfig) -> Images:
    """Return images [B, …], filled with NaN on overflow if the config says so."""
    if config.on_overflow == "flag":
        return images

    def one(image: Array) -> Array:
        flags = overflowed.reshape(-1, *(1,) * (image.ndim - 1))
        return jnp.where(flags, jnp.nan, image)

    return {name: one(image) for name, image in images.items()}
