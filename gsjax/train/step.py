"""A training step: a pure function (state, batch) → (state, metrics).

It consists of three stages, which `gsjax.train.step_compiler` compiles separately:
differentiate the loss, advance the parameters, and edit the slots when that is due.

Axis legend: N Gaussians (capacity), V views, B views of a step, H W image.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.densify.types import Observation, Strategy, apply_edit, copy_rows
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, num_active
from gsjax.math.numerics import all_within
from gsjax.raster.render import render
from gsjax.raster.tile_render import device_count
from gsjax.raster.types import OUTPUTS, RasterConfig, Render
from gsjax.train.camera_refinement import apply_exposure, refine_camera
from gsjax.train.config import TrainConfig
from gsjax.train.frames import Batch, targets
from gsjax.train.losses import LossTerm, evaluate_terms, photometric_term
from gsjax.train.metrics import psnr
from gsjax.train.models import Model, SceneParams, ViewInfo
from gsjax.train.optimiser import means_rate
from gsjax.train.state import (
    Gradients,
    Metrics,
    Setup,
    TrainState,
    gradients_like,
    make_setup,
)

Array = jax.Array

# Gradients from here on count as infinite: Adam squares them, and a second moment that
# overflows in float32 never recovers.
_MAX_GRADIENT = 1e18


class Stages(NamedTuple):
    """Stages of a training step, as pure functions.

    Attributes:
      differentiate: loss and gradients of a batch.
      advance: optimiser update, noise and statistics of the strategy; the third result
        is [] bool, whether an edit is due.
      edit: edit of the slots, to be applied after a step at which it is due.
      refresh: recomputes the buffers of the model from the cameras of all V views; None
        if it has none. To be applied before the steps of `refresh_table`.
    """

    differentiate: Callable[[TrainState, Batch], Gradients]
    advance: Callable[[TrainState, Gradients], tuple[TrainState, Metrics, Array]]
    edit: Callable[[TrainState, Metrics], tuple[TrainState, Metrics]]
    refresh: Callable[[TrainState, Camera], TrainState] | None = None


TrainStep = Callable[[TrainState, Batch], tuple[TrainState, Metrics]]


def make_train_step(
    config: TrainConfig,
    extent: float,
    *,
    strategy: Strategy | None = None,
    loss_terms: Sequence[LossTerm] = (),
    model: Model | None = None,
    raster: RasterConfig | None = None,
    cameras: Camera | None = None,
) -> TrainStep:
    """Return a training step, to be jitted, scanned or vmapped over seeds.

    Args:
      config: settings.
      extent: scene extent in world units.
      strategy, loss_terms, model: as `gsjax.fit` takes them.
      raster: render settings with a sufficient `pair_capacity`; default
        ``config.raster``.
      cameras: batch of the cameras of all V views, for models with `Model.refresh`.

    Returns:
      Function (`TrainState`, `Batch` of B views) → (`TrainState`, `Metrics`). The state
      is that of `init_state` with the same strategy and model. If
      ``Metrics.overflowed``, the state is unchanged.

    Raises:
      InputError: if the model needs ``cameras``, and there are none.
    """
    parts = {"strategy": strategy, "loss_terms": loss_terms, "model": model}
    setup = make_setup(config, extent, **parts)
    stages, table = make_stages(setup, raster), refresh_table(setup)
    if stages.refresh is not None and cameras is None:
        raise InputError(
            "make_train_step: the model recomputes values from all cameras; pass "
            "cameras=frames.camera"
        )

    def train_step(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        refresh: Any = stages.refresh
        if refresh is not None:
            due = jnp.asarray(table)[jnp.clip(state.step, 0, len(table) - 1)]
            state = lax.cond(due, lambda s: refresh(s, cameras), lambda s: s, state)
        gradients = stages.differentiate(state, batch)
        state, metrics, due = stages.advance(state, gradients)
        return lax.cond(due, stages.edit, lambda *same: same, state, metrics)

    return train_step


def make_stages(setup: Setup, raster: RasterConfig | None = None) -> Stages:
    """Return the stages of a step from `make_setup`; arguments as `make_train_step`."""
    stages = _differentiate(setup, raster), _advance(setup), _edit(setup)
    return Stages(*stages, _refresh(setup))


def refresh_table(setup: Setup) -> np.ndarray:
    """Return [steps + 1] bool by completed steps: `Stages.refresh` precedes the next.

    See `gsjax.train.models.Refresh`; all False if the model has none.
    """
    config, refresh = setup.config, setup.model.refresh
    step: Any = np.arange(config.steps + 1)
    if refresh is None:
        return np.zeros(step.shape, bool)
    due = np.broadcast_to(np.asarray(setup.strategy.due(step)), step.shape)
    divisors = np.asarray([config.divisor(s) for s in step])
    due = due | (np.diff(divisors, prepend=divisors[0]) != 0)
    regular = (step % refresh.every == 0) & (step <= config.steps - refresh.every)
    return (due | regular | (step == 0)) & (step < config.steps)


def step_raster(setup: Setup, raster: RasterConfig | None = None) -> RasterConfig:
    """Return the render settings of a step: with the outputs that its loss uses."""
    needed = {"rgb", *(name for term in setup.loss_terms for name in term.outputs)}
    return (raster or setup.config.raster).replace(
        outputs=tuple(name for name in OUTPUTS if name in needed),
        absgrad=setup.strategy.absgrad,
    )


def _differentiate(setup: Setup, raster: RasterConfig | None):
    config, penalty = setup.config, setup.strategy.penalty
    raster = step_raster(setup, raster)
    terms = [photometric_term(config.ssim_weight, device_count(raster))]
    if penalty is not None:
        terms.append(LossTerm("penalty", lambda *inputs: penalty(inputs[2].gaussians)))
    regulariser = setup.model.penalty
    if regulariser is not None:
        terms.append(_of_views("model", regulariser))
    terms += setup.loss_terms

    def objective(trained, probe, state: TrainState, batch: Batch):
        params = state.with_params(*trained).params
        view = _render(setup, raster, params, batch, probe)
        assert view.rgb is not None
        loss = evaluate_terms(terms, (view, batch, params), state.step + 1)
        image, (target, weight) = view.rgb, targets(batch, view.rgb.dtype)
        axes = 0, 0, None if weight is None else 0
        each = jax.vmap(psnr, axes)(lax.stop_gradient(image), target, weight)
        quality = jnp.mean(each)
        return loss, (quality, view)

    value_and_grad = jax.value_and_grad(objective, argnums=(0, 1), has_aux=True)

    def differentiate(state: TrainState, batch: Batch) -> Gradients:
        count, dtype = batch.view.shape[0], state.gaussians.params.means.dtype
        key, *_ = _keys(state.key, state.step)
        background = background_of(config, batch.transparent, key, dtype)
        batch = batch._replace(background=background)
        probe = jnp.zeros((count, state.gaussians.capacity, 2), dtype)
        trained = state.slot_params, state.shared_params
        (loss, (quality, view)), (by, by_probe) = value_and_grad(
            trained, probe, state, batch
        )
        size = batch.size
        if size is None:
            whole = jnp.asarray([*batch.pixels.shape[2:0:-1]], jnp.int32)
            size = jnp.broadcast_to(whole, (count, 2))
        found = Gradients(
            loss=loss,
            psnr=quality,
            by_slots=by[0],
            by_shared=by[1],
            by_probe=by_probe,
            radii=view.radii,
            size=size,
            pairs=view.demand.pairs,
            pair_capacity=view.demand.capacity,
            visible=view.demand.visible,
            overflowed=view.overflowed,
        )
        # Cameras may be float64 while the parameters are float32.
        like = gradients_like(state, count)
        return jax.tree.map(lambda a, b: a.astype(b.dtype), found, like)

    return differentiate


def _of_views(
    name: str, function: Callable[[SceneParams, ViewInfo], Array]
) -> LossTerm:
    """Return the mean over the views of a step as a loss term."""

    def mean(render: Render, batch: Batch, params: SceneParams) -> Array:
        del render
        each = jax.vmap(lambda view: function(params, view))
        return jnp.mean(each(_views(batch)))

    return LossTerm(name, mean)


def _views(batch: Batch) -> ViewInfo:
    """Return the views [B] of a batch."""
    time = jnp.zeros(batch.view.shape) if batch.time is None else batch.time
    return ViewInfo(batch.view, time)


def _render(
    setup: Setup, raster: RasterConfig, params: SceneParams, batch: Batch, probe: Array
) -> Render:
    """Render the views of a batch as their photographs would show them."""
    config, refinement, background = setup.config, params.refinement, batch.background
    camera = refine_camera(batch.camera, refinement, batch.view, setup.extent)
    camera = camera.replace(visible_size=batch.size)
    mask = batch.valid if config.skip_masked else None
    batch = batch._replace(camera=camera, valid=mask)
    # The background of transparent photographs is ours and has no exposure.
    apart = config.exposure and batch.transparent
    if apart:
        names = {*raster.outputs, "alpha"}
        raster = raster.replace(outputs=tuple(n for n in OUTPUTS if n in names))
        batch = batch._replace(background=None)
    view = _render_model(setup, raster, params, batch, probe)
    alpha = view.alpha if apart else None
    assert view.rgb is not None
    image = apply_exposure(view.rgb, refinement, batch.view, alpha)
    if alpha is not None:
        assert background is not None
        image += (1 - alpha[..., None]) * background
    return view._replace(rgb=image)


def _render_model(
    setup: Setup, raster: RasterConfig, params: SceneParams, batch: Batch, probe: Array
) -> Render:
    """Render each view of a batch with its own Gaussians; skips pixels not valid."""

    def draw(gaussians: Gaussians, camera: Camera, mask: Array | None, probe: Array):
        behind = batch.background
        return render(gaussians, camera, raster, behind, mask=mask, probe=probe)

    arguments = batch.camera, batch.valid, probe
    if setup.model.scene is not None:
        return draw(setup.model.scene(params), *arguments)
    count = batch.view.shape[0]

    def one(inputs) -> Render:
        return draw(setup.model.apply(params, inputs[0]), *inputs[1])

    views = _views(batch), arguments
    if count == 1:
        found = one(jax.tree.map(lambda a: a[0], views))
        found = jax.tree.map(lambda a: a[None], found)
    else:
        found = lax.map(one, views)
    demand = found.demand._replace(
        visible=jnp.max(found.demand.visible),
        pairs=jnp.sum(found.demand.pairs),
        capacity=jnp.max(found.demand.capacity),
    )
    return found._replace(demand=demand, overflowed=jnp.any(found.overflowed))


def _advance(setup: Setup):
    config, strategy = setup.config, setup.strategy

    def advance(state: TrainState, found: Gradients):
        by = found.by_slots, found.by_shared, found.by_probe
        finite = jnp.isfinite(found.loss) & all_within(by, _MAX_GRADIENT)

        def update():
            with jax.named_scope("optimise"):
                moved, good = optimise(setup, state, found)
            _, noise_key, _ = _keys(state.key, state.step)
            rate = means_rate(config.rates, moved.step / config.steps, setup.extent)
            with jax.named_scope("observe"):
                return _observe(moved, found, noise_key, strategy, rate), good

        def skip():
            return state.replace(step=state.step + 1), jnp.asarray(True)

        after, good = lax.cond(
            found.overflowed,
            lambda: (state, jnp.asarray(True)),
            lambda: lax.cond(finite, update, skip),
        )
        metrics = Metrics(
            step=after.step,
            loss=found.loss,
            psnr=found.psnr,
            gaussians=num_active(after.gaussians),
            wanted=jnp.int32(0),
            pairs=found.pairs,
            pair_capacity=found.pair_capacity,
            visible=found.visible,
            overflowed=found.overflowed,
            finite=finite & good,
        )
        return after, metrics, ~found.overflowed & finite & strategy.due(after.step)

    return advance


def _edit(setup: Setup):
    def edit(state: TrainState, metrics: Metrics) -> tuple[TrainState, Metrics]:
        *_, key = _keys(state.key, state.step - 1)
        plan, stats = setup.strategy.plan(key, state.step, state.gaussians, state.stats)
        gaussians, moments = apply_edit(plan, state.moments)
        rows = state.model.slots, state.model.buffers
        slots, buffers = copy_rows(plan, rows)
        model = state.model._replace(slots=slots, buffers=buffers)
        state = state.replace(
            gaussians=gaussians, model=model, moments=moments, stats=stats
        )
        count = num_active(gaussians)
        wanted = jnp.asarray(plan.wanted, jnp.int32)
        return state, metrics._replace(gaussians=count, wanted=wanted)

    return edit


def _refresh(setup: Setup):
    refresh = setup.model.refresh
    if refresh is None:
        return None

    def recompute(state: TrainState, cameras: Camera) -> TrainState:
        index = jnp.arange(cameras.viewmat.shape[0])
        cameras = refine_camera(cameras, state.refinement, index, setup.extent)
        fraction = state.step / setup.config.steps
        found = refresh.update(state.params, cameras, fraction)
        like = state.model.buffers
        buffers = jax.tree.map(lambda a, b: a.astype(b.dtype), found, like)
        return state.replace(model=state.model._replace(buffers=buffers))

    return recompute


def _keys(key: Array, step: Array) -> Array:
    """Return the keys [3] of a step: background, noise and edit."""
    return jax.random.split(jax.random.fold_in(key, step), 3)


def background_of(config: TrainConfig, transparent: bool, key: Array, dtype) -> Array:
    """Return the colour [3] behind the scene and behind transparent photographs."""
    if config.background == "random" or (config.background == "auto" and transparent):
        return jax.random.uniform(key, (3,), dtype)
    return jnp.full(3, 1.0 if config.background == "white" else 0.0, dtype)


def optimise(
    setup: Setup, state: TrainState, found: Gradients
) -> tuple[TrainState, Array]:
    """Return the state after an optimiser update, and whether it is finite.

    Numbers that would become non-finite keep their values.
    """
    config, by_gaussians = setup.config, found.by_slots.gaussians
    bases = jnp.arange(by_gaussians.sh.shape[-2], dtype=jnp.float32)
    degree = jnp.floor(jnp.sqrt(bases)).astype(jnp.int32)
    enabled = degree <= state.step // config.sh_every
    sh = jnp.where(enabled[:, None], by_gaussians.sh, 0)
    by_gaussians = by_gaussians.replace(sh=sh)  # pyright: ignore
    by_slots = found.by_slots._replace(gaussians=by_gaussians)
    fraction = state.step / config.steps

    def update(gradients, moments, params: Any) -> tuple[Any, Any]:
        updates, moments = setup.optimiser.update(
            gradients, moments, params, fraction=fraction
        )
        return optax.apply_updates(params, updates), moments

    slots, moments = update(by_slots, state.moments, state.slot_params)
    good, slots = _keep_finite(state.gaussians.active, state.slot_params, slots)
    shared, shared_moments = update(
        found.by_shared, state.shared_moments, state.shared_params
    )
    moved = state.with_params(slots, shared).replace(
        step=state.step + 1, moments=moments, shared_moments=shared_moments
    )
    return moved, good & all_within(shared)


def _keep_finite(active: Array, before: Any, after: Any) -> tuple[Array, Any]:
    """Return whether all active slots are finite, and ``after`` where it is."""

    def is_good(number):
        wide = active.reshape(-1, *(1,) * (number.ndim - 1))
        return jnp.isfinite(number) | ~wide

    good = jax.tree.map(is_good, after)
    kept = jax.tree.map(jnp.where, good, after, before)
    return jnp.all(jnp.stack([jnp.all(g) for g in jax.tree.leaves(good)])), kept


def _observe(
    state: TrainState, found: Gradients, key: Array, strategy: Strategy, rate: Array
) -> TrainState:
    """Apply the noise of the strategy and update its statistics."""
    gaussians = state.gaussians
    if strategy.perturb is not None:
        moved = strategy.perturb(key, gaussians, rate)
        gaussians = gaussians.replace(params=moved)  # pyright: ignore
    # The loss is a mean over the views of the step.
    gradient = found.by_probe * found.radii.shape[0]
    observation = Observation(gradient, found.radii, *found.size.T)
    stats = strategy.observe(state.stats, observation)
    return state.replace(gaussians=gaussians, stats=stats)
