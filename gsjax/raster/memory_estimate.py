"""How much memory a render takes, worked out from its sizes alone.

Not measured but counted, and then held against what XLA says of its programs and what
processes came to: jax 0.10.2, one and two CPU devices. What binning and the gradient of
compositing take goes with the pairs, what the loss takes with the pixels, and both are
shared by the devices; what projection takes goes with the Gaussians, and each has its
own. Without a gradient, compositing takes what a step of its loops does, at most; on
accelerators it takes its share for every chunk (of one GPU a process took 3.5 GB, where
4.1 are counted).

Axis legend: P pixels of a tile, K Gaussians of a chunk, C channels.
"""

import jax

from gsjax.raster.compositing import fused, fused_vjp, parallel, schedules
from gsjax.raster.lists import binning
from gsjax.raster.tile_render import default_pair_capacity
from gsjax.raster.types import RasterConfig
from gsjax.runtime.devices import on_cpu
from gsjax.runtime.memory import Estimate

_PAIRS = "for (tile, Gaussian) pairs"
_GAUSSIANS, _PICTURES = "for projected Gaussians", "for pictures"

# Where gradients are taken, numbers of a Gaussian in a chunk beside its channels: rank,
# place, ellipse, opacity; and how many more the backward pass makes of it.
_IN_CHUNK, _IN_CHUNK_LEARNT = 7, 8
_IN_LISTS = 4  # of a pair, while it is sorted
_IN_STEP = 3  # of a Gaussian at a pixel, while a chunk is blended
# Of a Gaussian beside its own numbers, as all stages come to; with gradients; and what
# is kept of it for another camera.
_PROJECTED, _PROJECTED_LEARNT, _KEPT = 42, 60, 32
# Bytes of a pixel: images and their tiles; with gradients; and what SSIM blurs, which
# the devices share (on accelerators the pairs are always more).
_OF_PIXEL, _OF_PIXEL_LEARNT, _BLURRED = 26, 35, 240


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
    """What a render takes beside its inputs, on all devices together.

    Within 1.5 times what XLA reserves, where pairs decide and where Gaussians do.

    Args:
      slots: capacity of the Gaussians.
      bases: spherical harmonics of each.
      size: (width, height) of the images, px.
      config: static settings.
      cameras: images in one call, made in turn; what their gradients need is kept.
      gradients: whether by reverse mode, as in a training step.
      width: bytes of a number.
    """
    devices = config.devices or jax.local_device_count()
    grid = binning.make_grid(*size, config.tile_size, devices)
    seen = min(slots, config.visible_capacity or slots)
    capacity = config.pair_capacity or default_pair_capacity(seen, grid)
    share = -(-capacity // devices)
    channels = 1 + 3 * ("rgb" in config.outputs) + ("depth" in config.outputs)
    numbers = 11 + 3 * bases
    by_turns = on_cpu()
    count = _by_turns if by_turns else _side_by_side
    if gradients and by_turns and fused_vjp.suits(3, width, grid, config):
        blended = kept = fused.look_capacity(share, grid) * config.tile_size**2
    else:
        blended, kept = count(share, grid, config, channels, gradients)
    pairs = _IN_LISTS * 4 * share + width * blended
    of_gaussians = _PROJECTED + numbers
    if gradients:  # of one camera; of the others there is what is kept for it
        of_gaussians = _PROJECTED_LEARNT + 3 * numbers
    gaussians = seen * of_gaussians
    each = devices * (_OF_PIXEL_LEARNT if gradients else _OF_PIXEL)
    pixels = size[0] * size[1] * cameras * (each + (_BLURRED if gradients else 0))
    parts = {
        _PAIRS: devices * pairs,
        _GAUSSIANS: devices * width * gaussians,
        _PICTURES: pixels * width // 4,
    }
    # Of these two, one is over before the other begins.
    stages = (_PAIRS, _PICTURES) if gradients else (_PAIRS, _GAUSSIANS)
    del parts[min(stages, key=lambda name: parts[name])]
    if gradients:
        kept += seen * (numbers + _KEPT)
        parts["kept of other cameras"] = devices * width * kept * (cameras - 1)
    else:
        parts["to share the scene"] = (devices - 1) * width * slots * numbers
    return Estimate(parts)


def _by_turns(
    share: int, grid: binning.Grid, config: RasterConfig, channels: int, gradients: bool
) -> tuple[int, int]:
    """Numbers that blending takes of a device, and those it keeps for a gradient."""
    group = schedules.tiles_per_step(config, grid)
    rows = group * schedules.step_capacity(share, grid, group, config.chunk_size)
    pixels, in_chunk = config.tile_size**2, _IN_CHUNK + channels
    blended = _IN_STEP * group * config.chunk_size * pixels
    if gradients:
        learnt = 2 * in_chunk + _IN_CHUNK_LEARNT
        blended += rows * (config.chunk_size * learnt + pixels)
    return blended, rows * (config.chunk_size * in_chunk + pixels)


def _side_by_side(
    share: int, grid: binning.Grid, config: RasterConfig, channels: int, gradients: bool
) -> tuple[int, int]:
    """As `_by_turns`, of accelerators."""
    entries = parallel.entry_capacity(share, grid, config.chunk_size)
    batch = min(parallel.batch_size(config), entries)
    pixels, in_chunk = config.tile_size**2, _IN_CHUNK + channels
    kept = entries * (config.chunk_size * in_chunk + (2 + channels) * pixels)
    step = batch * config.chunk_size * pixels
    if not gradients:
        return _IN_STEP * step + kept + entries * channels * pixels, kept
    learnt = config.chunk_size * (in_chunk + _IN_CHUNK_LEARNT)
    more = entries * (learnt + 2 * channels * pixels)
    return 2 * _IN_STEP * step + kept + more, kept
