"""Slots, capacities, tiles and chunks for a scene and its cameras."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians, compact, select
from gsjax.planning import bounds
from gsjax.planning.types import Reason
from gsjax.raster.render import (
    count_demand,
    exact_config,
    render_estimate,
    render_exact,
)
from gsjax.raster.types import Demand, RasterConfig
from gsjax.runtime.memory import size_text
from gsjax.runtime.timing import time_ms

_ROOM = 1.125  # of capacities, for views that show more than those measured
_TRIALS = ((8, 32), (16, 32), (16, 64))


def shown(
    gaussians: Gaussians, config: RasterConfig, slots: int
) -> tuple[Gaussians, Reason]:
    """Active Gaussians that are not below the cut everywhere, in as many slots."""
    active = np.asarray(gaussians.active)
    visible = np.zeros(active.shape, bool)
    # Antialiasing only lowers opacities.
    visible[active] = bounds.opacities(gaussians) > config.alpha_min * (1 - 1e-6)
    faint = int(active.sum() - visible.sum())
    count = max(int(visible.sum()), 1)
    gaussians = compact(select(gaussians, jnp.asarray(visible)), count)
    why = f"{count:,} slots in place of {slots:,}"
    if faint:
        why += f"; {faint:,} Gaussians are nowhere above the α cut"
    return gaussians, Reason("capacity", why)


def with_capacities(
    gaussians: Gaussians,
    views: list[Camera],
    config: RasterConfig,
    demands: Sequence[Demand] | None = None,
) -> tuple[RasterConfig, list[Reason]]:
    """``config`` with room for what the cameras ask for and an eighth more.

    Args:
      demands: of these cameras with that config, where they are known.
    """
    if demands is None:
        unlimited = config.replace(visible_capacity=None)
        demands = [count_demand(gaussians, view, unlimited) for view in views]
    pairs = max(1, *(int(demand.capacity) for demand in demands))
    seen = max(1, *(int(demand.visible) for demand in demands))
    visible = min(_roomy(seen), gaussians.capacity)
    reasons = [
        Reason("visible_capacity", f"{visible:,}: at most {seen:,} are in a view"),
        Reason("pair_capacity", f"{_roomy(pairs):,}: views ask for {pairs:,} at most"),
    ]
    config = config.replace(pair_capacity=_roomy(pairs), visible_capacity=visible)
    size = views[0].width, views[0].height
    bases = gaussians.params.sh.shape[-2]
    estimate = render_estimate(gaussians.capacity, bases, size, config)
    told = f"about {size_text(estimate.total)} for a picture of {size[0]} × {size[1]}"
    return config, [*reasons, Reason("memory", told)]


def _roomy(count: int) -> int:
    """An eighth more, in whole steps of about that size or less."""
    step = max(256, 2 ** (max(count, 1).bit_length() - 4))
    return -(-int(_ROOM * count) // step) * step


def tuned(
    gaussians: Gaussians,
    view: Camera,
    config: RasterConfig,
    background: Sequence[float],
) -> tuple[RasterConfig, Reason]:
    """``config`` with the fastest of a few tile and chunk sizes."""
    behind = jnp.asarray(background, gaussians.params.means.dtype)
    times = {}
    for tile, chunk in _TRIALS:
        trial = config.replace(tile_size=tile, chunk_size=chunk)
        trial = exact_config(gaussians, view, trial)
        times[tile, chunk] = min(
            time_ms(lambda c=trial: render_exact(gaussians, view, c, behind), 5)
        )
    tile, chunk = min(times, key=lambda sizes: times[sizes])
    told = ", ".join(f"{t} and {c} {ms:.3g} ms" for (t, c), ms in times.items())
    why = f"{tile} px and {chunk} Gaussians: timed on the first camera ({told})"
    config = config.replace(tile_size=tile, chunk_size=chunk)
    return config, Reason("tile_size, chunk_size", why)
