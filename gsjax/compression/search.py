"""Search for the price of a bit that meets a goal, measured on files read back."""

import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.compression.measure import Judge
from gsjax.compression.quantise import (
    Quantised,
    Source,
    as_gaussians,
    quantise,
    scaled,
)
from gsjax.compression.types import NOMINAL_PSNR, Goal, Quality
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.io.formats import load, save
from gsjax.runtime.console import note

_TRIALS = 8
_ENOUGH = 0.9  # share of the goal that is near enough
_COARSEST, _HALVINGS = 10.0, 30  # first price, of an even share of the error
_FACTORS = 0.05, 50.0  # limits of what corrects an estimate
_WIDEST = 16.0  # factor of the price from one trial to the next, at most


class Trial(NamedTuple):
    """A scene at one price, written and read back.

    Attributes:
      scene: what was written.
      gaussians: what was read.
      data: bytes of the file.
      quality: measured on the held-out pictures.
      value: what the goal limits: loss in dB, bytes, or error.
    """

    scene: Quantised
    gaussians: Gaussians
    data: bytes
    quality: Quality
    value: float


def search(
    source: Source,
    judge: Judge,
    before: Quality,
    goal: Goal,
    mode: str | None,
) -> Trial:
    """Return the trial that meets a goal with the smallest file or loss.

    Args:
      source: the scene.
      judge, before: measure quality, and that of the scene before.
      goal: what must be met.
      mode: render mode to record in the file.

    Raises:
      InputError: if no price meets the goal.
    """
    limit = next(float(v) for v in goal if v is not None)
    by_size = goal.max_size is not None

    def at(price: float) -> Trial:
        trial = _trial(source, judge, price, mode)
        value = {
            "max_loss": trial.quality.loss(before),
            "max_size": float(len(trial.data)),
            "max_error": trial.quality.largest_error,
        }
        name = next(k for k, v in goal._asdict().items() if v is not None)
        trial = trial._replace(value=value[name])
        note(
            f"price {price:.2e}: {len(trial.scene.kept):,} Gaussians, "
            f"{len(trial.data) / 1e6:.2f} MB, {value['max_loss']:.3f} dB lost"
        )
        return trial

    source = calibrated(source, judge, _first_price(source, before, goal))
    return _bisect(at, _first_price(source, before, goal), limit, by_size)


def _bisect(
    at: Callable[[float], Trial], price: float, limit: float, by_size: bool
) -> Trial:
    """Return the best trial. Values rise with the price, or fall if ``by_size``."""
    best: Trial | None = None
    low, high = 0.0, np.inf  # prices that meet the goal, and that do not
    tried: list[Trial] = []
    for _ in range(_TRIALS):
        trial = at(price)
        tried.append(trial)
        meets = trial.value <= limit
        if meets and (best is None or _better(trial, best, by_size)):
            best = trial
        if meets and trial.value > _ENOUGH * limit:
            break
        if meets != by_size:
            low = max(low, price)
        else:
            high = min(high, price)
        price = _next_price(tried, limit, low, high)
        if high < low * 1.03:
            break
    if best is None:
        least = min(tried, key=lambda trial: trial.value)
        raise InputError(
            f"goal: expected {limit:g} to be reached, got {least.value:g} at the least "
            f"with {len(least.data):,} bytes; allow more, or choose another format"
        )
    return best


def _better(trial: Trial, best: Trial, by_size: bool) -> bool:
    if by_size:
        return trial.quality.psnr_before > best.quality.psnr_before
    return len(trial.data) < len(best.data)


def _next_price(tried: list[Trial], limit: float, low: float, high: float) -> float:
    """Return a price between the bounds, by the logarithms of the last trials."""
    target = np.log(0.96 * limit)
    points = [(np.log(t.scene.price), np.log(max(t.value, 1e-12))) for t in tried]
    points.sort(key=lambda point: abs(point[1] - target))
    (x, y), slope = points[0], 1.0
    if len(points) > 1 and points[1][0] != x:
        slope = (points[1][1] - y) / (points[1][0] - x)
    slope = np.sign(slope or 1) * np.clip(abs(slope), 0.3, 3)
    price = np.exp(x + np.clip((target - y) / slope, *np.log([1 / _WIDEST, _WIDEST])))
    if low > 0 and high < np.inf and not low * 1.02 < price < high / 1.02:
        return float(np.sqrt(low * high))
    if not low < price < high:
        return float(4 * low if high == np.inf else high / 4)
    return float(price)


def _first_price(source: Source, before: Quality, goal: Goal) -> float:
    """Return a price whose estimated error is about that of the goal."""
    psnr = before.psnr if before.psnr is not None else NOMINAL_PSNR
    if goal.max_loss is not None:
        target = 10 ** (-psnr / 10) * (10 ** (goal.max_loss / 10) - 1)
    elif goal.max_error is not None:
        target = (goal.max_error / 8) ** 2
    else:
        target = 10 ** (-psnr / 10) / 15
    # From coarse to fine: fine prices ask for large palettes, which take long to make.
    price = _COARSEST * target / len(source.rows["means"])
    for _ in range(_HALVINGS):
        if sum(quantise(source, price).errors.values()) < target:
            break
        price /= 2
    return price


def calibrated(source: Source, judge: Judge, price: float) -> Source:
    """Return the scene with its estimates of errors corrected by measured ones.

    Estimates take Gaussians one by one. Together they err more: neighbours lose the
    same light, and those that change places in the order of depth are in no gradient.
    Each kind of change at this price is drawn by itself.
    """
    scene, factors = quantise(source, price), {}
    removed = judge.error(scene.with_change(source, "removal"))
    for kind, estimate in scene.errors.items():
        error = removed
        if kind != "removal":
            error = judge.error(scene.with_change(source, kind)) - removed
        if estimate > 0:
            factors[kind] = float(np.clip(error / estimate, *_FACTORS))
    return scaled(source, factors)


def _trial(source: Source, judge: Judge, price: float, mode: str | None) -> Trial:
    scene = quantise(source, price)
    data, gaussians = write_and_read(as_gaussians(scene.rows), source.suffix, mode)
    return Trial(scene, gaussians, data, judge.judge(gaussians), float("nan"))


def write_and_read(
    gaussians: Gaussians, suffix: str, mode: str | None
) -> tuple[bytes, Gaussians]:
    """Return the bytes of a file, and the Gaussians read from it.

    Warnings of the formats are left out: what is lost is measured.
    """
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        path = Path(folder) / f"scene{suffix}"
        save(path, gaussians, mode=mode)
        return path.read_bytes(), load(path)
