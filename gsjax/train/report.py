"""What a run says as it goes: a bar on a terminal, lines elsewhere; all on stderr."""

import sys
import time
from typing import Any

from gsjax.console import note
from gsjax.train.fit import Progress

_LINE_SECONDS = 10.0
_SMOOTH = 0.05


class Reporter:
    """Shows the steps of one run of ``steps``."""

    def __init__(self, steps: int, done: int = 0):
        self.steps = steps
        self.bar: Any = None
        if sys.stderr.isatty():
            from tqdm import tqdm

            self.bar = tqdm(
                total=steps, initial=done, desc="training", unit="step", leave=False,
                dynamic_ncols=True, smoothing=_SMOOTH,
            )  # fmt: skip
        self.loss = self.psnr = float("nan")
        self.last = time.monotonic()
        self.rate_from = (done, 0.0)

    def phase(self, text: str) -> None:
        """Say that something begins that takes a while."""
        note(text)

    def step(self, progress: Progress) -> None:
        """Show a step."""
        metrics = progress.metrics
        self.loss = _smoothed(self.loss, float(metrics.loss))
        self.psnr = _smoothed(self.psnr, float(metrics.psnr))
        told = (
            f"loss {self.loss:.4f}, {self.psnr:.2f} dB, "
            f"{int(metrics.gaussians):,} Gaussians"
        )
        if self.bar is not None:
            self.bar.set_postfix_str(told, refresh=False)
            self.bar.update(1)
            return
        now, step = time.monotonic(), int(metrics.step)
        if step < self.steps and now < self.last + _LINE_SECONDS:
            return
        self.last = now
        working = progress.seconds - progress.compile_seconds
        before, then = self.rate_from
        rate = (step - before) / max(working - then, 1e-9)
        self.rate_from = (step, working)
        left = (self.steps - step) / max(rate, 1e-9)
        note(
            f"step {step}/{self.steps}: {told}, {rate:.1f} steps/s, "
            f"{_clock(progress.seconds)} gone, {_clock(left)} left"
        )

    def close(self) -> None:
        """Take the bar away."""
        if self.bar is not None:
            self.bar.close()


def _smoothed(mean: float, value: float) -> float:
    return value if mean != mean else (1 - _SMOOTH) * mean + _SMOOTH * value


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
