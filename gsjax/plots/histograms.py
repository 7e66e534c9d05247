"""Histograms of a scene as a picture: opacity, scale and anisotropy, by OpenCV."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.gaussians import Gaussians
from gsjax.io import images
from gsjax.plots.curves import axes, draw_line, legend
from gsjax.runtime import files

_BINS, _SIZE = 60, (720, 300)
_TAIL = 1e-3  # of the values at either end may lie beyond a logarithmic axis


class Group(NamedTuple):
    """Values of one kind, [·]; what is not finite is left out."""

    label: str
    values: np.ndarray


def histograms_png(path: Path, gaussians: Gaussians, *, title: str = "") -> None:
    """Write `histograms` to a PNG, in place of what may be there.

    Raises:
      InputError: if the file cannot be written.
      MissingExtraError: if OpenCV is absent.
    """
    files.write_file(path, images.encode_png(histograms(gaussians, title=title)))


def histograms(gaussians: Gaussians, *, title: str = "") -> np.ndarray:
    """Three plots [H, W, 3] uint8, one above the other, of the active Gaussians.

    Opacity; the scales, by length of axis, in world units; and the longest scale over
    the shortest. The latter two on logarithmic axes, which hold what lies between the
    0.1 and the 99.9 % quantile: a few outliers would else own them. How many values lie
    beyond, and how many are not finite, is said.
    """
    active = np.asarray(gaussians.active)
    logits = np.asarray(gaussians.params.logit_opacities, np.float64)[active]
    logs = np.asarray(gaussians.params.log_scales, np.float64)[active]
    logs = np.sort(logs / np.log(10), axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        opacity, ratio = 1 / (1 + np.exp(-logits)), logs[:, 2] - logs[:, 0]
    count = f"{active.sum():,} Gaussians"
    scales = [
        Group(name, logs[:, axis])
        for axis, name in enumerate(("shortest", "middle", "longest axis"))
    ]
    heading = f"{title}: {count}" if title else count
    return np.concatenate(
        [
            _histogram([Group("", opacity)], heading, "opacity", (0.0, 1.0)),
            _histogram(scales, "count by axis", "scale, world units", None),
            _histogram([Group("", ratio)], "", "longest / shortest axis", None),
        ]
    )


def _histogram(
    groups: Sequence[Group], title: str, x_label: str, x: tuple[float, float] | None
) -> np.ndarray:
    """Counts by value, as steps; without a range ``x`` values are log10 of what they
    mean."""
    finite = [group.values[np.isfinite(group.values)] for group in groups]
    every = np.concatenate(finite)
    bounds = x or _rounded(every)
    edges = np.linspace(*bounds, _BINS + 1)
    counts = [np.histogram(values, edges)[0] for values in finite]
    left_out = {
        "below": np.count_nonzero(every < bounds[0]),
        "above": np.count_nonzero(every > bounds[1]),
        "not finite": sum(group.values.size for group in groups) - every.size,
    }
    told = ", ".join(f"{count:,} {what}" for what, count in left_out.items() if count)
    top = 1.06 * max(1, *(int(each.max()) for each in counts))
    plot, place = axes(
        bounds, (0.0, top), size=_SIZE,
        title=title, x_label=f"{x_label} ({told})" if told else x_label,
        log=(not x, False), y_label="" if len(groups) > 1 else "count",
    )  # fmt: skip
    for index, each in enumerate(counts):
        steps = np.stack(
            [np.repeat(edges, 2), np.concatenate([[0], np.repeat(each, 2), [0]])], 1
        )
        draw_line(plot, place(steps), index)
    if len(groups) > 1:
        legend(plot, [group.label for group in groups])
    return plot


def _rounded(logs: np.ndarray) -> tuple[float, float]:
    """A range of whole or half decades, of at least one, that holds these log10: all of
    fewer than a thousand, of more all but `_TAIL` at either end.
    """
    if not len(logs):
        return -1.0, 0.0
    least = np.quantile(logs, _TAIL, method="lower")
    most = np.quantile(logs, 1 - _TAIL, method="higher")
    low, high = np.floor(2 * least) / 2, np.ceil(2 * most) / 2
    return float(low), float(max(high, low + 1))
