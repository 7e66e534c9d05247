"""Renders whose capacities are fitted on the host until nothing overflows."""

from collections.abc import Callable
from functools import partial

import jax
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.cameras.lens import copies
from gsjax.errors import CapacityError
from gsjax.gaussians import Gaussians, capacity_bucket
from gsjax.raster.argument_checks import check_types, requires_concrete_values
from gsjax.raster.memory_estimate import render_estimate
from gsjax.raster.render import DEFAULT_CONFIG, render
from gsjax.raster.types import Array, Demand, RasterConfig, Render
from gsjax.runtime.memory import require

_FEWEST_SLOTS = 1024
_MOST_PAIRS = 2**30 - 1
_WIDEST = 8  # window that `render_exact` tries before it sorts exactly


@requires_concrete_values()
def render_exact(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
    background: Array | None = None,
    *,
    max_capacity: int = _MOST_PAIRS,
    mend_order: bool = False,
    **kwargs,
) -> Render:
    """Render with capacities that grow until nothing overflows.

    Call it outside of jit; see `exact_config` for use under jit. Capacities that the
    config leaves open follow the active Gaussians, not the slots.

    Args:
      gaussians, camera, config, background: as for `render`.
      max_capacity: upper limit of the pair capacity.
      mend_order: with ``order="window"``, widen the window until nothing is misordered,
        and beyond 8 places sort exactly (``order="pixel"``). Each is a program of its
        own.
      **kwargs: mask, features, probe and alpha_min of `render`.

    Raises:
      CapacityError: if more than ``max_capacity`` is needed, or more memory than is
        free (see `gsjax.runtime.memory`).
      InputError: as `render`, and under `jax.jit`, `vmap` or `scan`.
    """
    check_types(gaussians, camera, config)
    draw = partial(render, background=background, **kwargs)
    while True:
        result = _grow_until_fit(draw, gaussians, camera, config, max_capacity)
        if not mend_order or not int(result.misordered or 0):
            return result
        config = _mended(config)


def _mended(config: RasterConfig) -> RasterConfig:
    """Return ``config`` with twice the window, or with the exact order."""
    wider = 2 * config.order_window
    if wider > _WIDEST:
        return config.replace(order="pixel")
    return config.replace(order_window=wider)


def _grow_until_fit(
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
        config = _grow(config, result.demand, max_capacity)


@requires_concrete_values()
def exact_config(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
    *,
    max_capacity: int = _MOST_PAIRS,
) -> RasterConfig:
    """Return ``config`` with capacities that fit these cameras, for use under jit.

    They are the buckets just above what this view needs, larger by half at most (or
    1024), so that empty slots cost little.

    Args:
      gaussians: N slots, concrete.
      camera: one, or a batch; the result is enough for each, alone or in one call.
      config: other settings are kept.
      max_capacity: upper limit of the pair capacity.

    Raises:
      CapacityError, InputError: as `render_exact`.
    """
    check_types(gaussians, camera, config)
    fitted = _fit(count_demand(gaussians, camera, config, max_capacity), max_capacity)
    return config.replace(
        pair_capacity=fitted["pair_capacity"],
        visible_capacity=min(
            fitted["visible_capacity"], copies(camera.lens) * gaussians.capacity
        ),
    )


@partial(jax.jit, static_argnames="config")
def _demand(gaussians: Gaussians, camera: Camera, config: RasterConfig):
    """Return the counts of a render; the rest is not in the compiled program."""
    view = render(gaussians, camera, config)
    return view.demand, view.overflowed


def count_demand(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
    max_capacity: int = _MOST_PAIRS,
) -> Demand:
    """Return the counts that a view needs, whatever the capacities in ``config``.

    Raises:
      CapacityError: as `render_exact`.
    """
    light = config.replace(outputs=("alpha",), absgrad=False, num_size_buckets=1)
    light = _for_active(gaussians, light)
    while True:
        _check_memory(gaussians, camera, light)
        demand, overflowed = _demand(gaussians, camera, light)
        if not bool(overflowed):
            return demand
        light = _grow(light, demand, max_capacity)


def _check_memory(gaussians: Gaussians, camera: Camera, config: RasterConfig) -> None:
    """Reject a render that would not fit, before any allocation."""
    cameras = camera.viewmat.shape[0] if camera.batched else 1
    estimate = render_estimate(
        copies(camera.lens) * gaussians.capacity,
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
    """Return ``config`` with an open visible capacity fitted to the active Gaussians.

    Candidates are a half, a quarter, … of the slots: each is a program of its own.
    """
    active = int(np.sum(np.asarray(gaussians.active)))
    room = gaussians.capacity
    while room > _FEWEST_SLOTS and -(-room // 2) >= active:
        room = -(-room // 2)
    if config.visible_capacity is not None or room == gaussians.capacity:
        return config
    return config.replace(visible_capacity=room)


def _fit(demand: Demand, max_capacity: int) -> dict[str, int]:
    """Return buckets that hold the demand."""
    needed = int(demand.capacity)
    if needed > max_capacity:
        raise CapacityError(
            f"render: expected a pair capacity of at most {max_capacity:,}, needed "
            f"{needed:,}{' or more' if needed == 2**31 - 1 else ''}; render a smaller "
            "image or fewer Gaussians, use larger tiles, or raise max_capacity"
        )
    return {
        "pair_capacity": min(capacity_bucket(needed), max_capacity),
        "visible_capacity": capacity_bucket(int(demand.visible)),
    }


def _grow(config: RasterConfig, demand: Demand, max_capacity: int) -> RasterConfig:
    """Return ``config`` with capacities of at least the demand; none shrinks."""
    fitted = _fit(demand, max_capacity)
    grown = {
        name: max(size, getattr(config, name) or 0) for name, size in fitted.items()
    }
    if config.visible_capacity is None:
        grown.pop("visible_capacity")
    return config.replace(**grown)
