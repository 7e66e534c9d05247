"""Static settings of the rasteriser."""

from dataclasses import dataclass, replace
from typing import Any

from gsjax.runtime.settings import convert_fields, require_ranges

OUTPUTS = (
    *("rgb", "features", "normals", "alpha"),
    *("depth", "median_depth", "distortion"),
)
DEPTHS = {"depth", "median_depth", "distortion"}  # outputs that blend depth
PRIMITIVES = ("ellipsoid", "surfel", "surfel_area")
STOP_RULES = ("before", "after")
OVERFLOW_RULES = ("flag", "nan")
PROJECTIONS = ("ewa", "unscented")
ORDERS = ("center", "window", "pixel")


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
      ray_depth: blend the depth of the point at which the ray of a pixel meets a
        Gaussian, instead of that of its mean: the densest point along the ray (Zhang et
        al. 2024, RaDe-GS). Surfels always do.
      primitive: kind of Gaussian: "ellipsoid"; "surfel", flat, with the low-pass
        filter of Huang et al. (2024); "surfel_area", which filters by ``dilation`` and
        ``antialias`` instead; or a `Primitive`. None for ellipsoids.
      projection: how an ellipsoid is brought to the image: "ewa" linearises lens and
        shutter at its mean; "unscented" sends seven sigma points through them, for wide
        lenses and large Gaussians. Where a sigma point has no image, EWA is used.
      unscented: α, β, κ of the sigma points (Julier and Uhlmann 1997), β ≥ α².
      order: by which Gaussians are blended front to back. "center": the depth of their
        means, the same for all pixels; an image then pops when the camera turns.
        "pixel": the depth of the point that each pixel shows, the densest along its ray
        (Radl et al. 2024, StopThePop), sorted exactly; the reference, and slow.
        "window": by the same depths, in a buffer of ``order_window`` Gaussians for
        each pixel, through which the list of a tile runs; `Render.misordered` counts
        those that come too late.
      order_window: Gaussians that wait in the buffer of each pixel.

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
    ray_depth: bool = False
    primitive: Any = None
    projection: str = "ewa"
    unscented: tuple[float, float, float] = (1.0, 2.0, 0.0)
    order: str = "center"
    order_window: int = 2
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
        checks = {
            "alpha_min": "(0, 1)",
            "alpha_max": f"({self.alpha_min}, 1]",
            "transmittance_min": "[0, 1)",
            "stop_rule": STOP_RULES,
            "dilation": "[0, 1e9]",  # its square fits float32
            "outputs": (outputs, f"a tuple of {', '.join(OUTPUTS)}"),
            "primitive": (
                not isinstance(self.primitive, str) or self.primitive in PRIMITIVES,
                f"a gsjax.raster.types.Primitive or one of {', '.join(PRIMITIVES)}",
            ),
            "projection": ("ewa",) if self.draws_surfels else PROJECTIONS,
            "unscented": (
                _sigma_weights(self.unscented),
                "(α, β, κ): 0 < α² ≤ β, κ > −3",
            ),
            "order": ORDERS,
            "order_window": "[1, 64]",
            "occlusion": (
                not (self.occlusion and self.sorts_pixels),
                'False with order "window" and "pixel": what is behind one pixel may '
                "be in front of the next",
            ),
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

    @property
    def draws_surfels(self) -> bool:
        """True if the Gaussians are drawn as surfels."""
        name = getattr(self.primitive, "name", self.primitive)
        return f"{name}".startswith("surfel")

    @property
    def sorts_pixels(self) -> bool:
        """True if each pixel blends in an order of its own."""
        return self.order != "center"

    @property
    def blends_ray_depth(self) -> bool:
        """True if ellipsoids are evaluated with their depth along each ray."""
        return self.ray_depth and bool(DEPTHS & {*self.outputs})

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
