"""Statistics of a scene, and progress and quality of a run, for `gsjax info`."""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from gsjax.errors import InputError
from gsjax.gaussians import Gaussians, capacity_bucket
from gsjax.raster.memory_estimate import render_estimate
from gsjax.raster.types import RasterConfig
from gsjax.runs.folder import load_settings, run_files
from gsjax.runs.history import read_metrics
from gsjax.runtime.console import decibels
from gsjax.runtime.files import read_json
from gsjax.runtime.memory import size_text

_PERCENTILES = (1, 25, 50, 75, 99)
_SIZE = (1920, 1080)
_PAIRS = 5  # tile pairs per Gaussian, typical of trained scenes
_VIEWS = {"test": "held-out", "train": "training"}
# Reported keys of an evaluation and their types; psnr is null if it is infinite.
_REPORTED = {
    "which": (str,),
    "views": (int,),
    "ssim": (float, int),
    "psnr": (float, int, type(None)),
}


def describe_run(folder: Path) -> dict[str, Any]:
    """Return the main settings, progress and quality of a run, ready for JSON.

    ``evaluation`` is None if there is none yet.

    Raises:
      InputError: if the folder is not a run, or its files are damaged.
    """
    settings, files = load_settings(folder), run_files(folder)
    config = settings.config
    lines = read_metrics(files.metrics)
    last = lines[-1] if lines else {"step": 0, "seconds": 0.0}
    return {
        "dataset": str(settings.dataset),
        "strategy": config.strategy,
        "steps_done": last["step"],
        "steps": config.steps,
        "seconds": last["seconds"],
        "seed": config.seed,
        "max_size": config.max_size,
        "background": config.background,
        "shutter": config.shutter,
        "mip": config.mip,
        "motion": config.motion,
        "undistort": config.undistort,
        "evaluation": _evaluation(files.eval),
    }


def _evaluation(path: Path) -> dict[str, Any] | None:
    if not path.exists():
        return None
    data = read_json(path, "the eval.json of a run")
    for key, kinds in _REPORTED.items():
        value = data.get(key, "missing")
        good = type(value) in kinds
        if type(value) in (int, float):
            good &= abs(value) < 1e30
        if not good or (key == "which" and value not in _VIEWS):
            fault = f"damaged: {key} is {repr(value)[:80]}"
            raise InputError(f"{path}: {fault}; write it again with `gsjax eval`")
    return {key: data[key] for key in _REPORTED}


def run_text(path: str, facts: dict[str, Any]) -> str:
    """Return `describe_run` as readable lines."""
    rows = {
        "dataset": facts["dataset"],
        "strategy": facts["strategy"],
        "steps": f"{facts['steps_done']:,} of {facts['steps']:,}",
        "training": f"{facts['seconds']:.0f} s",
    }
    if facts["shutter"] != "global":
        rows["shutter"] = facts["shutter"].replace("_", " ")
    if facts["mip"]:
        rows["filters"] = "Mip-Splatting"
    if facts["motion"] != "none":
        rows["motion"] = facts["motion"]
    quality = facts["evaluation"]
    if quality is not None:
        views = f"{quality['views']} {_VIEWS[quality['which']]} views"
        metrics = f"PSNR {decibels(quality['psnr'])}, SSIM {quality['ssim']:.4f}"
        rows["quality"] = f"{metrics} ({views})"
    return _table(path, rows)


def describe(gaussians: Gaussians) -> dict[str, Any]:
    """Return counts, bounds and percentiles of the active Gaussians, ready for JSON.

    Percentiles are keyed by their number. Percentiles and bounds of no Gaussian are
    None, as are non-finite numbers.
    """
    params = gaussians.params
    active = np.asarray(gaussians.active)
    means = np.asarray(params.means)[active]
    quats = np.asarray(params.quats)[active]
    logits = np.asarray(params.logit_opacities, np.float64)[active]
    logs = np.asarray(params.log_scales, np.float64)[active]
    leaves, slots = jax.tree.leaves(params), gaussians.capacity
    pairs = min(capacity_bucket(_PAIRS * slots), 2**30 - 1)
    config, bases = RasterConfig(pair_capacity=pairs), params.sh.shape[-2]
    zero = np.abs(quats).max(axis=1, initial=0) < np.finfo(quats.dtype).tiny
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-logits))
        scales = np.exp(logs)
        anisotropy = np.exp(np.ptp(logs, axis=1))
    return {
        "count": int(active.sum()),
        "sh_degree": gaussians.sh_degree,
        "numbers_per_gaussian": sum(int(np.prod(leaf.shape[1:])) for leaf in leaves),
        "bounds": _bounds(means, (0, 100)),
        "bounds_1_99": _bounds(means, (1, 99)),
        "opacity": _percentiles(opacities),
        "scale": _percentiles(scales),
        "anisotropy": _percentiles(anisotropy),
        "zero_quaternions": int(zero.sum()),
        "parameter_bytes": sum(int(leaf.nbytes) for leaf in leaves),
        "render_bytes": render_estimate(slots, bases, _SIZE, config).total,
        "dtype": str(params.means.dtype),
    }


def _percentiles(values: np.ndarray) -> dict[str, float | None]:
    keys = [f"{p}%" for p in _PERCENTILES]
    if values.size == 0:
        return dict.fromkeys(keys)
    with np.errstate(invalid="ignore"):
        found = np.percentile(values, _PERCENTILES)
    return {key: _finite(value) for key, value in zip(keys, found)}


def _bounds(means: np.ndarray, percentiles: tuple[int, int]) -> list | None:
    """Return the [low, high] corners of a box; None without points."""
    if len(means) == 0:
        return None
    corners = np.percentile(means.astype(np.float64), percentiles, axis=0)
    return [[_finite(value) for value in corner] for corner in corners]


def _finite(value) -> float | None:
    return float(value) + 0.0 if np.isfinite(value) else None  # -0 becomes 0


def info_text(path: str, facts: dict[str, Any]) -> str:
    """Return `describe`, together with ``file_bytes``, as readable lines."""

    def number(value: float | None) -> str:
        return "–" if value is None else f"{value:.4g}"

    def spread(values: dict[str, float | None]) -> str:
        return "   ".join(f"{key} {number(value)}" for key, value in values.items())

    def box(corners: list | None) -> str:
        if corners is None:
            return "–"
        low, high = (" ".join(number(v) for v in corner) for corner in corners)
        return f"[{low}] to [{high}]"

    each = f"{facts['numbers_per_gaussian']} numbers each"
    rows = {
        "Gaussians": f"{facts['count']:,}",
        "SH degree": f"{facts['sh_degree']} ({each})",
        "bounds": box(facts["bounds"]),
        "bounds 1 to 99 %": box(facts["bounds_1_99"]),
        "opacity": spread(facts["opacity"]),
        "scale": spread(facts["scale"]),
        "longest/shortest": spread(facts["anisotropy"]),
        "zero quaternions": f"{facts['zero_quaternions']:,}",
        "file": _size(facts["file_bytes"]),
        "parameters": f"{_size(facts['parameter_bytes'])} ({facts['dtype']})",
        "memory to render": f"about {size_text(facts['render_bytes'])} at "
        f"{_SIZE[0]} × {_SIZE[1]}",
    }
    return _table(path, rows)


def _size(count: int) -> str:
    return f"{count / 2**20:.2f} MiB" if count >= 2**20 else f"{count / 1024:.1f} KiB"


def _table(path: str, rows: dict[str, str]) -> str:
    lines = (f"  {name:<18}{value}" for name, value in rows.items())
    return "\n".join([path, *lines])
