"""Steps at which slots are edited, and the growth to expect from the edits."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np


@dataclass(frozen=True)
class EditSchedule:
    """When a strategy edits, and by how much the number of Gaussians may grow.

    Attributes:
      start, stop, every: edits follow the steps in (start, stop] that are multiples of
        ``every``; steps are counted from 1.
      growth: expected factor on the number of Gaussians at each edit, a forecast for
        planning capacity; None if it is unknown.
      max_gaussians: upper limit of the number of Gaussians.
    """

    start: int = 0
    stop: int = 2**31 - 1
    every: int = 1
    growth: float | None = None
    max_gaussians: int = 2**30

    def due(self, step: jax.Array) -> jax.Array:
        """Return [] bool: whether an edit follows ``step``; traceable."""
        inside = (step > self.start) & (step <= self.stop)
        return inside & (step % self.every == 0)

    def edits_between(self, since: int, until: int) -> int:
        """Return the number of edits after the steps in (since, until]."""
        last, first = min(until, self.stop), max(since, self.start)
        return max(0, last // self.every - first // self.every)

    def expected(self, count: int, since: int, until: int) -> int:
        """Return the number of Gaussians to expect at step ``until``.

        There are ``count`` at step ``since``. Each edit adds at least one if ``growth``
        is above 1. If it is unknown, half as many more are expected.
        """
        edits = self.edits_between(since, until)
        if self.growth is None:
            more = count + count // 2 if edits else count
            return max(count, min(more, self.max_gaussians))
        if self.growth > 1 and count:
            while edits > 0 and count < self.max_gaussians:
                more = max(count + 1, int(self.growth * count))
                count, edits = min(more, self.max_gaussians), edits - 1
        return count


def schedule_of(due: Callable[[Any], Any], steps: int) -> EditSchedule:
    """Return a schedule of the steps up to ``steps`` at which ``due`` holds."""
    every_step = np.arange(steps + 1)
    found = np.flatnonzero(np.broadcast_to(np.asarray(due(every_step)), steps + 1))
    if not len(found):
        return EditSchedule(stop=0)
    every = int(np.diff(found).min()) if len(found) > 1 else 1
    return EditSchedule(int(found[0]) - 1, int(found[-1]), every)
