"""What a run says of itself as it goes."""

import math

import jax.numpy as jnp
import pytest

from gsjax.runs.report import Reporter, _smoothed
from gsjax.train.config import Level, TrainConfig
from gsjax.train.loop import Progress
from gsjax.train.state import Metrics

CONFIG = TrainConfig(steps=100, levels=(Level(0.0, 4), Level(0.5, 2), Level(0.8, 1)))


def progress(step: int, seconds: float, compiling: float) -> Progress:
    metrics = Metrics(*map(jnp.asarray, [0] * len(Metrics._fields)))
    metrics = metrics._replace(step=jnp.asarray(step))
    return Progress(metrics, seconds, compiling, 1, CONFIG.divisor(step), 64)


def test_the_time_left_knows_of_larger_pictures_and_of_compiling(monkeypatch, capsys):
    monkeypatch.setattr("gsjax.runs.report._LINE_SECONDS", 0.0)
    reporter = Reporter(CONFIG)
    reporter.step(progress(10, 30.0, 20.0))  # a step a second, twenty for a program
    assert reporter.left(10) == pytest.approx(40 + 2 * 30 + 4 * 20 + 2 * 20)
    reporter.step(progress(60, 120.0, 20.0 + 30.0))
    assert reporter.rate == pytest.approx(50 / 60)
    assert reporter.left(60) == pytest.approx(60 / 50 * (20 + 2 * 20) + 25)
    reporter.step(progress(100, 200.0, 50.0))
    assert reporter.left(100) == 0
    reporter.close()
    *_, before, last = capsys.readouterr().err.splitlines()
    assert "step 60/100: loss 0.0000, 0.00 dB, 0 Gaussians, 0.8 steps/s" in before
    assert last.endswith("3:20 gone, 0:00 left")


def test_what_is_no_number_is_not_in_the_mean():
    """The PSNR of a photograph that is masked altogether."""
    mean = float("nan")
    for value, wanted in ((float("inf"), None), (20.0, 20.0), (float("inf"), 20.0)):
        mean = _smoothed(mean, value)
        assert mean == wanted if wanted else math.isnan(mean)
    assert 20 < _smoothed(mean, 30.0) < 30
    assert _smoothed(mean, float("nan")) == mean


def test_of_the_first_steps_nothing_is_foretold(monkeypatch, capsys):
    """They are slow; and where all are, they are waited for no longer than usual."""
    monkeypatch.setattr("gsjax.runs.report._LINE_SECONDS", 0.5)
    reporter = Reporter(CONFIG)
    reporter.last = 0.0  # long ago, as after compiling
    for step in range(1, 20):
        reporter.step(progress(step, 20.02 * step, 20.0 * step))
    assert capsys.readouterr().err == ""
    reporter.step(progress(20, 420.4, 420.0))
    assert "step 20/100" in capsys.readouterr().err
    reporter.last = 0.0
    reporter.step(progress(21, 421.4, 420.0))
    assert "1.0 steps/s" in capsys.readouterr().err


def test_a_bar_on_a_terminal(monkeypatch, capsys):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    monkeypatch.setattr("gsjax.runs.report._BAR_SECONDS", 0.0)
    reporter = Reporter(CONFIG, 99)
    reporter.step(progress(100, 2.0, 1.0))
    reporter.bar.refresh()
    told = capsys.readouterr().err
    reporter.close()
    assert "100/100" in told
    assert "0:00 left, loss" in told


def test_that_there_may_be_no_more_is_said_once(capsys):
    reporter = Reporter(CONFIG)
    for wanted in (CONFIG.max_gaussians, *[CONFIG.max_gaussians + 1] * 2):
        reporter.tell_if_full(wanted)
    (told,) = capsys.readouterr().err.splitlines()
    assert f"{CONFIG.max_gaussians + 1:,} Gaussians are wanted" in told
    assert "(train --max-gaussians)" in told, "the demonstration has no such option"
