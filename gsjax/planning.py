"""The settings that a scene needs and no more: `plan`, and the reasons for each.

Two kinds of error are kept apart. A *bound* (see `gsjax.bounds`) holds for every
camera. An *estimate* was measured on the cameras given, and is multiplied by a margin
for those that were not: what the α cut leaves out depends on how many faint splats
happen to lie over one another, and a bound on that is of use in small scenes only.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax import bounds
from gsjax.cameras import Camera
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, capacity_bucket, compact, select, with_sh_degree
from gsjax.raster.render import DEFAULT_CONFIG, exact_config, render, render_exact
from gsjax.raster.types import Demand, RasterConfig
from gsjax.timing import time_ms

_CAMERAS = 12  # to measure on, at most
_ROUNDS = 5
_ROOM = 1.125  # of capacities, for views that show more than those measured
_SH_SHARE, _STOP_SHARE = 0.25, 1 / 16
_CAP = 1 - 1e-6
_REFERENCE_CUT, _REFERENCE_STOP = 1e-5, 1e-6
_LARGEST_CUT = 0.05
# Two roundings of one picture in float32 were up to 2e-5 apart.
_ROUNDING = 2e-5
_TRIALS = ((8, 32), (16, 32), (16, 64))


class Reason(NamedTuple):
    """Why one thing is as it is.

    Attributes:
      what: the setting, or the part of the scene.
      why: in words.
      error: what it may add to the largest error of rgb.
      basis: "exact" (nothing), "bound" (for every camera), "estimate", or "rounding".
    """

    what: str
    why: str
    error: float = 0.0
    basis: str = "exact"


class Plan(NamedTuple):
    """What `plan` found.

    Attributes:
      gaussians: the scene, without what does not show.
      config: static settings for it.
      reasons: for each of them.
      budget: as asked for, or None.
      measured: largest error of rgb seen on the cameras given, of the α cut and the
        stop together; None where bounds alone decided.
    """

    gaussians: Gaussians
    config: RasterConfig
    reasons: tuple[Reason, ...]
    budget: float | None
    measured: float | None

    @property
    def error(self) -> float:
        """Sum of what the reasons may add: at most the budget."""
        return sum(reason.error for reason in self.reasons)

    @property
    def bounded(self) -> bool:
        """Whether that holds for every camera, and is not an estimate."""
        return all(reason.basis != "estimate" for reason in self.reasons)

    def lines(self) -> list[str]:
        """The reasons, one a line, errors in grey levels of 255."""
        told = []
        for what, why, error, basis in self.reasons:
            adds = f"; {basis}: {255 * error:.3g}/255" if error > 0 else ""
            told.append(f"{what}: {why}{adds}")
        kind = "bound for every camera" if self.bounded else "estimate"
        if self.budget is not None:
            limit = f"{255 * self.budget:.3g}/255"
            told.append(f"error: {255 * self.error:.3g}/255 of {limit} ({kind})")
        return told


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
      `Plan`: render its ``gaussians`` with its ``config``.

    Raises:
      InputError: if there is no camera, or the budget is not above 0, or is below what
        float32 rounding allows.
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
        config, told, measured = _within(gaussians, views, config, background, left)
        reasons += told
    gaussians, told = _shown(gaussians, config, slots)
    reasons.append(told)
    if tune:
        config, told = _tuned(gaussians, views[0], config, background)
    else:
        told = Reason(
            "tile_size, chunk_size",
            f"{config.tile_size} px and {config.chunk_size} Gaussians: the defaults "
            f"of {jax.default_backend()}, not timed (tune=True does)",
        )
    reasons.append(told)
    config, told = _with_capacities(gaussians, views, config)
    reasons += told
    return Plan(gaussians, config, tuple(reasons), budget, measured)


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
    if not 0 < budget < float("inf"):
        raise InputError(f"budget {budget}: an error above 0 is wanted, as 1 / 255")
    single = gaussians.params.means.dtype == jnp.float32
    if single and budget < 5 * _ROUNDING:
        raise InputError(
            f"budget {budget:g}: rounding in float32 comes to {_ROUNDING:g}; ask for "
            f"{5 * _ROUNDING:g} or more, or turn on jax_enable_x64"
        )


def _outputs_reason(config: RasterConfig) -> Reason:
    return Reason("outputs", f"{', '.join(config.outputs)} and no more is computed")


def _lens_reason(views: list[Camera]) -> Reason:
    lenses = sorted({view.model.name for view in views})
    return Reason("lens", f"{', '.join(lenses)}: no other lens is in the program")


def _drawn(gaussians: Gaussians) -> Gaussians:
    """Without what has a number that is not finite; the renderer leaves it out.

    Before bands are cut: that could take the number away and bring it in.
    """
    finite = np.ones(gaussians.capacity, bool)
    for leaf in jax.tree.leaves(gaussians.params):
        finite &= np.isfinite(np.asarray(leaf)).reshape(len(finite), -1).all(axis=1)
    return select(gaussians, jnp.asarray(finite))


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


# --- α cut, cap and stop ---


def _within(
    gaussians: Gaussians,
    views: list[Camera],
    config: RasterConfig,
    background: Sequence[float],
    budget: float,
) -> tuple[RasterConfig, list[Reason], float | None]:
    """``config`` with the coarsest cut and stop that keep within ``budget``."""
    spread = bounds.color_range(gaussians, background)
    share = _STOP_SHARE * budget
    stop = float(np.clip(share / max(spread, 1e-9), _REFERENCE_STOP, 1e-2))
    stop = _rounded(stop)
    config = config.replace(alpha_cap=_CAP, stop=stop, stop_rule="after")
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
        Reason("alpha_cap", f"1 − {1 - _CAP:.0e}", capping, "bound"),
    ]
    single = gaussians.params.means.dtype == jnp.float32
    if single:
        told.append(Reason("rounding", "float32", _ROUNDING, "rounding"))
    budget -= stopping + capping + _ROUNDING * single
    cut = _bounded_cut(gaussians, spread, budget)
    if cut is not None:
        error = bounds.cut_error(gaussians, cut, spread)
        why = f"{cut:g}: even all the splats over one another hide no more"
        told.append(Reason("alpha_cut", why, error, "bound"))
        return config.replace(alpha_cut=cut), told, None
    # A heuristic: of 20 random cameras of a trained scene the worst was 1.7 times as
    # far off as the worst of 12 others.
    margin = 1.5 + 2 / np.sqrt(len(views))
    least = _reference_cut(gaussians, spread, budget)
    cut, measured = _measured_cut(
        gaussians, views, config, background, (budget / margin, least)
    )
    why = (
        f"{cut:.3g}: {255 * measured:.3g}/255 off at most on {len(views)} cameras, "
        f"times {margin:.2g} for those not seen"
    )
    told.append(Reason("alpha_cut", why, margin * measured, "estimate"))
    return config.replace(alpha_cut=cut), told, measured


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
) -> tuple[float, float]:
    """(cut, error) of the coarsest cut found with an error of at most ``limits[0]``.

    The error is nearly in proportion to the cut, so a few rounds do. ``limits[1]`` is
    the cut of the reference, and what remains if none does.
    """
    allowed, least = limits
    exact = config.replace(
        alpha_cut=least, stop=min(config.stop, _REFERENCE_STOP), outputs=("rgb",)
    )
    # Finer than all trials: what it has room for is room enough for them.
    fitted = exact_config(gaussians, views[0], exact).pair_capacity or 1
    room = capacity_bucket(fitted)
    wanted = list(_pictures(gaussians, views, exact, background, room))
    best = least
    error = float("inf")
    # Coarser has failed, or would be coarser than is sensible.
    failed, cut = _LARGEST_CUT * 1.01, _rounded(max(allowed / 12, 2 * least))
    for _ in range(_ROUNDS):
        trial = config.replace(alpha_cut=cut, outputs=("rgb",))
        found = _pictures(gaussians, views, trial, background, room)
        largest = max(float(np.abs(a - b).max()) for a, b in zip(found, wanted))
        # The error is about in proportion to the cut, and so is the reference's own.
        largest *= cut / (cut - least)
        if largest <= allowed:
            best, error = cut, largest
            if largest > 0.7 * allowed:
                break
        else:
            failed = cut
            if best == least:
                error = largest * least / cut
        step = 0.9 * allowed / max(largest, allowed / 20)
        aim = min(cut * step, np.sqrt(best * failed) if failed < cut * step else 1)
        cut = _rounded(float(np.clip(aim, best, _LARGEST_CUT)))
        if cut <= best * 1.05:
            break
    return best, error


def _pictures(
    gaussians: Gaussians,
    views: list[Camera],
    config: RasterConfig,
    background: Sequence[float],
    room: int,
) -> Iterator[np.ndarray]:
    """rgb [H, W, 3] of each camera, with ``room`` for pairs, or more."""
    behind = jnp.asarray(background, gaussians.params.means.dtype)
    for view in views:
        config = config.replace(rungs=1, pair_capacity=room, visible_capacity=None)
        result = render_exact(gaussians, view, config, behind)
        room = max(room, capacity_bucket(int(result.demand.capacity)))
        yield np.asarray(result.rgb)


# --- sizes ---


def _shown(
    gaussians: Gaussians, config: RasterConfig, slots: int
) -> tuple[Gaussians, Reason]:
    """Active Gaussians that are not below the cut everywhere, in as many slots."""
    active = np.asarray(gaussians.active)
    visible = np.zeros(active.shape, bool)
    # Antialiasing only lowers opacities.
    visible[active] = bounds.opacities(gaussians) > config.alpha_cut * (1 - 1e-6)
    faint = int(active.sum() - visible.sum())
    count = max(int(visible.sum()), 1)
    gaussians = compact(select(gaussians, jnp.asarray(visible)), count)
    why = f"{count:,} slots in place of {slots:,}"
    if faint:
        why += f"; {faint:,} Gaussians are nowhere above the α cut"
    return gaussians, Reason("capacity", why)


def _with_capacities(
    gaussians: Gaussians, views: list[Camera], config: RasterConfig
) -> tuple[RasterConfig, list[Reason]]:
    """``config`` with room for what the cameras ask for and an eighth more."""
    fitted = exact_config(gaussians, views[0], config)
    room = fitted.pair_capacity or 1
    light = config.replace(outputs=("alpha",), rungs=1, visible_capacity=None)
    pairs = seen = 1
    for view in views:
        while True:
            demand = _demand(gaussians, view, light.replace(pair_capacity=room))
            wanted = int(demand.capacity)
            if wanted <= room:
                break
            room = capacity_bucket(wanted)
        pairs, seen = max(pairs, wanted), max(seen, int(demand.visible))
    visible = min(_roomy(seen), gaussians.capacity)
    reasons = [
        Reason("visible_capacity", f"{visible:,}: at most {seen:,} are in a view"),
        Reason("pair_capacity", f"{_roomy(pairs):,}: views ask for {pairs:,} at most"),
    ]
    config = config.replace(pair_capacity=_roomy(pairs), visible_capacity=visible)
    return config, reasons


@partial(jax.jit, static_argnames="config")
def _demand(gaussians: Gaussians, camera: Camera, config: RasterConfig) -> Demand:
    return render(gaussians, camera, config).demand


def _roomy(count: int) -> int:
    """An eighth more, in whole steps of about that size or less."""
    step = max(256, 2 ** (max(count, 1).bit_length() - 4))
    return -(-int(_ROOM * count) // step) * step


def _tuned(
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
