"""The settings that a scene needs and no more: `plan`, and the reasons for each.

Two kinds of error are kept apart. A *bound* (see `gsjax.planning.bounds`) holds for
every camera. An *estimate* was measured on the cameras given, and is multiplied by a
margin for those that were not: what the α cut leaves out depends on how many faint
splats happen to lie over one another, and a bound on that is of use in small scenes
only.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, select, with_sh_degree
from gsjax.planning import bounds
from gsjax.planning.accuracy import ROUNDING, within_budget
from gsjax.planning.sizes import shown, tuned, with_capacities
from gsjax.planning.types import Plan, Reason
from gsjax.raster.render import DEFAULT_CONFIG, requires_concrete_values
from gsjax.raster.types import COLOR_LIMIT, RasterConfig
from gsjax.runtime.devices import platform_name

_CAMERAS = 12  # to measure on, at most
_SH_SHARE = 0.25


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
    """The settings that this scene needs, seen from such cameras, and no more.

    From the host: it renders, and compiles a few programs. Pays where many views
    follow.

    Args:
      gaussians: N slots, concrete.
      cameras: one, a batch, or several; up to 12 of them, evenly chosen, are measured
        on. Cameras to come should be like these.
      budget: largest error of a channel of rgb against the exact picture, e.g.
        1 / 255. None leaves accuracy as ``config`` has it, and skips only what changes
        nothing.
      config: its dilation and antialiasing belong to the scene and are kept; what
        is not decided here too.
      background: [3] that the views have.
      outputs: what is wanted; the budget is one of rgb.
      tune: also time tile and chunk sizes on the first camera.

    Returns:
      A plan; render its ``gaussians`` with its ``config``.

    Raises:
      InputError: if there is no camera, or the budget is not above 0, or is below what
        float32 rounding allows, or colours span too much for it; and under `jax.jit`,
        `vmap` or `scan`.
      CapacityError: as `render_exact`.
    """
    views = _sampled(cameras)
    _check_budget(budget, gaussians)
    config = config.replace(outputs=tuple(outputs), absgrad=False)
    reasons = [_outputs_reason(config), _lens_reason(views)]
    slots = gaussians.capacity
    gaussians, told = _without_bands(_drawn(gaussians), budget)
    reasons.append(told)
    measured = None
    if budget is not None and bool(np.any(np.asarray(gaussians.active))):
        left = budget - sum(reason.error for reason in reasons)
        config, told, measured = within_budget(
            gaussians, views, config, background, left
        )
        reasons += told
    gaussians, told = shown(gaussians, config, slots)
    reasons.append(told)
    if tune:
        config, told = tuned(gaussians, views[0], config, background)
    else:
        told = Reason(
            "tile_size, chunk_size",
            f"{config.tile_size} px and {config.chunk_size} Gaussians: the defaults "
            f"of {platform_name()}, not timed (tune=True does)",
        )
    reasons.append(told)
    demands = None if measured is None or tune else measured.demands
    config, told = with_capacities(gaussians, views, config, demands)
    reasons += told
    error = None if measured is None else measured.error
    return Plan(gaussians, config, tuple(reasons), budget, error)


def trimmed(gaussians: Gaussians, config: RasterConfig) -> Gaussians:
    """The scene without what changes no render of any camera beyond rounding: bands of
    spherical harmonics that are 0, Gaussians that are nowhere above the α cut. (Of a
    movie of depths, the range of colours is that of the Gaussians that are left.)

    Args:
      gaussians: N slots, concrete.
      config: whose α cut it is.

    Returns:
      In as many slots as there are Gaussians left.
    """
    slots = gaussians.capacity
    gaussians = _drawn(gaussians)
    gaussians = with_sh_degree(gaussians, bounds.highest_band(gaussians))
    return shown(gaussians, config, slots)[0]


def _sampled(cameras: Camera | Sequence[Camera]) -> list[Camera]:
    """At most `_CAMERAS` single cameras, the first and the last among them."""
    given = [cameras] if isinstance(cameras, Camera) else list(cameras)
    singles = []
    for camera in given:
        if camera.batched:
            count = camera.viewmat.shape[0]
            singles += [jax.tree.map(lambda a, i=i: a[i], camera) for i in range(count)]
        else:
            singles.append(camera)
    if not singles:
        raise InputError("no camera: a plan is made for cameras; pass one at least")
    count = min(len(singles), _CAMERAS)
    return [singles[i] for i in np.linspace(0, len(singles) - 1, count).astype(int)]


def _check_budget(budget: float | None, gaussians: Gaussians) -> None:
    if budget is None:
        return
    if not 0 < budget < 1:
        raise InputError(
            f"budget {budget}: an error above 0 and below 1 is wanted, as 1 / 255"
        )
    single = gaussians.params.means.dtype == jnp.float32
    if single and budget < 5 * ROUNDING:
        raise InputError(
            f"budget {budget:g}: rounding in float32 comes to {ROUNDING:g}; ask for "
            f"{5 * ROUNDING:g} or more, or turn on jax_enable_x64"
        )


def _outputs_reason(config: RasterConfig) -> Reason:
    return Reason("outputs", f"{', '.join(config.outputs)} and no more is computed")


def _lens_reason(views: list[Camera]) -> Reason:
    lenses = sorted({view.model.name for view in views})
    return Reason("lens", f"{', '.join(lenses)}: no other lens is in the program")


def _drawn(gaussians: Gaussians) -> Gaussians:
    """Without what has a number that is not finite, or a colour that counts as none;
    the renderer leaves it out.

    Before bands are cut: that could take the number away and bring it in.
    """
    drawn = np.ones(gaussians.capacity, bool)
    for leaf in jax.tree.leaves(gaussians.params):
        drawn &= np.isfinite(np.asarray(leaf)).reshape(len(drawn), -1).all(axis=1)
    colors = np.abs(np.asarray(gaussians.params.sh)) < COLOR_LIMIT
    drawn &= colors.all(axis=(1, 2))
    return select(gaussians, jnp.asarray(drawn))


def _without_bands(
    gaussians: Gaussians, budget: float | None
) -> tuple[Gaussians, Reason]:
    """The lowest SH degree whose bound is within its share."""
    degree = gaussians.sh_degree
    allowed = 0.0 if budget is None else _SH_SHARE * budget
    errors = [bounds.degree_error(gaussians, d) for d in range(degree + 1)]
    least = next((d for d in range(degree) if errors[d] <= allowed), degree)
    if degree == 0:
        return gaussians, Reason("SH degree", "0: colours do not turn with the view")
    if least == degree:
        short = errors[degree - 1]
        why = f"{degree}: without its last band rgb could be {255 * short:.3g}/255 off"
        return gaussians, Reason("SH degree", why)
    kind = "are 0" if errors[least] == 0 else "do not show"
    why = f"{least} in place of {degree}: the bands above {kind}"
    basis = "bound" if errors[least] else "exact"
    told = Reason("SH degree", why, errors[least], basis)
    return with_sh_degree(gaussians, least), told
