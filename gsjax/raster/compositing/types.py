"""The protocol of a compositing kernel, and the values that it takes.

Axis legend: R ranks (front to back), T tiles of a device, P pixels of a tile,
C channels.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

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
        """Number of blended channels: colours, depth if asked for, ones."""
        outputs = self.config.outputs
        return self.colors * ("rgb" in outputs) + ("depth" in outputs) + 1

    @property
    def gaussian_form(self) -> bool:
        """True if α has the Gaussian form of `Splat`."""
        primitive = self.config.primitive
        return primitive is None or primitive.alpha is None


class ReversePass(NamedTuple):
    """A reverse pass written by hand.

    Attributes:
      suits: task → whether it is available.
      forward: (tiles, task) → images, residuals.
      backward: (tiles, residuals, cotangent of "sums" [T, C, P], task, kinds) →
        cotangents of (splat, channels). ``kinds`` is a subset of {"splat", "channels"};
        cotangents of the other kind may be zeros.
    """

    suits: Callable[[Task], bool]
    forward: Callable[[Tiles, Task], tuple[Images, Any]]
    backward: Callable[..., tuple[Splat, Channels]]


class Compositor(NamedTuple):
    """A compositing kernel.

    Images are {"sums": [T, C, P] with colour, depth if asked for, and alpha; "median":
    [T, P] if asked for}, before the background, T in the order of the grid.

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
