"""A scatter plot on two logarithmic axes, with the Pareto front; drawn by OpenCV."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from gsjax import images
from gsjax.sheets import put_text, text_width

_PAPER, _INK, _GRID, _FRONT = (255,) * 3, (70, 74, 82), (228, 230, 234), (120, 124, 132)
_COLORS = (
    (38, 98, 186), (214, 92, 52), (44, 142, 92), (142, 82, 168), (176, 138, 28),
    (20, 150, 170), (190, 60, 120), (110, 110, 110), (90, 60, 30), (0, 0, 0),
)  # fmt: skip
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 24, 34, 40
_SMALL = 0.36


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
    cv2 = images.opencv()
    width, height = size
    values = np.log10([(mark.x, mark.y) for mark in marks])
    least, most = values.min(axis=0), values.max(axis=0)
    room = np.maximum(0.08 * (most - least), 0.05)
    # Labels stand to the right of their marks.
    least, most = least - room, most + room * (2.4, 1)
    low = np.asarray([_LEFT, height - _BOTTOM])
    high = np.asarray([width - _RIGHT, _TOP])
    places = low + (values - least) / (most - least) * (high - low)
    plot = np.full((height, width, 3), _PAPER, np.uint8)
    for axis in (0, 1):
        for tick in _ticks(least[axis], most[axis]):
            share = (np.log10(tick) - least[axis]) / (most[axis] - least[axis])
            place = round(float(low[axis] + share * (high[axis] - low[axis])))
            text = f"{tick:.3g}"
            if axis == 0:
                cv2.line(plot, (place, _TOP), (place, height - _BOTTOM), _GRID, 1)
                middle = place - text_width(text) // 2
                put_text(plot, text, (middle, height - _BOTTOM + 16), _INK)
            else:
                cv2.line(plot, (_LEFT, place), (width - _RIGHT, place), _GRID, 1)
                put_text(plot, text, (_LEFT - 8 - text_width(text), place + 4), _INK)
    frame = [
        (_LEFT, _TOP),
        (_LEFT, height - _BOTTOM),
        (width - _RIGHT, height - _BOTTOM),
    ]
    cv2.polylines(plot, [np.asarray(frame, np.int32)], False, _INK, 1)
    _draw_front(plot, places[list(front)])
    _draw_marks(plot, places, marks)
    put_text(plot, title, (_LEFT, 21), _INK, 0.5)
    put_text(plot, y_label, (width - _RIGHT - text_width(y_label), 21), _INK)
    middle = (_LEFT + width - _RIGHT - text_width(x_label)) // 2
    put_text(plot, x_label, (middle, height - 8), _INK)
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
        color = _COLORS[groups.index(mark.group) % len(_COLORS)]
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


def _ticks(low: float, high: float) -> list[float]:
    """Powers of ten between 10^low and 10^high, with 2 and 5 where there is room."""
    powers = range(int(np.floor(low)), int(np.ceil(high)) + 1)
    wide = high - low > 2
    factors = (1,) if high - low > 4 else (1, 3) if wide else (1, 2, 5)
    found = [factor * 10.0**power for power in powers for factor in factors]
    return [tick for tick in found if low <= np.log10(tick) <= high]
