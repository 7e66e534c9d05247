"""A scatter plot on two logarithmic axes, with the Pareto front; drawn by OpenCV."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from gsjax import images
from gsjax.curves import COLORS, axes
from gsjax.sheets import put_text, text_width

_FRONT, _SMALL = (120, 124, 132), 0.36


class Mark(NamedTuple):
    """A labelled point; marks of one group have one colour."""

    x: float
    y: float
    label: str
    group: str


def scatter(
    marks: Sequence[Mark],
    front: Sequence[int] = (),
    *,
    title: str = "",
    x_label: str = "",
    y_label: str = "",
    size: tuple[int, int] = (860, 560),
) -> np.ndarray:
    """A plot [H, W, 3] uint8.

    Args:
      marks: values above 0; at least one.
      front: indices of the marks that the front goes through, in order; drawn as the
        steps that it has.
      title, x_label, y_label: words.
      size: (width, height) in px.
    """
    values = np.log10([(mark.x, mark.y) for mark in marks])
    least, most = values.min(axis=0), values.max(axis=0)
    room = np.maximum(0.08 * (most - least), 0.05)
    # Labels stand to the right of their marks.
    x, y = np.transpose([least - room, most + room * (2.4, 1)])
    plot, place = axes(
        (x[0], x[1]), (y[0], y[1]), title=title, x_label=x_label, y_label=y_label,
        size=size, log=(True, True),
    )  # fmt: skip
    places = place(values)
    _draw_front(plot, places[list(front)])
    _draw_marks(plot, places, marks)
    return plot


def _draw_front(plot: np.ndarray, places: np.ndarray) -> None:
    """Steps: to the right of a point and above it, it is the better one."""
    if len(places) < 2:
        return
    corners = [places[0]]
    for before, after in pairwise(places):
        corners += [np.asarray([after[0], before[1]]), after]
    steps = np.rint(corners).astype(np.int32)
    images.opencv().polylines(plot, [steps], False, _FRONT, 1, 16)


def _draw_marks(plot: np.ndarray, places: np.ndarray, marks: Sequence[Mark]) -> None:
    """Dots, and labels moved down or up until they are clear of one another."""
    cv2 = images.opencv()
    groups = list(dict.fromkeys(mark.group for mark in marks))
    taken: list[tuple[int, int, int]] = []
    for index in np.argsort(places[:, 1]):
        mark = marks[index]
        x, y = (round(float(v)) for v in places[index])
        color = COLORS[groups.index(mark.group) % len(COLORS)]
        cv2.circle(plot, (x, y), 4, color, -1, 16)
        wide = text_width(mark.label, _SMALL)
        line = y + 4
        for shift in (0, 11, -11, 22, -22, 33, -33, 44, -44, 55, -55):
            line = y - 5 + shift
            clear = all(
                abs(line - other) > 10 or x + 7 > right or x + 7 + wide < left
                for left, right, other in taken
            )
            if clear:
                break
        left = min(x + 7, plot.shape[1] - wide - 2)
        taken.append((left, left + wide, line))
        put_text(plot, mark.label, (left, line), color, _SMALL)
