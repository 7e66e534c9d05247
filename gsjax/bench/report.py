"""Table and plot of the rows of `gsjax.bench.pareto`."""

from __future__ import annotations

import typing
from collections.abc import Iterator, Sequence

import numpy as np

from gsjax.bench.pareto import front
from gsjax.plots import figures

if typing.TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.text import Annotation

_LEAST = 1e-8  # smaller errors are drawn here
_SIZE = (860, 1120)
_SMALL = 7  # points


def table(rows: Sequence[dict], on_front: Sequence[int]) -> str:
    """Return lines of times, errors (of 255 levels) and the share of the bound.

    The share is that of the pixel where the error comes nearest to its bound.
    """
    head = (
        f"  {'':<18}{'forward':>9}{'gradient':>9}{'max':>11}{'PSNR':>8}"
        f"{'gradient':>10}{'of bound':>10}"
    )
    units = f"  {'':<18}{'ms':>9}{'ms':>9}{'/255':>11}{'dB':>8}{'rel. L2':>10}{'%':>10}"
    lines = [head, units]
    for index, row in enumerate(rows):
        mark = "*" if index in on_front else " "
        outside = "" if row["inside"] else "  OUTSIDE"
        share = row["at worst"] / max(row["bound"], _LEAST)
        lines.append(
            f"{mark} {_label(row):<18}{row['forward ms']:9.2f}{row['gradient ms']:9.2f}"
            f"{255 * row['max']:11.4g}{row['psnr']:8.1f}{row['gradient']:10.2g}"
            f"{100 * share:10.2g}{outside}"
        )
    lines += [
        "  * on the front of forward time and largest error",
        "  max, PSNR, gradient: against the exact image in float64, without cutoffs",
        "  of bound: error / proven bound at the pixel where it is largest",
    ]
    return "\n".join(lines)


def front_picture(
    rows: Sequence[dict],
    name: str,
    elsewhere: Sequence[tuple[str, Sequence[dict]]] = (),
) -> np.ndarray:
    """Return the pixels [H, W, 3] uint8 of `front_figure`."""
    return figures.figure_pixels(front_figure(rows, name, elsewhere))


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
    figure, axes = figures.new_chart(_SIZE, rows=2)
    knobs = list(dict.fromkeys(row["knob"] for row in rows))
    for each, time, error, title in (
        (axes[0], "forward ms", "max", "forward, largest error of rgb"),
        (axes[1], "gradient ms", "gradient", "value and gradient, relative L2"),
    ):
        each.set(xscale="log", yscale="log")
        each.margins(0.1)
        figures.label_axes(each, f"{name}: {title}", "ms", "error")
        _draw(each, rows, front(rows, time, error), knobs, (time, error))
        for device, others in elsewhere:
            best = front(others, time, error)
            some = [others[i] for i in best]
            _draw(each, some, range(len(some)), knobs, (time, error), f"{device}: ")
    figure.draw_without_rendering()  # places the axes
    figure.set_layout_engine("none")
    for each in axes:
        _place_labels(each)
    return figure


def _label(row: dict) -> str:
    return f"{row['knob']} {row['value']}".strip()


def _draw(
    axes: Axes,
    rows: Sequence[dict],
    on_front: Sequence[int],
    knobs: Sequence[str],
    keys: tuple[str, str],
    prefix: str = "",
) -> None:
    """Draw labelled dots, and the front as the steps that it has."""
    x, y = (np.asarray([row[key] for row in rows], float) for key in keys)
    y = np.maximum(y, _LEAST)
    axes.plot(x[on_front], y[on_front], drawstyle="steps-post", color=figures.FRAME)
    for row, at in zip(rows, zip(x, y)):
        index = knobs.index(row["knob"]) if row["knob"] in knobs else len(knobs)
        color = figures.COLORS[index % len(figures.COLORS)]
        axes.plot(*at, "o", color=color, markersize=4)
        axes.annotate(
            figures.printable(prefix + _label(row)), at, color=color, fontsize=_SMALL,
            textcoords="offset points", xytext=(0, 0), va="center",
        )  # fmt: skip


def _offsets(width: float) -> Iterator[tuple[float, float]]:
    """Yield offsets in px: right and left of a dot, then ever further up and down."""
    for step in range(60):
        for y in dict.fromkeys((10 * step, -10 * step)):
            yield 8, y
            yield -8 - width, y


def _place_labels(axes: Axes) -> None:
    """Move the labels apart, clear of dots and within the axes where there is room."""
    from matplotlib.transforms import Bbox

    labels: list[Annotation] = list(axes.texts)  # type: ignore
    labels.sort(key=lambda label: -label.xy[1])
    dots = axes.transData.transform([label.xy for label in labels])
    taken = [Bbox([dot - 5, dot + 5]) for dot in dots]
    frame, to_points = axes.get_window_extent(), 72 / figures.DPI
    for label, dot in zip(labels, dots):
        size = label.get_window_extent().size
        boxes = []
        for offset in _offsets(size[0]):
            low = dot + offset - (0, size[1] / 2)
            box = Bbox([low, low + size])
            if frame.containsx(box.x0) and frame.containsx(box.x1):
                boxes.append((box, offset))
        free = [
            one for one in boxes
            if frame.containsy(one[0].y0) and frame.containsy(one[0].y1)
            and not any(one[0].overlaps(other) for other in taken)
        ]  # fmt: skip
        box, offset = (free or boxes or [(Bbox([dot, dot + size]), (0, 0))])[0]
        taken.append(box)
        label.set_position(np.multiply(offset, to_points).tolist())
        if abs(offset[1]) > 12:
            near = offset[0] if offset[0] > 0 else offset[0] + size[0]
            axes.annotate(
                "", label.xy, np.multiply((near, offset[1]), to_points).tolist(),
                textcoords="offset points",
                arrowprops={"arrowstyle": "-", "color": label.get_color(), "lw": 0.5},
            )  # fmt: skip
