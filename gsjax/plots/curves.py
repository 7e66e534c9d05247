"""Line charts: curves of a training run."""

from __future__ import annotations

import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsjax.errors import InputError
from gsjax.io import images
from gsjax.plots import figures
from gsjax.runtime.files import write_file

if typing.TYPE_CHECKING:
    from matplotlib.figure import Figure


class Series(NamedTuple):
    """A line ``y`` over ``x``, of one length; non-finite values leave a gap.

    A ``faint`` line is thin and pale, for noise behind what matters.
    """

    label: str
    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    faint: bool = False


class Mark(NamedTuple):
    """A labelled vertical line at ``x``."""

    label: str
    x: float


def curves_png(path: Path, series: Sequence[Series], **options: Any) -> None:
    """Write `curves` to a PNG, replacing the file.

    Raises:
      InputError: as `curves`, or if the file cannot be written.
    """
    write_file(path, images.encode_png(curves(series, **options)))


def curves(series: Sequence[Series], **options: Any) -> np.ndarray:
    """Return the pixels [H, W, 3] uint8 of `curves_figure`, same arguments."""
    return figures.figure_pixels(curves_figure(series, **options))


def curves_figure(
    series: Sequence[Series],
    *,
    title: str = "",
    x_label: str = "step",
    size: tuple[int, int] = (720, 420),
    marks: Sequence[Mark] = (),
    log_x: bool = False,
    min_y_span: float = 0.0,
) -> Figure:
    """Draw all series in one chart.

    Args:
      series: the lines; without any finite value the frame is empty.
      title: text above the frame.
      x_label: text below it.
      size: (width, height) in px, at least 200 × 120.
      marks: vertical lines; those beyond the frame are left out.
      log_x: use a logarithmic x axis; values of 0 and below are left out.
      min_y_span: smallest range of the y axis, so that noise does not look like a
        trend.

    Raises:
      InputError: if ``x`` and ``y`` differ in length, or the size is too small.
    """
    figure, (axes,) = figures.new_chart(size)
    if log_x:
        axes.set_xscale("log")
    axes.ticklabel_format(axis="y" if log_x else "both", useOffset=False)
    axes.margins(x=0)
    for index, line in enumerate(series):
        x, y = figures.drawable(line.x), figures.drawable(line.y)
        if x.ndim != 1 or x.shape != y.shape:
            raise InputError(
                f"{line.label}: expected x and y of one length, got {x.shape} and "
                f"{y.shape}"
            )
        single = np.isfinite(x + y).sum() == 1
        axes.plot(
            np.where(x > 0, x, np.nan) if log_x else x, y,
            label=figures.printable(line.label),
            color=figures.COLORS[index % len(figures.COLORS)],
            linewidth=0.8 if line.faint else 1.6,
            alpha=0.45 if line.faint else 1.0,
            marker="o" if single else "", markersize=3,
        )  # fmt: skip
    low, high = axes.get_ylim()
    if high - low < min_y_span:
        middle = (low + high) / 2
        axes.set_ylim(middle - min_y_span / 2, middle + min_y_span / 2)
    left, right = axes.get_xlim()
    for mark in marks:
        if left <= mark.x <= right:
            axes.axvline(mark.x, color=figures.FRAME, linewidth=0.8, zorder=1)
            axes.annotate(
                figures.printable(mark.label), (mark.x, 0.02), rotation=90,
                xycoords=("data", "axes fraction"), xytext=(2, 0),
                textcoords="offset points", fontsize=7, color=figures.INK,
                annotation_clip=False, parse_math=False,
            )  # fmt: skip
    figures.label_axes(axes, title, x_label)
    figures.add_legend(axes)
    return figure
