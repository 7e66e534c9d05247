"""Scene models: the map from trained parameters to the Gaussians of a view.

Axis legend: N Gaussians (capacity).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import jax

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
      update: ``(SceneParams, batch of V cameras) → ModelParams.buffers``. The cameras
        are those of all training views, as refined so far.
      every: interval in steps. It is also called before the first step, after each
        edit of the slots and when the resolution changes; otherwise not in the last
        ``every`` steps.
    """

    update: Callable[[SceneParams, Camera], Any]
    every: int = 100


class Model(NamedTuple):
    """A scene model, as pure functions that are traced under jit.

    Attributes:
      init: ``gaussians → ModelParams``.
      apply: ``(SceneParams, ViewInfo) → Gaussians`` to render, N slots in the same
        order; differentiable.
      rates: learning rate of each parameter, by its name at the top level of
        `ModelParams.slots` or `.shared` (dicts, NamedTuples): a constant, or a function
        of the completed fraction of the run.
      scene: ``SceneParams → Gaussians`` of all views, for models whose ``apply`` does
        not depend on the view, or None. Views of a step are then rendered together, and
        files and viewers show these Gaussians instead of the canonical ones.
      refresh: how ``ModelParams.buffers`` are recomputed, or None.
    """

    init: Callable[[Gaussians], ModelParams]
    apply: Callable[[SceneParams, ViewInfo], Gaussians]
    rates: Mapping[str, Rate] = MappingProxyType({})
    scene: Callable[[SceneParams], Gaussians] | None = None
    refresh: Refresh | None = None


# Renders the Gaussians as they are.
IDENTITY = Model(
    init=lambda _: ModelParams(),
    apply=lambda params, _: params.gaussians,
    scene=lambda params: params.gaussians,
)


def scene_of(model: Model, params: SceneParams) -> Gaussians:
    """Return the Gaussians that files and viewers show; N slots.

    They are the canonical ones if the model depends on the view.
    """
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
