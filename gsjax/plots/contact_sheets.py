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

PAPER = "#181a1f"
_MISSING = (255, 0, 255)  # pixels that are not finite
_NOTHING = "#2c2f36"  # pixels without depth
_NARROW, _GAP = 96, 6  # px, least width of a cell with a caption, and between cells
_PAGE = 960  # px, default width of a page
_LINE, _LETTER = 13, 6.1  # px, height of a line and width of a letter


class SheetRow(NamedTuple):
    """One view of a contact sheet; `comparison` explains its pictures."""

    name: str
    truth: np.ndarray
    render: np.ndarray
    depth: np.ndarray
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
      rows: (name of the photograph, photograph [H, W, 3], render [H, W, 3], depth
        [H, W], caption of the render) of each view, of any sizes. Pictures are uint8 or
        floats in [0, 1]; depth is 0 where there is none.
      width: of a cell in px; pictures are scaled to it.

    Raises:
      InputError: if there is no row, or the pictures of one differ in size.
    """
    cells = [cell for row in rows for cell in _row(row)]
    scaled = [cell._replace(pixels=_scale(cell.pixels, width)) for cell in cells]
    return cell_grid(scaled, columns=4)


def _row(row: SheetRow) -> list[Cell]:
    size = row.depth.shape
    if not row.truth.shape == row.render.shape == (*size, 3):
        raise InputError(
            f"{row.name}: expected photograph and render of one shape [H, W, 3] and "
            f"depth [H, W], got {row.truth.shape}, {row.render.shape} and {size}"
        )
    truth, render = (
        picture / 255.0 if picture.dtype == np.uint8 else np.asarray(picture, float)
        for picture in (row.truth, row.render)
    )
    square = float(np.mean((truth - render) ** 2))
    with np.errstate(divide="ignore"):
        caption = f"{row.rendered} {-10 * np.log10(square):.2f} dB"  # inf if identical
    return [
        Cell(display_pixels(truth), row.name),
        Cell(display_pixels(render), caption),
        Cell(display_pixels(4 * np.abs(truth - render)), "error × 4"),
        depth_cell(row.depth),
    ]


def cell_grid(
    cells: Sequence[Cell], columns: int | None = None, max_width: int | None = None
) -> np.ndarray:
    """Return cells in rows [H, W, 3] uint8, pixel by pixel, over their captions.

    Columns are as wide as the widest cell; by default as many as fit into 960 px. Only
    a grid wider than ``max_width`` is scaled.

    Raises:
      InputError: if there is no cell.
    """
    if not cells:
        raise InputError("picture: expected at least one picture, got none")
    narrow = _NARROW if any(cell.caption for cell in cells) else 1
    width = _GAP + max(narrow, *(cell.pixels.shape[1] for cell in cells))
    columns = columns or max(1, min(len(cells), _PAGE // width))
    high, placed = _GAP // 2, []
    for start in range(0, len(cells), columns):
        row = cells[start : start + columns]
        texts = [_wrap(cell.caption, width - _GAP) for cell in row]
        placed += [(cell, text, high) for cell, text in zip(row, texts)]
        lines = max(len(text.splitlines()) for text in texts)
        high += max(cell.pixels.shape[0] for cell in row) + _GAP
        high += lines * _LINE + (_GAP if lines else 0)
    wide, high = min(columns, len(cells)) * width, high - _GAP // 2
    figure = figures.new_figure((wide, high), facecolor=PAPER)
    for index, (cell, text, top) in enumerate(placed):
        left, bottom = index % columns * width + _GAP // 2, top + cell.pixels.shape[0]
        figure.figimage(cell.pixels, left, high - bottom, origin="upper")
        figure.text(
            left / wide, 1 - (bottom + 3) / high, text, va="top", family="monospace",
            fontsize=7.2, color="#ff785a" if cell.alarm else "#c8ccd4",
        )  # fmt: skip
    page = figures.figure_pixels(figure)
    return page if wide <= (max_width or wide) else _scale(page, max_width or wide)


def _wrap(text: str, width: int) -> str:
    """Break a text into lines of at most ``width`` px."""
    lines = [textwrap.fill(line, int(width / _LETTER)) for line in text.splitlines()]
    return figures.plain("\n".join(lines))


def _scale(pixels: np.ndarray, width: int) -> np.ndarray:
    """Scale [H, W, 3] uint8 to ``width`` px: by area, or by repeating pixels."""
    cv2 = images.opencv()
    height = max(1, round(width * pixels.shape[0] / pixels.shape[1]))
    how = cv2.INTER_AREA if width < pixels.shape[1] else cv2.INTER_NEAREST
    return cv2.resize(pixels, (width, height), interpolation=how)


def depth_cell(depth: np.ndarray, name: str = "depth") -> Cell:
    """Return depth [H, W] in the colours of `depth_colors`, with its range."""
    pixels, near, far = depth_colors(depth)
    return Cell(pixels, f"{name} {near:.3g} to {far:.3g}")


def depth_colors(
    depth: np.ndarray, limits: tuple[float, float] | None = None
) -> tuple[np.ndarray, float, float]:
    """Return ([H, W, 3] uint8, near, far): Turbo from near (red) to far (blue).

    Near and far are ``limits``, or else the 2nd and the 98th percentile; both 0 if
    there is no depth.
    """
    from matplotlib import colormaps

    missing = ~(np.isfinite(depth) & (depth > 0))
    if missing.all():
        limits = 0.0, 0.0
    near, far = limits or np.percentile(depth[~missing], (2, 98)).tolist()
    closeness = (far - np.where(missing, far, depth)) / max(far - near, 1e-12)
    # The ends of the map are nearly black.
    levels = np.ma.array(0.06 + 0.88 * np.clip(closeness, 0, 1), mask=missing)
    colors = colormaps["turbo"].with_extremes(bad=_NOTHING)(levels, bytes=True)
    return colors[..., :3], near, far


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
    finite = np.isfinite(picture).all(axis=-1, keepdims=True)
    pixels = images.to_8_bit(np.where(finite, picture, 0).astype(np.float64))
    return np.where(finite, pixels, np.asarray(_MISSING, np.uint8))
