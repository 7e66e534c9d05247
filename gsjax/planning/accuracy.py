"""The coarsest accuracy settings whose error stays within a budget."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, capacity_bucket
from gsjax.planning import bounds
from gsjax.planning.types import Reason
from gsjax.raster.exact import render_exact
from gsjax.raster.types import Demand, RasterConfig

ROUNDING = 2e-5  # largest difference of two float32 roundings of one image
_ROUNDS = 5
_STOP_SHARE = 1 / 16  # share of the budget for stopping early
_ALPHA_MAX = 1 - 1e-6
_REFERENCE_ALPHA_MIN, _LEAST_TRANSMITTANCE = 1e-5, 1e-6
_PROVEN_ALPHA_MIN = (0.05, 0.02, 0.01, 1 / 255)  # tried by their bounds
_LARGEST_ALPHA_MIN = 0.05
_PAIRS_PER_GAUSSIAN = 8  # first guess of the capacity


class Measured(NamedTuple):
    """Largest error of a colour with one α cutoff, and the counts of each view."""

    error: float
    demands: list[Demand]


def fit_budget(
    gaussians: Gaussians,
    views: list[Camera],
    config: RasterConfig,
    background: Sequence[float],
    budget: float,
) -> tuple[RasterConfig, list[Reason], Measured | None]:
    """Return ``config`` with the coarsest cutoffs within ``budget``, and the reasons.

    The third result holds the measurements with these cutoffs; it is None if bounds
    alone decided.

    Raises:
      InputError: if the colour range is too large for the finest cutoffs.
    """
    spread = bounds.color_range(gaussians, background)
    stop = _STOP_SHARE * budget / max(spread, 1e-9)
    stop = _rounded(float(np.clip(stop, _LEAST_TRANSMITTANCE, 1e-2)))
    chosen = {"alpha_max": _ALPHA_MAX, "transmittance_min": stop, "stop_rule": "after"}
    config = config.replace(**chosen)
    stop_error = bounds.stop_error(stop, "after", _ALPHA_MAX, spread)
    alpha_max_error = bounds.alpha_max_error(_ALPHA_MAX, spread)
    why = f"{stop:g}: the weight behind is less; the colour range is {spread:.3g}"
    reasons = [
        Reason("transmittance_min", why, stop_error, "bound"),
        Reason("alpha_max", f"1 − {1 - _ALPHA_MAX:.0e}", alpha_max_error, "bound"),
    ]
    single = gaussians.params.means.dtype == jnp.float32
    if single:
        reasons.append(Reason("rounding", "float32", ROUNDING, "rounding"))
    fixed = stop_error + alpha_max_error + ROUNDING * single
    if not fixed < budget:
        raise InputError(
            f"budget: expected more than {fixed:.2g} to be left for transmittance_min, "
            f"alpha_max and rounding, got {budget:.2g} with a colour range of "
            f"{spread:.3g}; raise the budget, or remove the brightest Gaussians"
        )
    budget -= fixed
    for cutoff in _PROVEN_ALPHA_MIN:
        error = bounds.alpha_min_error(gaussians, cutoff, spread)
        if error <= budget:
            why = f"{cutoff:g}: holds even if all splats overlap"
            reasons.append(Reason("alpha_min", why, error, "bound"))
            return config.replace(alpha_min=cutoff), reasons, None
    margin = margin_for(len(views))
    least = _reference_alpha_min(gaussians, spread, budget)
    cutoff, measured = _measured_alpha_min(
        gaussians, views, config, background, (budget / margin, least)
    )
    why = (
        f"{cutoff:.3g}: largest error {255 * measured.error:.3g}/255 on {len(views)} "
        f"camera{'s' * (len(views) != 1)}, times {margin:.2g} for other cameras"
    )
    reasons.append(Reason("alpha_min", why, margin * measured.error, "estimate"))
    return config.replace(alpha_min=cutoff), reasons, measured


def margin_for(cameras: int) -> float:
    """Return the factor from the error on some cameras to that on others.

    A heuristic: other cameras of a trained scene had 1.7 times the error of 12 of it.
    """
    return 1.5 + 2 / np.sqrt(cameras)


def _rounded(value: float) -> float:
    """Round down to two digits, so that close plans share compiled programs."""
    power = 10.0 ** (np.floor(np.log10(value)) - 1)
    return float(f"{np.floor(value / power * (1 + 1e-9)) * power:.2g}")


def _reference_alpha_min(gaussians: Gaussians, spread: float, budget: float) -> float:
    """Return a cutoff whose fainter splats add up to a tenth of the budget at most."""
    cutoff = min(_REFERENCE_ALPHA_MIN, budget / 400)
    opacity = bounds.opacities(gaussians)
    while cutoff > 1e-12 and spread * opacity[opacity < cutoff].sum() > 0.1 * budget:
        cutoff /= 10
    return cutoff


def _measured_alpha_min(
    gaussians: Gaussians,
    views: list[Camera],
    config: RasterConfig,
    background: Sequence[float],
    limits: tuple[float, float],
) -> tuple[float, Measured]:
    """Return the coarsest cutoff found with an error of at most ``limits[0]``.

    The error is nearly proportional to the cutoff, so a few rounds suffice.
    ``limits[1]`` is the cutoff of the reference, and the result if no other fits.
    """
    allowed, least = limits
    behind = jnp.asarray(background, gaussians.params.means.dtype)
    config = config.replace(num_size_buckets=1, outputs=("rgb",), visible_capacity=None)
    capacity = capacity_bucket(_PAIRS_PER_GAUSSIAN * gaussians.capacity)

    def draw(cutoff: float) -> list[tuple[np.ndarray, Demand]]:
        """Return rgb and demand of each view; all cutoffs share one program."""
        nonlocal capacity
        drawn, alpha_min = [], jnp.asarray(cutoff, behind.dtype)
        for view in views:
            roomy = config.replace(pair_capacity=capacity)
            result = render_exact(gaussians, view, roomy, behind, alpha_min=alpha_min)
            capacity = max(capacity, capacity_bucket(int(result.demand.capacity)))
            drawn.append((np.asarray(result.rgb), result.demand))
        return drawn

    # The finest cutoff needs the most pairs: its capacity is enough for the others.
    references, demands = zip(*draw(least))
    best, found = least, Measured(float("inf"), list(demands))
    # The coarsest cutoff known to fail, or beyond what is sensible.
    failed = _LARGEST_ALPHA_MIN * 1.01
    cutoff = _rounded(max(allowed / 12, 2 * least))
    for _ in range(_ROUNDS):
        drawn, demands = zip(*draw(cutoff))
        largest = max(float(np.abs(a - b).max()) for a, b in zip(drawn, references))
        largest *= cutoff / (cutoff - least)  # for the error of the reference
        if largest <= allowed:
            best, found = cutoff, Measured(largest, list(demands))
            if largest > 0.7 * allowed:
                break
        else:
            failed = cutoff
            if best == least:
                found = found._replace(error=largest * least / cutoff)
        step = cutoff * (0.9 * allowed / max(largest, allowed / 20))
        step = min(step, np.sqrt(best * failed) if failed < step else 1)
        cutoff = _rounded(float(np.clip(step, best, _LARGEST_ALPHA_MIN)))
        if cutoff <= best * 1.05:
            break
    return best, found
