"""The door of the rasteriser: project → bin → composite.

Nothing here is jitted: wrap `render` with ``config`` static. `render_exact` is the
exception: it jits, looks at the counts on the host, and regrows.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec

from gsjax.cameras import Camera
from gsjax.errors import CapacityError, InputError
from gsjax.gaussians import Gaussians, capacity_bucket
from gsjax.numerics import safe_divide
from gsjax.raster import bins
from gsjax.raster.composite import composite
from gsjax.raster.ladder import on_ladder
from gsjax.raster.occlude import hidden
from gsjax.raster.project import depth_order, project, radii_of
from gsjax.raster.types import Array, Demand, Projected, RasterConfig, Render

DEFAULT_CONFIG = RasterConfig()


def render(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
    background: Array | None = None,
    *,
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
      camera: one camera, or a batch B (one call, one image each).
      config: static settings.
      background: [C] or [B, C]; default black.
      features: [N, C] composited in place of the SH colour.
      probe: [N, 2], or [B, N, 2] for a batch, zeros: added to the projected means
        (px); its gradient is the screen-space statistic of densification.
      abs_probe: like ``probe``, with ``config.absgrad``: its gradient is the sum over
        pixels of the absolute per-pixel gradient.

    Returns:
      `Render`. Look at ``overflowed``: if True the image is incomplete and
      ``demand.capacity`` is the `RasterConfig.pair_capacity` that would do.

    Raises:
      InputError: if a shape does not fit.
    """
    cameras = camera if camera.batched else jax.tree.map(lambda a: a[None], camera)
    count = cameras.viewmat.shape[0]
    probe = _with_batch("probe", probe, gaussians, camera)
    abs_probe = _with_batch("abs_probe", abs_probe, gaussians, camera)
    if (abs_probe is not None) != config.absgrad:
        raise InputError("config.absgrad and abs_probe go together: pass both or none")
    _check_features(features, gaussians)

    def project_one(inputs):
        return _project_one(gaussians, config, features, *inputs)

    if count == 1:
        squeezed = jax.tree.map(lambda a: a[0], (cameras, probe, abs_probe))
        projected, radii, visible = project_one(squeezed)
        radii = radii[None]
    else:
        projected, radii, visible = lax.map(project_one, (cameras, probe, abs_probe))
        projected = _flatten_cameras(projected)
    sums, demand, overflowed = rasterise(
        projected, count, camera.width, camera.height, config
    )
    visible = jnp.max(visible)
    room = min(config.visible_capacity or gaussians.capacity, gaussians.capacity)
    demand = demand._replace(visible=visible)
    overflowed |= visible > room
    images = _finish(sums, config, background, count, projected.colors.shape[0])
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


def _project_one(
    gaussians: Gaussians,
    config: RasterConfig,
    features: Array | None,
    camera: Camera,
    probe: Array | None,
    abs_probe: Array | None,
) -> tuple[Projected, Array, Array]:
    """One camera: what was projected, radii [N], and the count of what may be seen."""
    order, visible = depth_order(gaussians, camera, config)
    out = project(gaussians, camera, config, order, visible, features, probe, abs_probe)
    radii = jnp.zeros(gaussians.capacity, out.u.dtype)
    seen = lax.stop_gradient(radii_of(out))
    return out, radii.at[order].set(seen, mode="drop"), visible


def _with_batch(name: str, probe, gaussians: Gaussians, camera: Camera):
    """``probe`` as [B, N, 2], or None."""
    if probe is None:
        return None
    wanted = (*camera.viewmat.shape[:-2], gaussians.capacity, 2)
    if probe.shape != wanted:
        raise InputError(f"{name} has shape {probe.shape}; {wanted} is wanted")
    return probe if camera.batched else probe[None]


def _check_features(features, gaussians: Gaussians) -> None:
    if features is None:
        return
    if features.ndim != 2 or features.shape[0] != gaussians.capacity:
        raise InputError(
            f"features has shape {features.shape}; ({gaussians.capacity}, C) is wanted"
        )


def _flatten_cameras(projected: Projected) -> Projected:
    """[B, R] and [B, C, R] to [B · R] and [C, B · R]: more ranks, as it were."""

    def flatten(value):
        value = jnp.moveaxis(value, 0, -2)
        return value.reshape(*value.shape[:-2], -1)

    return jax.tree.map(flatten, projected)


def default_pair_capacity(ranks: int, grid: bins.Grid) -> int:
    """Room for eight tiles a Gaussian and two Gaussians a tile, as a bucket."""
    return capacity_bucket(8 * ranks + 2 * grid.tiles * grid.stride)


def rasterise(
    projected: Projected, cameras: int, width: int, height: int, config: RasterConfig
) -> tuple[dict[str, Array], Demand, Array]:
    """Bin and composite what was projected, over all devices.

    Args:
      projected: [R], ranks of all cameras one after another, R / B each.
      cameras: B.
      width, height: image size.
      config: static settings.

    Returns:
      Images before the background, {"sums": [B, H, W, C], "median": [B, H, W]};
      the demand (``visible`` is left at 0); whether the capacity was too small.
    """
    devices = config.devices or jax.local_device_count()
    grid = bins.make_grid(width, height, config.tile_size, cameras, devices)
    ranks = projected.u.shape[0]
    capacity = config.pair_capacity or default_pair_capacity(ranks, grid)
    share = -(-capacity // devices)
    seen = _unhidden(lax.stop_gradient(projected), cameras, width, height, config)
    local = partial(_rasterise_local, grid=grid, config=config, capacity=share)
    if devices == 1:
        images, pairs, wanted = local(jnp.zeros(1, jnp.int32), projected, seen)
    else:
        mesh = Mesh(np.array(jax.local_devices()[:devices]), ("tiles",))
        images, pairs, wanted = jax.shard_map(
            local,
            mesh=mesh,
            in_specs=(PartitionSpec("tiles"), PartitionSpec(), PartitionSpec()),
            out_specs=PartitionSpec("tiles"),
            check_vma=False,
        )(jnp.arange(devices, dtype=jnp.int32), projected, seen)
    images = {name: _untile(image, grid) for name, image in images.items()}
    overflowed = jnp.any(wanted > share)
    wanted = jnp.max(wanted)
    limit = bins.COUNT_LIMIT // devices
    capacity_wanted = jnp.where(wanted < limit, wanted * devices, 2**31 - 1)
    pairs_float = jnp.sum(pairs.astype(jnp.float32))
    total = jnp.where(
        pairs_float < bins.COUNT_LIMIT, jnp.sum(pairs, dtype=jnp.int32), 2**31 - 1
    )
    demand = Demand(visible=jnp.int32(0), pairs=total, capacity=capacity_wanted)
    return images, demand, overflowed


def _unhidden(
    projected: Projected, cameras: int, width: int, height: int, config: RasterConfig
) -> Projected:
    """``projected`` with no reach for what is hidden."""
    if config.stop <= 0 or not config.occlusion:
        return projected

    def split(value):  # [..., B · R] → [B, ..., R]
        value = value.reshape(*value.shape[:-1], cameras, -1)
        return jnp.moveaxis(value, -2, 0)

    per_camera = jax.tree.map(split, projected)
    behind = lax.map(lambda one: hidden(one, width, height, config), per_camera)
    return projected._replace(reach=jnp.where(behind.ravel(), 0, projected.reach))


def _rasterise_local(
    device: Array,
    projected: Projected,
    geometry: Projected,
    *,
    grid: bins.Grid,
    config: RasterConfig,
    capacity: int,
):
    """One device's tiles; ``device`` is [1]. Results gain a leading device axis.

    ``geometry`` is what to bin: ``projected`` without derivatives and without what
    is hidden.
    """
    device = device[0]
    ranks = projected.u.shape[0]
    group = bins.tiles_per_step(config, grid, jax.default_backend())
    camera = lax.iota(jnp.int32, ranks) // (ranks // grid.cameras)
    spans = bins.row_spans(geometry, camera, grid, device)
    # The boxes bound the pairs from above, for no more than a sum.
    bound = jnp.sum(spans.rows.astype(jnp.float32) * spans.cols)

    def sort(room):
        lists = bins.make_lists(geometry, spans, grid, device, room)
        return lists._replace(ranks=jnp.pad(lists.ranks, (0, capacity - room)))

    lists = on_ladder(bound, capacity, config.rungs, sort)
    schedule = bins.make_schedule(lists.length, grid, group, config.chunk_size)

    def blend(room):
        work = bins.make_work(lists, schedule, config.chunk_size, ranks, room)
        return composite(projected, work, schedule, grid, device, config)

    room = bins.step_capacity(capacity, grid, group, config.chunk_size)
    images = on_ladder(schedule.steps, room, config.rungs, blend)
    for_steps = bins.pairs_for_steps(schedule.steps, grid, group, config.chunk_size)
    wanted = jnp.maximum(jnp.maximum(lists.items, lists.pairs), for_steps)
    images = {name: image[None] for name, image in images.items()}
    return images, lists.pairs[None], wanted[None]


def _untile(image: Array, grid: bins.Grid) -> Array:
    """[D, T, (C,) P] to [B, H, W, (C)]: rows of tiles were dealt out to D devices."""
    channels = image.shape[2:-1]
    image = image.reshape(
        grid.stride,
        grid.cameras,
        grid.rows,
        grid.cols,
        int(np.prod(channels)),
        grid.tile,
        grid.tile,
    )
    image = image.transpose(1, 2, 0, 5, 3, 6, 4)
    image = image.reshape(
        grid.cameras,
        grid.rows * grid.stride * grid.tile,
        grid.cols * grid.tile,
        *channels,
    )
    return image[:, : grid.height, : grid.width]


def _finish(
    sums: dict[str, Array], config: RasterConfig, background, cameras: int, colors: int
) -> dict[str, Array]:
    """Background and normalisation: sums [B, H, W, C] to named images."""
    total = sums["sums"]
    alpha = total[..., -1]
    out = {}
    if "rgb" in config.outputs:
        rgb = total[..., :colors]
        if background is not None:
            background = jnp.asarray(background, rgb.dtype)
            if background.shape not in ((colors,), (cameras, colors)):
                raise InputError(
                    f"background has shape {background.shape}; ({colors},) or "
                    f"({cameras}, {colors}) is wanted"
                )
            background = jnp.broadcast_to(background, (cameras, colors))
            rgb = rgb + (1 - alpha)[..., None] * background[:, None, None]
        out["rgb"] = rgb
    if "alpha" in config.outputs:
        out["alpha"] = alpha
    if "depth" in config.outputs:
        out["depth"] = safe_divide(total[..., -2], alpha, alpha > 1e-10)
    if "median_depth" in config.outputs:
        out["median_depth"] = sums["median"]
    return out


_render_jit = jax.jit(render, static_argnames="config")


@partial(jax.jit, static_argnames="config")
def _demand_jit(gaussians: Gaussians, camera: Camera, config: RasterConfig):
    """What `render` tells of its sizes; the rest is not in the compiled program."""
    view = render(gaussians, camera, config)
    return view.demand, view.overflowed


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

    For calls from the host; for use under jit, see `exact_config`.

    Args:
      gaussians, camera, config, background: as for `render`.
      max_capacity: refuse to grow the pair capacity beyond this.
      **kwargs: features, probe, abs_probe.

    Raises:
      CapacityError: if more than ``max_capacity`` is wanted.
    """
    while True:
        result = _render_jit(gaussians, camera, config, background, **kwargs)
        if not bool(result.overflowed):
            return result
        config = _regrow(config, result.demand, max_capacity)


def exact_config(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
    *,
    max_capacity: int = 2**30 - 1,
) -> RasterConfig:
    """``config`` with capacities that fit these cameras, for use under jit.

    They are the buckets just above what this view wants: larger than needed by a
    third at most, so that nothing is paid for slots that are empty or out of view.

    Raises:
      CapacityError: as `render_exact`.
    """
    light = config.replace(outputs=("alpha",), absgrad=False, rungs=1)
    while True:
        demand, overflowed = _demand_jit(gaussians, camera, light)
        if not bool(overflowed):
            fitted = _fit(demand, max_capacity)
            return config.replace(
                pair_capacity=fitted["pair_capacity"],
                visible_capacity=min(fitted["visible_capacity"], gaussians.capacity),
            )
        light = _regrow(light, demand, max_capacity)


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
