"""One step of training: a pure function (state, batch) → (state, metrics).

Its stages, which a run compiles one by one (`gsjax.train.step_compiler`): differentiate what
the views show, advance by it, and edit the slots where that is due.

Axis legend: N Gaussians (capacity), V views, B views of a step, H W image.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.densify.types import Densifier, Observation, apply_edit
from gsjax.gaussians import Gaussians, num_active
from gsjax.math.numerics import all_within
from gsjax.raster.render import device_count, render
from gsjax.raster.types import RasterConfig
from gsjax.train.camera_refinement import exposed, refine_camera, refinement_step
from gsjax.train.config import TrainConfig
from gsjax.train.frames import Batch
from gsjax.train.losses import photometric_spread
from gsjax.train.metrics import psnr
from gsjax.train.optimiser import adam_step, means_rate
from gsjax.train.state import Gradients, Metrics, TrainState, gradients_like

Array = jax.Array

# A gradient from there on counts as infinite: Adam squares it, and in float32 the
# second moment of a slot would never come back from infinity.
_STEEPEST = 1e18


class Stages(NamedTuple):
    """The parts of a step, as pure functions.

    Attributes:
      differentiate: of the state, looks at scene, corrections, step and key.
      advance: optimiser and what the strategy does at each step; the last result is []
        bool, whether an edit is due then.
      edit: the edit of the strategy, behind a step that it is due at.
    """

    differentiate: Callable[[TrainState, Batch], Gradients]
    advance: Callable[[TrainState, Gradients], tuple[TrainState, Metrics, Array]]
    edit: Callable[[TrainState, Metrics], tuple[TrainState, Metrics]]


TrainStep = Callable[[TrainState, Batch], tuple[TrainState, Metrics]]


def make_train_step(
    config: TrainConfig, extent: float, raster: RasterConfig | None = None
) -> TrainStep:
    """The step of a run: to be jitted, scanned, or mapped over seeds by the caller.

    Args:
      config: the settings.
      extent: of the scene, in its units.
      raster: how to render, with a `pair_capacity` that fits; default
        ``config.raster``. Its ``visible_capacity`` is not used.

    Returns:
      (`TrainState`, `Batch` of B views) → (`TrainState`, `Metrics`). Look at
      ``overflowed``; if True, nothing was done.
    """
    stages = make_stages(config, extent, raster)

    def train_step(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        gradients = stages.differentiate(state, batch)
        state, metrics, due = stages.advance(state, gradients)
        return lax.cond(due, stages.edit, lambda *same: same, state, metrics)

    return train_step


def make_stages(
    config: TrainConfig, extent: float, raster: RasterConfig | None = None
) -> Stages:
    """The parts of `make_train_step`, each a pure function to be compiled by itself.

    Args:
      config, extent, raster: as for `make_train_step`.
    """
    densifier = config.densifier(extent)
    # Room for all that is visible: `Metrics` would not tell how many there are.
    raster = (raster or config.raster).replace(
        outputs=("rgb",), absgrad=densifier.absgrad, visible_capacity=None
    )

    def objective(params, refinement, probe, state, batch: Batch, background):
        gaussians = state.gaussians.replace(params=params)
        camera = refine_camera(batch.camera, refinement, batch.view, extent)
        name = "abs_probe" if densifier.absgrad else "probe"
        mask = batch.valid if config.skip_masked else None
        given = {"mask": mask, "size": batch.size, name: probe}
        if config.exposure and _transparent(batch):
            # Of such photographs the background is ours, and has no exposure.
            outputs = raster.replace(outputs=("rgb", "alpha"))
            view = render(gaussians, camera, outputs, **given)
            assert view.rgb is not None
            assert view.alpha is not None
            image = exposed(view.rgb, refinement, batch.view, view.alpha)
            image += (1 - view.alpha[..., None]) * background
        else:
            view = render(gaussians, camera, raster, background, **given)
            assert view.rgb is not None
            image = exposed(view.rgb, refinement, batch.view)
        target, weight = targets(batch, background, image.dtype)
        with jax.named_scope("loss"):
            loss = photometric_spread(
                image, target, weight, config.ssim_weight, device_count(raster)
            )
        total = jnp.mean(loss)
        if densifier.penalty is not None:
            total += densifier.penalty(gaussians)
        quality = jnp.mean(
            jax.vmap(psnr, in_axes=(0, 0, None if weight is None else 0))(
                lax.stop_gradient(image), target, weight
            )
        )
        return total, (quality, view)

    slopes = jax.value_and_grad(objective, argnums=(0, 1, 2), has_aux=True)

    def differentiate(state: TrainState, batch: Batch) -> Gradients:
        params, count = state.gaussians.params, batch.view.shape[0]
        dtype = params.means.dtype
        by_background, *_ = _keys(state.key, state.step)
        background = background_of(config, _transparent(batch), by_background, dtype)
        probe = jnp.zeros((count, state.gaussians.capacity, 2), dtype)
        (loss, (quality, view)), by = slopes(
            params, state.refinement, probe, state, batch, background
        )
        size = batch.size
        if size is None:
            whole = jnp.asarray([batch.camera.width, batch.camera.height], jnp.int32)
            size = jnp.broadcast_to(whole, (count, 2))
        demand = view.demand
        by_params, by_refinement, by_probe = by
        found = Gradients(
            loss=loss,
            psnr=quality,
            by_params=by_params,
            by_refinement=by_refinement,
            by_probe=by_probe,
            radii=view.radii,
            size=size,
            pairs=demand.pairs,
            pair_capacity=demand.capacity,
            overflowed=view.overflowed,
        )
        # Cameras may be wider than what is learnt.
        like = gradients_like(state, count)
        return jax.tree.map(lambda a, b: a.astype(b.dtype), found, like)

    def advance(state: TrainState, found: Gradients):
        by = found.by_params, found.by_refinement, found.by_probe
        finite = jnp.isfinite(found.loss) & all_within(by, _STEEPEST)

        def keep():
            return state, jnp.asarray(True)

        def skip():
            return state.replace(step=state.step + 1), jnp.asarray(True)

        def update():
            with jax.named_scope("optimise"):
                moved, good = _optimise(state, found, config, extent)
            _, by_noise, _ = _keys(state.key, state.step)
            rate = means_rate(config.rates, moved.step / config.steps, extent)
            with jax.named_scope("observe"):
                return _observe(moved, found, by_noise, densifier, rate), good

        after, good = lax.cond(
            found.overflowed, keep, lambda: lax.cond(finite, update, skip)
        )
        metrics = Metrics(
            step=after.step,
            loss=found.loss,
            psnr=found.psnr,
            gaussians=num_active(after.gaussians),
            wanted=jnp.int32(0),
            pairs=found.pairs,
            pair_capacity=found.pair_capacity,
            overflowed=found.overflowed,
            finite=finite & good,
        )
        return after, metrics, ~found.overflowed & finite & densifier.due(after.step)

    def edit(state: TrainState, metrics: Metrics) -> tuple[TrainState, Metrics]:
        *_, by_plan = _keys(state.key, state.step - 1)
        plan, stats = densifier.plan(by_plan, state.step, state.gaussians, state.stats)
        gaussians, moments = apply_edit(plan, state.moments)
        state = state.replace(gaussians=gaussians, moments=moments, stats=stats)
        count = num_active(gaussians)
        return state, metrics._replace(gaussians=count, wanted=plan.wanted)

    return Stages(differentiate, advance, edit)


def _transparent(batch: Batch) -> bool:
    """Whether something shows through the photographs."""
    return batch.pixels.shape[-1] == 4


def _keys(key: Array, step: Array) -> Array:
    """[3] of the step behind ``step`` others: background, noise and edit."""
    return jax.random.split(jax.random.fold_in(key, step), 3)


def background_of(config: TrainConfig, transparent: bool, key: Array, dtype) -> Array:
    """[3] colour behind the scene, and behind photographs that are ``transparent``."""
    if config.background == "random" or (config.background == "auto" and transparent):
        return jax.random.uniform(key, (3,), dtype)
    return jnp.full(3, 1.0 if config.background == "white" else 0.0, dtype)


def targets(batch: Batch, background: Array, dtype) -> tuple[Array, Array | None]:
    """What to learn, [B, H, W, 3] in [0, 1], and the weights [B, H, W] or None."""
    values = batch.pixels.astype(dtype) / 255
    rgb = values[..., :3]
    if _transparent(batch):
        alpha = values[..., 3:]
        rgb = rgb * alpha + background * (1 - alpha)
    return rgb, None if batch.valid is None else batch.valid.astype(dtype)


def _optimise(
    state: TrainState, found: Gradients, config: TrainConfig, extent: float
) -> tuple[TrainState, Array]:
    """Parameters and corrections after one step of Adam; whether all made it."""
    by_params, by_refinement = found.by_params, found.by_refinement
    bases = by_params.sh.shape[-2]
    degree = jnp.floor(jnp.sqrt(jnp.arange(bases, dtype=jnp.float32))).astype(jnp.int32)
    learnt = degree <= state.step // config.sh_every
    sh = jnp.where(learnt[:, None], by_params.sh, 0)
    params, moments = adam_step(
        state.gaussians.params,
        by_params.replace(sh=sh),  # pyright: ignore
        state.moments,
        config.rates,
        state.step / config.steps,
        extent,
    )
    good, params = _still_numbers(state.gaussians, params)
    refinement, refinement_moments = refinement_step(
        state.refinement, by_refinement, state.refinement_moments, config
    )
    moved = state.replace(
        step=state.step + 1,
        gaussians=state.gaussians.replace(params=params),  # pyright: ignore
        moments=moments,
        refinement=refinement,
        refinement_moments=refinement_moments,
    )
    return moved, good & all_within(refinement)


def _still_numbers(before: Gaussians, params) -> tuple[Array, Any]:
    """Whether all numbers are still finite; parameters, with those that are not as
    they were before."""

    def is_good(number):
        active = before.active.reshape(-1, *(1,) * (number.ndim - 1))
        return jnp.isfinite(number) | ~active

    good = jax.tree.map(is_good, params)
    kept = jax.tree.map(jnp.where, good, params, before.params)
    return jnp.all(jnp.stack([jnp.all(g) for g in jax.tree.leaves(good)])), kept


def _observe(
    state: TrainState, found: Gradients, key: Array, densifier: Densifier, rate: Array
) -> TrainState:
    """What the strategy does at each step: its noise, and what it gathers."""
    gaussians = state.gaussians
    if densifier.perturb is not None:
        moved = densifier.perturb(key, gaussians, rate)
        gaussians = gaussians.replace(params=moved)  # pyright: ignore
    # The loss is a mean over the views of the step.
    gradient = found.by_probe * found.radii.shape[0]
    seen = Observation(gradient, found.radii, *found.size.T)
    stats = densifier.observe(state.stats, seen)
    return state.replace(gaussians=gaussians, stats=stats)
