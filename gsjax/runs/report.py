"""What a run says as it goes: a bar on a terminal, lines elsewhere; all on stderr."""

import math
import sys
import time
from typing import Any

import numpy as np

from gsjax.runtime.console import note
from gsjax.train.config import TrainConfig
from gsjax.train.loop import Progress

_LINE_SECONDS, _BAR_SECONDS = 10.0, 1.0
_SMOOTH = 0.05
_SURE = 20


class Reporter:
    """Shows the steps of one run, of which ``done`` lie behind it."""

    def __init__(self, config: TrainConfig, done: int = 0):
        self.steps = config.steps
        self.divisors = np.array([config.divisor(s) for s in range(config.steps)])
        # Times of all steps from each on, in those of a step at full size. They go with
        # the side of the pictures rather than with their pixels: twice the side took
        # 1.1 to 2.3 times as long, as more than pictures is worked on.
        self.ahead = np.append(np.cumsum(1 / self.divisors[::-1])[::-1], 0)
        self.bar: Any = None
        if sys.stderr.isatty():
            from tqdm import tqdm

            # tqdm's own guess of the time left takes all steps for alike.
            self.bar = tqdm(
                total=self.steps, initial=done, desc="training", leave=False,
                dynamic_ncols=True,
                bar_format="{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} "
                "[{elapsed}{postfix}]",
            )  # fmt: skip
        self.loss = self.psnr = float("nan")
        self.last = time.monotonic()
        self.rate_from = (done, 0.0)
        self.rate = float("nan")
        self.compiled: list[float] = []  # seconds by then, after each compilation
        self.most, self.full = config.max_gaussians, False

    def phase(self, text: str) -> None:
        """Say that something begins that takes a while."""
        note(text)

    def step(self, progress: Progress) -> None:
        """Show a step."""
        metrics = progress.metrics
        self.loss = _smoothed(self.loss, float(metrics.loss))
        self.psnr = _smoothed(self.psnr, float(metrics.psnr))
        if [progress.compile_seconds] != self.compiled[-1:]:
            self.compiled.append(progress.compile_seconds)
        self.tell_if_full(int(metrics.wanted))
        now, step = time.monotonic(), int(metrics.step)
        if self.bar is not None:
            self.bar.update(1)
        pause = _LINE_SECONDS if self.bar is None else _BAR_SECONDS
        working = progress.seconds - progress.compile_seconds
        before, then = self.rate_from
        # The first steps of a program are slow: of few of them nothing follows.
        sure = step - before >= _SURE or working - then >= pause
        if step < self.steps and not (sure and now >= self.last + pause):
            return
        self.last = now
        self.rate = (step - before) / max(working - then, 1e-9)
        self.rate_from = (step, working)
        told = (
            f"loss {self.loss:.4f}, {self.psnr:.2f} dB, "
            f"{int(metrics.gaussians):,} Gaussians, {self.rate:.1f} steps/s"
        )
        left = f"{_clock(self.left(step))} left"
        if self.bar is not None:
            self.bar.set_postfix_str(f"{left}, {told}", refresh=False)
            return
        note(
            f"step {step}/{self.steps}: {told}, {_clock(progress.seconds)} gone, {left}"
        )

    def tell_if_full(self, wanted: int) -> None:
        """Say once that there are to be more Gaussians than there may be."""
        if wanted > self.most and not self.full:
            self.full = True
            note(
                f"{wanted:,} Gaussians are wanted, {self.most:,} is the most "
                "(train --max-gaussians): those that lack most come first"
            )

    def left(self, step: int) -> float:
        """Seconds to come, about: a step takes as long as its pictures are wide, and
        where they become larger there is a program to compile."""
        here = self.divisors[max(step - 1, 0)]
        work = here * self.ahead[step]
        programs = np.sum(np.unique(self.divisors[step:]) != here)
        each = self.compiled[-1] / len(self.compiled) if self.compiled else 0.0
        return work / max(self.rate, 1e-9) + programs * each

    def close(self) -> None:
        """Take the bar away."""
        if self.bar is not None:
            self.bar.close()


def _smoothed(mean: float, value: float) -> float:
    """The running mean, over what is a number: of a photograph that is masked
    altogether the PSNR is none."""
    if not math.isfinite(value):
        return mean
    return value if math.isnan(mean) else (1 - _SMOOTH) * mean + _SMOOTH * value


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
