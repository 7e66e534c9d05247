"""Settings and results of the rasteriser, and the values that its stages exchange.

Axis legend: N Gaussians (capacity), R visible ranks (front to back), H W image,
B cameras, C channels.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer
from jax.experimental import checkify

from gsjax.errors import CapacityError
from gsjax.runtime.settings import convert_fields, require_ranges

if TYPE_CHECKING:
    from gsjax.cameras.camera import Camera
    from gsjax.gaussians import Gaussians

Array = jax.Array
COLOR_LIMIT = 1e32  # a coefficient or feature from here on counts as infinite

OUTPUTS = ("rgb", "alpha", "depth", "median_depth")
STOP_RULES = ("before", "after")
OVERFLOW_RULES = ("flag", "nan")
PROJECTIONS = ("ewa", "unscented")


def _sigma_weights(values) -> bool:
    """Return whether α, β, κ of an unscented transform are usable."""
    if not (isinstance(values, tuple) and len(values) == 3):
        return False
    alpha, beta, kappa = values
    return 1e-3 <= alpha <= 100 and alpha * alpha <= beta < 1e6 and -3 < kappa < 1e6


@dataclass(frozen=True)
class RasterConfig:
    """Static settings of a render; hashable, so pass it as a static argument.

    Accuracy. Gaussians that are left out of a pixel change it by at most D · Σ α, where
    D is the colour range including the background.

    Attributes:
      alpha_min: a Gaussian is left out of a pixel where its α is below this. It also
        sets the extent, sqrt(2 ln(opacity / alpha_min)) standard deviations.
      alpha_max: upper limit of α; at most 1.
      transmittance_min: a pixel stops once its transmittance T has fallen to this.
      stop_rule: "before": a Gaussian that would bring T to ``transmittance_min`` is not
        blended (the rule of Kerbl et al. 2023); "after": it is blended, then the pixel
        stops.
      dilation: px² added to the diagonal of the projected covariance.
      antialias: compensate the opacity for the dilation (Mip-Splatting).
      outputs: images to compute, of `OUTPUTS`; others are not in the program.
      absgrad: make the gradient by ``probe`` of `render` the sum of absolute per-pixel
        gradients (reverse mode only).
      primitive: the `Primitive` that is drawn; None for ellipsoids.
      projection: how an ellipsoid is brought to the image: "ewa" linearises lens and
        shutter at its mean; "unscented" sends seven sigma points through them, for wide
        lenses and large Gaussians. Where a sigma point has no image, EWA is used.
      unscented: α, β, κ of the sigma points (Julier and Uhlmann 1997), β ≥ α².

    Size and speed. None of these changes the image beyond rounding.

    Attributes:
      tile_size: side of a tile in px.
      chunk_size: Gaussians of a tile that chunked compositing blends together.
      tiles_per_step: chunks of tiles composited side by side; None chooses by platform.
      pair_capacity: room for (tile, Gaussian) pairs of a camera; None chooses from the
        sizes. If it is too small, `Render.overflowed` is set and `Render.demand`
        reports the capacity needed; `render_exact` grows it. Unused room costs memory,
        and time in a gradient; `exact_config` fits it.
      visible_capacity: room for Gaussians in view of each camera; None for all slots.
        Reported and grown like ``pair_capacity``.
      on_overflow: "flag" sets `Render.overflowed` only; "nan" also fills the images
        with NaN, so that an incomplete image cannot go unnoticed under jit.
      occlusion: before sorting, cull Gaussians behind pixels that have all stopped. The
        image does not change on a CPU. Pays off where something opaque fills much of
        the view; compiling takes longer.
      num_size_buckets: number of array sizes, each a quarter of the one before, that
        sorting and projection are compiled for; the smallest that fits runs. More than
        one pays off for views that need less than a quarter of their capacity, and
        costs seconds of compiling.
      devices: number of devices that share the tiles; None for all local devices. Use
        1 inside your own `jax.shard_map` (with ``check_vma=False``), `jax.pmap` or
        `jax.set_mesh`.

    Raises:
      InputError: if a setting is out of its range.
    """

    alpha_min: float = 1 / 255
    alpha_max: float = 0.99
    transmittance_min: float = 1e-4
    stop_rule: str = "before"
    dilation: float = 0.3
    antialias: bool = False
    outputs: tuple[str, ...] = ("rgb", "alpha", "depth")
    absgrad: bool = False
    primitive: "Primitive | None" = None
    projection: str = "ewa"
    unscented: tuple[float, float, float] = (1.0, 2.0, 0.0)
    tile_size: int = 8
    chunk_size: int = 32
    tiles_per_step: int | None = None
    pair_capacity: int | None = None
    visible_capacity: int | None = None
    on_overflow: str = "flag"
    occlusion: bool = False
    num_size_buckets: int = 1
    devices: int | None = None

    def __post_init__(self):
        convert_fields(self)
        if isinstance(self.unscented, list):  # from JSON
            object.__setattr__(self, "unscented", tuple(self.unscented))
        outputs = isinstance(self.outputs, tuple) and len(self.outputs) > 0
        outputs = outputs and set(self.outputs) <= set(OUTPUTS)
        own = self.primitive is not None and self.primitive.alpha is not None
        checks = {
            "alpha_min": "(0, 1)",
            "alpha_max": f"({self.alpha_min}, 1]",
            "transmittance_min": "[0, 1)",
            "stop_rule": STOP_RULES,
            "dilation": "[0, 1e9]",  # its square fits float32
            "outputs": (outputs, f"a tuple of {', '.join(OUTPUTS)}"),
            "projection": PROJECTIONS,
            "unscented": (
                _sigma_weights(self.unscented),
                "(α, β, κ): 0 < α² ≤ β, κ > −3",
            ),
            "absgrad": (not (own and self.absgrad), "False for a primitive with own α"),
            "tile_size": "[1, inf)",
            "chunk_size": "[1, inf)",
            "tiles_per_step": "[1, inf)",
            "pair_capacity": f"[1, {2**30})",
            "visible_capacity": "[1, inf)",
            "on_overflow": OVERFLOW_RULES,
            "num_size_buckets": "[1, inf)",
            "devices": "[1, inf)",
        }
        require_ranges(self, checks)

    @classmethod
    def compat(cls, **changes) -> "RasterConfig":
        """The constants of Kerbl et al. (2023): α in 1/255 … 0.99, stop before 1e-4."""
        return cls(**changes)

    @classmethod
    def accurate(cls, **changes) -> "RasterConfig":
        """Within 0.5/255 of the exact image: α from 1e-5, blend then stop at 1e-5.

        Use it where poses are optimised: pose gradients of `compat` can be off by half.
        """
        settings = {
            "alpha_min": 1e-5,
            "alpha_max": 1 - 1e-6,
            "transmittance_min": 1e-5,
            "stop_rule": "after",
        }
        return cls(**{**settings, **changes})

    @classmethod
    def fast(cls, **changes) -> "RasterConfig":
        """α from 1/255, blend then stop at 1e-3: faster than `compat`, errs less."""
        settings = {"alpha_max": 0.999, "transmittance_min": 1e-3, "stop_rule": "after"}
        return cls(**{**settings, **changes})

    def replace(self, **changes) -> "RasterConfig":
        """Return a copy with some settings changed."""
        return replace(self, **changes)


class Footprint(NamedTuple):
    """Ellipses on the image plane, [R] each, front to back; all that lists see.

    The ellipse is Q ≤ reach, with Q = y1² + y2², y1 = inv_sx · dx and
    y2 = √(a / det) · (dy − slope · dx), for the 2D covariance [[a, b], [b, c]].

    Attributes:
      u, v: centre in px.
      inv_sx: 1 / √a.
      slope: b / a.
      var_y: c.
      det: determinant of the covariance.
      reach: largest Q that is drawn; 0 for what cannot be seen.
    """

    u: Array
    v: Array
    inv_sx: Array
    slope: Array
    var_y: Array
    det: Array
    reach: Array


class Splat(NamedTuple):
    """Numbers from which α follows at a pixel, [R] each, front to back.

    Attributes:
      u, v: centre in px.
      shape: further numbers, in the order that `Primitive.alpha` expects. Ellipsoids
        have inv_sx, slope, inv_sy and opacity, so that with dx, dy the offset of a
        pixel y1 = inv_sx · dx, y2 = inv_sy · (dy − slope · dx), Q = y1² + y2² and
        α = opacity · exp(−Q / 2): the exponent cannot turn positive.
    """

    u: Array
    v: Array
    shape: tuple[Array, ...]


class Channels(NamedTuple):
    """Values that are blended, front to back.

    Attributes:
      colors: [C, R] colour or features.
      depth: [R] depth by which Gaussians are ordered.
      probe: [2, R] zeros that collect the absolute gradient, or None.
      alpha_min: [] replaces `RasterConfig.alpha_min`, or None; no derivative is taken.
    """

    colors: Array
    depth: Array
    probe: Array | None = None
    alpha_min: Array | None = None


class Projection(NamedTuple):
    """Gaussians on the image plane: what a primitive returns."""

    footprint: Footprint
    splat: Splat
    channels: Channels


class Box(NamedTuple):
    """Boxes on the image plane, [K] each, px.

    Attributes:
      u, v: centres.
      half_width, half_height: extent to either side.
    """

    u: Array
    v: Array
    half_width: Array
    half_height: Array


class Bounds(NamedTuple):
    """Conservative bounds of Gaussians in view, [K] each.

    Attributes:
      z: depth; infinity for a Gaussian that cannot be visible.
      box: box that holds all pixels with α at or above the limit.
      wide: whether the Gaussian is wide and opaque enough to hide others.
    """

    z: Array
    box: Box
    wide: Array


class Inputs(NamedTuple):
    """Inputs of one camera's render.

    Attributes:
      gaussians: N slots.
      camera: a single camera.
      features: [N, C] in place of SH colours, or None.
      probe: [N, 2] added to the projected means, or the zeros that collect the absolute
        gradient; or None.
      mask: [H, W] bool, pixels to draw; or None for all.
      alpha_min: [] in place of `RasterConfig.alpha_min`, or None.
    """

    gaussians: "Gaussians"
    camera: "Camera"
    features: Array | None = None
    probe: Array | None = None
    mask: Array | None = None
    alpha_min: Array | None = None


class Primitive(NamedTuple):
    """A kind of thing that is drawn, as pure functions; see `gsjax.raster.primitives`.

    Attributes:
      name: the name in files and messages.
      bounds: (active [K], (means, log_scales, logit_opacities), camera, config,
        alpha_min) → `Bounds`; cheap and conservative, for every slot, without
        derivative.
      order_depth: (means [K, 3], camera) → what `Bounds.z` is sorted by, in full
        precision; see `gsjax.raster.lists.sorting`.
      project: (inputs, config, order [R], count []) → `Projection` of the slots
        ``order``, of which the first ``count`` are used. Differentiable.
      occluders: (inputs, config, slots [K], count []) → `Splat` of candidates for
        occlusion culling; or None if the primitive does not support it.
      alpha: (shape, dx, dy) → α before its limits, from the numbers of `Splat.shape`
        and the offset of a pixel from the centre, px. None for the Gaussian form of
        `Splat`, which has kernels of its own. Differentiated by JAX.
    """

    name: str
    bounds: Callable[..., Bounds]
    order_depth: Callable[..., Any]
    project: Callable[..., Projection]
    occluders: Callable[..., Splat] | None = None
    alpha: Callable[..., Array] | None = None


class Demand(NamedTuple):
    """Counts needed, int32; 2³⁰ or more is reported as 2³¹ − 1.

    Attributes:
      visible: Gaussians that may be in view, of the camera that sees most; the
        ``visible_capacity`` that would be enough.
      pairs: (tile, Gaussian) pairs of all cameras.
      capacity: the ``pair_capacity`` that would be enough for the camera that needs
        most. If ``visible`` did not fit, ``pairs`` and this count only those that did.
    """

    visible: Array
    pairs: Array
    capacity: Array


class Render(NamedTuple):
    """Result of a render; a batch of cameras adds a leading axis B to the images.

    Attributes:
      rgb: [H, W, C] colour or features over the background, or None.
      alpha: [H, W] accumulated opacity, or None.
      depth: [H, W] expected depth Σ w z / Σ w; 0 where nothing is. Or None.
      median_depth: [H, W] depth of the Gaussian at which T falls through 1/2; 0 where
        it never does. Or None.
      radii: [N] half the longer side, in px, of the box that a Gaussian covers; 0 if it
        is out of view or culled by ``config.occlusion``.
      demand: counts needed.
      overflowed: [] bool; True if a capacity was too small and the image is incomplete.
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
        """[N] bool, True for Gaussians in view; see ``radii``."""
        return self.radii > 0

    def check(self) -> "Render":
        """Return the result itself if nothing overflowed.

        Under `jax.jit`, functionalise the caller with `jax.experimental.checkify`.

        Raises:
          CapacityError: if a capacity was too small; the message names the setting.
        """
        message = (
            "render: RasterConfig.pair_capacity or visible_capacity is too small; use "
            "gsjax.exact_config(gaussians, camera, config)"
        )
        if isinstance(self.overflowed, Tracer):
            checkify.check(~self.overflowed, message)
        elif np.any(np.asarray(self.overflowed)):
            demand = self.demand
            raise CapacityError(
                f"{message}, or set pair_capacity to at least {int(demand.capacity)} "
                f"and visible_capacity to at least {int(demand.visible)}"
            )
        return self
