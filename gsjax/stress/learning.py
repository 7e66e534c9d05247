"""Cases about training: initial scales, optimiser, opacity resets, SSIM."""

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
from gsjax.stress import scenes
from gsjax.stress.scenes import SLOTS, camera_of
from gsjax.stress.types import Measurement, StressCase
from gsjax.train.metrics import ssim
from gsjax.train.optimiser import Rates, gaussian_rates, make_optimiser


def similarity(full: bool) -> Measurement:
    """Measure |1 − SSIM| of equal images, some of them smaller than the window."""
    shapes = ((1, 1), (5, 7), (32, 32)) if full else ((1, 1), (32, 32))
    score, worst, count = jax.jit(ssim), 0.0, 0
    for height, width in shapes:
        drawn = np.random.default_rng(0).uniform(size=(height, width, 3))
        flat = [np.full((height, width, 3), v) for v in (0, 1e-3, 0.1, 0.5, 0.999, 1)]
        for image in scenes.to_float32([*flat, drawn, 1 - 1e-3 * drawn]):
            count += 1
            worst = np.maximum(worst, abs(1 - float(score(image, image))))
    return Measurement(worst, f"{count} pictures")


_OPTIMISER = make_optimiser(gaussian_rates(Rates(), 1.0))


@jax.jit
def _step(params, grads, moments):
    updates, moments = _OPTIMISER.update(
        grads, moments, params, fraction=jnp.float32(0)
    )
    return optax.apply_updates(params, updates), moments


@jax.jit
def _first_step(params):
    """Return parameters and moments after a step with gradients of 1."""
    ones = jax.tree.map(jnp.ones_like, params)
    return _step(params, ones, _OPTIMISER.init(params))


def dead_slots(full: bool) -> Measurement:
    """Count parameters of dead slots that Adam moves after they had gradients."""
    start = scenes.default_scene()
    ones = jax.tree.map(jnp.ones_like, start.params)
    params, moments = _first_step(start.params)
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
    grads = scenes.where_slots(dead, jax.tree.map(jnp.zeros_like, ones), ones)
    for _ in range(100 if full else 10):
        params, moments = _step(params, grads, moments)
    rows = [jax.tree.map(lambda a: a[dead], p) for p in (params, edited.params)]
    live = [jax.tree.map(lambda a: a[~dead], p) for p in (params, edited.params)]
    return Measurement(
        scenes.count_unequal(*rows) if scenes.count_unequal(*live) else np.nan,
        f"{int(dead.sum())} dead slots",
    )


def reset_opacities(_full: bool) -> Measurement:
    """Count Gaussians without a gradient after a reset, and wrong moments."""
    low = float(logit(jnp.float32(AdaptiveSettings().reset_opacity)))
    logits = np.full(SLOTS, low, np.float32)
    reset = scenes.with_params(scenes.default_scene(), logit_opacities=logits)
    _, gradients = scenes.render_and_gradients(reset)
    _, _, wanted = scenes.reference(reset, camera_of())
    live = np.abs(wanted.params.logit_opacities) > 1e-6
    lost = live & (gradients.params.logit_opacities == 0)
    seen = int(live.sum())
    count = int(lost.sum()) + _wrong_moments(reset)
    return Measurement(count if seen > SLOTS // 2 else np.nan, f"of {seen}")


def _wrong_moments(reset: Gaussians) -> int:
    """Count moments of opacities that outlive a reset, and others that do not."""
    _, moments = _first_step(reset.params)
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
    return scenes.count_unequal([after[0].mu, after[0].nu], wanted)


def initial_scales(_full: bool) -> Measurement:
    """Count non-finite parameters of Gaussians at few, collinear or equal points."""
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
            dataset = Dataset(Path("none"), "none", seen, points, colors)
            gaussians = init_gaussians(dataset, sh_degree=0)
            count += scenes.count_nonfinite(gaussians.params)
    return Measurement(count, ", ".join(clouds))


CASES = (
    StressCase("SSIM/equal pictures", "largest |1 − SSIM|", 1e-6, similarity),
    StressCase("Adam/dead slots", "numbers changed", 0, dead_slots),
    StressCase("opacity/reset", "no gradient, or old moments", 0, reset_opacities),
    StressCase("points/initial scales", "non-finite numbers", 0, initial_scales),
)
