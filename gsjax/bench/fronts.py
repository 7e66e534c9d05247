"""A scatter plot on two logarithmic axes, with Pareto fronts; drawn by OpenCV."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from gsjax.io import images
from gsjax.plots.contact_sheets import put_text, text_width
from gsjax.plots.curves import BOTTOM, COLORS, LEFT, PAPER, RIGHT, TOP, axes

_FRONT, _SMALL = (120, 124, 132), 0.36
_LINE, _DOT = 12, 5  # px: height of a label, half a dot and its margin


class Mark(NamedTuple):
    """A labelled point; marks of one group have one colour."""

    x: float
    y: float
    label: str
    group: str


def scatter(
    marks: Sequence[Mark],
    fronts: Sequence[Sequence[int]] = (),
    *,
    title: str = "",
    x_label: str = "",
    y_label: str = "",
    size: tuple[int, int] = (860, 560),
) -> np.ndarray:
    """A plot [H, W, 3] uint8.

    Args:
      marks: values above 0; at least one.
      fronts: indices of the marks that each front goes through, in order; drawn as the
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
    for front in fronts:
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
    """Dots and their labels."""
    cv2 = images.opencv()
    groups = list(dict.fromkeys(mark.group for mark in marks))
    colors = [COLORS[groups.index(mark.group) % len(COLORS)] for mark in marks]
    spots = [(round(float(x)), round(float(y))) for x, y in places]
    labels = [mark.label for mark in marks]
    boxes = label_boxes(spots, labels, (plot.shape[1], plot.shape[0]))
    for (x, y), box, color in zip(spots, boxes, colors):
        middle = (box.top + box.bottom) // 2
        if abs(middle - y) > 2 * _LINE:  # too far away to belong together by itself
            near = box.left if box.left > x else box.right
            cv2.line(plot, (x, y), (near, middle), color, 1, 16)
    for box, label, color in zip(boxes, labels, colors):
        plot[box.top : box.bottom, box.left : box.right] = PAPER
        put_text(plot, label, (box.left + 2, box.bottom - 3), color, _SMALL)
    for spot, color in zip(spots, colors):
        cv2.circle(plot, spot, _DOT - 1, color, -1, 16)


class Box(NamedTuple):
    """A rectangle in px."""

    left: int
    top: int
    right: int
    bottom: int

    def clear_of(self, other: "Box") -> bool:
        """Whether they have no pixel in common."""
        across = self.right <= other.left or other.right <= self.left
        return across or self.bottom <= other.top or other.bottom <= self.top


def label_boxes(
    spots: Sequence[tuple[int, int]], labels: Sequence[str], size: tuple[int, int]
) -> list[Box]:
    """Room for the labels of dots at ``spots``, within the frame of a plot.

    Clear of dots and of one another, as long as there is room: beside the dot, or else
    as little above or below it as can be.
    """
    taken = [Box(x - _DOT, y - _DOT, x + _DOT, y + _DOT) for x, y in spots]
    boxes = {}
    for index in sorted(range(len(spots)), key=lambda i: spots[i][1]):
        width = text_width(labels[index], _SMALL) + 4
        tried = list(_boxes_beside(*spots[index], width, size))
        free = (box for box in tried if all(box.clear_of(other) for other in taken))
        boxes[index] = next(free, tried[0])
        taken.append(boxes[index])
    return [boxes[index] for index in range(len(spots))]


def _boxes_beside(x: int, y: int, width: int, size: tuple[int, int]) -> Iterator[Box]:
    """To the right of a dot and to the left, just above it, then ever further away."""
    least, most = LEFT + 1, size[0] - RIGHT - width
    low, high = TOP, size[1] - BOTTOM - _LINE
    sides = [s for s in (x + _DOT + 1, x - _DOT - 1 - width) if least <= s <= most]
    for step in range(size[1] // _LINE):
        for top in dict.fromkeys((y + (step - 1) * _LINE, y - (step + 1) * _LINE)):
            if low <= top <= high:
                for left in sides or [max(least, most)]:
                    yield Box(left, top, left + width, top + _LINE)
