"""Importance of each Gaussian, and of each of its numbers, to pictures.

Axis legend: N Gaussians (capacity), V views, H W image.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera, resize_camera
from gsjax.compression.curvature import shape_curvature, shrunk
from gsjax.gaussians import Gaussians
from gsjax.raster.contribution import contribution
from gsjax.raster.exact import exact_config
from gsjax.raster.render import render
from gsjax.raster.types import RasterConfig
from gsjax.runtime.console import progress

MAX_VIEWS = 48
MAX_SIZE = 480  # px of the longer side, of pictures from which importance is measured
_GRADIENTS = 12  # views of which gradients are taken
_MEASURED = ("means", "quats", "log_scales")


class Importance(NamedTuple):
    """Contribution of each Gaussian to pictures, as mean squared errors.

    A mean is over the pixels and colour channels of all pictures.

    Attributes:
      shares: [V, N] sum of the weights over the pixels of each view, over the number of
        pixels and channels: the error per squared change of the colour (summed over
        channels) if all Gaussians of a pixel change alike.
      centres: [V, 3] centres of the cameras.
      energy: [N] sum of the squared weights over all pixels, over their number and that
        of the channels: the error per squared change of the colour if the Gaussians of
        a pixel change independently.
      largest: [N] largest weight in a pixel.
      removal: [N] error if this Gaussian alone is removed.
      curvature: error per squared change of a number, by the names and in the shapes
        of `GaussianParams` without harmonics: the diagonal of JᵀJ.
    """

    shares: np.ndarray
    centres: np.ndarray
    energy: np.ndarray
    largest: np.ndarray
    removal: np.ndarray
    curvature: dict[str, np.ndarray]

    def scaled(self, factors: Mapping[str, float]) -> "Importance":
        """Return errors times a factor of their kind, see `Quantised.errors`."""
        curvature = {k: factors.get(k, 1) * v for k, v in self.curvature.items()}
        return self._replace(
            shares=self.shares * np.float32(factors.get("harmonics", 1)),
            energy=self.energy * factors.get("colors", 1),
            removal=self.removal * factors.get("removal", 1),
            curvature=curvature,
        )

    def rows(self, kept: np.ndarray) -> "Importance":
        """Return the importance of some Gaussians, by their indices."""
        return Importance(
            shares=self.shares[:, kept],
            centres=self.centres,
            largest=self.largest[kept],
            energy=self.energy[kept],
            removal=self.removal[kept],
            curvature={name: v[kept] for name, v in self.curvature.items()},
        )


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

    The diagonal of JᵀJ is measured by one reverse pass in each of some pictures, with a
    random sign in each pixel and channel as cotangent: the expected square of the
    gradient is the sum of squares (Hutchinson, "A stochastic estimator of the trace",
    1989). `gsjax.compression.curvature` reduces the noise.

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
    with_gradient = set(np.linspace(0, len(cameras) - 1, _GRADIENTS).astype(int))
    found = []
    squares = {
        name: np.zeros(getattr(gaussians.params, name).shape) for name in _MEASURED
    }
    for place, camera in enumerate(progress(cameras, "importance")):
        one = contribution(gaussians, camera, config, behind)
        found.append([np.asarray(values, np.float32) for values in one])
        if place in with_gradient:
            fitted = exact_config(gaussians, camera, config.replace(order="center"))
            key = jax.random.fold_in(jax.random.key(seed), place)
            gradient = _of_signs(gaussians, camera, behind, key, fitted)
            for name in _MEASURED:
                square = np.square(np.asarray(getattr(gradient, name), np.float64))
                squares[name] += square
    total, largest, energy, removal = (np.stack(some) for some in zip(*found))
    numbers = sum(3 * camera.width * camera.height for camera in cameras)
    sampled = sum(3 * cameras[k].width * cameras[k].height for k in with_gradient)
    removal = removal.sum(0, dtype=np.float64) / numbers
    params = gaussians.params.__dict__
    prior = shape_curvature(
        {name: np.asarray(values) for name, values in params.items()},
        removal,
        config.dilation * _pixel_areas(gaussians, cameras, total),
    )
    measured = {name: values / sampled for name, values in squares.items()}
    times = np.count_nonzero(total[sorted(with_gradient)], axis=0)
    return Importance(
        shares=total / np.float32(numbers),
        centres=np.stack([_centre(camera) for camera in cameras]),
        largest=largest.max(0),
        energy=energy.sum(0, dtype=np.float64) / numbers,
        removal=removal,
        curvature=shrunk(measured, prior, times),
    )


def _pixel_areas(
    gaussians: Gaussians, cameras: Sequence[Camera], weights: np.ndarray
) -> np.ndarray:
    """Return the area [N] of a pixel at each Gaussian, a mean by weights [V, N]."""
    means = np.asarray(gaussians.params.means, np.float64)
    total = np.zeros(len(means))
    for camera, weight in zip(cameras, weights):
        focal = float(np.sqrt(abs(np.linalg.det(np.asarray(camera.K)[:2, :2]))))
        distances = np.linalg.norm(means - _centre(camera), axis=1)
        total += weight * np.square(distances / focal)
    return total / np.maximum(weights.sum(0), 1e-30)


def _centre(camera: Camera) -> np.ndarray:
    """Return the centre [3] of a single camera in the world."""
    viewmat = np.asarray(camera.viewmat, np.float64)
    return -viewmat[:3, :3].T @ viewmat[:3, 3]


@partial(jax.jit, static_argnums=4)
def _of_signs(gaussians: Gaussians, camera: Camera, behind, key, config: RasterConfig):
    """Return the gradient of the picture times random signs, as `GaussianParams`."""

    def picture(params):
        scene = gaussians.replace(params=params)  # pyright: ignore
        return render(scene, camera, config, behind).rgb

    image, pull = jax.vjp(picture, gaussians.params)
    assert image is not None
    signs = jax.random.rademacher(key, image.shape, image.dtype)
    return pull(signs)[0]
