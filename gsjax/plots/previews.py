"""Cells that a notebook shows of a render, a depth map or a scene.

Axis legend: B batch, H W picture, N Gaussians.

Nothing is rendered here: the sketch of a scene is discs, drawn by OpenCV.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from gsjax.cameras.camera import look_at
from gsjax.gaussians import Gaussians
from gsjax.io import images
from gsjax.math.sh import dc_to_rgb
from gsjax.plots.contact_sheets import (
    Cell,
    cell_grid,
    depth_colors,
    display_pixels,
    scale_to_width,
)
from gsjax.raster.types import Render
from gsjax.viewer.splats import Cut, most_important, within

_PAPER = (24, 26, 31)
_SHEET = 960  # px, default width of a sheet
_NARROW = 96  # px, least width of a cell with a caption
_MOST_CELLS = 24
_DISCS = 20_000
_SIZE = (320, 240)


def depth_cell(depth: np.ndarray) -> Cell:
    """Return depth [H, W] in Turbo colours, near red and far blue, with its range."""
    pixels, near, far = depth_colors(depth)
    return Cell(pixels, f"depth {near:.3g} to {far:.3g}")


def render_cells(render: Render) -> list[Cell]:
    """Return a cell for each image; of a batch camera by camera, at most 24 in all.

    A single image has no caption.
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
                cell = depth_cell(image)
                prefix = "median " if name == "median_depth" else ""
                cell = cell._replace(caption=prefix + cell.caption)
            else:
                image = _three(image) if name == "rgb" else image
                cell = Cell(display_pixels(image), name)
            if count > 1:
                cell = cell._replace(caption=f"{index}: {cell.caption}")
            cells.append(cell)
    if len(cells) == 1:
        cells = [cells[0]._replace(caption="")]
    if bool(np.any(np.asarray(render.overflowed))):
        told = "INCOMPLETE: overflowed"
        cells = [cell._replace(caption=told, alarm=True) for cell in cells]
    return cells


def _three(image: np.ndarray) -> np.ndarray:
    """Return features [H, W, C] as colours: the first three, or grey if C is 1."""
    channels = image.shape[-1]
    if channels == 1:
        return np.repeat(image, 3, axis=2)
    return np.pad(image[..., :3], ((0, 0), (0, 0), (0, max(0, 3 - channels))))


def gaussian_cells(gaussians: Gaussians) -> list[Cell]:
    """Return a sketch over a summary; of a batch, a sketch of each, at most 24."""
    if gaussians.active.ndim == 1:
        return [Cell(sketch(gaussians), summary(gaussians))]
    size = gaussians.active.shape[-1]
    lead = gaussians.active.ndim - 1
    flat = jax.tree.map(
        lambda a: np.asarray(a).reshape(-1, size, *a.shape[lead + 1 :]), gaussians
    )
    cells, view = [], None
    for index in range(min(len(flat.active), _MOST_CELLS)):
        one = jax.tree.map(lambda a, i=index: a[i], flat)
        view = view or choose_viewpoint(one)  # the same for all
        text = f"{index}: {one.active.sum():,} Gaussians"
        cells.append(Cell(sketch(one, view), text))
    return cells


def summary(gaussians: Gaussians) -> str:
    """Return counts and ranges of a scene, in a few lines."""
    active = np.asarray(gaussians.active)
    slots = f" in {len(active):,} slots" if not active.all() else ""
    lines = [f"{active.sum():,} Gaussians{slots}, SH degree {gaussians.sh_degree}"]
    if not active.any():
        return lines[0]
    params = gaussians.params
    with np.errstate(all="ignore"):
        logits = np.asarray(params.logit_opacities, np.float64)[active]
        longest = np.asarray(params.log_scales, np.float64)[active].max(axis=1)
        values = {"opacity": 1 / (1 + np.exp(-logits)), "longest axis": np.exp(longest)}
        means = np.asarray(params.means, np.float64)[active]
        low, high = np.nanpercentile(means, (1, 99), axis=0)
    for name, value in values.items():
        least, middle, most = np.nanpercentile(value, (10, 50, 90))
        lines.append(f"{name} {least:.3g} to {most:.3g}, median {middle:.3g}")
    box = (f"{n} {a:.3g} to {b:.3g}" for n, a, b in zip("xyz", low, high))
    return "\n".join([*lines, *box])


class Viewpoint(NamedTuple):
    """World → camera [4, 4], and the distance to the centre of the scene."""

    viewmat: np.ndarray
    distance: float


def sketch(gaussians: Gaussians, view: Viewpoint | None = None) -> np.ndarray:
    """Draw the 20 000 Gaussians of most weight as discs [240, 320, 3], far to near.

    Colours are those of degree 0, radii the middle scale.

    Args:
      gaussians: N slots, concrete.
      view: default `choose_viewpoint`.
    """
    cv2 = images.opencv()
    width, height = _SIZE
    page = np.full((height, width, 3), _PAPER, np.uint8)
    shown = _important(gaussians)
    means = np.asarray(gaussians.params.means, np.float64)[shown]
    if not len(means):
        return page
    viewmat, distance = view or choose_viewpoint(gaussians)
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


def _important(gaussians: Gaussians) -> np.ndarray:
    """Return which Gaussians [N] a sketch draws."""
    shown = within(gaussians, Cut(min_opacity=0.05))
    return most_important(gaussians, shown, _DISCS)


def choose_viewpoint(gaussians: Gaussians) -> Viewpoint:
    """Return a view from obliquely above with most of the scene in it.

    Up is the direction of least spread, signed by convention (−y, or z): a heuristic.
    """
    points = np.asarray(gaussians.params.means, np.float64)[_important(gaussians)]
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


def cell_sheet(cells: Sequence[Cell], columns: int | None, most: int) -> np.ndarray:
    """Return cells in rows [H, W, 3] uint8, at most ``most`` px wide.

    Pictures are shown pixel by pixel; only a sheet wider than ``most`` is scaled.
    """
    if any(cell.caption for cell in cells):
        cells = [cell._replace(pixels=_widened(cell.pixels, _NARROW)) for cell in cells]
    widest = max(cell.pixels.shape[1] for cell in cells)
    columns = columns or max(1, min(len(cells), _SHEET // widest))
    page = cell_grid([cells[i : i + columns] for i in range(0, len(cells), columns)])
    return scale_to_width(page, most) if page.shape[1] > most else page


def enlarge(pixels: np.ndarray, zoom: int) -> np.ndarray:
    """Return [H, W, 3] with each pixel ``zoom`` by ``zoom``."""
    return pixels.repeat(zoom, axis=0).repeat(zoom, axis=1)


def stack_pictures(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Return pictures [H, W, 3] one below the other, padded to one width."""
    width = max(picture.shape[1] for picture in pictures)
    return np.concatenate([_widened(picture, width) for picture in pictures])


def _widened(pixels: np.ndarray, width: int) -> np.ndarray:
    """Pad pixels on the right to a width of at least ``width``."""
    page = np.full((pixels.shape[0], max(width, pixels.shape[1]), 3), _PAPER, np.uint8)
    page[:, : pixels.shape[1]] = pixels
    return page
