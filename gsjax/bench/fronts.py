"""A scatter plot on two logarithmic axes, with the Pareto front; drawn by OpenCV."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from gsjax import images
from gsjax.curves import COLORS, LEFT, PAPER, axes
from gsjax.sheets import put_text, text_width

_FRONT, _SMALL = (120, 124, 132), 0.36
_LINE = 12  # px, height of a label


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
    """Dots and their labels, which are clear of dots and of one another."""
    cv2 = images.opencv()
    groups = list(dict.fromkeys(mark.group for mark in marks))
    colors = [COLORS[groups.index(mark.group) % len(COLORS)] for mark in marks]
    spots = [(round(float(x)), round(float(y))) for x, y in places]
    for spot, color in zip(spots, colors):
        cv2.circle(plot, spot, 4, color, -1, 16)
    taken = [_Box(x - 5, y - 5, x + 5, y + 5) for x, y in spots]
    for index in np.argsort(places[:, 1]):
        (x, y), label, color = spots[index], marks[index].label, colors[index]
        box = _free_box(x, y, text_width(label, _SMALL) + 4, plot.shape, taken)
        taken.append(box)
        middle = (box.top + box.bottom) // 2
        if abs(middle - y) > 2 * _LINE:  # too far away to belong together by itself
            near = box.left if box.left > x else box.right
            cv2.line(plot, (x, y), (near, middle), color, 1, 16)
        plot[box.top : box.bottom, box.left : box.right] = PAPER
        put_text(plot, label, (box.left + 2, box.bottom - 3), color, _SMALL)


class _Box(NamedTuple):
    """A rectangle in px."""

    left: int
    top: int
    right: int
    bottom: int

    def clear_of(self, other: "_Box") -> bool:
        across = self.right <= other.left or other.right <= self.left
        return across or self.bottom <= other.top or other.bottom <= self.top


def _free_box(
    x: int, y: int, width: int, shape: tuple[int, ...], taken: Sequence[_Box]
) -> _Box:
    """Room for a label beside (x, y): to the right if there is any, else to the left,
    at first above, then as far up or down as need be.
    """
    height, most = shape[0], shape[1] - width
    boxes = []
    for step in range(height // _LINE):
        for shift in (step * _LINE, -step * _LINE):
            for left in (x + 6, x - 6 - width):
                top = y - _LINE + shift
                if LEFT < left <= most and 0 <= top <= height - _LINE:
                    boxes.append(_Box(left, top, left + width, top + _LINE))
    if not boxes:  # a label wider than the plot
        return _Box(0, 0, shape[1], _LINE)
    free = (box for box in boxes if all(box.clear_of(other) for other in taken))
    return next(free, boxes[0])
