"""Importance of each Gaussian, and of each of its numbers, to pictures.

Axis legend: N Gaussians (capacity), V views, H W image.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera, resize_camera
from gsjax.compression.curvature import shape_curvature
from gsjax.gaussians import Gaussians
from gsjax.raster.contribution import contribution
from gsjax.raster.exact import exact_config
from gsjax.raster.types import RasterConfig
from gsjax.runtime.console import progress

MAX_VIEWS = 48
MAX_SIZE = 480  # px of the longer side, of pictures from which importance is measured


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
        of `GaussianParams` without harmonics, by `shape_curvature`.
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
) -> Importance:
    """Measure the importance of Gaussians on the pictures of some cameras.

    Args:
      gaussians: N slots, concrete.
      cameras: single cameras, see `sample_cameras`.
      config: render settings.
      background: RGB behind the scene.

    Raises:
      InputError, CapacityError: as `render_exact`.
    """
    behind = jnp.asarray(background, gaussians.params.means.dtype)
    config = _fitted(gaussians, cameras, config)
    found = []
    for camera in progress(cameras, "importance"):
        one = contribution(gaussians, camera, config, behind)
        found.append([np.asarray(values, np.float32) for values in one])
    total, largest, energy, removal = (np.stack(some) for some in zip(*found))
    numbers = sum(3 * camera.width * camera.height for camera in cameras)
    removal = removal.sum(0, dtype=np.float64) / numbers
    params = gaussians.params.__dict__
    curvature = shape_curvature(
        {name: np.asarray(values) for name, values in params.items()},
        removal,
        config.dilation * _pixel_areas(gaussians, cameras, total),
    )
    return Importance(
        shares=total / np.float32(numbers),
        centres=np.stack([_centre(camera) for camera in cameras]),
        largest=largest.max(0),
        energy=energy.sum(0, dtype=np.float64) / numbers,
        removal=removal,
        curvature=curvature,
    )


def _fitted(
    gaussians: Gaussians, cameras: Sequence[Camera], config: RasterConfig
) -> RasterConfig:
    """Return settings with capacities for all cameras: one program serves them all."""
    config = config.replace(
        outputs=("rgb",), order="center", absgrad=False, num_size_buckets=1
    )
    each = [exact_config(gaussians, camera, config) for camera in cameras]
    return config.replace(
        pair_capacity=max(one.pair_capacity or 1 for one in each),
        visible_capacity=max(one.visible_capacity or 1 for one in each),
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
