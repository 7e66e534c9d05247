"""Contact sheets: photograph, render, error and depth side by side.

Axis legend: H W a picture. Colours are RGB.
"""

import textwrap
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gsjax.errors import InputError
from gsjax.io import images
from gsjax.plots import figures

MAGNIFIED = 4  # factor on the error

_PAPER, _TEXT, _ALARM = (24, 26, 31), "#c8ccd4", "#ff785a"
_MISSING = (255, 0, 255)  # pixels that are not finite
_NOTHING = (44, 47, 54)  # pixels without depth
_GAP, _LINE, _CHARACTER = 6, 15, 6.1  # px: margin, height of a line, width of a letter
_FONT = {"family": "DejaVu Sans Mono", "fontsize": 7.2, "parse_math": False}


class SheetRow(NamedTuple):
    """One view of a contact sheet.

    Attributes:
      name: caption of the photograph.
      truth: [H, W, 3] the photograph, uint8, or floats in [0, 1].
      render: [H, W, 3] alike.
      depth: [H, W] of the render, 0 where there is none; or None.
      rendered: caption of the render, before its PSNR.
    """

    name: str
    truth: np.ndarray
    render: np.ndarray
    depth: np.ndarray | None = None
    rendered: str = "render"


class Cell(NamedTuple):
    """A picture [H, W, 3] uint8 with its caption; ``alarm`` sets it in red."""

    pixels: np.ndarray
    caption: str = ""
    alarm: bool = False


def comparison(rows: Sequence[SheetRow], *, width: int = 320) -> np.ndarray:
    """Return a sheet [·, ·, 3] uint8 of photograph, render, error × 4 and depth.

    Pixels that are not finite are magenta. Near is red and far is blue, between the
    2nd and the 98th percentile of each view. PSNR is that of the pixels as given.

    Args:
      rows: the views, of any sizes.
      width: of a cell in px; pictures are scaled to it.

    Raises:
      InputError: if there is no row, or the pictures of one differ in size.
    """
    if not rows:
        raise InputError("comparison: expected at least one row, got none")
    return cell_grid([_row(row, width) for row in rows])


def cell_grid(rows: Sequence[Sequence[Cell]]) -> np.ndarray:
    """Return cells in rows [H, W, 3] uint8, pixel by pixel, over their captions.

    Columns are as wide as the widest cell; captions are broken into lines.
    """
    width = max(cell.pixels.shape[1] for row in rows for cell in row)
    captions = [[_wrapped(cell.caption, width) for cell in row] for row in rows]
    heights = [
        max(cell.pixels.shape[0] + _GAP for cell in row)
        + (_LINE * max(map(len, texts)) + _GAP if any(texts) else 0)
        for row, texts in zip(rows, captions)
    ]
    size = max(map(len, rows)) * (width + _GAP), sum(heights)
    page, places, top = np.full((*size[::-1], 3), _PAPER, np.uint8), [], _GAP // 2
    for row, height in zip(rows, heights):
        places.append([(_GAP // 2 + i * (width + _GAP), top) for i in range(len(row))])
        top += height
    if any(text for texts in captions for text in texts):
        page = _page_of_text(size, rows, captions, places)
    for row, where in zip(rows, places):
        for cell, (x, y) in zip(row, where):
            page[y : y + cell.pixels.shape[0], x : x + cell.pixels.shape[1]] = (
                cell.pixels
            )
    return page


def _page_of_text(size: tuple[int, int], rows, captions, places) -> np.ndarray:
    """Draw the captions of `cell_grid`."""
    width, height = size
    figure = figures.new_figure(size, color=_PAPER)
    for row, texts, where in zip(rows, captions, places):
        for cell, lines, (x, y) in zip(row, texts, where):
            top = y + cell.pixels.shape[0] + 3
            for number, line in enumerate(lines):
                figure.text(
                    (x + 2) / width, 1 - (top + _LINE * number) / height, line,
                    va="top", color=_ALARM if cell.alarm else _TEXT, **_FONT,
                )  # fmt: skip
    return figures.figure_pixels(figure)


def _wrapped(text: str, width: int) -> list[str]:
    """Break a caption into lines that fit into ``width`` px."""
    letters = max(1, int((width - 4) / _CHARACTER))
    lines = [figures.printable(line) for line in text.splitlines()]
    return [piece for line in lines for piece in textwrap.wrap(line, letters)]


def depth_colors(
    depth: np.ndarray, limits: tuple[float, float] | None = None
) -> tuple[np.ndarray, float, float]:
    """Return ([H, W, 3] uint8, near, far): Turbo from near (red) to far (blue).

    Near and far are ``limits``, or else the 2nd and the 98th percentile; both 0 if
    there is no depth.
    """
    cv2 = images.opencv()
    found = np.isfinite(depth) & (depth > 0)
    pixels = np.full((*depth.shape, 3), _NOTHING, np.uint8)
    if not found.any():
        return pixels, 0.0, 0.0
    near, far = limits or np.percentile(depth[found], (2, 98)).tolist()
    closeness = (far - np.where(found, depth, far)) / max(far - near, 1e-12)
    # The ends of the map are nearly black.
    level = images.to_8_bit(0.06 + 0.88 * np.clip(closeness, 0, 1))
    colors = cv2.applyColorMap(level, cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(found[..., None], colors, pixels), near, far


def display_pixels(picture) -> np.ndarray:
    """Return [H, W, 3] uint8 of a picture [H, W] or [H, W, 3].

    Floats are clipped to [0, 1]; pixels that are not finite become magenta.

    Raises:
      InputError: on another shape, or an empty picture.
    """
    picture = np.asarray(picture)
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=2)
    if picture.ndim != 3 or picture.shape[2] != 3 or 0 in picture.shape:
        raise InputError(
            f"picture: expected shape [H, W] or [H, W, 3], got {picture.shape}"
        )
    if picture.dtype == np.uint8:
        return picture
    picture = picture.astype(np.float64)
    finite = np.isfinite(picture).all(axis=-1, keepdims=True)
    pixels = images.to_8_bit(np.where(finite, picture, 0))
    return np.where(finite, pixels, np.asarray(_MISSING, np.uint8))


def _row(row: SheetRow, width: int) -> list[Cell]:
    for what, picture in (("photograph", row.truth), ("render", row.render)):
        if picture.ndim != 3 or picture.shape != (*row.truth.shape[:2], 3):
            raise InputError(
                f"{row.name}: expected the photograph and the render to have one "
                f"shape [H, W, 3], got {what} {picture.shape}"
            )
    if row.depth is not None and row.depth.shape != row.truth.shape[:2]:
        raise InputError(
            f"{row.name}: expected a depth of shape {row.truth.shape[:2]}, got "
            f"{row.depth.shape}"
        )
    truth, render = (
        picture / 255.0 if picture.dtype == np.uint8 else np.asarray(picture, float)
        for picture in (row.truth, row.render)
    )
    error = np.abs(truth - render)
    cells = [
        Cell(display_pixels(truth), row.name),
        Cell(display_pixels(render), f"{row.rendered} {_psnr(error)}"),
        Cell(display_pixels(MAGNIFIED * error), f"error × {MAGNIFIED}"),
    ]
    if row.depth is not None:
        pixels, near, far = depth_colors(row.depth)
        cells.append(Cell(pixels, f"depth, 2 to 98 %: {near:.3g} to {far:.3g}"))
    return [cell._replace(pixels=scale_to_width(cell.pixels, width)) for cell in cells]


def _psnr(error: np.ndarray) -> str:
    square = float(np.mean(error**2))
    if not np.isfinite(square):
        return "not finite"
    return f"{-10 * np.log10(square):.2f} dB" if square > 0 else "identical"


def scale_to_width(pixels: np.ndarray, width: int) -> np.ndarray:
    """Scale [H, W, 3] uint8 to ``width`` px: by area, or by repeating pixels."""
    cv2 = images.opencv()
    height = max(1, round(width * pixels.shape[0] / pixels.shape[1]))
    how = cv2.INTER_AREA if width < pixels.shape[1] else cv2.INTER_NEAREST
    return cv2.resize(np.ascontiguousarray(pixels), (width, height), interpolation=how)
