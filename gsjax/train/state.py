"""Parts and state of a training run, and the results of its steps.

Axis legend: N Gaussians (capacity), V views, B views of a step.
"""

import io
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax

from gsjax.cameras.camera import USUAL_EXTENT
from gsjax.densify.schedule import EditSchedule, schedule_of
from gsjax.densify.types import Strategy
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.io.npy import read_npy
from gsjax.runtime.files import write_file
from gsjax.train.camera_refinement import CameraRefinement, init_refinement
from gsjax.train.config import TrainConfig
from gsjax.train.geometry_loss import geometry_terms
from gsjax.train.losses import LossTerm
from gsjax.train.mip import mip_model
from gsjax.train.models import (
    IDENTITY,
    Model,
    ModelParams,
    SceneParams,
    SharedParams,
    SlotParams,
    init_model,
    scene_of,
)
from gsjax.train.motion.registry import motion_model
from gsjax.train.motion.scene import MovingScene, Scene
from gsjax.train.optimiser import (
    Rate,
    Rates,
    cooling_factor,
    gaussian_rates,
    make_optimiser,
    scale_by_rate,
)

Array = jax.Array
Tree = TypeVar("Tree")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """State of a run; with its settings and photographs it determines all later steps.

    Attributes:
      step: [] int32, number of completed steps.
      key: random key of the run, constant; each step derives its own keys from it.
        (The views of a step follow from `TrainConfig.seed`, see
        `gsjax.train.frames.views_of_step`.)
      gaussians: the scene.
      model: parameters that the scene model adds.
      refinement: corrections of cameras and exposures.
      moments: optimiser state of `slot_params`.
      shared_moments: optimiser state of `shared_params`.
      stats: statistics of the strategy.
    """

    step: Array
    key: Array
    gaussians: Gaussians
    model: ModelParams
    refinement: CameraRefinement
    moments: optax.OptState
    shared_moments: optax.OptState
    stats: Any

    def replace(self, **changes) -> "TrainState":
        """Return a copy with some fields changed."""
        return replace(self, **changes)

    @property
    def params(self) -> SceneParams:
        """Everything that is trained, as scene models and loss terms take it."""
        return SceneParams(self.gaussians, self.model, self.refinement)

    @property
    def slot_params(self) -> SlotParams:
        """Trained parameters with a slot axis."""
        return SlotParams(self.gaussians.params, self.model.slots)

    @property
    def shared_params(self) -> SharedParams:
        """Trained parameters without a slot axis."""
        return SharedParams(self.refinement, self.model.shared)

    def with_params(self, slots: SlotParams, shared: SharedParams) -> "TrainState":
        """Return a copy with other parameters."""
        gaussians = self.gaussians.replace(params=slots.gaussians)  # pyright: ignore
        model = self.model._replace(slots=slots.model, shared=shared.model)
        refinement = shared.refinement
        return self.replace(gaussians=gaussians, model=model, refinement=refinement)


class Setup(NamedTuple):
    """Static parts of a training step, as `make_train_step` takes them.

    Attributes:
      optimiser: for `SlotParams` and `SharedParams`.
      schedule: when the strategy edits, and the growth to expect.
    """

    config: TrainConfig
    extent: float
    strategy: Strategy
    loss_terms: tuple[LossTerm, ...]
    model: Model
    optimiser: optax.GradientTransformationExtraArgs
    schedule: EditSchedule


# Corrections of cameras slow down to a hundredth in the second half of a run.
_CAMERA_RATES = Rates(cooling=0.01, cooling_from=0.5)


def _cooled(rate: float) -> Rate:
    return lambda fraction: rate * cooling_factor(_CAMERA_RATES, fraction)


def make_setup(
    config: TrainConfig,
    extent: float,
    *,
    strategy: Strategy | None = None,
    loss_terms: Sequence[LossTerm] = (),
    model: Model | None = None,
) -> Setup:
    """Return the parts of a training step; arguments as `make_train_step`.

    Raises:
      InputError: if there is a ``model`` beside that of `TrainConfig.mip` or
        ``motion``.
    """
    strategy = strategy or config.make_strategy(extent)
    if model is not None and (config.mip or config.motion != "none"):
        name = "mip" if config.mip else "motion"
        raise InputError(
            f"model: expected None with TrainConfig.{name}, which is a model itself; "
            f"leave out {name}, or call its functions in the model"
        )
    model = model or model_of(config, extent)
    rates: dict[str, Rate] = {
        "turns": config.pose_rate,
        "shifts": config.pose_rate,
        "intrinsics": _cooled(config.intrinsics_rate),
        "distortion": _cooled(10 * config.intrinsics_rate),
        "twists": _cooled(config.shutter_rate),
        "exposures": config.exposure_rate,
    }
    table = gaussian_rates(config.rates, extent)
    table |= {name: scale_by_rate(rate) for name, rate in rates.items()}
    for name, rate in model.rates.items():
        plain = not isinstance(rate, optax.GradientTransformation)
        table[f"model.{name}"] = scale_by_rate(rate) if plain else rate
    return Setup(
        config=config,
        extent=extent,
        strategy=strategy,
        loss_terms=(*geometry_terms(config), *loss_terms),
        model=model,
        optimiser=make_optimiser(table),
        schedule=strategy.schedule or schedule_of(strategy.due, config.steps),
    )


def model_of(config: TrainConfig, extent: float) -> Model:
    """Return the scene model of settings, for a scene extent in world units."""
    return motion_model(config, extent) or (
        mip_model(extent) if config.mip else IDENTITY
    )


def shown_gaussians(state: TrainState, config: TrainConfig) -> Gaussians:
    """Return the Gaussians of a run of `TrainConfig` as files and viewers show them."""
    return scene_of(model_of(config, USUAL_EXTENT), state.params)


def shown_scene(state: TrainState, config: TrainConfig) -> Scene:
    """Return the scene of a run: Gaussians, or with a motion those of all times."""
    if config.motion == "none":
        return shown_gaussians(state, config)
    return MovingScene(config.motion, state.params)


def init_state(
    gaussians: Gaussians,
    config: TrainConfig,
    extent: float,
    views: int,
    *,
    strategy: Strategy | None = None,
    model: Model | None = None,
) -> TrainState:
    """Return the state of a run before its first step.

    Args:
      gaussians: initial Gaussians, N slots.
      config: settings.
      extent: scene extent in world units, see `gsjax.data.extent.scene_extent`.
      views: V, number of views.
      strategy, model: as `gsjax.fit` takes them.

    Raises:
      InputError: if the model has no learning rate for one of its parameters, or an
        array of its ``slots`` does not have N rows.
    """
    setup = make_setup(config, extent, strategy=strategy, model=model)
    return setup_state(setup, gaussians, views)


def setup_state(setup: Setup, gaussians: Gaussians, views: int) -> TrainState:
    """Return `init_state` of a `Setup`."""
    model = init_model(setup.model, gaussians)
    refinement = init_refinement(setup.config, views)
    slots: Any = SlotParams(gaussians.params, model.slots)
    shared: Any = SharedParams(refinement, model.shared)
    return TrainState(
        step=jnp.int32(0),
        key=jax.random.key(setup.config.seed),
        gaussians=gaussians,
        model=model,
        refinement=refinement,
        moments=setup.optimiser.init(slots),
        shared_moments=setup.optimiser.init(shared),
        stats=setup.strategy.init(gaussians),
    )


def state_arrays(state: Any) -> dict[str, np.ndarray]:
    """Return the leaves of a pytree on the host by path; random keys as numbers."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return {jax.tree_util.keystr(path): np.asarray(_numbers(v)) for path, v in leaves}


def _is_key(leaf) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _numbers(leaf):
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def state_from_arrays(where: str, arrays: dict[str, np.ndarray], like: Tree) -> Tree:
    """Return a pytree like ``like`` with the leaves of `state_arrays`.

    Raises:
      InputError: if leaves are missing or surplus, or a shape or dtype differs;
        ``where`` is the subject of the message.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(like)
    names = [jax.tree_util.keystr(path) for path, _ in leaves]
    remedy = "pass the settings of the run that wrote it"
    if {*names} != {*arrays}:
        missing, surplus = sorted({*names} - {*arrays}), sorted({*arrays} - {*names})
        raise InputError(
            f"{where}: expected the arrays of these settings, got {surplus[:3]} in "
            f"excess and {missing[:3]} missing; {remedy}"
        )
    out = []
    for name, (_, leaf) in zip(names, leaves):
        array, expected = arrays[name], _numbers(leaf)
        if array.shape != expected.shape or array.dtype != expected.dtype:
            raise InputError(
                f"{where}: expected {name} as {expected.dtype} {expected.shape}, got "
                f"{array.dtype} {array.shape}; {remedy}"
            )
        value = jnp.asarray(array)
        out.append(jax.random.wrap_key_data(value) if _is_key(leaf) else value)
    return jax.tree_util.tree_unflatten(structure, out)


def save_state(path: str | PathLike, state: Any) -> None:
    """Write a training state, or any pytree of arrays, to an .npz file.

    An existing file is replaced only after the new one is complete.

    Args:
      path: file to write.
      state: pytree of arrays; random keys are allowed.

    Raises:
      InputError: if the file cannot be written.
    """
    buffer = io.BytesIO()
    np.savez(buffer, **state_arrays(state))  # pyright: ignore
    write_file(Path(path), buffer.getvalue(), durable=True)


def load_state(path: str | PathLike, like: Tree) -> Tree:
    """Read a state that `save_state` wrote.

    Args:
      path: file to read.
      like: state of the same settings and capacity, such as `init_state`; only its
        structure, shapes and dtypes are used.

    Raises:
      InputError: if the file is missing or damaged, or its arrays are not those of
        ``like``.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            if any(entry.compress_type for entry in entries):
                raise ValueError("compressed arrays")
            names = [entry.filename for entry in entries]
            arrays = {
                name.removesuffix(".npy"): read_npy(name, archive.read(name))
                for name in names
            }
    except (OSError, ValueError, RuntimeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            f"{path}: expected a file of save_state, got {error}; save it again"
        ) from error
    return state_from_arrays(str(path), arrays, like)


class Metrics(NamedTuple):
    """Measurements of a step; scalars.

    Attributes:
      step: number of completed steps, including this one.
      loss: value of the loss.
      psnr: PSNR in dB of the views of this step, before the update.
      gaussians: number of active Gaussians after the step.
      wanted: number of Gaussians if the capacity had sufficed; 0 without an edit.
      pairs: (tile, Gaussian) pairs of all views of this step.
      pair_capacity: largest pair capacity that a view requires.
      visible: largest number of Gaussians that a view shows; more of those of a scene
        that moves exist at other times.
      overflowed: True if pairs or visible Gaussians exceeded their capacity. Nothing
        was changed and the step does not count: increase `RasterConfig.pair_capacity`
        or ``visible_capacity`` and repeat it.
      finite: False if the loss or a gradient was not finite, in which case only
        ``step`` changed, or if a parameter would have become non-finite, in which case
        it was kept.
    """

    step: Array
    loss: Array
    psnr: Array
    gaussians: Array
    wanted: Array
    pairs: Array
    pair_capacity: Array
    visible: Array
    overflowed: Array
    finite: Array


class Gradients(NamedTuple):
    """Loss and gradients of a step.

    Attributes:
      loss, psnr: [] as in `Metrics`.
      by_slots: gradient by `TrainState.slot_params`.
      by_shared: gradient by `TrainState.shared_params`.
      by_probe: [B, N, 2] gradient by the projected means, 1/px; see `Observation`.
      radii: [B, N] px.
      size: [B, 2] int32, width and height of the photographs.
      pairs, pair_capacity, visible, overflowed: [] as in `Metrics`.
    """

    loss: Array
    psnr: Array
    by_slots: SlotParams
    by_shared: SharedParams
    by_probe: Array
    radii: Array
    size: Array
    pairs: Array
    pair_capacity: Array
    visible: Array
    overflowed: Array


def gradients_like(state: TrainState, batch: int) -> Gradients:
    """Return the shapes and dtypes of the `Gradients` of ``batch`` views."""
    dtype, slots = state.gaussians.params.means.dtype, state.gaussians.capacity
    shape: Any = jax.ShapeDtypeStruct
    params = state.slot_params, state.shared_params
    by_slots, by_shared = jax.tree.map(lambda a: shape(a.shape, a.dtype), params)
    return Gradients(
        loss=shape((), dtype),
        psnr=shape((), dtype),
        by_slots=by_slots,
        by_shared=by_shared,
        by_probe=shape((batch, slots, 2), dtype),
        radii=shape((batch, slots), dtype),
        size=shape((batch, 2), jnp.int32),
        pairs=shape((), jnp.int32),
        pair_capacity=shape((), jnp.int32),
        visible=shape((), jnp.int32),
        overflowed=shape((), jnp.bool_),
    )
