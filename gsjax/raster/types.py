"""Settings and results of the rasteriser's stages.

Axis legend: N Gaussians (capacity), R visible ranks (front to back), P pairs,
S steps, G tiles of a step, K Gaussians of a chunk, H W image, B cameras, C channels.
"""

from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax

from gsjax.runtime.settings import require_ranges, settle

Array = jax.Array
COLOR_LIMIT = 1e32  # a coefficient or feature from there on counts as infinite

OUTPUTS = ("rgb", "alpha", "depth", "median_depth")
STOP_RULES = ("before", "after")


@dataclass(frozen=True)
class RasterConfig:
    """Static settings of a render; hashable, so pass it as a static argument.

    Accuracy. What is left out at a pixel changes it by at most D · Σ α of the
    Gaussians left out, D being the colour range including the background.

    Attributes:
      alpha_min: a Gaussian is left out of a pixel where its α is below this; it
        also sets the extent, sqrt(2 ln(opacity / alpha_min)) standard deviations.
      alpha_max: α is at most this; at most 1.
      stop: a pixel stops once its transmittance T has fallen to this.
      stop_rule: "before": a Gaussian that would bring T to ``stop`` is not blended
        (the field's rule); "after": it is blended, then the pixel stops.
      dilation: px² added to the diagonal of the projected covariance.
      antialias: compensate the opacity for the dilation (Mip-Splatting).
      outputs: what to compute, of `OUTPUTS`; the rest is not in the program.
      absgrad: let ``abs_probe`` of `render` collect per-pixel absolute gradients;
        reverse mode only.

    Size and speed. None of these changes the image beyond rounding.

    Attributes:
      tile_size: pixels along the side of a tile.
      chunk_size: Gaussians of a tile composited in one go, where it goes by chunks.
      tiles_per_step: chunks of tiles composited side by side; None chooses by
        platform.
      pair_capacity: room for (tile, Gaussian) pairs of a camera; None chooses from
        the sizes. If it is too small, `Render.overflowed` is set and `Render.demand`
        says what was wanted; `render_exact` regrows. Unused room costs memory, and
        time, most of all in a gradient: fit it with `exact_config`.
      visible_capacity: room for Gaussians in view (of each camera); None means all
        slots. Reported and regrown like ``pair_capacity``.
      occlusion: leave out, before sorting, what lies behind pixels that have all
        stopped. Bit-equal on a CPU; pays where something opaque fills part of the view.
      num_size_buckets: how many sizes, each a quarter of the one before, sorting by depth is
        compiled for; the smallest that fits is run. Sorting pairs, on accelerators,
        has sizes between them; from 2 on there is a small size of projecting, from 4 on
        the gradient of compositing by chunks has sizes too, two fewer, and on
        accelerators from 3 on all of compositing, one fewer. Each takes seconds to
        compile, and saves time where a view needs a quarter of its capacity or less.
      devices: how many devices share the tiles (and on CPUs the projection, where
        colours turn with the view); None means all local ones. Within a
        `jax.shard_map` of your own: 1, and ``check_vma=False`` there; within
        `jax.pmap` or `jax.set_mesh`: 1.

    Raises:
      InputError: if a setting is out of its range.
    """

    alpha_min: float = 1 / 255
    alpha_max: float = 0.99
    stop: float = 1e-4
    stop_rule: str = "before"
    dilation: float = 0.3
    antialias: bool = False
    outputs: tuple[str, ...] = ("rgb", "alpha", "depth")
    absgrad: bool = False
    tile_size: int = 8
    chunk_size: int = 32
    tiles_per_step: int | None = None
    pair_capacity: int | None = None
    visible_capacity: int | None = None
    occlusion: bool = True
    num_size_buckets: int = 3
    devices: int | None = None

    def __post_init__(self):
        settle(self)
        checks = {
            "alpha_min": 0 < self.alpha_min < 1,
            "alpha_max": self.alpha_min < self.alpha_max <= 1,
            "stop": 0 <= self.stop < 1,
            "stop_rule": self.stop_rule in STOP_RULES,
            "dilation": 0 <= self.dilation <= 1e9,  # its square is one of float32
            "outputs": isinstance(self.outputs, tuple)
            and len(self.outputs) > 0
            and set(self.outputs) <= set(OUTPUTS),
            "tile_size": self.tile_size >= 1,
            "chunk_size": self.chunk_size >= 1,
            "tiles_per_step": self.tiles_per_step is None or self.tiles_per_step >= 1,
            "pair_capacity": self.pair_capacity is None
            or 1 <= self.pair_capacity < 2**30,
            "visible_capacity": self.visible_capacity is None
            or self.visible_capacity >= 1,
            "num_size_buckets": self.num_size_buckets >= 1,
            "devices": self.devices is None or self.devices >= 1,
        }
        require_ranges(self, checks)

    @classmethod
    def compat(cls, **changes) -> "RasterConfig":
        """The field's constants: cut 1/255, cap 0.99, stop before 1e-4."""
        return cls(**changes)

    @classmethod
    def accurate(cls, **changes) -> "RasterConfig":
        """Within 0.5/255 of the exact image: cut 1e-5, blend then stop at 1e-5."""
        settings = {
            "alpha_min": 1e-5,
            "alpha_max": 1 - 1e-6,
            "stop": 1e-5,
            "stop_rule": "after",
        }
        return cls(**{**settings, **changes})

    @classmethod
    def fast(cls, **changes) -> "RasterConfig":
        """Cut 1/255, blend then stop at 1e-3: stops earlier, and yet errs less."""
        settings = {"alpha_max": 0.999, "stop": 1e-3, "stop_rule": "after"}
        return cls(**{**settings, **changes})

    def replace(self, **changes) -> "RasterConfig":
        """A copy with some settings changed."""
        return replace(self, **changes)

    def at_cut(self, alpha_min: Array) -> "RasterConfig":
        """A copy with an α cut that is traced, for use within what traces it alone: see
        `gsjax.raster.render.render_at_cut`."""
        config = copy(self)
        object.__setattr__(config, "alpha_min", alpha_min)
        return config


class Projected(NamedTuple):
    """Gaussians on the image plane, [R] each unless said, front to back.

    The 2D covariance is [[a, b], [b, c]] (dilation included), held in a form whose
    exponent cannot turn negative: with dx, dy the offset of a pixel from the mean,
    y1 = inv_sx · dx, y2 = inv_sy · (dy − slope · dx), Q = y1² + y2² and
    α = opacity · exp(−Q / 2).

    Attributes:
      u, v: pixel coordinates of the mean.
      depth: camera z.
      inv_sx: 1 / √a.
      slope: b / a.
      inv_sy: √(a / det).
      var_y: c.
      det: determinant of the covariance.
      opacity: after the sigmoid and, where asked for, the compensation.
      reach: Q at which α falls to the cut; 0 for what cannot be seen.
      colors: [C, R] colour or features.
      compensation: factor that antialiasing puts on the opacity.
      probe: [2, R] zeros or None; collects the absolute gradient.
    """

    u: Array
    v: Array
    depth: Array
    inv_sx: Array
    slope: Array
    inv_sy: Array
    var_y: Array
    det: Array
    opacity: Array
    reach: Array
    colors: Array
    compensation: Array
    probe: Array | None


class Demand(NamedTuple):
    """Counts wanted, int32; a count of 2³⁰ or more is reported as 2³¹ − 1.

    Attributes:
      visible: Gaussians that may be in the view, of the camera that sees most; the
        ``visible_capacity`` that would have been enough.
      pairs: (tile, Gaussian) pairs, of all cameras.
      capacity: the ``pair_capacity`` that would have been enough, of the camera that
        wants most. Where ``visible`` did not fit, this and ``pairs`` count only those
        that did.
    """

    visible: Array
    pairs: Array
    capacity: Array


class Render(NamedTuple):
    """What a render returns; a batch of cameras adds a leading axis B to the images.

    Attributes:
      rgb: [H, W, C] colour or features over the background, or None.
      alpha: [H, W] accumulated opacity, or None.
      depth: [H, W] expected camera z, Σ w z / Σ w; 0 where nothing is. Or None.
      median_depth: [H, W] z of the Gaussian at which T falls through 1/2; 0 where
        it never does. Or None.
      radii: [N] half the longer side, in px, of the box that the Gaussian covers;
        0 where it is out of the view, or left out by ``config.occlusion``.
      demand: the counts wanted.
      overflowed: [] bool; True if the capacity was too small, and the image
        therefore is not exact.
    """

    rgb: Array | None
    alpha: Array | None
    depth: Array | None
    median_depth: Array | None
    radii: Array
    demand: Demand
    overflowed: Array

    @property
    def visible(self) -> Array:
        """[N] bool: which Gaussians are in the view; see ``radii``."""
        return self.radii > 0
