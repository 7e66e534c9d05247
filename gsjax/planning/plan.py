"""Choice of the settings that a scene needs, with a reason for each: `plan`.

A *bound* (`gsjax.planning.bounds`) holds for every camera. An *estimate* is measured on
the cameras given and multiplied by a margin for other cameras. For small scenes the
α-cutoff error is a bound; for larger ones it is an estimate, and is labelled as one.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, select, with_sh_degree
from gsjax.planning import bounds
from gsjax.planning.accuracy import ROUNDING, fit_budget
from gsjax.planning.order import choose_order
from gsjax.planning.sizes import drop_faint, fit_capacities, tune_sizes
from gsjax.planning.types import Plan, Reason
from gsjax.raster.argument_checks import requires_concrete_values
from gsjax.raster.render import DEFAULT_CONFIG
from gsjax.raster.types import COLOR_LIMIT, RasterConfig
from gsjax.runtime.devices import platform_name

_MAX_CAMERAS = 12
_SH_SHARE = 0.25  # share of the budget for leaving out bands


@requires_concrete_values()
def plan(
    gaussians: Gaussians,
    cameras: Camera | Sequence[Camera],
    *,
    budget: float | None = None,
    config: RasterConfig = DEFAULT_CONFIG,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    outputs: Sequence[str] = ("rgb",),
    tune: bool = False,
) -> Plan:
    """Choose the settings that a scene needs from such cameras.

    It renders and compiles a few programs, so it pays off if many views follow. Call it
    outside jit, vmap and scan.

    Args:
      gaussians: N slots, concrete.
      cameras: one, a batch, or several; at most 12, evenly spaced, are measured. Other
        cameras should be similar.
      budget: largest error of a channel of rgb against the exact image, e.g. 1 / 255.
        That image has the order of ``config``, or for a window that of each pixel.
        None keeps the accuracy of ``config`` and leaves out only what is invisible.
      config: other settings, such as dilation and antialiasing, are kept.
      background: [3] colour behind the views.
      outputs: images to compute; the budget concerns rgb.
      tune: also time tile and chunk sizes on the first camera.

    Returns:
      A plan; render its ``gaussians`` with its ``config``.

    Raises:
      InputError: if there is no camera; if the budget is not in (0, 1), is below the
        rounding of float32, or is too small for the colour range; or under `jax.jit`,
        `vmap` or `scan`.
      CapacityError: as `render_exact`.
    """
    views = _sample(cameras)
    if budget is not None:
        _check_budget(budget, gaussians)
    config = config.replace(outputs=tuple(outputs), absgrad=False)
    lenses = ", ".join(sorted({view.lens.name for view in views}))
    reasons = [
        Reason("outputs", f"only {', '.join(config.outputs)} are computed"),
        Reason("lens", f"{lenses}: no other lens is compiled"),
    ]
    slots = gaussians.capacity
    gaussians, reason = _choose_sh_degree(_drop_invalid(gaussians), budget)
    reasons.append(reason)
    config, reason = choose_order(gaussians, views, config, background, budget)
    reasons.append(reason)
    measured = None
    if budget is not None and bool(np.any(np.asarray(gaussians.active))):
        left = budget - sum(reason.error for reason in reasons)
        config, found, measured = fit_budget(gaussians, views, config, background, left)
        reasons += found
    gaussians, why = drop_faint(gaussians, config)
    why = f"{gaussians.capacity:,} slots in place of {slots:,}{why}"
    reasons.append(Reason("capacity", why))
    if tune:
        config, reason = tune_sizes(gaussians, views[0], config, background)
    else:
        reason = Reason(
            "tile_size, chunk_size",
            f"{config.tile_size} px and {config.chunk_size} Gaussians: the defaults "
            f"of {platform_name()}, not timed (tune=True does)",
        )
    reasons.append(reason)
    demands = None if measured is None or tune else measured.demands
    config, found = fit_capacities(gaussians, views, config, demands)
    reasons += found
    error = None if measured is None else measured.error
    return Plan(gaussians, config, tuple(reasons), budget, error)


def trim_scene(gaussians: Gaussians, config: RasterConfig) -> Gaussians:
    """Remove what changes no render of any camera beyond rounding, and spare slots.

    That is SH bands that are 0, and Gaussians nowhere above ``config.alpha_min``.
    """
    gaussians = _drop_invalid(gaussians)
    gaussians = with_sh_degree(gaussians, bounds.highest_band(gaussians))
    return drop_faint(gaussians, config)[0]


def _sample(cameras: Camera | Sequence[Camera]) -> list[Camera]:
    """Return at most `_MAX_CAMERAS` single cameras, with the first and the last."""
    singles = []
    for camera in [cameras] if isinstance(cameras, Camera) else cameras:
        count = camera.viewmat.shape[0] if camera.batched else 0
        singles += [jax.tree.map(lambda a, i=i: a[i], camera) for i in range(count)]
        singles += [] if camera.batched else [camera]
    if not singles:
        raise InputError("cameras: expected at least one camera, got none")
    count = min(len(singles), _MAX_CAMERAS)
    return [singles[i] for i in np.linspace(0, len(singles) - 1, count).astype(int)]


def _check_budget(budget: float, gaussians: Gaussians) -> None:
    """Raise `InputError` if no plan can keep the budget."""
    if not 0 < budget < 1:
        raise InputError(f"budget: expected an error above 0 and below 1, got {budget}")
    if gaussians.params.means.dtype == jnp.float32 and budget < 5 * ROUNDING:
        raise InputError(
            f"budget: expected at least {5 * ROUNDING:g} in float32, whose rounding is "
            f"{ROUNDING:g}, got {budget:g}; raise it, or enable jax_enable_x64"
        )


def _drop_invalid(gaussians: Gaussians) -> Gaussians:
    """Remove Gaussians that the renderer leaves out: non-finite or with huge colours.

    This comes before bands are removed, which could make such a Gaussian valid.
    """
    valid = (np.abs(np.asarray(gaussians.params.sh)) < COLOR_LIMIT).all(axis=(1, 2))
    for leaf in jax.tree.leaves(gaussians.params):
        valid &= (
            np.isfinite(np.asarray(leaf)).reshape(gaussians.capacity, -1).all(axis=1)
        )
    return select(gaussians, jnp.asarray(valid))


def _choose_sh_degree(
    gaussians: Gaussians, budget: float | None
) -> tuple[Gaussians, Reason]:
    """Reduce the SH degree to the lowest whose error bound is within its share."""
    degree, allowed = gaussians.sh_degree, _SH_SHARE * (budget or 0.0)
    if degree == 0:
        return gaussians, Reason("SH degree", "0: colours do not depend on the view")
    errors = [bounds.degree_error(gaussians, d) for d in range(degree)]
    least = next((d for d, error in enumerate(errors) if error <= allowed), degree)
    if least == degree:
        error = f"{255 * errors[-1]:.3g}/255"
        why = f"{degree}: without its last band rgb could change by {error}"
        return gaussians, Reason("SH degree", why)
    kind, basis = ("invisible", "bound") if errors[least] else ("0", "exact")
    why = f"{least} in place of {degree}: the bands above are {kind}"
    reason = Reason("SH degree", why, errors[least], basis)
    return with_sh_degree(gaussians, least), reason
