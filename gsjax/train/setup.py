"""Parts of a training step, resolved from settings and arguments."""

from collections.abc import Sequence
from typing import NamedTuple

import optax

from gsjax.densify.schedule import EditSchedule, schedule_of
from gsjax.densify.types import Strategy
from gsjax.train.camera_refinement import refinement_rates
from gsjax.train.config import TrainConfig
from gsjax.train.losses import LossTerm
from gsjax.train.models import IDENTITY, Model
from gsjax.train.optimiser import gaussian_rates, make_optimiser, scale_by_rate


class Setup(NamedTuple):
    """Static parts of a training step.

    Attributes:
      config: settings.
      extent: scene extent in world units.
      strategy: density control.
      loss_terms: terms added to the photometric loss and the strategy's penalty.
      model: scene model.
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


def make_setup(
    config: TrainConfig,
    extent: float,
    *,
    strategy: Strategy | None = None,
    loss_terms: Sequence[LossTerm] = (),
    model: Model | None = None,
) -> Setup:
    """Return the parts of a training step.

    Args:
      config: settings.
      extent: scene extent in world units.
      strategy: density control; default that of ``config``.
      loss_terms: terms to add to the loss.
      model: scene model; default `IDENTITY`.
    """
    strategy = strategy or config.make_strategy(extent)
    model = model or IDENTITY
    shared = refinement_rates(config)
    shared |= {f"model.{name}": rate for name, rate in model.rates.items()}
    table = gaussian_rates(config.rates, extent)
    table |= {name: scale_by_rate(rate) for name, rate in shared.items()}
    return Setup(
        config=config,
        extent=extent,
        strategy=strategy,
        loss_terms=tuple(loss_terms),
        model=model,
        optimiser=make_optimiser(table),
        schedule=strategy.schedule or schedule_of(strategy.due, config.steps),
    )
