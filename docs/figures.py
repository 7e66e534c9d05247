"""The pictures of these pages, made anew: ``python docs/figures.py``."""

from pathlib import Path

import cv2
import numpy as np

import gsjax
from gsjax.scene.synthetic import torus_knot_scene
from gsjax.sh import rgb_to_dc
from gsjax.sheets import depth_colors

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


if __name__ == "__main__":
    gsjax.use_all_cores()
    knot()
    order()
