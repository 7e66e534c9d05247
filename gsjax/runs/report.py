"""Progress of training on stderr: a bar on a terminal, lines elsewhere."""

import io
import math
import sys

import numpy as np
from tqdm import tqdm

from gsjax.runtime.console import note
from gsjax.train.config import TrainConfig
from gsjax.train.loop import Progress

_LINE_SECONDS, _BAR_SECONDS = 10.0, 1.0
_SMOOTHING = 0.05


class _Lines(io.StringIO):
    """Stream for tqdm that prints each refresh as a line of its own."""

    last = ""

    def write(self, text: str) -> int:
        line = text.strip()
        if line and line != self.last:
            note(line)
            self.last = line
        return len(text)


class Reporter:
    """Reports the steps of a run, of which ``done`` precede this session.

    The time left is estimated by tqdm. A step is weighted by the side of its images,
    and compilations are not counted.
    """

    def __init__(self, config: TrainConfig, done: int = 0):
        self.steps, self.max_gaussians = config.steps, config.max_gaussians
        weights = 1 / np.array([config.divisor(step) for step in range(config.steps)])
        self.work = np.append(0, np.cumsum(weights))
        terminal = sys.stderr.isatty()
        form = "{desc}{postfix}, {remaining} left"
        self.bar = tqdm(
            total=self.work[-1],
            initial=self.work[done],
            desc=f"step {done}/{self.steps}",
            leave=False,
            dynamic_ncols=terminal,
            mininterval=_BAR_SECONDS if terminal else _LINE_SECONDS,
            miniters=0,
            file=None if terminal else _Lines(),
            bar_format="{percentage:3.0f}%|{bar}| " + form if terminal else form,
            delay=1e-6,  # nothing before the first step
        )
        self.loss = self.psnr = float("nan")
        self.compile_seconds, self.full = 0.0, False

    def step(self, progress: Progress) -> None:
        """Report a step."""
        metrics, step = progress.metrics, int(progress.metrics.step)
        self.loss = _smoothed(self.loss, float(metrics.loss))
        self.psnr = _smoothed(self.psnr, float(metrics.psnr))
        self.report_if_full(int(metrics.wanted))
        if progress.compile_seconds != self.compile_seconds:
            self.compile_seconds = progress.compile_seconds
            self.bar.unpause()
        self.bar.set_description_str(f"step {step}/{self.steps}", refresh=False)
        self.bar.set_postfix_str(
            f"loss {self.loss:.4f}, {self.psnr:.2f} dB, "
            f"{int(metrics.gaussians):,} Gaussians, "
            f"{tqdm.format_interval(progress.seconds)} elapsed",
            refresh=False,
        )
        self.bar.update(self.work[step] - self.bar.n)
        if step == self.steps:
            self.bar.refresh()

    def report_if_full(self, wanted: int) -> None:
        """Report once that the strategy needs more Gaussians than the maximum."""
        if wanted > self.max_gaussians and not self.full:
            self.full = True
            most = f"{self.max_gaussians:,} (train --max-gaussians)"
            asked = f"the strategy asks for {wanted:,} Gaussians, the maximum is {most}"
            note(f"{asked}; the most needed ones are added first")

    def close(self) -> None:
        """Remove the bar."""
        self.bar.close()


def _smoothed(mean: float, value: float) -> float:
    """Return the running mean of finite values; without valid pixels, PSNR is none."""
    if not math.isfinite(value):
        return mean
    return value if math.isnan(mean) else (1 - _SMOOTHING) * mean + _SMOOTHING * value
