"""Progress that a run reports."""

import math
import time

import jax.numpy as jnp
import pytest

from gsjax.runs import report
from gsjax.runs.report import Reporter
from gsjax.train.config import Level, TrainConfig
from gsjax.train.loop import Progress
from gsjax.train.state import Metrics

CONFIG = TrainConfig(steps=100, levels=(Level(0.0, 4), Level(0.5, 2), Level(0.8, 1)))


def progress(step: int, compile_seconds: float = 0.0, psnr: float = 0.0) -> Progress:
    metrics = Metrics(*map(jnp.asarray, [0] * len(Metrics._fields)))
    metrics = metrics._replace(step=jnp.asarray(step), psnr=jnp.asarray(psnr))
    return Progress(metrics, 200.0, compile_seconds, 1, CONFIG.divisor(step), 64)


def test_time_left_weighs_image_sizes_and_excludes_compilation(monkeypatch, capsys):
    monkeypatch.setattr(report, "_LINE_SECONDS", 0.0)
    clock = [time.time()]
    reporter = Reporter(CONFIG)
    monkeypatch.setattr(reporter.bar, "_time", lambda: clock[0])
    reporter.bar.start_t = reporter.bar.last_print_t = clock[0]
    clock[0] += 20.0
    reporter.step(progress(1, compile_seconds=20.0))
    for step in range(2, 51):
        clock[0] += 1.0  # a step at a quarter of the size
        reporter.step(progress(step, compile_seconds=20.0))
    left = (reporter.bar.total - reporter.bar.n) / reporter.bar.format_dict["rate"]
    assert left == pytest.approx(30 * 2 + 20 * 4, rel=0.02)
    reporter.step(progress(100, compile_seconds=20.0))
    reporter.close()
    *_, last = capsys.readouterr().err.splitlines()
    assert last.startswith("gsjax: step 100/100, loss 0.0000, 0.00 dB, 0 Gaussians")
    assert last.endswith("03:20 elapsed, 00:00 left")


def test_the_mean_ignores_values_that_are_not_finite():
    """The PSNR of a fully masked photograph is infinite."""
    reporter = Reporter(CONFIG)
    reporter.step(progress(1, psnr=math.inf))
    assert math.isnan(reporter.psnr)
    for step, psnr in enumerate((20.0, math.inf, math.nan), 2):
        reporter.step(progress(step, psnr=psnr))
        assert reporter.psnr == 20.0
    reporter.step(progress(5, psnr=30.0))
    assert 20 < reporter.psnr < 30
    reporter.close()


def test_a_terminal_shows_a_bar(monkeypatch, capsys):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    reporter = Reporter(CONFIG, 99)
    reporter.step(progress(100))
    reporter.close()
    shown = capsys.readouterr().err
    assert "100%|" in shown
    assert "step 100/100, loss" in shown


def test_reaching_the_maximum_is_reported_once(capsys):
    reporter = Reporter(CONFIG)
    for wanted in (CONFIG.max_gaussians, *[CONFIG.max_gaussians + 1] * 2):
        reporter.report_if_full(wanted)
    (line,) = capsys.readouterr().err.splitlines()
    assert f"asks for {CONFIG.max_gaussians + 1:,} Gaussians" in line
    assert "(train --max-gaussians)" in line
    reporter.close()
