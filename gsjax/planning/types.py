"""Result of a plan."""

from typing import NamedTuple

from gsjax.gaussians import Gaussians
from gsjax.raster.types import RasterConfig


class Reason(NamedTuple):
    """Reason for one setting or part of the scene, in words.

    ``error`` is the largest error of rgb that it may add; its ``basis`` is "exact"
    (none), "bound" (for every camera), "estimate", or "rounding".
    """

    what: str
    why: str
    error: float = 0.0
    basis: str = "exact"


class Plan(NamedTuple):
    """Result of `plan`.

    Attributes:
      gaussians: the scene, without what is invisible.
      config: static settings for it.
      reasons: one for each decision.
      budget: as requested, or None.
      measured: largest error of rgb on the cameras given, caused by the α cutoff; None
        if bounds alone decided.
    """

    gaussians: Gaussians
    config: RasterConfig
    reasons: tuple[Reason, ...]
    budget: float | None
    measured: float | None

    @property
    def error(self) -> float:
        """Sum of the errors of all reasons; at most the budget."""
        return sum(reason.error for reason in self.reasons)

    @property
    def bounded(self) -> bool:
        """True if ``error`` is a bound for every camera, not an estimate."""
        return all(reason.basis != "estimate" for reason in self.reasons)

    def lines(self) -> list[str]:
        """Return the reasons, one a line, with errors in grey levels of 255."""
        lines = []
        for what, why, error, basis in self.reasons:
            adds = f"; {basis}: {255 * error:.3g}/255" if error > 0 else ""
            lines.append(f"{what}: {why}{adds}")
        kind = "bound for every camera" if self.bounded else "estimate"
        if self.budget is not None:
            limit = f"{255 * self.budget:.3g}/255"
            error = f"{255 * self.error:.3g}/255 at most, of {limit} allowed"
            lines.append(f"in all: {error} ({kind})")
        return lines
