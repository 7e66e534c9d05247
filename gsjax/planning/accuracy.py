"""The coarsest α cut, cap and stop that keep within an error."""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, capacity_bucket
from gsjax.planning import bounds
from gsjax.planning.types import Reason
from gsjax.raster.render import render_at_cut
from gsjax.raster.types import Demand, RasterConfig

# Two roundings of one picture in float32 were up to 2e-5 apart.
ROUNDING = 2e-5
_ROUNDS = 5
_STOP_SHARE = 1 / 16
_CAP = 1 - 1e-6
_REFERENCE_CUT, _LEAST_STOP = 1e-5, 1e-6
_LARGEST_CUT = 0.05
_TILES = 8  # of a Gaussian, to begin with


class Measured(NamedTuple):
    """What was found with an α cut.

    Attributes:
      error: largest of a colour, on the cameras given.
      demands: what each of these views wants.
    """

    error: float
    demands: list[Demand]


def within_budget(
    gaussians: Gaussians,
    views: list[Camera],
    config: RasterConfig,
    background: Sequence[float],
    budget: float,
) -> tuple[RasterConfig, list[Reason], Measured | None]:
    """``config`` with the coarsest cut and stop that keep within ``budget``, why, and
    what was measured with these; None where bounds alone decided.

    Raises:
      InputError: if colours are so far apart that not even the finest do.
    """
    spread = bounds.color_range(gaussians, background)
    share = _STOP_SHARE * budget
    stop = float(np.clip(share / max(spread, 1e-9), _LEAST_STOP, 1e-2))
    stop = _rounded(stop)
    config = config.replace(alpha_max=_CAP, stop=stop, stop_rule="after")
    stopping = bounds.stop_error(stop, "after", _CAP, spread)
    capping = bounds.cap_error(_CAP, spread)
    told = [
        Reason(
            "stop",
            f"after T = {stop:g}: what is behind weighs less, colours span "
            f"{spread:.3g}",
            stopping,
            "bound",
        ),
        Reason("alpha_max", f"1 − {1 - _CAP:.0e}", capping, "bound"),
    ]
    single = gaussians.params.means.dtype == jnp.float32
    if single:
        told.append(Reason("rounding", "float32", ROUNDING, "rounding"))
    fixed = stopping + capping + ROUNDING * single
    if not fixed < budget:
        raise InputError(
            f"{budget:.2g} is left of the budget, and where to stop, the cap and "
            f"rounding alone may come to {fixed:.2g}: colours span {spread:.3g}, in "
            "some direction; ask for more, or drop what is so bright"
        )
    budget -= fixed
    cut = _bounded_cut(gaussians, spread, budget)
    if cut is not None:
        error = bounds.cut_error(gaussians, cut, spread)
        why = f"{cut:g}: even all the splats over one another hide no more"
        told.append(Reason("alpha_min", why, error, "bound"))
        return config.replace(alpha_min=cut), told, None
    # A heuristic: of 20 random cameras of a trained scene the worst was 1.7 times as
    # far off as the worst of 12 others.
    margin = 1.5 + 2 / np.sqrt(len(views))
    least = _reference_cut(gaussians, spread, budget)
    cut, measured = _measured_cut(
        gaussians, views, config, background, (budget / margin, least)
    )
    why = (
        f"{cut:.3g}: {255 * measured.error:.3g}/255 off at most on {len(views)} "
        f"camera{'s' * (len(views) != 1)}, times {margin:.2g} for those not seen"
    )
    told.append(Reason("alpha_min", why, margin * measured.error, "estimate"))
    return config.replace(alpha_min=cut), told, measured


def _rounded(value: float) -> float:
    """Down to two digits: close plans share compiled programs."""
    power = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(f"{np.floor(value / power * (1 + 1e-9)) * power:.2g}")


def _bounded_cut(gaussians: Gaussians, spread: float, budget: float) -> float | None:
    """A cut that is no finer than the field's and within ``budget`` for every camera;
    None if there is none."""
    for cut in (_LARGEST_CUT, 0.02, 0.01, 1 / 255):
        if bounds.cut_error(gaussians, cut, spread) <= budget:
            return cut
    return None


def _reference_cut(gaussians: Gaussians, spread: float, budget: float) -> float:
    """Cut of the picture to measure against: `RasterConfig.accurate`'s, or finer where
    splats that are fainter than that could add up to a tenth of the budget."""
    cut = min(_REFERENCE_CUT, budget / 400)
    opacity = bounds.opacities(gaussians)
    while cut > 1e-12 and spread * opacity[opacity < cut].sum() > 0.1 * budget:
        cut /= 10
    return cut


def _measured_cut(
    gaussians: Gaussians,
    views: list[Camera],
    config: RasterConfig,
    background: Sequence[float],
    limits: tuple[float, float],
) -> tuple[float, Measured]:
    """The coarsest cut found with an error of at most ``limits[0]``.

    The error is nearly in proportion to the cut, so a few rounds do. ``limits[1]`` is
    the cut of the reference, and what remains if none does.
    """
    allowed, least = limits
    draw = partial(_pictures, gaussians, views, config, background)
    # Of all cuts the finest wants most: what it has room for is enough for the others.
    room = capacity_bucket(_TILES * gaussians.capacity)
    wanted, demands = zip(*draw(room, least))
    room = max(room, *(capacity_bucket(int(demand.capacity)) for demand in demands))
    best, found = least, Measured(float("inf"), list(demands))
    # Coarser has failed, or would be coarser than is sensible.
    failed, cut = _LARGEST_CUT * 1.01, _rounded(max(allowed / 12, 2 * least))
    for _ in range(_ROUNDS):
        largest, demands = 0.0, []
        for (picture, demand), exactly in zip(draw(room, cut), wanted):
            largest = max(largest, float(np.abs(picture - exactly).max()))
            demands.append(demand)
        # The error is about in proportion to the cut, and so is the reference's own.
        largest *= cut / (cut - least)
        if largest <= allowed:
            best, found = cut, Measured(largest, demands)
            if largest > 0.7 * allowed:
                break
        else:
            failed = cut
            if best == least:
                found = found._replace(error=largest * least / cut)
        step = 0.9 * allowed / max(largest, allowed / 20)
        aim = min(cut * step, np.sqrt(best * failed) if failed < cut * step else 1)
        cut = _rounded(float(np.clip(aim, best, _LARGEST_CUT)))
        if cut <= best * 1.05:
            break
    return best, found


def _pictures(
    gaussians: Gaussians,
    views: list[Camera],
    config: RasterConfig,
    background: Sequence[float],
    room: int,
    cut: float,
) -> Iterator[tuple[np.ndarray, Demand]]:
    """rgb [H, W, 3] of each camera with an α cut, by one program for any, and what it
    wants; with ``room`` for pairs, or more."""
    behind = jnp.asarray(background, gaussians.params.means.dtype)
    config = config.replace(num_size_buckets=1, outputs=("rgb",), visible_capacity=None)
    for view in views:
        config = config.replace(pair_capacity=room)
        result = render_at_cut(gaussians, view, config, behind, cut)
        room = max(room, capacity_bucket(int(result.demand.capacity)))
        yield np.asarray(result.rgb), result.demand
