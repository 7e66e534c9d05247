"""Curves of a training as a picture: a plain line plot, drawn by OpenCV."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.errors import InputError
from gsjax.io import images
from gsjax.plots.contact_sheets import put_text, text_width
from gsjax.runtime.files import write_file

PAPER, _INK, _GRID = (255, 255, 255), (70, 74, 82), (228, 230, 234)
_MARK = (150, 154, 162)
COLORS = (
    (38, 98, 186), (214, 92, 52), (44, 142, 92), (142, 82, 168), (176, 138, 28),
    (20, 150, 170), (190, 60, 120), (110, 110, 110), (90, 60, 30), (0, 0, 0),
)  # fmt: skip
LEFT, RIGHT, TOP, BOTTOM = 62, 18, 34, 40
_FINE = 4  # bits of a pixel's fraction that OpenCV takes


class Series(NamedTuple):
    """A line: ``y`` over ``x``, of one length; what is not finite is left out.

    A ``faint`` one is thin and pale: noise, behind what matters.
    """

    label: str
    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    faint: bool = False


class Mark(NamedTuple):
    """A thin line upright at ``x``, from which on something holds, with its name."""

    label: str
    x: float


def curves_png(
    path: Path,
    series: Sequence[Series],
    *,
    title: str = "",
    x_label: str = "step",
    marks: Sequence[Mark] = (),
) -> None:
    """Write `curves` to a PNG, in place of what may be there.

    Raises:
      InputError: as `curves`, or if the file cannot be written.
    """
    pixels = curves(series, title=title, x_label=x_label, marks=marks)
    write_file(path, images.encode_png(pixels))


def curves(
    series: Sequence[Series],
    *,
    title: str = "",
    x_label: str = "step",
    size: tuple[int, int] = (720, 420),
    marks: Sequence[Mark] = (),
    log_x: bool = False,
    least: float = 0.0,
) -> np.ndarray:
    """A plot [H, W, 3] uint8 of all series in one frame, with a legend.

    Args:
      series: what to draw; nothing finite in any of them gives an empty frame.
      title: above the frame.
      x_label: below it.
      size: (width, height) in px, at least 200 × 120.
      marks: by ``x``; those that lie within the frame are drawn, behind the series.
      log_x: whether ``x`` is logarithmic; what is not above 0 is left out then.
      least: how much of ``y`` is shown at least, lest noise look like a rise or a fall.

    Raises:
      InputError: if ``x`` and ``y`` differ in length, or the size is too small.
    """

    def along(x) -> np.ndarray:
        x = np.asarray(x, float)
        return np.log10(x, out=np.full(x.shape, np.nan), where=x > 0) if log_x else x

    lines = [_points(line) for line in series]
    lines = [np.stack([along(line[:, 0]), line[:, 1]], axis=1) for line in lines]
    marks = [mark._replace(x=float(along(mark.x))) for mark in marks]
    finite = np.concatenate(
        [np.zeros((0, 2)), *(p[np.isfinite(p).all(axis=1)] for p in lines)]
    )
    ranges = _range(finite[:, 0], 0.0), _range(finite[:, 1], 0.06, least)
    plot, place = axes(
        *ranges, title=title, x_label=x_label, size=size, log=(log_x, False)
    )
    inside = [m for m in marks if ranges[0][0] <= m.x <= ranges[0][1]]
    at = place(np.asarray([(mark.x, ranges[1][0]) for mark in inside]).reshape(-1, 2))
    _draw_marks(plot, inside, np.rint(at[:, 0]).astype(int).tolist())
    for index, points in enumerate(lines):
        gaps = np.flatnonzero(~np.isfinite(points).all(axis=1))
        for piece in np.split(points, gaps):
            there = place(piece[np.isfinite(piece).all(axis=1)])
            draw_line(plot, there, index, series[index].faint)
    legend(plot, [line.label for line in series], [line.faint for line in series])
    return plot


def axes(
    x: tuple[float, float],
    y: tuple[float, float],
    *,
    title: str = "",
    x_label: str = "",
    y_label: str = "",
    size: tuple[int, int] = (720, 420),
    log: tuple[bool, bool] = (False, False),
) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """An empty plot [H, W, 3] uint8, and what takes points [·, 2] to its px.

    Args:
      x, y: the ranges, from less to more.
      title, x_label, size: as `curves`.
      y_label: at the right above the frame, in place of a legend.
      log: whether x, and y, are log10 of what their ticks are to say.

    Raises:
      InputError: if the size is too small.
    """
    cv2 = images.opencv()
    width, height = size
    if width < 200 or height < 120:
        raise InputError(f"size {size}: a plot has at least 200 × 120 px")
    least, most = np.transpose([x, y])
    low, high = np.asarray([(LEFT, height - BOTTOM), (width - RIGHT, TOP)])

    def place(points) -> np.ndarray:
        return low + (points - least) / (most - least) * (high - low)

    plot = np.full((height, width, 3), PAPER, np.uint8)
    for tick, text in _ticks(*y, (height - TOP - BOTTOM) // 45, log[1]):
        v = round(place((x[0], tick))[1])
        cv2.line(plot, (LEFT, v), (width - RIGHT, v), _GRID, 1)
        put_text(plot, text, (LEFT - 8 - text_width(text), v + 4), _INK)
    for tick, text in _ticks(*x, (width - LEFT - RIGHT) // 90, log[0]):
        u = round(place((tick, y[0]))[0])
        cv2.line(plot, (u, TOP), (u, low[1]), _GRID, 1)
        put_text(plot, text, (u - text_width(text) // 2, low[1] + 16), _INK)
    frame = np.asarray([(LEFT, TOP), low, (width - RIGHT, low[1])], np.int32)
    cv2.polylines(plot, [frame], False, _INK, 1)
    put_text(plot, title, (LEFT, 21), _INK, 0.5)
    middle = (LEFT + width - RIGHT - text_width(x_label)) // 2
    put_text(plot, x_label, (middle, height - 8), _INK)
    put_text(plot, y_label, (width - RIGHT - text_width(y_label), 21), _INK)
    return plot, place


def draw_line(
    plot: np.ndarray, points: np.ndarray, index: int, faint: bool = False
) -> None:
    """A line through points [·, 2] in px, in the colour of the ``index``-th."""
    cv2 = images.opencv()
    if len(points):
        at = np.rint(points * 2**_FINE).astype(np.int32)
        width = 1 if faint else 2
        cv2.polylines(plot, [at], False, _color(index, faint), width, 16, _FINE)


def _draw_marks(plot: np.ndarray, marks: Sequence[Mark], where: list[int]) -> None:
    """Lines at these px, and names beside them, lower where one is in the way."""
    bottom, taken = plot.shape[0] - BOTTOM, list[int]()
    for mark, u in zip(marks, where):
        images.opencv().line(plot, (u, TOP), (u, bottom), _MARK, 1)
        width = text_width(mark.label, 0.38)
        left = min(u + 4, plot.shape[1] - RIGHT - width)
        row = next((i for i, end in enumerate(taken) if end < left), len(taken))
        taken[row : row + 1] = [left + width + 4]
        put_text(plot, mark.label, (left, bottom - 6 - 14 * row), _INK, 0.38)


def _color(index: int, faint: bool) -> tuple[int, ...]:
    color = COLORS[index % len(COLORS)]
    return tuple(255 - (255 - c) * 45 // 100 for c in color) if faint else color


def _points(line: Series) -> np.ndarray:
    x, y = np.asarray(line.x, float), np.asarray(line.y, float)
    if x.ndim != 1 or x.shape != y.shape:
        raise InputError(
            f"{line.label}: x is {x.shape}, y is {y.shape}; one length is wanted"
        )
    return np.stack([x, y], axis=1)


def _range(values: np.ndarray, margin: float, least: float = 0) -> tuple[float, float]:
    """Least and greatest, a margin beyond, and ``least`` apart; never empty."""
    if not len(values):
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    short = max(0.0, least - (high - low)) / 2
    low, high = low - short, high + short
    spread = high - low
    if spread <= 1e-9 * max(abs(low), abs(high), 1e-300):
        return low - 0.5 * (abs(low) or 1), high + 0.5 * (abs(high) or 1)
    return low - margin * spread, high + margin * spread


def _ticks(low: float, high: float, most: int, log: bool) -> list[tuple[float, str]]:
    """Where they are, and what they say: within the range, about ``most`` of them."""
    if log:
        return _decades(low, high, most)
    least = (high - low) / max(most, 1)
    power = 10 ** np.floor(np.log10(least))
    step = power * next((m for m in (1, 2, 5) if m * power >= least), 10)
    places = step * np.arange(np.ceil(low / step), np.floor(high / step) + 1)
    # As many digits as tell one from the next.
    digits = np.log10(max(abs(low), abs(high), step)) - np.log10(step)
    digits = max(4, 1 + int(np.ceil(digits)))
    return [(float(place), short_number(place, digits)) for place in places]


def _decades(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """Powers of ten from 10^low to 10^high, and between them where there is room; of
    too many, each second, third, …"""
    wide = high - low > 2
    factors = (1,) if high - low > 4 else (1, 3) if wide else (1, 2, 5)
    step = int(np.ceil((high - low) / most)) if high - low > 4 else 1
    first = step * int(np.floor(low / step))
    powers = range(first, int(np.ceil(high)) + 1, step)
    found = [(k + float(np.log10(f)), f, k) for k in powers for f in factors]
    short = low >= -4 and high < 6  # one notation for all
    return [
        (place, short_number(f * 10.0**k) if short else f"{f}e{k}")
        for place, f, k in found
        if low <= place <= high
    ]


def short_number(value: float, digits: int = 4) -> str:
    """Short: 1500 is 1.5k; the rounding of the ticks is not shown."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:.{digits}g}{letter}"
    return f"{value + 0.0:.{digits}g}" if abs(value) > 1e-12 else "0"


def legend(plot: np.ndarray, labels: list[str], faint: Sequence[bool] = ()) -> None:
    """Names in the colours of their lines, at the right above the frame."""
    cv2 = images.opencv()
    right = plot.shape[1] - RIGHT
    for index in reversed(range(len(labels))):
        right -= text_width(labels[index])
        put_text(plot, labels[index], (right, 21), _INK)
        color = _color(index, index < len(faint) and faint[index])
        cv2.line(plot, (right - 22, 17), (right - 6, 17), color, 2, cv2.LINE_AA)
        right -= 36
