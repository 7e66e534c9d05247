"""Search for the price of a bit that meets a goal, measured on files read back."""

import tempfile
import warnings
from collections.abc import Callable
from functools import partial, reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsjax.compression.finetune import Finetuning, finetune
from gsjax.compression.measure import Judge, squared_error
from gsjax.compression.quantise import (
    Quantised,
    Source,
    quantise,
    scaled,
)
from gsjax.compression.types import NOMINAL_PSNR, Goal, Quality
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, concatenate
from gsjax.io.formats import load, save
from gsjax.runtime.console import note

_TRIALS = 8
_TUNED = 4  # trials with fine-tuning
_COARSER = 2.0  # first price with fine-tuning, of that without
_ENOUGH = 0.9  # share of the goal that is near enough
_STRIDE, _STRIDES = 6.0, 16  # from one estimate to the next, of the price
# Rounding less costs little: harmonics of a palette are repeated.
_OPTIONS: dict[str, dict[str, Any]] = {".spz": {"harmonic_bits": (8, 8)}}
_SMALL = 2  # palettes that are tried before errors are known
_WITHOUT_HARMONICS = 0.7  # share of the error, for the first price
_FACTORS = 0.05, 100.0  # limits of what corrects an estimate
_WIDEST = 16.0  # factor of the price from one trial to the next, at most


class UnreachableError(InputError):
    """No price meets the goal."""


class Trial(NamedTuple):
    """A scene at one price, written and read back.

    Attributes:
      scene: what was written.
      gaussians: what was read.
      files: bytes of each file.
      quality: measured on the held-out pictures.
      value: what the goal limits: loss in dB, bytes, or error.
    """

    scene: Quantised
    gaussians: Gaussians
    files: tuple[bytes, ...]
    quality: Quality
    value: float

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(map(len, self.files))


def search(
    source: Source,
    judge: Judge,
    before: Quality,
    goal: Goal,
    mode: str | None,
    finetuning: Finetuning | None = None,
) -> Trial:
    """Return the trial that meets a goal with the smallest file or loss.

    Args:
      source: the scene.
      judge, before: measure quality, and that of the scene before.
      goal: what must be met.
      mode: render mode to record in the file.
      finetuning: how scenes are trained further, in a second search from the result of
        the first; None not to.

    Raises:
      UnreachableError: if no price meets the goal.
    """
    ((name, limit),) = goal.limits.items()
    by_size = goal.max_size is not None

    def at(price: float, tune: Finetuning | None = None) -> Trial:
        trial = _trial(quantise(source, price), source.suffix, judge, mode, tune)
        value = {
            "max_loss": trial.quality.loss(before),
            "max_size": float(trial.size),
            "max_error": trial.quality.largest_error,
        }
        trial = trial._replace(value=value[name])
        note(
            f"price {price:.2e}: {len(trial.scene.kept):,} Gaussians, "
            f"{trial.size / 1e6:.2f} MB, {value['max_loss']:.3f} dB lost"
        )
        return trial

    price = _first_price(source, before, goal)
    source = calibrated(source, judge, price)
    best = _bisect(at, _first_price(source, before, goal, price), limit, by_size)
    if finetuning is None:
        return best
    note(f"{finetuning.steps} steps of fine-tuning in each of up to {_TUNED} trials")
    tuned = partial(at, tune=finetuning)
    start = best.scene.price * (1 if by_size else _COARSER)
    try:
        found = _bisect(tuned, start, limit, by_size, _TUNED)
    except UnreachableError:
        return best
    return found if _better(found, best, by_size) else best


def _bisect(
    at: Callable[[float], Trial],
    price: float,
    limit: float,
    by_size: bool,
    trials: int = _TRIALS,
) -> Trial:
    """Return the best trial. Values rise with the price, or fall if ``by_size``."""
    best: Trial | None = None
    low, high = 0.0, np.inf  # prices that meet the goal, and that do not
    tried: list[tuple[float, float]] = []  # (price, value): trials take memory
    for _ in range(trials):
        trial = at(price)
        tried.append((price, trial.value))
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
        least = min(value for _, value in tried)
        raise UnreachableError(
            f"goal: expected {limit:g} to be reached, got {least:g} at the least; "
            "allow more, or choose another format"
        )
    return best


def _better(trial: Trial, best: Trial, by_size: bool) -> bool:
    if not by_size:
        return trial.size < best.size
    one, other = trial.quality, best.quality
    if one.psnr is not None and other.psnr is not None:
        return one.psnr > other.psnr
    return one.psnr_before > other.psnr_before


def _next_price(
    tried: list[tuple[float, float]], limit: float, low: float, high: float
) -> float:
    """Return a price between the bounds, by the logarithms of the last trials."""
    target = np.log(0.96 * limit)
    points = [(np.log(price), np.log(max(value, 1e-12))) for price, value in tried]
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


def _first_price(
    source: Source, before: Quality, goal: Goal, start: float | None = None
) -> float:
    """Return a price whose estimated error is about that of the goal, or less.

    ``start`` is a price near it, if one is known.
    """
    psnr = before.psnr if before.psnr is not None else NOMINAL_PSNR
    if goal.max_loss is not None:
        target = 10 ** (-psnr / 10) * (10 ** (goal.max_loss / 10) - 1)
    elif goal.max_error is not None:
        target = (goal.max_error / 8) ** 2
    else:
        target = 10 ** (-psnr / 10) / 15
    target *= _WITHOUT_HARMONICS
    price = start or target / len(source.rows["means"])
    error = _estimate(source, price)
    finer = error > target
    for _ in range(_STRIDES):
        last = price, error
        price = price / _STRIDE if finer else price * _STRIDE
        error = _estimate(source, price)
        if (error > target) != finer:
            x, y = np.log([last, (price, error)]).T
            return float(np.exp(np.interp(np.log(target), *_ascending(y, x))))
    return price


def _ascending(keys: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    order = np.argsort(keys)
    return keys[order], values[order]


def _estimate(source: Source, price: float) -> float:
    """Return the estimated error at a price, without that of harmonics.

    Palettes take long to make, and a price that is far too low asks for large ones.
    """
    errors = quantise(source, price, palettes=0).errors
    return max(sum(errors.values()) - errors["harmonics"], 1e-300)


def calibrated(source: Source, judge: Judge, price: float) -> Source:
    """Return the scene with its estimates of errors corrected by measured ones.

    Estimates take Gaussians one by one. Together they err more: neighbours lose the
    same light, and those that change places in the order of depth are in no gradient.
    Each kind of change at this price is drawn by itself.
    """
    scene, factors = quantise(source, price, palettes=_SMALL), {}
    removed = judge.few(scene.with_change(source, "removal"))
    for kind, estimate in scene.errors.items():
        if kind == "removal":
            error = squared_error(removed, judge.few())
        else:  # against the pictures after the removal, whose error may be far larger
            changed = judge.few(scene.with_change(source, kind))
            error = squared_error(changed, removed)
        if estimate > 0:
            factors[kind] = float(np.clip(error / estimate, *_FACTORS))
    return scaled(source, factors)


def _trial(
    scene: Quantised,
    suffix: str,
    judge: Judge,
    mode: str | None,
    finetuning: Finetuning | None,
) -> Trial:
    if finetuning is not None:
        scene = finetune(scene, finetuning)
    found = [write_and_read(one, suffix, mode) for one in scene.files()]
    files, read = zip(*found)
    gaussians = reduce(concatenate, read)
    return Trial(scene, gaussians, files, judge.judge(gaussians), float("nan"))


def write_and_read(
    gaussians: Gaussians, suffix: str, mode: str | None
) -> tuple[bytes, Gaussians]:
    """Return the bytes of a file, and the Gaussians read from it.

    Warnings of the formats are left out: what is lost is measured.
    """
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        path = Path(folder) / f"scene{suffix}"
        save(path, gaussians, mode=mode, **_OPTIONS.get(suffix, {}))
        return path.read_bytes(), load(path)
