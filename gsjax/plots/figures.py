"""Matplotlib figures of a given size in px, drawn off screen.

Figures use the object-oriented API and the Agg canvas, which need no display and share
no global state between threads. Matplotlib is imported inside the functions.
"""

from __future__ import annotations

import typing

import numpy as np

from gsjax.errors import InputError

if typing.TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 100
INK, GRID, FRAME = "#464a52", "#e4e6ea", "#969aa2"
COLORS = (
    "#2662ba", "#d65c34", "#2c8e5c", "#8e52a8", "#b08a1c",
    "#1496aa", "#be3c78", "#6e6e6e", "#5a3c1e", "#000000",
)  # fmt: skip
_LEAST_SIZE = (200, 120)
_LARGEST = 1e100  # larger values are drawn as gaps: their range would overflow


def new_figure(
    size: tuple[int, int], color: tuple[int, int, int] = (255, 255, 255), **options
) -> Figure:
    """Return a figure of (width, height) px over a colour of 8-bit RGB.

    ``options`` are those of `Figure`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # The canvas rounds down: the excess keeps width / DPI · DPI above width.
    width, height = ((side + 1e-3) / DPI for side in size)
    paper = "#{:02x}{:02x}{:02x}".format(*color)
    figure = Figure((width, height), dpi=DPI, facecolor=paper, **options)
    FigureCanvasAgg(figure)
    return figure


def new_chart(size: tuple[int, int], rows: int = 1) -> tuple[Figure, list[Axes]]:
    """Return a figure of plain axes, one below the other.

    Raises:
      InputError: if ``size`` is below 200 × 120 px.
    """
    if size[0] < _LEAST_SIZE[0] or size[1] < _LEAST_SIZE[1]:
        raise InputError(f"size: expected at least 200 × 120 px, got {size}")
    figure = new_figure(size, layout="constrained")
    axes = list(figure.subplots(rows, squeeze=False)[:, 0])
    for each in axes:
        each.grid(color=GRID, linewidth=0.8)
        each.set_axisbelow(True)
        each.tick_params(which="both", colors=INK, labelsize=8)
        each.spines[["top", "right"]].set_visible(False)
        each.spines[["left", "bottom"]].set_color(FRAME)
    return figure, axes


def label_axes(axes: Axes, title: str, x_label: str, y_label: str = "") -> None:
    """Set the texts of a chart."""
    style = {"color": INK, "fontsize": 9, "parse_math": False}
    axes.set_title(printable(title), loc="left", **{**style, "fontsize": 10})
    axes.set_xlabel(printable(x_label), **style)
    axes.set_ylabel(printable(y_label), **style)


def add_legend(axes: Axes) -> None:
    """Name the labelled lines above the axes, at the right."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        axes.legend(
            loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=min(len(labels), 5),
            frameon=False, fontsize=8, labelcolor=INK, borderaxespad=0.2,
            handlelength=1.4, columnspacing=1.2,
        )  # fmt: skip


def figure_pixels(figure: Figure) -> np.ndarray:
    """Draw a figure and return its pixels [H, W, 3] uint8."""
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()  # pyright: ignore


def drawable(values) -> np.ndarray:
    """Return float64 values with NaN for what no axis can show."""
    values = np.asarray(values, np.float64)
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values) < _LARGEST, values, np.nan)


def printable(text: str) -> str:
    """Replace characters that the default font lacks by "?".

    Latin, Greek, Cyrillic, punctuation and mathematical operators stay.
    """
    return "".join(
        c if c.isprintable() and (c < "\u0530" or "\u2010" <= c < "\u2300") else "?"
        for c in text
    )
