"""The door of the rasteriser: project → bin → composite.

Nothing here is jitted: wrap `render` with ``config`` static. `render_exact` is the
exception: it jits, looks at the counts on the host, and regrows.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.errors import CapacityError, InputError
from gsjax.gaussians import Gaussians, capacity_bucket
from gsjax.raster.argument_checks import (
    check_camera,
    check_config,
    check_features,
    check_gaussians,
    checked_mask,
    checked_size,
    with_batch,
)
from gsjax.raster.argument_checks import (
    requires_concrete_values as requires_concrete_values,
)
from gsjax.raster.lists.counting import total_count
from gsjax.raster.memory_estimate import render_estimate as render_estimate
from gsjax.raster.render_camera import draw, finish
from gsjax.raster.tile_render import device_count as device_count
from gsjax.raster.types import Array, Demand, RasterConfig, Render
from gsjax.runtime.memory import require

DEFAULT_CONFIG = RasterConfig()
_LEAST_ROOM = 1024  # slots


def render(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
    background: Array | None = None,
    *,
    mask: Array | None = None,
    size: Array | None = None,
    features: Array | None = None,
    probe: Array | None = None,
    abs_probe: Array | None = None,
) -> Render:
    """Render Gaussians by exact, sorted, front-to-back splatting (Kerbl et al. 2023).

    Differentiable in every float of ``gaussians``, ``camera``, ``background``,
    ``features`` and ``probe``: `jax.grad`, `jax.jvp`, Hessian–vector products and
    `jax.vmap` go through.

    Args:
      gaussians: N slots.
      camera: one camera, or a batch B (one call, one image each, made in turn).
      config: static settings.
      background: [C] or [B, C]; default black, as is a component that is not finite.
      mask: [H, W] bool, or [B, H, W] for a batch: the pixels that are wanted. Tiles
        without any are skipped; what other pixels come to is not defined, nor do
        gradients by them mean anything. Not counted as pairs is what lies before the
        first and after the last wanted tile of a row.
      size: [2], or [B, 2] for a batch: width and height, px, of a picture that fills
        the upper left corner alone, as if the camera had it; what other pixels come to
        is not defined, and ``radii`` are 0 for what is out of it.
      features: [N, C] composited in place of the SH colour.
      probe: [N, 2], or [B, N, 2] for a batch, zeros: added to the projected means
        (px); its gradient is the screen-space statistic of densification.
      abs_probe: like ``probe``, with ``config.absgrad``: its gradient is the sum over
        pixels of the absolute per-pixel gradient.

    Returns:
      `Render`. Look at ``overflowed``; if True the image is incomplete, and
      ``demand.capacity`` is the `RasterConfig.pair_capacity` that would do.

    Raises:
      InputError: if a shape does not fit, a number is complex, or there is no camera
        or no slot.
    """
    check_config(config)
    # Tracers cannot index what is NumPy's.
    gaussians = jax.tree.map(jnp.asarray, gaussians)
    features, probe, abs_probe, mask, size = (
        None if value is None else jnp.asarray(value)
        for value in (features, probe, abs_probe, mask, size)
    )
    check_camera(camera)
    check_gaussians(gaussians)
    cameras = camera if camera.batched else jax.tree.map(lambda a: a[None], camera)
    count = cameras.viewmat.shape[0]
    probe = with_batch("probe", probe, gaussians, camera)
    abs_probe = with_batch("abs_probe", abs_probe, gaussians, camera)
    if (abs_probe is not None) != config.absgrad:
        raise InputError("config.absgrad and abs_probe go together: pass both or none")
    check_features(features, gaussians)
    mask, size = checked_mask(mask, camera), checked_size(size, camera)

    def render_one(inputs):
        return draw(gaussians, config, features, *inputs)

    # One after another: no more at a time than one camera takes (a gradient keeps what
    # it needs of each), and the program of one.
    inputs = (cameras, probe, abs_probe, mask, size)
    if count == 1:
        out = render_one(jax.tree.map(lambda a: a[0], inputs))
        sums, radii, demands, overflowed = jax.tree.map(lambda a: a[None], out)
    else:
        sums, radii, demands, overflowed = lax.map(render_one, inputs)
    demand = Demand(
        visible=jnp.max(demands.visible),
        pairs=total_count(demands.pairs)[0],
        capacity=jnp.max(demands.capacity),
    )
    overflowed = jnp.any(overflowed)
    colors = 3 if features is None else features.shape[1]
    images = finish(sums, config, background, count, colors)
    if not camera.batched:
        images = {name: image[0] for name, image in images.items()}
        radii = radii[0]
    return Render(
        rgb=images.get("rgb"),
        alpha=images.get("alpha"),
        depth=images.get("depth"),
        median_depth=images.get("median_depth"),
        radii=radii,
        demand=demand,
        overflowed=overflowed,
    )


_render_jit = jax.jit(render, static_argnames="config")


@partial(jax.jit, static_argnames="config")
def _demand_jit(gaussians: Gaussians, camera: Camera, config: RasterConfig):
    """What `render` tells of its sizes; the rest is not in the compiled program."""
    view = render(gaussians, camera, config)
    return view.demand, view.overflowed


@requires_concrete_values()
def render_exact(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
    background: Array | None = None,
    *,
    max_capacity: int = 2**30 - 1,
    **kwargs,
) -> Render:
    """`render`, jitted, its capacities regrown until nothing overflows.

    For calls from the host; for use under jit, see `exact_config`. Capacities that are
    left open go by the Gaussians that are active, and not by the slots.

    Args:
      gaussians, camera, config, background: as for `render`.
      max_capacity: refuse to grow the pair capacity beyond this.
      **kwargs: mask, features, size, probe, abs_probe.

    Raises:
      CapacityError: if more than ``max_capacity`` is wanted, or more memory than there
        is (see `gsjax.runtime.memory`).
      InputError: as `render`, and under `jax.jit`, `vmap` or `scan`.
    """
    draw = partial(_render_jit, background=background, **kwargs)
    return _regrown(draw, gaussians, camera, config, max_capacity)


def render_at_cut(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig,
    background: Array,
    alpha_min: float,
) -> Render:
    """`render_exact` with ``alpha_min`` in place of that of ``config``, as a number of
    the program's input: one program draws with any. Pictures alone: no derivative goes
    through it."""
    cut = jnp.asarray(alpha_min, gaussians.params.means.dtype)
    draw = partial(_at_cut_jit, background=background, cut=cut)
    return _regrown(draw, gaussians, camera, config, 2**30 - 1)


@partial(jax.jit, static_argnames="config")
def _at_cut_jit(gaussians, camera, config: RasterConfig, background, cut) -> Render:
    return render(gaussians, camera, config.at_cut(cut), background)


def _regrown(
    draw: Callable[..., Render],
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig,
    max_capacity: int,
) -> Render:
    config = _for_active(gaussians, config)
    while True:
        _check_memory(gaussians, camera, config)
        result = draw(gaussians, camera, config)
        if not bool(result.overflowed):
            return result
        config = _regrow(config, result.demand, max_capacity)


@requires_concrete_values()
def exact_config(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
    *,
    max_capacity: int = 2**30 - 1,
) -> RasterConfig:
    """``config`` with capacities that fit these cameras, for use under jit.

    They are the buckets just above what this view wants, larger by half at most (or
    1024), so that little is paid for slots that are empty or out of view.

    Args:
      gaussians: N slots, concrete.
      camera: one, or a batch: enough for each of them, alone or in one call.
      config: all else stays as it is.
      max_capacity: as for `render_exact`.

    Raises:
      CapacityError, InputError: as `render_exact`.
    """
    fitted = _fit(count_demand(gaussians, camera, config, max_capacity), max_capacity)
    return config.replace(
        pair_capacity=fitted["pair_capacity"],
        visible_capacity=min(fitted["visible_capacity"], gaussians.capacity),
    )


def count_demand(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
    max_capacity: int = 2**30 - 1,
) -> Demand:
    """What a view wants, whatever the capacities in ``config``; see `exact_config`.

    Raises:
      CapacityError: as `render_exact`.
    """
    light = config.replace(outputs=("alpha",), absgrad=False, num_size_buckets=1)
    light = _for_active(gaussians, light)
    while True:
        _check_memory(gaussians, camera, light)
        demand, overflowed = _demand_jit(gaussians, camera, light)
        if not bool(overflowed):
            return demand
        light = _regrow(light, demand, max_capacity)


def _check_memory(gaussians: Gaussians, camera: Camera, config: RasterConfig) -> None:
    """Refuse what would not fit, before a byte of it is taken."""
    cameras = camera.viewmat.shape[0] if camera.batched else 1
    estimate = render_estimate(
        gaussians.capacity,
        gaussians.params.sh.shape[-2],
        (camera.width, camera.height),
        config,
        cameras=cameras,
        width=gaussians.params.means.dtype.itemsize,
    )
    several = f"{cameras} images" if cameras > 1 else "an image"
    pairs, each = config.pair_capacity, " each" if cameras > 1 else ""
    require(
        estimate,
        f"{several} of {camera.width} × {camera.height} px of {gaussians.capacity:,} "
        "Gaussians" + (f", {pairs:,} (tile, Gaussian) pairs{each}," if pairs else ""),
        "render smaller images, or fewer Gaussians (export --min-opacity), or larger "
        "tiles (RasterConfig.tile_size)",
    )


def _for_active(gaussians: Gaussians, config: RasterConfig) -> RasterConfig:
    """``config``, where it leaves that open with room for the Gaussians there are: what
    goes with the slots, most of it pairs, is not paid for those that are empty.

    A half, a quarter, … of the slots: each that is used is a program of its own.
    """
    active = int(np.sum(np.asarray(gaussians.active)))
    room = gaussians.capacity
    while room > _LEAST_ROOM and -(-room // 2) >= active:
        room = -(-room // 2)
    if config.visible_capacity is not None or room == gaussians.capacity:
        return config
    return config.replace(visible_capacity=room)


def _fit(demand: Demand, max_capacity: int) -> dict[str, int]:
    """Buckets that hold the demand."""
    wanted = int(demand.capacity)
    if wanted > max_capacity:
        raise CapacityError(
            f"this view wants a pair capacity of {wanted:,}"
            f"{' or more' if wanted == 2**31 - 1 else ''}, above the limit of "
            f"{max_capacity:,}; render a smaller image or fewer Gaussians, use "
            "larger tiles, or raise max_capacity"
        )
    return {
        "pair_capacity": min(capacity_bucket(wanted), max_capacity),
        "visible_capacity": capacity_bucket(int(demand.visible)),
    }


def _regrow(config: RasterConfig, demand: Demand, max_capacity: int) -> RasterConfig:
    """``config`` with no capacity below the demand; none shrinks."""
    fitted = _fit(demand, max_capacity)
    grown = {
        name: max(size, getattr(config, name) or 0) for name, size in fitted.items()
    }
    if config.visible_capacity is None:
        grown.pop("visible_capacity")
    return config.replace(**grown)
