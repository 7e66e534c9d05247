"""Histograms of a scene: opacity, scale and anisotropy of its Gaussians."""

from __future__ import annotations

import typing
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gsjax.gaussians import Gaussians
from gsjax.io import images
from gsjax.plots import figures
from gsjax.runtime import files

if typing.TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BINS, _SIZE = 60, (720, 900)
_TAIL = 1e-3  # share of the values at either end that a logarithmic axis may leave out
_DECADES = 200.0  # powers of ten on an axis: float64 holds them and a margin


def histograms_png(path: Path, gaussians: Gaussians, *, title: str = "") -> None:
    """Write `histograms` to a PNG, replacing the file.

    Raises:
      InputError: if the file cannot be written.
      MissingExtraError: if OpenCV is absent.
    """
    files.write_file(path, images.encode_png(histograms(gaussians, title=title)))


def histograms(gaussians: Gaussians, *, title: str = "") -> np.ndarray:
    """Return the pixels [H, W, 3] uint8 of `histograms_figure`."""
    return figures.figure_pixels(histograms_figure(gaussians, title=title))


def histograms_figure(gaussians: Gaussians, *, title: str = "") -> Figure:
    """Draw three histograms of the active Gaussians, one below the other.

    They show the opacity, the scales in world units by length of the axis, and the
    ratio of the longest to the shortest scale. The last two have logarithmic axes from
    the 0.1 % to the 99.9 % quantile; the label counts the values that lie beyond or are
    not finite.
    """
    active = np.asarray(gaussians.active)
    logits = np.asarray(gaussians.params.logit_opacities, np.float64)[active]
    logs = np.asarray(gaussians.params.log_scales, np.float64)[active]
    logs = np.sort(logs / np.log(10), axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        opacity, ratio = 1 / (1 + np.exp(-logits)), logs[:, 2] - logs[:, 0]
    count = f"{active.sum():,} Gaussians"
    names = ("shortest axis", "middle axis", "longest axis")
    figure, (first, second, third) = figures.new_chart(_SIZE, rows=3)
    outside = _draw(first, {"": opacity}, (0.0, 1.0))
    figures.label_axes(
        first, f"{title}: {count}" if title else count, f"opacity{outside}", "count"
    )
    outside = _draw(second, dict(zip(names, logs.T)))
    figures.label_axes(second, "", f"scale, world units{outside}", "count")
    figures.add_legend(second)
    outside = _draw(third, {"": ratio})
    figures.label_axes(third, "", f"longest / shortest axis{outside}", "count")
    return figure


def _draw(
    axes: Axes,
    groups: Mapping[str, np.ndarray],
    bounds: tuple[float, float] | None = None,
) -> str:
    """Draw counts of each group, and return what the label says of values left out.

    Without ``bounds``, values are log10 of what the axis shows.
    """
    found = [values[np.isfinite(values)] for values in groups.values()]
    every = np.concatenate(found)
    low, high = bounds or _decade_range(every)
    edges = np.linspace(low, high, _BINS + 1)
    for (name, color), values in zip(zip(groups, figures.COLORS), found):
        counts, _ = np.histogram(values, edges)
        axes.stairs(counts, edges if bounds else 10**edges, label=name, color=color)
    if not bounds:
        axes.set_xscale("log")
    axes.set_xlim(*((low, high) if bounds else (10**low, 10**high)))
    axes.set_ylim(bottom=0)
    left_out = {
        "below": np.count_nonzero(every < low),
        "above": np.count_nonzero(every > high),
        "not finite": sum(values.size for values in groups.values()) - every.size,
    }
    told = ", ".join(f"{count:,} {what}" for what, count in left_out.items() if count)
    return f" ({told})" if told else ""


def _decade_range(logs: np.ndarray) -> tuple[float, float]:
    """Return a range of whole or half decades, at least one, that holds these log10.

    It holds all of fewer than a thousand values, else all but `_TAIL` at either end.
    """
    if not len(logs):
        return -1.0, 0.0
    least = np.quantile(logs, _TAIL, method="lower")
    most = np.quantile(logs, 1 - _TAIL, method="higher")
    low, high = np.floor(2 * least) / 2, np.ceil(2 * most) / 2
    low = float(np.clip(low, -_DECADES, _DECADES - 1))
    return low, float(np.clip(high, low + 1, _DECADES))
