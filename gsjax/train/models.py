"""Scene models: the map from trained parameters to the Gaussians of a view.

Axis legend: N Gaussians (capacity).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import jax

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
    """

    slots: Any = None
    shared: Any = None


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


class Model(NamedTuple):
    """A scene model, as pure functions that are traced under jit.

    Attributes:
      init: ``gaussians → ModelParams``.
      apply: ``(SceneParams, ViewInfo) → Gaussians`` to render, N slots in the same
        order; differentiable.
      rates: learning rate of each parameter, by its name at the top level of
        `ModelParams.slots` or `.shared` (dicts, NamedTuples): a constant, or a function
        of the completed fraction of the run.
    """

    init: Callable[[Gaussians], ModelParams]
    apply: Callable[[SceneParams, ViewInfo], Gaussians]
    rates: Mapping[str, Rate] = MappingProxyType({})


# Renders the Gaussians as they are.
IDENTITY = Model(init=lambda _: ModelParams(), apply=lambda params, _: params.gaussians)


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
      InputError: if an array of ``slots`` does not have one row per slot.
    """
    params = model.init(gaussians)
    for path, leaf in jax.tree_util.tree_flatten_with_path(params.slots)[0]:
        if leaf.shape[:1] != (gaussians.capacity,):
            raise InputError(
                f"model: expected slots{jax.tree_util.keystr(path)} of shape "
                f"[{gaussians.capacity}, …], got {leaf.shape}; put arrays without a "
                "row per Gaussian into ModelParams.shared"
            )
    return params
