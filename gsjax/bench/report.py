"""Table and plot of the rows of `gsjax.bench.pareto`."""

from __future__ import annotations

import typing
from collections.abc import Sequence

import numpy as np

from gsjax.bench.pareto import front
from gsjax.plots.figures import figure_pixels, new_chart, plain

if typing.TYPE_CHECKING:
    from matplotlib.figure import Figure

_LEAST = 1e-8  # smaller errors are drawn here


def table(rows: Sequence[dict], on_front: Sequence[int]) -> str:
    """Return lines of times, errors (of 255 levels) and the share of the bound.

    The share is that of the pixel where the error comes nearest to its bound.
    """
    lines = [
        f"  {'':<18}{'forward':>9}{'gradient':>9}{'max':>11}{'PSNR':>8}"
        f"{'gradient':>10}{'of bound':>10}",
        f"  {'':<18}{'ms':>9}{'ms':>9}{'/255':>11}{'dB':>8}{'rel. L2':>10}{'%':>10}",
    ]
    for index, row in enumerate(rows):
        mark = "*" if index in on_front else " "
        outside = "" if row["inside"] else "  OUTSIDE"
        share = row["at worst"] / max(row["bound"], _LEAST)
        lines.append(
            f"{mark} {row['knob'] + ' ' + row['value']:<18}"
            f"{row['forward ms']:9.2f}{row['gradient ms']:9.2f}"
            f"{255 * row['max']:11.4g}{row['psnr']:8.1f}{row['gradient']:10.2g}"
            f"{100 * share:10.2g}{outside}"
        )
    lines += [
        "  * on the front of forward time and largest error",
        "  max, PSNR, gradient: against the exact image in float64, without cutoffs;",
        "  of orders, against that in the exact order of each pixel",
        "  of bound: error / proven bound at the pixel where it is largest",
    ]
    return "\n".join(lines)


def front_picture(
    rows: Sequence[dict],
    name: str,
    elsewhere: Sequence[tuple[str, Sequence[dict]]] = (),
) -> np.ndarray:
    """Return the pixels [H, W, 3] uint8 of `front_figure`."""
    return figure_pixels(front_figure(rows, name, elsewhere))


def front_figure(
    rows: Sequence[dict],
    name: str,
    elsewhere: Sequence[tuple[str, Sequence[dict]]] = (),
) -> Figure:
    """Draw forward time against largest error, and gradient time against its error.

    Args:
      rows: all are drawn, with their Pareto front.
      name: of the scene.
      elsewhere: (device, rows) of other devices; only their fronts are drawn.
    """
    figure, axes = new_chart((860, 1120), rows=2)
    knobs = list(dict.fromkeys(row["knob"] for row in rows))
    for each, time, error, title in (
        (axes[0], "forward ms", "max", "forward, largest error of rgb"),
        (axes[1], "gradient ms", "gradient", "value and gradient, relative L2"),
    ):
        each.set(xscale="log", yscale="log", xlabel="ms", ylabel="error")
        each.margins(0.1)
        each.set_title(f"{plain(name)}: {title}")
        for index, knob in enumerate(knobs):
            some = [row for row in rows if row["knob"] == knob]
            x, y = _points(some, time, error)
            color, marker = f"C{index % 10}", "os^Dv*P"[index % 7]
            each.scatter(x, y, label=plain(knob), color=color, marker=marker)
            for row, at in zip(some, zip(x, y)):
                each.annotate(
                    plain(row["value"]), at, fontsize=7, color=color,
                    textcoords="offset points", xytext=(5, 3),
                )  # fmt: skip
        for index, (device, found) in enumerate([("front", rows), *elsewhere]):
            best = [found[i] for i in front(found, time, error)]
            each.step(
                *_points(best, time, error), where="post", label=plain(device),
                linestyle=("-", "--", ":", "-.")[index % 4], color="gray", zorder=1,
                marker="." if index else "",
            )  # fmt: skip
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
    return figure


def _points(rows: Sequence[dict], time: str, error: str) -> np.ndarray:
    """Return times and errors to draw, [2, P]."""
    points = np.reshape([(row[time], row[error]) for row in rows], (-1, 2))
    return np.maximum(points, (0, _LEAST)).T


def popping_table(rows: Sequence[dict]) -> str:
    """Return lines of the rows of `gsjax.bench.popping.measure_popping`."""
    lines = [
        f"{'':<12}{'forward ms':>11}{'popping /255':>14}{'of center':>11}{'late':>12}"
    ]
    for row in rows:
        ms, late = row["forward ms"], row["misordered"]
        time = f"{'':>11}" if ms is None else f"{ms:11.1f}"
        count = f"{'':>12}" if late is None else f"{late:12,}"
        lines.append(
            f"{row['order']:<12}{time}{row['popping']:14.4g}{row['of center']:11.3f}"
            f"{count}"
        )
    lines.append(
        "popping: mean change between frames, beside the turn; late: misordered"
    )
    return "\n".join(lines)


def popping_picture(rows: Sequence[dict], name: str) -> np.ndarray:
    """Return a plot of popping against forward time as pixels [H, W, 3] uint8."""
    figure, (axes,) = new_chart((720, 480))
    timed = [row for row in rows if row["forward ms"] is not None]
    for index, row in enumerate(timed):
        at = row["forward ms"], row["popping"]
        axes.scatter(*at, color=f"C{index % 10}")
        axes.annotate(
            plain(row["order"]), at, textcoords="offset points", xytext=(6, 4)
        )
    axes.set(xscale="log", yscale="log", xlabel="forward ms", ylabel="popping, of 255")
    axes.margins(0.15)
    axes.set_title(f"{plain(name)}: popping against run time")
    return figure_pixels(figure)
