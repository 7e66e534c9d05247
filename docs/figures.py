"""The pictures of these pages, made anew: ``python docs/figures.py``."""

from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np

import gsjax
from gsjax.math.sh import rgb_to_dc
from gsjax.plots.contact_sheets import depth_colors, put_text, text_width, wrapped
from gsjax.raster.lists import binning
from gsjax.raster.lists.depth_order import depth_order
from gsjax.raster.primitives.ellipsoid import project
from gsjax.synthetic.torus_knot import torus_knot_scene

ASSETS = Path(__file__).parent / "assets"


def write(name: str, rgb: np.ndarray) -> None:
    """RGB [H, W, 3] in [0, 1] as a .webp."""
    pixels = np.rint(255 * np.clip(rgb, 0, 1)).astype(np.uint8)[..., ::-1]
    quality = [cv2.IMWRITE_WEBP_QUALITY, 82]
    _, encoded = cv2.imencode(".webp", pixels, quality)
    (ASSETS / name).write_bytes(encoded.tobytes())


def knot() -> None:
    """The torus knot beside its depth."""
    scene = torus_knot_scene(count=20_000, frames=48, width=560, height=420)
    behind = np.asarray(scene.background)
    view = gsjax.render_exact(scene.gaussians, scene.cameras[4], background=behind)
    depth = depth_colors(np.asarray(view.depth))[0] / 255
    alpha = np.asarray(view.alpha)[..., None]
    depth = depth * alpha + behind * (1 - alpha)
    write("knot.webp", np.concatenate([np.asarray(view.rgb), depth], axis=1))


def order() -> None:
    """Two splats beside each other, one in front, then the other."""
    K = [[240, 0, 140], [0, 240, 100], [0, 0, 1]]
    camera = gsjax.make_camera(viewmat=np.eye(4), K=K, width=280, height=200)
    pictures = []
    for first, second in ((2.0, 2.1), (2.1, 2.0)):
        pair = gsjax.make_gaussians(
            means=[[-0.18, 0, first], [0.18, 0, second]],
            quats=np.tile([1.0, 0, 0, 0], (2, 1)),
            log_scales=np.full((2, 3), np.log(0.22)),
            logit_opacities=np.full(2, np.log(9.0)),
            sh=rgb_to_dc(np.asarray([[[0.86, 0.2, 0.14]], [[0.13, 0.35, 0.8]]])),
        )
        view = gsjax.render_exact(pair, camera, background=np.ones(3))
        pictures.append(np.asarray(view.rgb))
    write("order.webp", np.concatenate(pictures, axis=1))


_PAPER, _INK, _BACK = (255, 255, 255), (60, 64, 72), (190, 70, 40)
_GAP, _TILE = 46, 16
# Shown half as wide on the pages.
_HEAD, _TEXT, _LINE = 1.15, 0.9, 32


def pipeline() -> None:
    """The way from Gaussians to a picture, and back: four panels and arrows."""
    scene = torus_knot_scene(count=6000, frames=48, width=320, height=240)
    gaussians, camera = scene.gaussians, scene.cameras[4]
    white = np.ones(3)
    small = gaussians.replace(
        params=gaussians.params.replace(log_scales=gaussians.params.log_scales - 1.1)
    )
    dots, picture = (
        np.asarray(gsjax.render_exact(one, camera, background=white).rgb)
        for one in (small, gaussians)
    )
    config = gsjax.RasterConfig(tile_size=_TILE, devices=1, num_size_buckets=1)
    slots, count = depth_order(gaussians, camera, config)
    seen = project(gaussians, camera, config, slots, count)
    panels = [dots, _ellipses(seen, dots.shape), _lengths(seen, picture), picture]
    captions = [
        ("Gaussians", "position, rotation, scale, opacity, colour"),
        ("project", "each to an ellipse, with its colour from here"),
        ("sort", "by tile and depth: red tiles have long lists"),
        ("blend", "tile by tile, front to back"),
    ]
    height, width = dots.shape[:2]
    texts = [wrapped(text, width, _TEXT) for _, text in captions]
    below = height + 80 + _LINE * max(map(len, texts))
    page = np.full((below + 50, 4 * width + 3 * _GAP + 20, 3), 255, np.uint8)
    for index, (panel, (title, _), text) in enumerate(zip(panels, captions, texts)):
        left = 10 + index * (width + _GAP)
        pixels = np.rint(255 * np.clip(panel, 0, 1)).astype(np.uint8)
        page[10 : 10 + height, left : left + width] = pixels
        cv2.rectangle(page, (left, 10), (left + width, 10 + height), _INK, 1)
        put_text(page, title, (left, height + 48), _INK, _HEAD)
        for number, line in enumerate(text):
            put_text(page, line, (left, height + 86 + _LINE * number), _INK, _TEXT)
        if index:
            middle = 10 + height // 2
            _arrow(page, (left - _GAP + 8, middle), (left - 8, middle), _INK)
    row, right = below + 20, page.shape[1] - 12
    _arrow(page, (right, row), (12, row), _BACK)
    told = "jax.grad, jax.jvp: by Gaussians, camera and background"
    wide = text_width(told, _TEXT)
    left = (page.shape[1] - wide) // 2
    page[row - 14 : row + 15, left - 16 : left + wide + 16] = _PAPER
    put_text(page, told, (left, row + 9), _BACK, _TEXT)
    write("pipeline.webp", page / 255)


def _arrow(page: np.ndarray, start: tuple[int, int], end: tuple[int, int], color):
    tip = 12 / max(abs(end[0] - start[0]), 1)
    cv2.arrowedLine(page, start, end, color, 3, cv2.LINE_AA, tipLength=tip)


def _ellipses(seen, shape: tuple[int, ...]) -> np.ndarray:
    """One in six of them, where their densities are e^(-1/2), far to near."""
    page = np.full(shape, 255, np.uint8)
    u, v, var_y, slope, inv_sx = (
        np.asarray(a, np.float64)
        for a in (seen.u, seen.v, seen.var_y, seen.slope, seen.inv_sx)
    )
    colors = 255 * np.clip(np.asarray(seen.colors), 0, 1)
    for rank in range(len(u) - 1, -1, -6):
        if not seen.reach[rank] > 0:
            continue
        var_x = 1 / inv_sx[rank] ** 2
        cov = slope[rank] * var_x
        axes, turn = np.linalg.eigh([[var_x, cov], [cov, var_y[rank]]])
        angle = float(np.degrees(np.arctan2(turn[1, 1], turn[0, 1])))
        half = (16 * np.sqrt(axes[::-1])).astype(int)
        centre = (round(16 * u[rank]), round(16 * v[rank]))
        color = tuple(float(c) for c in colors[:, rank])
        cv2.ellipse(page, centre, half, angle, 0, 360, color, 1, cv2.LINE_AA, 4)
    return page / 255


def _lengths(seen, picture: np.ndarray) -> np.ndarray:
    """How many Gaussians each tile's list has, in colours over the picture."""
    height, width = picture.shape[:2]
    grid = binning.make_grid(width, height, _TILE, 1)
    device = jnp.int32(0)
    spans = binning.row_spans(seen, grid, device)
    lists = binning.make_lists(seen, spans, grid, device, 2**17)
    assert lists.fit
    length = np.asarray(lists.length, np.float64).reshape(grid.rows, grid.cols)
    levels = np.rint(255 * length / length.max()).astype(np.uint8)
    heat = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[..., ::-1] / 255
    heat = np.repeat(np.repeat(heat, _TILE, axis=0), _TILE, axis=1)[:height, :width]
    page = 0.35 * picture + 0.65 * heat
    page[::_TILE] = page[:, ::_TILE] = 1
    return page


if __name__ == "__main__":
    gsjax.use_all_cores()
    knot()
    order()
    pipeline()
