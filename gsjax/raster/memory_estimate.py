"""Estimate of the memory that a render takes, from its sizes alone.

Counted, and compared with what XLA reports of its programs. Lists and the gradient of
compositing go with the pairs, the loss with the pixels, and the devices share both;
projection goes with the Gaussians, on each device.
"""

import jax

from gsjax.raster.compositing.compositor import choose, choose_for_gradient
from gsjax.raster.compositing.types import Task
from gsjax.raster.lists import binning
from gsjax.raster.primitives.table import with_primitive
from gsjax.raster.tile_render import default_pair_capacity
from gsjax.raster.types import RasterConfig
from gsjax.runtime.devices import platform_name
from gsjax.runtime.memory import Estimate

_PAIRS = "for (tile, Gaussian) pairs"
_GAUSSIANS, _IMAGES = "for projected Gaussians", "for images"

_IN_LISTS = 4  # numbers of a pair, while it is sorted
# Numbers of a Gaussian beside its parameters in all stages; with gradients; and those
# kept for the gradient of another camera.
_PROJECTED, _PROJECTED_BACKWARD, _KEPT = 42, 60, 32
# Bytes of a pixel: images and their tiles; with gradients; and the blurred planes of
# SSIM, which the devices share.
_OF_PIXEL, _OF_PIXEL_BACKWARD, _BLURRED = 26, 35, 240


def render_estimate(
    slots: int,
    bases: int,
    size: tuple[int, int],
    config: RasterConfig,
    *,
    cameras: int = 1,
    gradients: bool = False,
    width: int = 4,
) -> Estimate:
    """Return the memory that a render takes beside its inputs, on all devices together.

    Within 1.5 times what XLA reserves, where pairs decide and where Gaussians do.

    Args:
      slots: capacity of the Gaussians.
      bases: spherical-harmonic bases of each.
      size: (width, height) of the images, px.
      config: static settings.
      cameras: images in one call, rendered one after another; what their gradients need
        is kept.
      gradients: whether a reverse-mode gradient is taken, as in a training step.
      width: bytes of a number.
    """
    devices = config.devices or jax.local_device_count()
    grid = binning.make_grid(*size, config.tile_size, devices)
    seen = min(slots, config.visible_capacity or slots)
    capacity = config.pair_capacity or default_pair_capacity(seen, grid)
    share = -(-capacity // devices)
    numbers = 11 + 3 * bases
    config = with_primitive(config)
    task = Task(platform_name(), 3, width, grid, config)
    compositor = choose_for_gradient(task) if gradients else choose(task)
    blended, kept = compositor.memory(share, task, gradients)
    pairs = _IN_LISTS * 4 * share + width * blended
    of_gaussians = _PROJECTED + numbers
    if gradients:  # of one camera
        of_gaussians = _PROJECTED_BACKWARD + 3 * numbers
    gaussians = seen * of_gaussians
    each = devices * (_OF_PIXEL_BACKWARD if gradients else _OF_PIXEL)
    pixels = size[0] * size[1] * cameras * (each + (_BLURRED if gradients else 0))
    parts = {
        _PAIRS: devices * pairs,
        _GAUSSIANS: devices * width * gaussians,
        _IMAGES: pixels * width // 4,
    }
    # One of these two stages ends before the other begins.
    stages = (_PAIRS, _IMAGES) if gradients else (_PAIRS, _GAUSSIANS)
    del parts[min(stages, key=lambda name: parts[name])]
    if gradients:
        kept += seen * (numbers + _KEPT)
        parts["kept for other cameras"] = devices * width * kept * (cameras - 1)
    else:
        parts["for copies of the scene"] = (devices - 1) * width * slots * numbers
    return Estimate(parts)
