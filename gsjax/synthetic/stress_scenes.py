"""Small scenes that stress a renderer, each with one camera.

Random numbers have fixed seeds; the camera is at the origin and looks along z.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gsjax.cameras.camera import Camera, make_camera
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.math.sh import rgb_to_dc
from gsjax.synthetic.torus_knot import torus_knot_scene


class StressScene(NamedTuple):
    """Gaussians with a camera and a background."""

    name: str
    gaussians: Gaussians
    camera: Camera
    background: tuple[float, float, float]


def knot(width: int = 240, height: int = 180) -> StressScene:
    """Return a torus knot over a floor: opaque surfaces, SH degree 1."""
    scene = torus_knot_scene(3000, frames=1, width=width, height=height)
    return StressScene("knot", scene.gaussians, scene.cameras[0], scene.background)


def fog(width: int = 240, height: int = 180, count: int = 6000) -> StressScene:
    """Return thousands of wide splats with opacities near the cut-off of 1/255."""
    rng = np.random.default_rng(1)
    depth = rng.uniform(1, 9, count)
    scales = depth[:, None] * rng.uniform(0.01, 0.06, (count, 3))
    opacity = np.exp(rng.uniform(np.log(0.001), np.log(0.03), count))
    return _random_scene("fog", depth, scales, opacity, rng, (width, height))


def needles(width: int = 240, height: int = 180, count: int = 1500) -> StressScene:
    """Return splats 30 to 300 px long, 0.01 px wide and half opaque."""
    rng = np.random.default_rng(2)
    depth = rng.uniform(2, 8, count)
    along = depth * np.exp(rng.uniform(np.log(0.03), np.log(0.3), count))
    scales = np.stack([1e-5 * depth, along, 1e-5 * depth], axis=1)
    opacity = rng.uniform(0.2, 0.9, count)
    return _random_scene("needles", depth, scales, opacity, rng, (width, height))


def huge(width: int = 240, height: int = 180, count: int = 4000) -> StressScene:
    """Return one huge splat over many small ones."""
    rng = np.random.default_rng(3)
    depth = rng.uniform(2, 8, count)
    scales = depth[:, None] * rng.uniform(0.002, 0.012, (count, 3))
    opacity = rng.beta(2, 1, count).clip(0.01, 0.99)
    depth[0], scales[0], opacity[0] = 1.0, 2.0, 0.5
    return _random_scene("huge", depth, scales, opacity, rng, (width, height))


STRESS_SCENES: dict[str, Callable[[], StressScene]] = {
    make.__name__: make for make in (knot, fog, needles, huge)
}


def _random_scene(
    name: str, depth, scales, opacity, rng, size: tuple[int, int]
) -> StressScene:
    """Return Gaussians at random over the view and a little beyond it."""
    width, height = size
    count, focal = len(depth), float(max(size))
    spread = 0.55 * np.asarray(size) / focal
    across = rng.uniform(-spread, spread, (count, 2)) * depth[:, None]
    gaussians = make_gaussians(
        means=np.column_stack([across, depth]),
        quats=rng.normal(size=(count, 4)),
        log_scales=np.log(scales),
        logit_opacities=np.log(opacity) - np.log1p(-opacity),
        sh=rgb_to_dc(rng.uniform(0, 1, (count, 1, 3))),
    )
    K = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    camera = make_camera(viewmat=np.eye(4), K=K, width=width, height=height)
    return StressScene(name, gaussians, camera, (0.2, 0.5, 0.9))
