"""Laws of edit schedules, and the ranges of the strategies' settings."""

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.densify.mcmc import McmcSettings
from gsjax.densify.schedule import EditSchedule, schedule_of
from gsjax.errors import InputError


@pytest.mark.parametrize(
    ("start", "stop", "every"), [(20, 50, 10), (3, 9, 2), (0, 7, 7)]
)
def test_edits_are_the_due_steps(start, stop, every):
    schedule = EditSchedule(start, stop, every)
    due = np.flatnonzero(schedule.due(jnp.arange(100)))
    wanted = [step for step in range(start + 1, stop + 1) if step % every == 0]
    assert due.tolist() == wanted
    for since in (0, start, 8, 40):
        for until in (since, 9, 40, 99):
            count = np.sum((due > since) & (due <= until))
            assert schedule.edits_between(since, until) == count
    found = schedule_of(schedule.due, 100)
    assert np.flatnonzero(found.due(np.arange(100))).tolist() == wanted
    assert schedule_of(lambda step: step < 0, 100).edits_between(0, 100) == 0


def test_expected_growth_compounds():
    schedule = EditSchedule(3, 9, 2, growth=1.5, max_gaussians=100)
    steps = [(0, 3), (0, 4), (4, 5), (4, 8), (4, 9), (4, 99), (8, 99)]
    found = [schedule.expected(10, *pair) for pair in steps]
    assert found == [10, 15, 10, 22, 22, 22, 10]
    assert schedule.expected(40, 0, 99) == 100
    assert schedule.expected(400, 0, 99) == 400
    unknown = EditSchedule(3, 9, 2, max_gaussians=100)
    found = [unknown.expected(n, 0, 9) for n in (0, 10, 90, 200)]
    assert found == [0, 15, 100, 200]


@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        (AdaptiveSettings, {"every": 0}),
        (AdaptiveSettings, {"start": -1}),
        (AdaptiveSettings, {"reset_opacity": 1.0}),
        (AdaptiveSettings, {"opacity_penalty": -0.1}),
        (AdaptiveSettings, {"max_gaussians": 0}),
        (McmcSettings, {"every": 0}),
        (McmcSettings, {"growth": 0.9}),
        (McmcSettings, {"dead_opacity": 0.0}),
        (McmcSettings, {"noise": -1.0}),
    ],
    ids=str,
)
def test_settings_out_of_range(kind, changes):
    with pytest.raises(InputError, match=rf"{kind.__name__}.{next(iter(changes))}"):
        kind(**changes)
