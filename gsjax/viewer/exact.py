"""Images that gsjax renders for the camera of a browser."""

import threading
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from gsjax.cameras.camera import NEAR, Camera, make_camera
from gsjax.data.types import inverted
from gsjax.gaussians import Gaussians, capacity_bucket
from gsjax.io import images
from gsjax.plots.contact_sheets import depth_colors
from gsjax.raster.exact import render_exact
from gsjax.raster.types import RasterConfig, Render

KINDS = ("rgb", "depth", "alpha")
_PAIRS, _MARGIN = 2**20, 1.5  # initial capacity, and spare room when it grows


def camera_of(
    wxyz, position, fov: float, width: int, height: int, near: float = NEAR
) -> Camera:
    """Return the pinhole camera of a browser.

    Args:
      wxyz, position: [4] rotation camera → world, OpenCV axes, and [3] in the world.
      fov: vertical field of view, radians.
      width, height: size of the image, px.
      near: depth below which nothing is drawn.
    """
    world_from_camera = Rotation.from_quat(np.roll(wxyz, -1)).as_matrix()
    viewmat = inverted(world_from_camera, np.asarray(position, np.float64))
    focal = 0.5 * height / np.tan(fov / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return make_camera(viewmat=viewmat, K=K, width=width, height=height, near=near)


class ExactRenderer:
    """Renders one image at a time, with a capacity that grows as needed.

    One program returns rgb, depth and alpha, so each image size is compiled once.
    """

    def __init__(self, config: RasterConfig, background: Sequence[float]):
        # One size bucket and a fixed capacity: less to compile.
        self.config = config.replace(
            outputs=("rgb", "alpha", "depth"), num_size_buckets=1, pair_capacity=_PAIRS
        )
        self.background = tuple(background)
        self._lock = threading.Lock()

    def __call__(self, gaussians: Gaussians, camera: Camera) -> Render:
        """Return the images on the host; raise `CapacityError` if they do not fit."""
        camera = jax.device_put(camera, gaussians.active.sharding)  # perhaps only one
        behind = jnp.asarray(self.background, jnp.result_type(float))
        with self._lock:
            view = render_exact(gaussians, camera, self.config, behind)
            needed = int(view.demand.capacity)
            if needed > (self.config.pair_capacity or 0):
                roomy = min(capacity_bucket(int(_MARGIN * needed)), 2**30 - 1)
                self.config = self.config.replace(pair_capacity=roomy)
            return jax.device_get(view)


def picture(view: Render, kind: str) -> tuple[np.ndarray, str]:
    """Return ([H, W, 3] uint8, description) of one of `KINDS`."""
    if kind == "depth":
        pixels, near, far = depth_colors(np.asarray(view.depth))
        return pixels, f"depth {near:.3g} (red) to {far:.3g} (blue)"
    if kind == "alpha":
        alpha = images.to_8_bit(np.asarray(view.alpha))
        return np.repeat(alpha[..., None], 3, axis=2), "alpha"
    return images.to_8_bit(np.asarray(view.rgb)), "rgb"
