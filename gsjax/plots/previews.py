"""Cells that a notebook shows of a render or a scene, without rendering anything.

Axis legend: B batch, H W picture, N Gaussians, M dots of a sketch.
"""

import jax
import numpy as np
from scipy.special import expit

from gsjax.gaussians import Gaussians
from gsjax.math.sh import dc_to_rgb
from gsjax.plots import figures
from gsjax.plots.contact_sheets import PAPER, Cell, depth_cell, display_pixels
from gsjax.raster.types import Render

_MOST_CELLS, _MOST_DOTS = 24, 20_000
_WIDTH, _HEIGHT = 320, 240  # px of a sketch


def render_cells(render: Render) -> list[Cell]:
    """Return a cell for each image; of a batch camera by camera, at most 24 in all.

    A single image has no caption. Features are shown as their first three channels.
    """
    found = {}
    for name in ("rgb", "alpha", "depth", "median_depth"):
        if (image := getattr(render, name)) is not None:
            single = 3 if name == "rgb" else 2
            found[name] = np.asarray(image).reshape(-1, *image.shape[-single:])
    if "rgb" in found:
        rgb = found["rgb"]
        rgb = np.repeat(rgb, 3, axis=-1) if rgb.shape[-1] == 1 else rgb
        found["rgb"] = np.pad(rgb, [(0, 0)] * 3 + [(0, 2)])[..., :3]
    cells = []
    count = len(next(iter(found.values()), ()))
    for index in range(min(count, max(1, _MOST_CELLS // max(len(found), 1)))):
        for name, stack in found.items():
            if "depth" in name:
                cell = depth_cell(stack[index], name.replace("_", " "))
            else:
                cell = Cell(display_pixels(stack[index]), name)
            prefix = f"{index}: " if count > 1 else ""
            cells.append(cell._replace(caption=prefix + cell.caption))
    if np.any(np.asarray(render.overflowed)):
        told = "INCOMPLETE: overflowed"
        return [cell._replace(caption=told, alarm=True) for cell in cells]
    return cells if len(cells) > 1 else [cell._replace(caption="") for cell in cells]


def gaussian_cells(gaussians: Gaussians) -> list[Cell]:
    """Return a sketch over a summary; of a batch, a sketch of each, at most 24.

    A sketch [240, 320, 3] shows Gaussians as dots: the colours of degree 0, the middle
    scales, and for a batch the viewpoint of its first scene.
    """
    lead = gaussians.active.ndim - 1
    flat = jax.tree.map(lambda a: np.asarray(a).reshape(-1, *a.shape[lead:]), gaussians)
    cells, view = [], None
    for index in range(min(len(flat.active), _MOST_CELLS)):
        one = jax.tree.map(lambda a, i=index: a[i], flat)
        dots = _dots(one)
        view = view or _viewpoint(dots[0])
        text = f"{index}: {one.active.sum():,} Gaussians" if lead else _summary(one)
        cells.append(Cell(_sketch(*dots, *view), text))
    return cells


def _summary(gaussians: Gaussians) -> str:
    """Return counts and the middle 80 % of the values of a scene, a line each."""
    active = np.asarray(gaussians.active)
    slots = f" in {len(active):,} slots" if not active.all() else ""
    lines = [f"{active.sum():,} Gaussians{slots}, SH degree {gaussians.sh_degree}"]
    params = jax.tree.map(lambda a: np.asarray(a, float)[active], gaussians.params)
    values = dict(zip("xyz", params.means.T))
    values["opacity"] = expit(params.logit_opacities)
    with np.errstate(over="ignore"):
        values["longest axis"] = np.exp(params.log_scales.max(axis=1))
    for name, value in values.items():
        if (value := value[np.isfinite(value)]).size:
            low, middle, high = np.percentile(value, (10, 50, 90))
            lines.append(f"{name} {low:.3g} to {high:.3g}, median {middle:.3g}")
    return "\n".join(lines)


def _dots(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return means [M, 3], middle scales [M] and colours [M, 3] of a sketch.

    They are the finite Gaussians of the largest opacity times area, at most 20 000.
    """
    params = gaussians.params
    leaves = params.means, params.log_scales, params.sh[:, 0]
    means, logs, dc = (np.asarray(leaf, np.float64) for leaf in leaves)
    opacity = expit(np.asarray(params.logit_opacities, np.float64))
    shown = np.asarray(gaussians.active) & (opacity > 0.05)
    shown &= np.isfinite(np.hstack([means, logs, dc])).all(axis=1)
    scales = np.exp(np.clip(np.sort(logs, axis=1), -50, 50))
    weight = np.where(shown, opacity * scales[:, 1] * scales[:, 2], 0)
    kept = np.argsort(-weight)[: min(shown.sum(), _MOST_DOTS)]
    colors = np.clip(dc_to_rgb(dc[kept]), 0, 1)  # pyright: ignore
    return means[kept], scales[kept, 1], np.asarray(colors)


def _viewpoint(means: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return a view of points [M, 3] from obliquely above with most of them in it.

    It is a centre [3], the directions to the right, up and to the viewer [3, 3], and
    half a height. Up is the direction of least spread, signed by convention (−y, or z).
    """
    if not len(means):
        return np.zeros(3), np.eye(3), 1.0
    centre = np.median(means, axis=0)
    _, vectors = np.linalg.eigh((means - centre).T @ (means - centre))
    up, across = vectors[:, 0], vectors[:, 2]
    up = up if up @ (0.0, -1.0, 1.01) >= 0 else -up
    aside, cos, sin = np.cross(up, across), np.cos(0.45), np.sin(0.45)
    axes = np.stack([-across, cos * up - sin * aside, cos * aside + sin * up])
    extent = float(np.percentile(np.linalg.norm(means - centre, axis=1), 90))
    return centre, axes, 1.1 * extent or 1.0


def _sketch(means, scales, colors, centre, turn, extent) -> np.ndarray:
    """Draw dots, the nearest last."""
    x, y, near = turn @ (means - centre).T
    order = np.argsort(near)
    order = order[(np.maximum(np.abs(x), np.abs(y)) < 2 * extent)[order]]
    figure = figures.new_figure((_WIDTH, _HEIGHT), facecolor=PAPER)
    wide = extent * _WIDTH / _HEIGHT
    axes = figure.add_axes((0, 0, 1, 1), xlim=(-wide, wide), ylim=(-extent, extent))
    axes.set_axis_off()
    diameter = 2.6 * scales[order] * _HEIGHT / (2 * extent) * 72 / figures.DPI
    area = np.clip(diameter, 1, _HEIGHT) ** 2
    axes.scatter(x[order], y[order], area, colors[order], linewidths=0)
    return figures.figure_pixels(figure)
