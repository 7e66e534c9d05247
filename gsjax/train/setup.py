"""Parts of a training step, resolved from settings and arguments."""

from collections.abc import Sequence
from typing import NamedTuple

import optax

from gsjax.densify.schedule import EditSchedule, schedule_of
from gsjax.densify.types import Strategy
from gsjax.train.config import TrainConfig
from gsjax.train.losses import LossTerm
from gsjax.train.models import IDENTITY, Model
from gsjax.train.optimiser import Rate, gaussian_rates, make_optimiser, scale_by_rate


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


def make_setup(
    config: TrainConfig,
    extent: float,
    *,
    strategy: Strategy | None = None,
    loss_terms: Sequence[LossTerm] = (),
    model: Model | None = None,
) -> Setup:
    """Return the parts of a training step; arguments as `make_train_step`."""
    strategy = strategy or config.make_strategy(extent)
    model = model or IDENTITY
    rates: dict[str, Rate] = {
        "turns": config.pose_rate,
        "shifts": config.pose_rate,
        "intrinsics": config.intrinsics_rate,
        "exposures": config.exposure_rate,
    }
    rates |= {f"model.{name}": rate for name, rate in model.rates.items()}
    table = gaussian_rates(config.rates, extent)
    table |= {name: scale_by_rate(rate) for name, rate in rates.items()}
    return Setup(
        config=config,
        extent=extent,
        strategy=strategy,
        loss_terms=tuple(loss_terms),
        model=model,
        optimiser=make_optimiser(table),
        schedule=strategy.schedule or schedule_of(strategy.due, config.steps),
    )
