"""What a scene consists of, in numbers: the text behind `gsjax info`."""

from typing import Any

import jax
import numpy as np

from gsjax.gaussians import Gaussians, capacity_bucket
from gsjax.raster.render import render_estimate
from gsjax.raster.types import RasterConfig

_PERCENTILES = (1, 25, 50, 75, 99)
_SIZE = (1920, 1080)
_PAIRS = 5  # a Gaussian has about so many, where it is one of a trained scene


def describe(gaussians: Gaussians) -> dict[str, Any]:
    """Counts, bounds and percentiles of the active Gaussians, ready for JSON.

    Percentiles are keyed by their number; they and the bounds are None if there is
    no Gaussian, and a number that is not finite is None.
    """
    params = gaussians.params
    active = np.asarray(gaussians.active)
    means = np.asarray(params.means)[active]
    quats = np.asarray(params.quats)[active]
    logits = np.asarray(params.logit_opacities, np.float64)[active]
    logs = np.asarray(params.log_scales, np.float64)[active]
    leaves = jax.tree.leaves(params)
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
        "render_bytes": _render_bytes(gaussians),
        "dtype": str(params.means.dtype),
    }


def _render_bytes(gaussians: Gaussians) -> int:
    """What a picture of `_SIZE` takes, about, of scenes as training makes them."""
    pairs = capacity_bucket(_PAIRS * gaussians.capacity)
    config = RasterConfig(pair_capacity=min(pairs, 2**30 - 1))
    bases = gaussians.params.sh.shape[-2]
    return render_estimate(gaussians.capacity, bases, _SIZE, config).total


def _percentiles(values: np.ndarray) -> dict[str, float | None]:
    keys = [f"{p}%" for p in _PERCENTILES]
    if values.size == 0:
        return dict.fromkeys(keys)
    with np.errstate(invalid="ignore"):
        found = np.percentile(values, _PERCENTILES)
    return {key: _finite(value) for key, value in zip(keys, found)}


def _bounds(means: np.ndarray, percentiles: tuple[int, int]) -> list | None:
    """[low, high] corners, or None if there are no points."""
    if len(means) == 0:
        return None
    corners = np.percentile(means.astype(np.float64), percentiles, axis=0)
    return [[_finite(value) for value in corner] for corner in corners]


def _finite(value) -> float | None:
    return float(value) + 0.0 if np.isfinite(value) else None  # -0 becomes 0


def info_text(path: str, facts: dict[str, Any]) -> str:
    """`describe`, and ``file_bytes``, as lines to read."""

    def row(name: str, value: str) -> str:
        return f"  {name:<18}{value}"

    def spread(values: dict[str, float | None]) -> str:
        return "   ".join(f"{key} {_number(value)}" for key, value in values.items())

    def box(corners: list | None) -> str:
        if corners is None:
            return "–"
        low, high = (" ".join(_number(v) for v in corner) for corner in corners)
        return f"[{low}] to [{high}]"

    numbers = facts["numbers_per_gaussian"]
    return "\n".join(
        [
            path,
            row("Gaussians", f"{facts['count']:,}"),
            row("SH degree", f"{facts['sh_degree']} ({numbers} numbers each)"),
            row("bounds", box(facts["bounds"])),
            row("bounds 1 to 99 %", box(facts["bounds_1_99"])),
            row("opacity", spread(facts["opacity"])),
            row("scale", spread(facts["scale"])),
            row("longest/shortest", spread(facts["anisotropy"])),
            row("zero quaternions", f"{facts['zero_quaternions']:,}"),
            row("file", _size(facts["file_bytes"])),
            row("parameters", f"{_size(facts['parameter_bytes'])} ({facts['dtype']})"),
            row(
                "memory to render",
                f"about {_size(facts['render_bytes'])} at {_SIZE[0]} × {_SIZE[1]}",
            ),
        ]
    )


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"


def _size(count: int) -> str:
    return f"{count / 2**20:.2f} MiB" if count >= 2**20 else f"{count / 1024:.1f} KiB"
