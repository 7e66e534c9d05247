"""What training leans on: initial scales, optimiser, resets, structural similarity."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax

from gsjax.cameras.camera import look_at
from gsjax.data.types import Dataset, View
from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.densify.types import SlotEdit, apply_edit
from gsjax.gaussians import Gaussians
from gsjax.init.gaussians import init_gaussians
from gsjax.math.numerics import logit
from gsjax.stress.scenes import (
    SLOTS,
    camera_of,
    changed,
    not_finite,
    oracle,
    single,
    unequal,
    usual,
    usual_gradients,
)
from gsjax.stress.types import Case, Measured, worse
from gsjax.train.metrics import ssim
from gsjax.train.optimiser import Rates, gaussian_rates, make_optimiser


def similarity(full: bool) -> Measured:
    """Largest |1 − SSIM| of equal pictures, some of them smaller than the window."""
    shapes = ((1, 1), (5, 7), (32, 32)) if full else ((1, 1), (32, 32))
    score, worst, count = jax.jit(ssim), 0.0, 0
    for height, width in shapes:
        drawn = np.random.default_rng(0).uniform(size=(height, width, 3))
        flat = [np.full((height, width, 3), v) for v in (0, 1e-3, 0.1, 0.5, 0.999, 1)]
        for image in single([*flat, drawn, 1 - 1e-3 * drawn]):
            count += 1
            worst = worse(worst, abs(1 - float(score(image, image))))
    return Measured(worst, f"{count} pictures")


_OPTIMISER = make_optimiser(gaussian_rates(Rates(), 1.0))


@jax.jit
def _step(params, grads, moments):
    updates, moments = _OPTIMISER.update(
        grads, moments, params, fraction=jnp.float32(0)
    )
    return optax.apply_updates(params, updates), moments


def dead_slots(full: bool) -> Measured:
    """Numbers of dead slots that Adam moves after they have had gradients."""
    start = usual()
    ones = jax.tree.map(jnp.ones_like, start.params)
    params, moments = _step(start.params, ones, _OPTIMISER.init(start.params))
    dead = jnp.arange(SLOTS) % 2 == 0
    edit = SlotEdit(
        params=params,
        active=~dead,
        cleared=dead,
        opacities_reset=jnp.asarray(False),
        wanted=jnp.int32(0),
    )
    edited, moments = apply_edit(edit, moments)
    params = edited.params
    grads = jax.tree.map(
        lambda g: jnp.where(dead.reshape(-1, *(1,) * (g.ndim - 1)), 0, g), ones
    )
    for _ in range(100 if full else 10):
        params, moments = _step(params, grads, moments)
    rows = [jax.tree.map(lambda a: a[dead], p) for p in (params, edited.params)]
    live = [jax.tree.map(lambda a: a[~dead], p) for p in (params, edited.params)]
    return Measured(
        unequal(*rows) if unequal(*live) else np.nan, f"{int(dead.sum())} dead slots"
    )


def reset_opacities(full: bool) -> Measured:
    """Gaussians that a reset leaves without a gradient that they should have."""
    del full
    low = float(logit(jnp.float32(AdaptiveSettings().reset_opacity)))
    reset = changed(usual(), logit_opacities=np.full(SLOTS, low, np.float32))
    _, slopes = usual_gradients(reset)
    _, _, wanted = oracle(reset, camera_of())
    live = np.abs(wanted.params.logit_opacities) > 1e-6
    lost = live & (slopes.params.logit_opacities == 0)
    seen = int(live.sum())
    count = int(lost.sum()) + _kept_moments(reset)
    return Measured(count if seen > SLOTS // 2 else np.nan, f"of {seen}")


def _kept_moments(reset: Gaussians) -> int:
    """Moments of opacities that outlive a reset, or of anything else that do not."""
    ones = jax.tree.map(jnp.ones_like, reset.params)
    _, moments = _step(reset.params, ones, _OPTIMISER.init(reset.params))
    edit = SlotEdit(
        params=reset.params,
        active=reset.active,
        cleared=jnp.zeros(SLOTS, bool),
        opacities_reset=jnp.asarray(True),
        wanted=jnp.int32(SLOTS),
    )
    _, after = apply_edit(edit, moments)
    wanted = [
        moment.replace(logit_opacities=jnp.zeros(SLOTS))
        for moment in (moments[0].mu, moments[0].nu)
    ]
    return unequal([after[0].mu, after[0].nu], wanted)


def initial_scales(full: bool) -> Measured:
    """Numbers not finite in Gaussians made of few, collinear or equal points."""
    del full
    K = np.array([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]])
    views = tuple(
        View(str(x), Path("none"), look_at((x, -4, 1), (0, 0, 0)), K, 32, 32)
        for x in (-1.0, 1.0)
    )
    line = np.linspace(0, 1, 50)[:, None] * [1.0, 2.0, 3.0]
    clouds = {
        "one": np.zeros((1, 3)),
        "two": line[:2],
        "three": line[:3],
        "equal": np.ones((50, 3)),
        "collinear": line,
        "some equal": np.concatenate([line, line, line, line]),
        "far": 1e7 + line,
        "wide": 1e30 * line,
    }
    count = 0
    for points in clouds.values():
        for seen in (views, views[:1]):
            colors = np.zeros((len(points), 3), np.uint8)
            scene = Dataset(Path("none"), "none", seen, points, colors)
            count += not_finite(init_gaussians(scene, sh_degree=0).params)
    return Measured(count, ", ".join(clouds))


CASES = (
    Case("SSIM/equal pictures", "largest |1 − SSIM|", 1e-6, similarity),
    Case("Adam/dead slots", "numbers changed", 0, dead_slots),
    Case("opacity/reset", "no gradient, or old moments", 0, reset_opacities),
    Case("points/initial scales", "numbers not finite", 0, initial_scales),
)
