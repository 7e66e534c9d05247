"""Contact sheets, and sketches of scenes: what a notebook shows of a value.

Axis legend: B batch, H W picture, N Gaussians.

Nothing here renders: a sketch is discs, drawn by OpenCV from the arrays as they are.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from gsjax.cameras.camera import look_at
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.io import images
from gsjax.math.sh import dc_to_rgb
from gsjax.plots import contact_sheets
from gsjax.plots.contact_sheets import depth_colors, put_text, text_width, wrapped
from gsjax.raster.types import Render
from gsjax.viewer.splats import Cut, most_important, within

_PAPER, _TEXT, _ALARM = (24, 26, 31), (200, 204, 212), (255, 120, 90)
_GAP, _BAR, _LINE, _SMALL = 4, 18, 17, 0.38
_SHEET = 960  # px, how wide a sheet becomes by itself
_NARROW = 96  # px, as wide as captions may make a cell
_MOST_CELLS = 24
_DISCS = 20_000
_SIZE = (320, 240)


class Cell(NamedTuple):
    """A picture [H, W, 3] uint8 of a sheet, and what is said below it."""

    pixels: np.ndarray
    caption: str = ""


def visible(picture) -> np.ndarray:
    """[H, W, 3] uint8 of a picture [H, W] or [H, W, 3]; magenta where not finite.

    Raises:
      InputError: on another shape, or an empty one.
    """
    picture = np.asarray(picture)
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=2)
    if picture.ndim != 3 or picture.shape[2] != 3 or 0 in picture.shape:
        raise InputError(
            f"a picture is {picture.shape}; [H, W] or [H, W, 3] is wanted, or a batch"
        )
    if picture.dtype == np.uint8:
        return picture
    return contact_sheets.visible(picture.astype(np.float64))


def of_depth(depth: np.ndarray) -> Cell:
    """Depth [H, W] in Turbo colours, near red and far blue, with its range."""
    pixels, near, far = depth_colors(depth)
    return Cell(pixels, f"depth {near:.3g} to {far:.3g}")


def of_render(render: Render) -> list[Cell]:
    """A cell for each image; of a batch camera by camera, at most 24 in all.

    The single picture of a render without any other has no caption.
    """
    names = ("rgb", "alpha", "depth", "median_depth")
    there = [name for name in names if getattr(render, name) is not None]
    found = {name: np.asarray(getattr(render, name)) for name in there}
    if not there:
        return []
    lead = found[there[0]].ndim - (3 if there[0] == "rgb" else 2)
    batch = found[there[0]].shape[:lead]
    found = {name: a.reshape(-1, *a.shape[lead:]) for name, a in found.items()}
    count = int(np.prod(batch, dtype=int))
    cells = []
    for index in range(min(count, max(1, _MOST_CELLS // len(there)))):
        for name in there:
            image = found[name][index]
            if "depth" in name:
                cell = of_depth(image)
                prefix = "median " if name == "median_depth" else ""
                cell = cell._replace(caption=prefix + cell.caption)
            else:
                cell = Cell(visible(_three(image) if name == "rgb" else image), name)
            if count > 1:
                cell = cell._replace(caption=f"{index}: {cell.caption}")
            cells.append(cell)
    if len(cells) == 1:
        cells = [cells[0]._replace(caption="")]
    if bool(np.any(np.asarray(render.overflowed))):
        cells = [c._replace(caption="INCOMPLETE: overflowed") for c in cells]
    return cells


def _three(image: np.ndarray) -> np.ndarray:
    """Features [H, W, C] as colours: the first three, or grey if it is one."""
    channels = image.shape[-1]
    if channels == 1:
        return np.repeat(image, 3, axis=2)
    return np.pad(image[..., :3], ((0, 0), (0, 0), (0, max(0, 3 - channels))))


def of_gaussians(gaussians: Gaussians) -> list[Cell]:
    """A sketch beside a few numbers; of a batch, a sketch of each, at most 24."""
    if gaussians.active.ndim == 1:
        picture, lines = drawn(gaussians), facts(gaussians)
        width = max(text_width(line) for line in lines) + 24
        page = np.full((picture.shape[0], width, 3), _PAPER, np.uint8)
        for index, line in enumerate(lines):
            put_text(page, line, (12, 30 + _LINE * index), _TEXT)
        return [Cell(np.concatenate([picture, page], axis=1))]
    size = gaussians.active.shape[-1]
    lead = gaussians.active.ndim - 1
    flat = jax.tree.map(
        lambda a: np.asarray(a).reshape(-1, size, *a.shape[lead + 1 :]), gaussians
    )
    cells, view = [], None
    for index in range(min(len(flat.active), _MOST_CELLS)):
        one = jax.tree.map(lambda a, i=index: a[i], flat)
        view = view or viewpoint(one)  # of the first: all from one place
        text = f"{index}: {one.active.sum():,} Gaussians"
        cells.append(Cell(drawn(one, view), text))
    return cells


def facts(gaussians: Gaussians) -> list[str]:
    """What `Gaussians` are, in a few lines of ASCII."""
    active = np.asarray(gaussians.active)
    slots = f" in {len(active):,} slots" if not active.all() else ""
    lines = [f"{active.sum():,} Gaussians{slots}", f"SH degree {gaussians.sh_degree}"]
    if not active.any():
        return lines
    params = gaussians.params
    with np.errstate(all="ignore"):
        logits = np.asarray(params.logit_opacities, np.float64)[active]
        values = {
            "opacity": 1 / (1 + np.exp(-logits)),
            "longest axis": np.exp(
                np.asarray(params.log_scales, np.float64)[active].max(axis=1)
            ),
        }
        means = np.asarray(params.means, np.float64)[active]
        low, high = np.nanpercentile(means, (1, 99), axis=0)
    for name, value in values.items():
        low_, middle, high_ = np.nanpercentile(value, (10, 50, 90))
        lines += ["", name, f"  {low_:.3g} to {high_:.3g}, median {middle:.3g}"]
    lines += ["", "within"]
    lines += [f"  {n} {a:.3g} to {b:.3g}" for n, a, b in zip("xyz", low, high)]
    return lines


class Viewpoint(NamedTuple):
    """World → camera [4, 4], and how far what is looked at is."""

    viewmat: np.ndarray
    distance: float


def drawn(gaussians: Gaussians, view: Viewpoint | None = None) -> np.ndarray:
    """A sketch [240, 320, 3]: the 20 000 of most weight as discs, the far ones first.

    Colours are those of degree 0, radii the middle scale.

    Args:
      gaussians: N slots, concrete.
      view: from where; default `viewpoint`.
    """
    cv2 = images.opencv()
    width, height = _SIZE
    page = np.full((height, width, 3), _PAPER, np.uint8)
    shown = _worth_drawing(gaussians)
    means = np.asarray(gaussians.params.means, np.float64)[shown]
    if not len(means):
        return page
    viewmat, distance = view or viewpoint(gaussians)
    local = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    focal = height  # a field of view of 53°
    middle = np.median(np.asarray(gaussians.params.log_scales, np.float64)[shown], 1)
    colors = np.asarray(gaussians.params.sh, np.float64)[shown, 0]
    colors = images.to_8_bit(np.asarray(dc_to_rgb(colors)))  # pyright: ignore
    order = np.argsort(-local[:, 2])
    order = order[local[order, 2] > 0.02 * distance]
    z = local[order, 2]
    with np.errstate(over="ignore"):
        radius = np.clip(1.3 * focal * np.exp(middle[order]) / z, 1, height)
    at = focal * local[order, :2] / z[:, None] + (width / 2, height / 2)
    at, radius = (np.rint(8 * np.clip(v, -1e4, 1e4)).astype(int) for v in (at, radius))
    for place, r, color in zip(at.tolist(), radius.tolist(), colors[order].tolist()):
        cv2.circle(page, place, r, color, -1, cv2.LINE_AA, 3)
    return page


def _worth_drawing(gaussians: Gaussians) -> np.ndarray:
    """[N] bool."""
    shown = within(gaussians, Cut(min_opacity=0.05))
    return most_important(gaussians, shown, _DISCS)


def viewpoint(gaussians: Gaussians) -> Viewpoint:
    """From obliquely above, with most of the scene in view.

    Up is the way of the least spread that is up by habit (−y, or z): a heuristic.
    """
    points = np.asarray(gaussians.params.means, np.float64)[_worth_drawing(gaussians)]
    if not len(points):
        points = np.zeros((1, 3))
    target = np.median(points, axis=0)
    offsets = points - target
    _, vectors = np.linalg.eigh(offsets.T @ offsets)
    up, across = vectors[:, 0], vectors[:, 2]
    up = up if up @ (0.0, -1.0, 1.01) >= 0 else -up
    radius = float(np.percentile(np.linalg.norm(offsets, axis=1), 90)) or 1.0
    distance = 2.1 * radius
    aside = np.cross(up, across)  # the widest side lies across the picture
    direction = np.cos(0.45) * aside + np.sin(0.45) * up
    return Viewpoint(look_at(target + distance * direction, target, up), distance)


def sheet(cells: Sequence[Cell], columns: int | None, most: int) -> np.ndarray:
    """Cells in rows [H, W, 3] uint8, at most ``most`` px wide; captions where any."""
    longest = max(text_width(cell.caption, _SMALL) for cell in cells) + 2
    widest = max(min(longest, _NARROW), *(c.pixels.shape[1] for c in cells)) + _GAP
    columns = columns or max(1, min(len(cells), _SHEET // widest))
    captioned = any(cell.caption for cell in cells)
    rows = []
    for first in range(0, len(cells), columns):
        some = cells[first : first + columns]
        captions = [wrapped(c.caption, widest - _GAP - 2, _SMALL) for c in some]
        bar = _BAR + _LINE * (max(map(len, captions)) - 1) if captioned else 0
        height = max(cell.pixels.shape[0] for cell in some) + bar + _GAP
        row = np.full((height, columns * widest, 3), _PAPER, np.uint8)
        for index, ((pixels, caption), lines) in enumerate(zip(some, captions)):
            left, top = index * widest + _GAP // 2, _GAP // 2
            row[top : top + pixels.shape[0], left : left + pixels.shape[1]] = pixels
            color = _ALARM if caption.startswith("INCOMPLETE") else _TEXT
            for number, line in enumerate(lines):
                below = top + pixels.shape[0] + 13 + _LINE * number
                put_text(row, line, (left + 2, below), color, _SMALL)
        rows.append(row)
    whole = np.concatenate(rows)
    if whole.shape[1] <= most:
        return whole
    size = most, max(1, round(whole.shape[0] * most / whole.shape[1]))
    return images.opencv().resize(whole, size, interpolation=3)  # by area


def enlarged(pixels: np.ndarray, zoom: int) -> np.ndarray:
    """[H, W, 3] with each pixel ``zoom`` by ``zoom``."""
    return pixels.repeat(zoom, axis=0).repeat(zoom, axis=1)


def stacked(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures [H, W, 3] one above the other, the narrower ones padded."""
    width = max(picture.shape[1] for picture in pictures)
    out = []
    for picture in pictures:
        page = np.full((picture.shape[0], width, 3), _PAPER, np.uint8)
        page[:, : picture.shape[1]] = picture
        out.append(page)
    return np.concatenate(out)
