"""The protocol of a compositing kernel, and the values that it takes.

Axis legend: R ranks (front to back), T tiles of a device, P pixels of a tile,
C channels.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from gsjax.raster.forms import Form
from gsjax.raster.lists.binning import Grid, Lists
from gsjax.raster.types import Array, Channels, RasterConfig, Splat

Images = dict[str, Array]


class Tiles(NamedTuple):
    """Inputs of compositing on one device.

    Attributes:
      splat, channels: [R].
      lists: sorted tile lists.
      device: [] number of the device.
    """

    splat: Splat
    channels: Channels
    lists: Lists
    device: Array


def form_of(config: RasterConfig) -> Form | None:
    """Return the form of the splats; None for the Gaussian form of `Splat`."""
    primitive = config.primitive
    if primitive is None or primitive.form is not None:
        return None if primitive is None else primitive.form
    return primitive.ray_form if config.blends_ray_depth else None


def has_ray_depth(config: RasterConfig) -> bool:
    """Return whether the depth of a splat varies from pixel to pixel."""
    form = form_of(config)
    return form is not None and form.has_depth


def summed_channels(config: RasterConfig, colors: int) -> dict[str, int]:
    """Return the channels of "sums" in their order, with the number of each.

    The disparities are 1 / z and 1 / z²; ones give alpha.

    Args:
      config: static settings.
      colors: number of colours and features.
    """
    outputs, of_mean = config.outputs, not has_ray_depth(config)
    there = {
        "colors": colors * ("rgb" in outputs or "features" in outputs),
        "normals": 3 * ("normals" in outputs),
        "depth": 1 * (of_mean and "depth" in outputs),
        "disparities": 2 * (of_mean and "distortion" in outputs),
        "ones": 1,
    }
    return {name: count for name, count in there.items() if count}


def pixel_channels(config: RasterConfig) -> tuple[str, ...]:
    """Return the blended values that vary from pixel to pixel, images of their own."""
    if not has_ray_depth(config):
        return ()
    there = ("depth",) if "depth" in config.outputs else ()
    return (*there, "disparity", "square") if "distortion" in config.outputs else there


def single_images(config: RasterConfig) -> tuple[str, ...]:
    """Return the names of the images beside "sums", [T, P] each."""
    median = ("median",) if "median_depth" in config.outputs else ()
    late = ("misordered",) if config.sorts_pixels else ()
    return (*pixel_channels(config), *median, *late)


class Task(NamedTuple):
    """Static description of compositing on one device; hashable.

    Attributes:
      platform: as JAX names it.
      colors: number of colour channels.
      itemsize: bytes of a number.
      grid: tiles of the device.
      config: static settings.
      room_for_all: whether chunked compositing has room for any lists, instead of for
        those that its ``capacity`` accepts.
    """

    platform: str
    colors: int
    itemsize: int
    grid: Grid
    config: RasterConfig
    room_for_all: bool = False

    @property
    def channels(self) -> int:
        """Number of blended channels."""
        summed = sum(summed_channels(self.config, self.colors).values())
        return summed + len(pixel_channels(self.config))


class ReversePass(NamedTuple):
    """A reverse pass written by hand.

    Attributes:
      suits: task → whether it is available.
      forward: (tiles, task) → images, residuals.
      backward: (tiles, residuals, cotangents of the images except "median", task,
        kinds) → cotangents of (splat, channels). ``kinds`` is a subset of {"splats",
        "channels"}; cotangents of the other kind may be zeros.
    """

    suits: Callable[[Task], bool]
    forward: Callable[[Tiles, Task], tuple[Images, Any]]
    backward: Callable[..., tuple[Splat, Channels]]


class Compositor(NamedTuple):
    """A compositing kernel.

    Images are {"sums": [T, C, P], see `summed_channels`; "depth" and the like [T, P],
    see `pixel_channels`; "median": [T, P] if asked for; "misordered": [T, P] counts
    for `Render.misordered`, if each pixel has an order of its own}, before the
    background, T in the order of the grid.

    Attributes:
      name: for messages.
      suits: task → whether the kernel is available and fast.
      forward: (tiles, task) → images. No derivative is taken of it, unless it is
        ``differentiable`` itself.
      differentiable: (tiles, task) → the same images, which JAX differentiates in any
        mode and order; or None.
      reverse: a `ReversePass`, or None to let JAX differentiate.
      capacity: (lists, task) → [] pair capacity that would have been enough.
      memory: (pair capacity of a device, task, gradients) → (numbers taken on a device,
        of which are kept for a gradient).
    """

    name: str
    suits: Callable[[Task], bool]
    forward: Callable[[Tiles, Task], Images]
    differentiable: Callable[[Tiles, Task], Images] | None
    reverse: ReversePass | None
    capacity: Callable[[Lists, Task], Array]
    memory: Callable[[int, Task, bool], tuple[int, int]]


def listed_pairs(lists: Lists, task: Task) -> Array:
    """Return the number of pairs: the capacity of kernels that need no further room."""
    del task
    return lists.pairs
