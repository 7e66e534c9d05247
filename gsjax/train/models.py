"""Scene models: the map from trained parameters to the Gaussians of a view.

Axis legend: N Gaussians (capacity).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from optax import GradientTransformation

from gsjax.cameras.camera import Camera
from gsjax.errors import InputError
from gsjax.gaussians import GaussianParams, Gaussians
from gsjax.train.camera_refinement import CameraRefinement
from gsjax.train.optimiser import Rate

Array = jax.Array


class ModelParams(NamedTuple):
    """Parameters that a scene model adds to the Gaussians; pytrees of float arrays.

    Attributes:
      slots: arrays [N, …], one row per Gaussian. Density control copies the rows along
        with the Gaussians.
      shared: all other arrays.
      buffers: arrays [N, …] that follow the Gaussians as ``slots`` do, but are not
        trained: `Refresh.update` recomputes them.
    """

    slots: Any = None
    shared: Any = None
    buffers: Any = None


class SceneParams(NamedTuple):
    """Everything that is trained.

    Attributes:
      gaussians: canonical Gaussians, N slots.
      model: parameters that the scene model adds.
      refinement: corrections of cameras and exposures.
    """

    gaussians: Gaussians
    model: ModelParams = ModelParams()
    refinement: CameraRefinement = CameraRefinement()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ViewInfo:
    """The view that is rendered.

    Attributes:
      index: [] int32, index of the view in the dataset.
      time: [] `gsjax.data.types.View.time`.
    """

    index: Array
    time: Array


class Refresh(NamedTuple):
    """Values of a model that are recomputed from the scene now and then.

    Attributes:
      update: ``(SceneParams, batch of V cameras, fraction []) → ModelParams.buffers``.
        The cameras are those of all training views, as refined so far; the fraction is
        that of the run that is completed.
      every: interval in steps. It is also called before the first step, after each
        edit of the slots and when the resolution changes; otherwise not in the last
        ``every`` steps.
    """

    update: Callable[[SceneParams, Camera, Array], Any]
    every: int = 100


class Model(NamedTuple):
    """A scene model, as pure functions that are traced under jit.

    Attributes:
      init: ``gaussians → ModelParams``.
      apply: ``(SceneParams, ViewInfo) → Gaussians`` to render, N slots in the same
        order; differentiable.
      rates: learning rate of each parameter, by its name at the top level of
        `ModelParams.slots` or `.shared` (dicts, NamedTuples): a constant, a function
        of the completed fraction of the run, or a transformation of Adam's updates,
        such as `gsjax.train.optimiser.scale_by_rate`.
      scene: ``SceneParams → Gaussians`` of all views, for models whose ``apply`` does
        not depend on the view, or None. Views of a step are then rendered together, and
        files and viewers show these Gaussians instead of the canonical ones.
      refresh: how ``ModelParams.buffers`` are recomputed, or None.
      at: ``(SceneParams, time []) → Gaussians`` for models whose ``apply`` depends on
        the time of the view alone, or None.
      penalty: ``(SceneParams, ViewInfo) → []`` added to the loss of a view, or None.
      until: completed fraction of the run → share of the time, 0 to 1, from whose views
        `gsjax.fit` draws, or None for all. Called on the host.
    """

    init: Callable[[Gaussians], ModelParams]
    apply: Callable[[SceneParams, ViewInfo], Gaussians]
    rates: Mapping[str, Rate | GradientTransformation] = MappingProxyType({})
    scene: Callable[[SceneParams], Gaussians] | None = None
    refresh: Refresh | None = None
    at: Callable[[SceneParams, Array], Gaussians] | None = None
    penalty: Callable[[SceneParams, ViewInfo], Array] | None = None
    until: Callable[[float], float] | None = None


# Renders the Gaussians as they are.
IDENTITY = Model(
    init=lambda _: ModelParams(),
    apply=lambda params, _: params.gaussians,
    scene=lambda params: params.gaussians,
)


def scene_of(model: Model, params: SceneParams, time: float = 0.0) -> Gaussians:
    """Return the Gaussians that files and viewers show at a time; N slots.

    They are the canonical ones if the model depends on more than the time.
    """
    if model.at is not None:
        return model.at(params, jnp.asarray(time))
    return params.gaussians if model.scene is None else model.scene(params)


class SlotParams(NamedTuple):
    """Trained parameters with a slot axis: those of the Gaussians and of the model."""

    gaussians: GaussianParams
    model: Any


class SharedParams(NamedTuple):
    """Trained parameters without a slot axis: corrections, and those of the model."""

    refinement: CameraRefinement
    model: Any


def init_model(model: Model, gaussians: Gaussians) -> ModelParams:
    """Return the initial parameters of a model.

    Raises:
      InputError: if an array of ``slots`` or ``buffers`` does not have one row per
        slot.
    """
    params = model.init(gaussians)
    rows = {"slots": params.slots, "buffers": params.buffers}
    for name, tree in rows.items():
        for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
            if leaf.shape[:1] != (gaussians.capacity,):
                raise InputError(
                    f"model: expected {name}{jax.tree_util.keystr(path)} of shape "
                    f"[{gaussians.capacity}, …], got {leaf.shape}; put arrays without "
                    "a row per Gaussian into ModelParams.shared"
                )
    return params
