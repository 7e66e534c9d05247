"""Slots, capacities, tile and chunk sizes for a scene and its cameras."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians, compact, select
from gsjax.planning import bounds
from gsjax.planning.types import Reason
from gsjax.raster.exact import count_demand, exact_config, render_exact
from gsjax.raster.memory_estimate import render_estimate
from gsjax.raster.types import Demand, RasterConfig
from gsjax.runtime.memory import size_text
from gsjax.runtime.timing import time_ms

_MARGIN = 1.125  # on capacities, for views that show more than those measured
_TRIALS = ((8, 32), (16, 32), (16, 64))  # tile and chunk sizes


def drop_faint(gaussians: Gaussians, config: RasterConfig) -> tuple[Gaussians, str]:
    """Keep active Gaussians with an opacity above ``config.alpha_min``, and say so."""
    active = np.asarray(gaussians.active)
    visible = np.zeros(active.shape, bool)
    # Antialiasing only lowers opacities.
    visible[active] = bounds.opacities(gaussians) > config.alpha_min * (1 - 1e-6)
    faint = int(active.sum() - visible.sum())
    count = max(int(visible.sum()), 1)
    gaussians = compact(select(gaussians, jnp.asarray(visible)), count)
    why = f"; {faint:,} Gaussians are nowhere above the α cutoff" if faint else ""
    return gaussians, why


def fit_capacities(
    gaussians: Gaussians,
    views: list[Camera],
    config: RasterConfig,
    demands: Sequence[Demand] | None = None,
) -> tuple[RasterConfig, list[Reason]]:
    """Return ``config`` with capacities for the cameras and an eighth more.

    ``demands`` are those of these cameras with that config, if they are known.
    """
    if demands is None:
        unlimited = config.replace(visible_capacity=None)
        demands = [count_demand(gaussians, view, unlimited) for view in views]
    pairs = max(1, *(int(demand.capacity) for demand in demands))
    seen = max(1, *(int(demand.visible) for demand in demands))
    visible = min(_with_margin(seen), gaussians.capacity)
    capacity = _with_margin(pairs)
    config = config.replace(pair_capacity=capacity, visible_capacity=visible)
    size = views[0].width, views[0].height
    bases = gaussians.params.sh.shape[-2]
    memory = size_text(render_estimate(gaussians.capacity, bases, size, config).total)
    return config, [
        Reason("visible_capacity", f"{visible:,}: at most {seen:,} are in a view"),
        Reason("pair_capacity", f"{capacity:,}: views need {pairs:,} at most"),
        Reason("memory", f"about {memory} for an image of {size[0]} × {size[1]}"),
    ]


def _with_margin(count: int) -> int:
    """Add an eighth, rounded up to steps of about that size or less."""
    step = max(256, 2 ** (max(count, 1).bit_length() - 4))
    return -(-int(_MARGIN * count) // step) * step


def tune_sizes(
    gaussians: Gaussians,
    view: Camera,
    config: RasterConfig,
    background: Sequence[float],
) -> tuple[RasterConfig, Reason]:
    """Return ``config`` with the fastest of a few tile and chunk sizes."""
    behind = jnp.asarray(background, gaussians.params.means.dtype)
    times = {}
    for tile, chunk in _TRIALS:
        trial = config.replace(tile_size=tile, chunk_size=chunk)
        trial = exact_config(gaussians, view, trial)
        times[tile, chunk] = min(
            time_ms(lambda c=trial: render_exact(gaussians, view, c, behind), 5)
        )
    tile, chunk = min(times, key=lambda sizes: times[sizes])
    timed = ", ".join(f"{t} and {c} {ms:.3g} ms" for (t, c), ms in times.items())
    why = f"{tile} px and {chunk} Gaussians: timed on the first camera ({timed})"
    config = config.replace(tile_size=tile, chunk_size=chunk)
    return config, Reason("tile_size, chunk_size", why)
