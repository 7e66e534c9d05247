"""The rows of `gsjax.bench.pareto` as a table and as a plot."""

from collections.abc import Sequence

import numpy as np

from gsjax.bench.fronts import Mark, scatter
from gsjax.bench.pareto import front

_LEAST = 1e-8  # errors below are drawn here


def table(rows: Sequence[dict], on_front: Sequence[int]) -> str:
    """Lines to read: times, errors in grey levels of 255, and the share of its bound
    that the error has where it comes nearest to it.
    """
    head = (
        f"  {'':<18}{'forward':>9}{'gradient':>9}{'max':>11}{'PSNR':>8}"
        f"{'gradient':>10}{'of bound':>10}"
    )
    units = f"  {'':<18}{'ms':>9}{'ms':>9}{'/255':>11}{'dB':>8}{'rel. L2':>10}{'%':>10}"
    lines = [head, units]
    for index, row in enumerate(rows):
        mark = "*" if index in on_front else " "
        label = f"{row['knob']} {row['value']}".strip()
        told = "" if row["inside"] else "  OUTSIDE"
        share = row["at worst"] / max(row["bound"], _LEAST)
        lines.append(
            f"{mark} {label:<18}{row['forward ms']:9.2f}{row['gradient ms']:9.2f}"
            f"{255 * row['max']:11.4g}{row['psnr']:8.1f}{row['gradient']:10.2g}"
            f"{100 * share:10.2g}{told}"
        )
    lines += [
        "  * on the front of forward time and largest error",
        "  max, PSNR, gradient: against the exact picture, float64 without cuts;",
        "  of bound: of what theory allows a pixel, where the error is nearest to it",
    ]
    return "\n".join(lines)


def front_picture(
    rows: Sequence[dict],
    name: str,
    elsewhere: Sequence[tuple[str, Sequence[dict]]] = (),
) -> np.ndarray:
    """Two plots [H, W, 3], one above the other: forward time against the largest
    error, and that of value and gradient against the gradient's.

    Args:
      rows: all of them are drawn, and their front.
      name: of the scene.
      elsewhere: (device, rows) of which the fronts are drawn too.
    """
    plots = []
    for time, error, title in (
        ("forward ms", "max", f"{name}: forward, largest error of rgb"),
        ("gradient ms", "gradient", f"{name}: value and gradient, relative L2"),
    ):
        best = front(rows, time, error)
        marks = [_mark(row, time, error) for row in rows]
        fronts: list[Sequence[int]] = [best]
        for device, others in elsewhere:
            best = front(others, time, error)
            fronts.append(range(len(marks), len(marks) + len(best)))
            marks += [_mark(others[i], time, error, f"{device}: ") for i in best]
        plots.append(scatter(marks, fronts, title=title, x_label="ms", y_label="error"))
    return np.concatenate(plots)


def _mark(row: dict, time: str, error: str, device: str = "") -> Mark:
    label = f"{device}{row['knob']} {row['value']}".strip()
    return Mark(row[time], max(row[error], _LEAST), label, row["knob"])
