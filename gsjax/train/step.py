"""One step of training: a pure function (state, batch) → (state, metrics).

Axis legend: N Gaussians (capacity), V views, B views of a step, H W image.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax

from gsjax.densify.types import Densifier, Observation, apply_edit
from gsjax.gaussians import Gaussians, num_active
from gsjax.losses import photometric_spread
from gsjax.metrics import psnr
from gsjax.numerics import all_within
from gsjax.optim import adam_step, init_moments, means_rate
from gsjax.raster.render import device_count, render
from gsjax.raster.types import RasterConfig
from gsjax.train.config import TrainConfig
from gsjax.train.frames import Batch
from gsjax.train.tuning import (
    Tuning,
    exposed,
    init_tuning,
    init_tuning_moments,
    tuned_camera,
    tuning_step,
)

Array = jax.Array

# A gradient from there on counts as infinite: Adam squares it, and in float32 the
# second moment of a slot would never come back from infinity.
_STEEPEST = 1e18


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """All that a run goes on from; what it does next depends on nothing else.

    Attributes:
      step: [] int32, steps done.
      key: random key of the run; steps derive theirs from it and never change it.
      gaussians: the scene.
      moments: Adam's, slot by slot.
      stats: what the strategy has gathered.
      tuning, tuning_moments: corrections of cameras and exposures.
    """

    step: Array
    key: Array
    gaussians: Gaussians
    moments: optax.ScaleByAdamState
    stats: Any
    tuning: Tuning
    tuning_moments: optax.ScaleByAdamState

    def replace(self, **changes) -> "TrainState":
        """A copy with some fields changed."""
        return replace(self, **changes)


class Metrics(NamedTuple):
    """What a step tells of itself; scalars.

    Attributes:
      step: steps done, including this one.
      loss: what was minimised.
      psnr: dB of the views of this step, before it.
      gaussians: active ones, after it.
      wanted: how many there would be with room for all; 0 where nothing was edited.
      pairs: (tile, Gaussian) pairs of all views of this step.
      pair_capacity: what the view that wants most of it would have room in.
      overflowed: the pairs did not fit, and nothing was changed, nor counted as a
        step: grow `RasterConfig.pair_capacity`, and go on.
      finite: False if loss or gradients were not, and nothing but ``step`` changed; or
        if a number would have left the finite ones by this step, and stayed.
    """

    step: Array
    loss: Array
    psnr: Array
    gaussians: Array
    wanted: Array
    pairs: Array
    pair_capacity: Array
    overflowed: Array
    finite: Array


TrainStep = Callable[[TrainState, Batch], tuple[TrainState, Metrics]]


def init_state(
    gaussians: Gaussians, config: TrainConfig, extent: float, views: int
) -> TrainState:
    """A run before its first step.

    Args:
      gaussians: as initialised; capacity as wanted.
      config: the settings.
      extent: of the scene, see `gsjax.scene.initialise.scene_extent`.
      views: V.
    """
    tuning = init_tuning(config, views)
    return TrainState(
        step=jnp.int32(0),
        key=jax.random.key(config.seed),
        gaussians=gaussians,
        moments=init_moments(gaussians.params),
        stats=config.densifier(extent).init(gaussians),
        tuning=tuning,
        tuning_moments=init_tuning_moments(tuning),
    )


def make_train_step(
    config: TrainConfig, extent: float, raster: RasterConfig | None = None
) -> TrainStep:
    """The step of a run: to be jitted, scanned, or mapped over seeds by the caller.

    Args:
      config: the settings.
      extent: of the scene, in its units.
      raster: how to render, with a `pair_capacity` that fits; default
        ``config.raster``.

    Returns:
      (`TrainState`, `Batch` of B views) → (`TrainState`, `Metrics`). Look at
      ``overflowed``; if True, nothing was done.
    """
    densifier = config.densifier(extent)
    raster = (raster or config.raster).replace(
        outputs=("rgb",), absgrad=densifier.absgrad
    )

    def objective(params, tuning, probe, state, batch: Batch, background):
        gaussians = state.gaussians.replace(params=params)
        camera = tuned_camera(batch.camera, tuning, batch.view, extent)
        name = "abs_probe" if densifier.absgrad else "probe"
        mask = batch.valid if config.skip_masked else None
        given = {"mask": mask, "size": batch.size, name: probe}
        view = render(gaussians, camera, raster, background, **given)
        assert view.rgb is not None
        image = exposed(view.rgb, tuning, batch.view)
        target, weight = targets(batch, background, image.dtype)
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
        return total, (quality, view.radii, view.demand, view.overflowed)

    differentiate = jax.value_and_grad(objective, argnums=(0, 1, 2), has_aux=True)

    def train_step(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        key = jax.random.fold_in(state.key, state.step)
        by_background, by_noise, by_plan = jax.random.split(key, 3)
        params = state.gaussians.params
        dtype = params.means.dtype
        transparent = batch.pixels.shape[-1] == 4
        background = background_of(config, transparent, by_background, dtype)
        count = batch.view.shape[0]
        probe = jnp.zeros((count, state.gaussians.capacity, 2), dtype)
        (loss, (quality, radii, demand, overflowed)), grads = differentiate(
            params, state.tuning, probe, state, batch, background
        )
        finite = jnp.isfinite(loss) & all_within(grads, _STEEPEST)
        width, height = batch.camera.width, batch.camera.height
        if batch.size is not None:
            width, height = batch.size.T
        # The loss is a mean over the views of the step.
        observation = Observation(grads[2] * count, radii, width, height)

        def keep():
            return state, jnp.int32(0), jnp.asarray(True)

        def skip():
            return state.replace(step=state.step + 1), jnp.int32(0), jnp.asarray(True)

        def update():
            moved, good = _optimise(state, grads, config, extent)
            rate = means_rate(config.rates, moved.step / config.steps, extent)
            keys = by_noise, by_plan
            return *_densify(moved, observation, keys, densifier, rate), good

        state, wanted, good = lax.cond(
            overflowed, keep, lambda: lax.cond(finite, update, skip)
        )
        return state, Metrics(
            step=state.step,
            loss=loss,
            psnr=quality,
            gaussians=num_active(state.gaussians),
            wanted=wanted,
            pairs=demand.pairs,
            pair_capacity=demand.capacity,
            overflowed=overflowed,
            finite=finite & good,
        )

    return train_step


def background_of(config: TrainConfig, transparent: bool, key: Array, dtype) -> Array:
    """[3] colour behind the scene, and behind photographs that are ``transparent``."""
    if config.background == "random" or (config.background == "auto" and transparent):
        return jax.random.uniform(key, (3,), dtype)
    return jnp.full(3, 1.0 if config.background == "white" else 0.0, dtype)


def targets(batch: Batch, background: Array, dtype) -> tuple[Array, Array | None]:
    """What to learn, [B, H, W, 3] in [0, 1], and the weights [B, H, W] or None."""
    values = batch.pixels.astype(dtype) / 255
    rgb = values[..., :3]
    if values.shape[-1] == 4:
        alpha = values[..., 3:]
        rgb = rgb * alpha + background * (1 - alpha)
    return rgb, None if batch.valid is None else batch.valid.astype(dtype)


def _optimise(
    state: TrainState, grads, config: TrainConfig, extent: float
) -> tuple[TrainState, Array]:
    """Parameters and corrections after one step of Adam; whether all made it."""
    by_params, by_tuning, _ = grads
    bases = by_params.sh.shape[-2]
    degree = jnp.floor(jnp.sqrt(jnp.arange(bases, dtype=jnp.float32))).astype(jnp.int32)
    learnt = degree <= state.step // config.sh_every
    sh = jnp.where(learnt[:, None], by_params.sh, 0)
    params, moments = adam_step(
        state.gaussians.params,
        by_params.replace(sh=sh),
        state.moments,
        config.rates,
        state.step / config.steps,
        extent,
    )
    good, params = _still_numbers(state.gaussians, params)
    tuning, tuning_moments = tuning_step(
        state.tuning, by_tuning, state.tuning_moments, config
    )
    moved = state.replace(
        step=state.step + 1,
        gaussians=state.gaussians.replace(params=params),  # pyright: ignore
        moments=moments,
        tuning=tuning,
        tuning_moments=tuning_moments,
    )
    return moved, good & all_within(tuning)


def _still_numbers(before: Gaussians, params) -> tuple[Array, Any]:
    """Whether all numbers are still finite; parameters, with those that are not as
    they were before."""

    def is_good(number):
        active = before.active.reshape(-1, *(1,) * (number.ndim - 1))
        return jnp.isfinite(number) | ~active

    good = jax.tree.map(is_good, params)
    kept = jax.tree.map(jnp.where, good, params, before.params)
    return jnp.all(jnp.stack([jnp.all(g) for g in jax.tree.leaves(good)])), kept


def _densify(
    state: TrainState, observation: Observation, keys, densifier: Densifier, rate: Array
) -> tuple[TrainState, Array]:
    """What the strategy does after a step; also how many Gaussians it wanted."""
    by_noise, by_plan = keys
    gaussians = state.gaussians
    if densifier.perturb is not None:
        moved = densifier.perturb(by_noise, gaussians, rate)
        gaussians = gaussians.replace(params=moved)  # pyright: ignore
    stats = densifier.observe(state.stats, observation)

    def edit():
        plan, fresh = densifier.plan(by_plan, state.step, gaussians, stats)
        return (*apply_edit(plan, state.moments), fresh, plan.wanted)

    def leave():
        return gaussians, state.moments, stats, jnp.int32(0)

    gaussians, moments, stats, wanted = lax.cond(densifier.due(state.step), edit, leave)
    return state.replace(gaussians=gaussians, moments=moments, stats=stats), wanted
