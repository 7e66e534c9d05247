"""Matplotlib figures of a given size in px, drawn off screen: curves and histograms.

The object-oriented API and the Agg canvas need no display and share no global state.
Matplotlib is imported inside the functions, because it takes long to load.
"""

from __future__ import annotations

import typing
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit

from gsjax.gaussians import Gaussians

if typing.TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 100
_TAIL = 1e-3  # share of the values at either end that a logarithmic axis may leave out
_DECADES = 200.0  # larger powers of ten count as not finite


class Series(NamedTuple):
    """A line ``y`` over ``x``, of one length; non-finite values leave a gap.

    A ``faint`` line is thin and pale, for noise behind what matters.
    """

    label: str
    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    faint: bool = False


def new_figure(size: tuple[int, int], **options: Any) -> Figure:
    """Return a figure of (width, height) px; ``options`` are those of `Figure`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # The canvas rounds down: the excess keeps width / DPI · DPI above width.
    width, height = ((side + 1e-3) / DPI for side in size)
    figure = Figure((width, height), dpi=DPI, **options)
    FigureCanvasAgg(figure)
    return figure


def new_chart(size: tuple[int, int], rows: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a figure of axes, one below the other."""
    figure = new_figure(size, layout="constrained")
    axes = list(figure.subplots(rows, squeeze=False)[:, 0])
    for each in axes:
        each.grid(alpha=0.3)
        each.tick_params(which="both", labelsize=8)
        each.spines[["top", "right"]].set_visible(False)
    return figure, axes


def figure_pixels(figure: Figure) -> np.ndarray:
    """Draw a figure and return its pixels [H, W, 3] uint8."""
    with warnings.catch_warnings():  # letters that the font lacks become boxes
        warnings.simplefilter("ignore", UserWarning)
        figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()  # pyright: ignore


def plain(text: str) -> str:
    """Escape a text that Matplotlib would take for a formula."""
    return text.replace("$", r"\$")


def curves(series: Sequence[Series], **options: Any) -> np.ndarray:
    """Return the pixels [H, W, 3] uint8 of `curves_figure`, same arguments."""
    return figure_pixels(curves_figure(series, **options))


def curves_figure(
    series: Sequence[Series],
    *,
    title: str = "",
    x_label: str = "step",
    size: tuple[int, int] = (720, 420),
    marks: Mapping[str, float] | None = None,
) -> Figure:
    """Draw all series in one chart of (width, height) px.

    ``marks`` are labels of vertical lines and their x.
    """
    figure, (axes,) = new_chart(size)
    for line in series:
        points = np.isfinite(np.asarray(line.y, np.float64)).sum()
        axes.plot(
            line.x, line.y, label=plain(line.label), marker="o" if points == 1 else "",
            linewidth=0.8 if line.faint else 1.6, alpha=0.45 if line.faint else 1,
        )  # fmt: skip
    for label, x in (marks or {}).items():
        axes.axvline(x, color="gray", linewidth=0.8, zorder=1)
        place = {"transform": axes.get_xaxis_transform(), "rotation": 90}
        axes.text(x, 0.02, plain(label), fontsize=8, **place)
    axes.margins(x=0.01)
    axes.ticklabel_format(useOffset=False)
    axes.set(title=plain(title), xlabel=plain(x_label))
    if series:
        columns = max(1, size[0] // 180)
        figure.legend(loc="outside lower center", ncols=columns, frameon=False)
    return figure


def histograms(gaussians: Gaussians, *, title: str = "") -> np.ndarray:
    """Return the pixels [H, W, 3] uint8 of `histograms_figure`."""
    return figure_pixels(histograms_figure(gaussians, title=title))


def histograms_figure(gaussians: Gaussians, *, title: str = "") -> Figure:
    """Draw three histograms of the active Gaussians, one below the other.

    They show the opacity, the scales in world units by length of the axis, and the
    ratio of the longest to the shortest scale. The last two have logarithmic axes from
    the 0.1 % to the 99.9 % quantile; labels count the values that are not shown.
    """
    active = np.asarray(gaussians.active)
    opacity = expit(np.asarray(gaussians.params.logit_opacities, np.float64)[active])
    logs = np.asarray(gaussians.params.log_scales, np.float64)[active]
    logs = np.sort(logs / np.log(10), axis=1)
    with np.errstate(invalid="ignore"):
        ratio = logs[:, 2] - logs[:, 0]
    names = ("shortest axis", "middle axis", "longest axis")
    figure, axes = new_chart((720, 900), rows=3)
    _histogram(axes[0], "opacity", {"": opacity}, (0.0, 1.0))
    _histogram(axes[1], "scale, world units", dict(zip(names, logs.T)))
    _histogram(axes[2], "longest / shortest axis", {"": ratio})
    count = f"{active.sum():,} Gaussians"
    axes[0].set_title(f"{plain(title)}: {count}" if title else count)
    axes[1].legend(frameon=False)
    return figure


def _histogram(
    axes: Axes,
    label: str,
    groups: Mapping[str, np.ndarray],
    bounds: tuple[float, float] | None = None,
) -> None:
    """Draw counts of each group; without ``bounds``, values are log10."""
    every = np.concatenate(list(groups.values()))
    finite = every[np.abs(every) < _DECADES]
    low, high = bounds or (-1.0, 0.0)
    if bounds is None and len(finite):
        # The nearest values that exist: all of fewer than a thousand are shown.
        low = np.quantile(finite, _TAIL, method="lower") - 0.1
        high = np.quantile(finite, 1 - _TAIL, method="higher") + 0.1
    edges = np.linspace(low, high, 61)
    shown, hidden = (edges if bounds else 10**edges), len(every)
    for name, values in groups.items():
        counts, _ = np.histogram(values, edges)
        hidden -= counts.sum()
        axes.stairs(counts, shown, label=name)
    axes.set_xscale("linear" if bounds else "log")
    axes.set_xlim(shown[0], shown[-1])
    axes.set_xlabel(f"{label} ({hidden:,} not shown)" if hidden else label)
    axes.set_ylabel("count")
