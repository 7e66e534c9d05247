"""What a plan consists of."""

from typing import NamedTuple

from gsjax.gaussians import Gaussians
from gsjax.raster.types import RasterConfig


class Reason(NamedTuple):
    """Why one thing is as it is.

    Attributes:
      what: the setting, or the part of the scene.
      why: in words.
      error: what it may add to the largest error of rgb.
      basis: "exact" (nothing), "bound" (for every camera), "estimate", or "rounding".
    """

    what: str
    why: str
    error: float = 0.0
    basis: str = "exact"


class Plan(NamedTuple):
    """What `plan` found.

    Attributes:
      gaussians: the scene, without what does not show.
      config: static settings for it.
      reasons: for each of them.
      budget: as asked for, or None.
      measured: largest error of rgb seen on the cameras given, of the α cut; None where
        bounds alone decided.
    """

    gaussians: Gaussians
    config: RasterConfig
    reasons: tuple[Reason, ...]
    budget: float | None
    measured: float | None

    @property
    def error(self) -> float:
        """Sum of what the reasons may add: at most the budget."""
        return sum(reason.error for reason in self.reasons)

    @property
    def bounded(self) -> bool:
        """Whether that holds for every camera, and is not an estimate."""
        return all(reason.basis != "estimate" for reason in self.reasons)

    def lines(self) -> list[str]:
        """The reasons, one a line, errors in grey levels of 255."""
        told = []
        for what, why, error, basis in self.reasons:
            adds = f"; {basis}: {255 * error:.3g}/255" if error > 0 else ""
            told.append(f"{what}: {why}{adds}")
        kind = "bound for every camera" if self.bounded else "estimate"
        if self.budget is not None:
            limit = f"{255 * self.budget:.3g}/255"
            error = f"{255 * self.error:.3g}/255 at most, of {limit} allowed"
            told.append(f"in all: {error} ({kind})")
        return told
