"""What a run goes on from, and what its steps learn and tell.

Axis legend: N Gaussians (capacity), V views, B views of a step.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from gsjax.gaussians import GaussianParams, Gaussians
from gsjax.train.camera_refinement import (
    CameraRefinement,
    init_refinement,
    init_refinement_moments,
)
from gsjax.train.config import TrainConfig
from gsjax.train.optimiser import init_moments

Array = jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """All that a run goes on from, with its settings and its photographs.

    Attributes:
      step: [] int32, steps done.
      key: random key of the run; steps derive theirs from it and never change it.
        (Which views a step looks at follows from `TrainConfig.seed`: it is drawn on
        the host, see `gsjax.train.frames.views_of_step`.)
      gaussians: the scene.
      moments: Adam's, slot by slot.
      stats: what the strategy has gathered.
      refinement, refinement_moments: corrections of cameras and exposures.
    """

    step: Array
    key: Array
    gaussians: Gaussians
    moments: optax.ScaleByAdamState
    stats: Any
    refinement: CameraRefinement
    refinement_moments: optax.ScaleByAdamState

    def replace(self, **changes) -> "TrainState":
        """A copy with some fields changed."""
        return replace(self, **changes)


def init_state(
    gaussians: Gaussians, config: TrainConfig, extent: float, views: int
) -> TrainState:
    """A run before its first step.

    Args:
      gaussians: as initialised; capacity as wanted.
      config: the settings.
      extent: of the scene, see `gsjax.init.gaussians.scene_extent`.
      views: V.
    """
    refinement = init_refinement(config, views)
    return TrainState(
        step=jnp.int32(0),
        key=jax.random.key(config.seed),
        gaussians=gaussians,
        moments=init_moments(gaussians.params),
        stats=config.densifier(extent).init(gaussians),
        refinement=refinement,
        refinement_moments=init_refinement_moments(refinement),
    )


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


class Gradients(NamedTuple):
    """What a step learns from its views.

    Attributes:
      loss, psnr: [] as in `Metrics`.
      by_params: of the loss, by the parameters.
      by_refinement: by the corrections.
      by_probe: [B, N, 2] by the projected means, px; see `Observation`.
      radii: [B, N] px.
      size: [B, 2] int32, width and height of the photographs.
      pairs, pair_capacity, overflowed: [] as in `Metrics`.
    """

    loss: Array
    psnr: Array
    by_params: GaussianParams
    by_refinement: CameraRefinement
    by_probe: Array
    radii: Array
    size: Array
    pairs: Array
    pair_capacity: Array
    overflowed: Array


def gradients_like(state: TrainState, batch: int) -> Gradients:
    """Shapes of what `Stages.differentiate` returns for ``batch`` views."""
    dtype, slots = state.gaussians.params.means.dtype, state.gaussians.capacity

    def shape(*sizes: int, dtype=dtype) -> Any:
        return jax.ShapeDtypeStruct(sizes, dtype)

    params, refinement = jax.tree.map(
        lambda a: shape(*a.shape, dtype=a.dtype),
        (state.gaussians.params, state.refinement),
    )
    return Gradients(
        loss=shape(),
        psnr=shape(),
        by_params=params,
        by_refinement=refinement,
        by_probe=shape(batch, slots, 2),
        radii=shape(batch, slots),
        size=shape(batch, 2, dtype=jnp.int32),
        pairs=shape(dtype=jnp.int32),
        pair_capacity=shape(dtype=jnp.int32),
        overflowed=shape(dtype=jnp.bool_),
    )
