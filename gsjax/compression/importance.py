"""Importance of each Gaussian, and of each of its numbers, to pictures.

Axis legend: N Gaussians (capacity), H W image.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera, resize_camera
from gsjax.gaussians import Gaussians
from gsjax.raster.contribution import contribution
from gsjax.raster.exact import exact_config
from gsjax.raster.render import render
from gsjax.raster.types import RasterConfig
from gsjax.runtime.console import progress

MAX_VIEWS = 12
MAX_SIZE = 640  # px of the longer side, of pictures from which importance is measured
GEOMETRY = ("means", "quats", "log_scales", "logit_opacities")


class Importance(NamedTuple):
    """Contribution of each Gaussian to pictures, as mean squared errors.

    A mean is over the pixels and colour channels of all pictures.

    Attributes:
      total: [N] sum of the weights over all pixels.
      largest: [N] largest weight in a pixel.
      energy: [N] error per unit of a squared change of the colour (all channels).
      removal: [N] error if this Gaussian alone is removed.
      curvature: error per squared change of a number, by the names in `GEOMETRY`, in
        the shapes of `GaussianParams`: the diagonal of JᵀJ, estimated.
    """

    total: np.ndarray
    largest: np.ndarray
    energy: np.ndarray
    removal: np.ndarray
    curvature: dict[str, np.ndarray]


def sample_cameras(
    cameras: Camera | Sequence[Camera], count: int = MAX_VIEWS, max_size: int = MAX_SIZE
) -> list[Camera]:
    """Return at most ``count`` single cameras, evenly spaced, of at most this size."""
    singles = []
    for camera in [cameras] if isinstance(cameras, Camera) else cameras:
        some = camera.viewmat.shape[0] if camera.batched else 0
        singles += [jax.tree.map(lambda a, i=i: a[i], camera) for i in range(some)]
        singles += [] if camera.batched else [camera]
    places = np.linspace(0, len(singles) - 1, min(count, len(singles))).astype(int)
    return [_at_most(singles[place], max_size) for place in places]


def _at_most(camera: Camera, size: int) -> Camera:
    scale = size / max(camera.width, camera.height)
    if scale >= 1:
        return camera
    width, height = round(camera.width * scale), round(camera.height * scale)
    return resize_camera(camera, max(1, width), max(1, height))


def measure_importance(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    config: RasterConfig,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    seed: int = 0,
) -> Importance:
    """Measure the importance of Gaussians on the pictures of some cameras.

    The diagonal of JᵀJ is estimated from one reverse pass a picture, with a random sign
    in each pixel and channel as cotangent: the expected square of the gradient is the
    sum of squares (Hutchinson, "A stochastic estimator of the trace", 1989).

    Args:
      gaussians: N slots, concrete.
      cameras: single cameras, see `sample_cameras`.
      config: render settings.
      background: RGB behind the scene.
      seed: seed of the signs.

    Raises:
      InputError, CapacityError: as `render_exact`.
    """
    behind = jnp.asarray(background, gaussians.params.means.dtype)
    config = config.replace(outputs=("rgb",), absgrad=False, num_size_buckets=1)
    sums = [np.zeros(gaussians.capacity) for _ in range(4)]
    squares = dict.fromkeys(GEOMETRY, 0.0)
    numbers = 0
    for place, camera in enumerate(progress(cameras, "importance")):
        found = contribution(gaussians, camera, config, behind)
        total, largest, energy, removal = (np.asarray(a, np.float64) for a in found)
        sums[0] += total
        sums[1] = np.maximum(sums[1], largest)
        sums[2] += energy
        sums[3] += removal
        fitted = exact_config(gaussians, camera, _centre_order(config))
        key = jax.random.fold_in(jax.random.key(seed), place)
        gradient = _of_signs(gaussians, camera, behind, key, fitted)
        for name in GEOMETRY:
            square = np.square(np.asarray(getattr(gradient, name), np.float64))
            squares[name] = squares[name] + square
        numbers += 3 * camera.width * camera.height
    numbers = max(numbers, 1)
    return Importance(
        total=sums[0],
        largest=sums[1],
        energy=sums[2] / numbers,
        removal=sums[3] / numbers,
        curvature={k: np.nan_to_num(v) / numbers for k, v in squares.items()},
    )


def _centre_order(config: RasterConfig) -> RasterConfig:
    return config.replace(order="center")


@partial(jax.jit, static_argnums=4)
def _of_signs(gaussians: Gaussians, camera: Camera, behind, key, config: RasterConfig):
    """Return the gradient of the picture times random signs, as `GaussianParams`."""

    def picture(params):
        scene = gaussians.replace(params=params)  # pyright: ignore
        return render(scene, camera, config, behind).rgb

    image, pull = jax.vjp(picture, gaussians.params)
    signs = jax.random.rademacher(key, image.shape, image.dtype)
    return pull(signs)[0]
