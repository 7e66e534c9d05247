"""Sheets of results: photograph, render, error and depth side by side.

Axis legend: H W a picture; the sheet is one row of four cells for each view.

Colours are RGB. OpenCV draws the captions; its font is ASCII.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gsjax.errors import InputError
from gsjax.io import images

MAGNIFIED = 4  # the error is shown so many times as large

_PAPER, _TEXT, _FAINT = (24, 26, 31), (232, 234, 238), (150, 156, 166)
_MISSING = (255, 0, 255)  # what is not finite
_NOTHING = (44, 47, 54)  # where there is no depth
# In px: between cells, the height of a caption, and of each line that it has more.
_GAP, _BAR, _LINE = 6, 20, 15


class SheetRow(NamedTuple):
    """One view.

    Attributes:
      name: what the caption calls it, below the photograph.
      truth: [H, W, 3] the photograph, uint8, or floats in [0, 1].
      render: [H, W, 3] alike.
      depth: [H, W] of the render, 0 where nothing is; or None.
      rendered: what is said below the render, before its PSNR.
    """

    name: str
    truth: np.ndarray
    render: np.ndarray
    depth: np.ndarray | None = None
    rendered: str = "render"


def comparison(rows: Sequence[SheetRow], *, width: int = 320) -> np.ndarray:
    """A sheet [·, ·, 3] uint8 of photograph, render, error × 4 and depth.

    Pixels that are not finite are magenta. Near is red and far is blue, between the
    2nd and the 98th percentile of each view. PSNR is that of the pixels as given.

    Args:
      rows: the views, of any sizes.
      width: of a cell in px; pictures are scaled to it, and captions broken into lines.

    Raises:
      InputError: if there is no row, or the pictures of one are not of one size.
    """
    if not rows:
        raise InputError("no views to compare; a sheet has at least one row")
    with_depth = any(row.depth is not None for row in rows)
    return np.concatenate([_row(row, width, with_depth) for row in rows])


def depth_colors(
    depth: np.ndarray, limits: tuple[float, float] | None = None
) -> tuple[np.ndarray, float, float]:
    """([H, W, 3] uint8, near, far): Turbo from near (red) to far (blue).

    Near and far are ``limits``, or else the 2nd and the 98th percentile, both 0 if
    there is no depth.
    """
    cv2 = images.opencv()
    found = np.isfinite(depth) & (depth > 0)
    pixels = np.full((*depth.shape, 3), _NOTHING, np.uint8)
    if not found.any():
        return pixels, 0.0, 0.0
    near, far = limits or np.percentile(depth[found], (2, 98)).tolist()
    # The ends of the map are nearly black.
    closeness = (far - np.where(found, depth, far)) / max(far - near, 1e-12)
    level = images.to_8_bit(0.06 + 0.88 * np.clip(closeness, 0, 1))
    colors = cv2.applyColorMap(level, cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(found[..., None], colors, pixels), near, far


def put_text(
    picture: np.ndarray, text: str, place: tuple[int, int], color=_TEXT, size=0.42
) -> None:
    """Write into ``picture`` [H, W, 3]; ``place`` (x, y) is where the line begins."""
    cv2 = images.opencv()
    text = _ascii(text)
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, color, 1, 16)


def text_width(text: str, size: float = 0.42) -> int:
    """Width in px of what `put_text` writes."""
    cv2 = images.opencv()
    return cv2.getTextSize(_ascii(text), cv2.FONT_HERSHEY_SIMPLEX, size, 1)[0][0]


def _ascii(text: str) -> str:
    return text.encode("ascii", "replace").decode()


def wrapped(text: str, width: int, size: float = 0.42) -> list[str]:
    """Lines that `put_text` writes into ``width`` px: words, broken where one is wider.

    Every character but for the blanks between lines is in them, at least one in each.
    """
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".lstrip()
        if text_width(longer, size) <= width:
            lines[-1] = longer
            continue
        if lines[-1]:
            lines.append("")
        for letter in word:
            if lines[-1] and text_width(lines[-1] + letter, size) > width:
                lines.append("")
            lines[-1] += letter
    return lines


def _row(row: SheetRow, width: int, with_depth: bool) -> np.ndarray:
    truth, render = _floats(row.truth), _floats(row.render)
    if truth.shape != render.shape:
        raise InputError(
            f"{row.name}: the photograph is {truth.shape}, the render {render.shape}"
        )
    if row.depth is not None and row.depth.shape != truth.shape[:2]:
        raise InputError(
            f"{row.name}: the depth is {row.depth.shape}, the photograph {truth.shape}"
        )
    error = np.abs(truth - render)
    pictures = [visible(truth), visible(render), visible(MAGNIFIED * error)]
    captions = [row.name, f"{row.rendered} {_psnr(error)}", f"error x {MAGNIFIED}"]
    if row.depth is not None:
        pixels, near, far = depth_colors(row.depth)
        pictures.append(pixels)
        captions.append(f"depth, 2 to 98 %: {near:.3g} to {far:.3g}")
    texts = [wrapped(caption, width - 2) for caption in captions]
    bar = _BAR + _LINE * (max(map(len, texts)) - 1)
    cells = [_cell(*one, width, bar) for one in zip(pictures, texts)]
    if with_depth and row.depth is None:
        cells.append(np.full_like(cells[0], _PAPER))
    return np.concatenate(cells, axis=1)


def _psnr(error: np.ndarray) -> str:
    square = float(np.mean(error**2))
    if not np.isfinite(square):
        return "not finite"
    return f"{-10 * np.log10(square):.2f} dB" if square > 0 else "identical"


def _floats(picture: np.ndarray) -> np.ndarray:
    if picture.ndim != 3 or picture.shape[2] != 3:
        raise InputError(f"a picture is {picture.shape}; [H, W, 3] is wanted")
    return picture / 255.0 if picture.dtype == np.uint8 else np.asarray(picture, float)


def visible(picture: np.ndarray) -> np.ndarray:
    """[H, W, 3] uint8 of floats in [0, 1] (clipped); magenta where not finite."""
    finite = np.isfinite(picture).all(axis=-1, keepdims=True)
    pixels = images.to_8_bit(np.where(finite, picture, 0))
    return np.where(finite, pixels, np.asarray(_MISSING, np.uint8))


def _cell(pixels: np.ndarray, lines: list[str], width: int, bar: int) -> np.ndarray:
    """A picture scaled to ``width`` over its caption of ``bar`` px, with a margin."""
    cv2 = images.opencv()
    height = max(1, round(width * pixels.shape[0] / pixels.shape[1]))
    shrinks = width < pixels.shape[1]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST
    cell = np.full((height + bar + _GAP, width + _GAP, 3), _PAPER, np.uint8)
    left = _GAP // 2
    top = left
    cell[top : top + height, left : left + width] = cv2.resize(
        np.ascontiguousarray(pixels), (width, height), interpolation=how
    )
    for index, line in enumerate(lines):
        put_text(cell, line, (left + 2, top + height + 14 + _LINE * index), _FAINT)
    return cell
