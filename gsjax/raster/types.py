"""Results of the rasteriser, and the values that its stages exchange.

Axis legend: N Gaussians (capacity), R visible ranks (front to back), H W image,
B cameras, C channels.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer
from jax.experimental import checkify

from gsjax.errors import CapacityError
from gsjax.raster.config import OUTPUTS as OUTPUTS
from gsjax.raster.config import PRIMITIVES as PRIMITIVES
from gsjax.raster.config import RasterConfig
from gsjax.raster.forms import Form

if TYPE_CHECKING:
    from gsjax.cameras.camera import Camera
    from gsjax.gaussians import Gaussians

Array = jax.Array
COLOR_LIMIT = 1e32  # a coefficient or feature from here on counts as infinite


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
      shape: further numbers, in the order that `Primitive.form` expects, the opacity
        last. Ellipsoids have inv_sx, slope, inv_sy and opacity, so that with dx, dy the
        offset of a pixel y1 = inv_sx · dx, y2 = inv_sy · (dy − slope · dx),
        Q = y1² + y2² and α = opacity · exp(−Q / 2): the exponent cannot turn positive.
      key: numbers that `Primitive.key` expects; none with `RasterConfig.order`
        "center". No derivative is taken of them.
    """

    u: Array
    v: Array
    shape: tuple[Array, ...]
    key: tuple[Array, ...] = ()


class Channels(NamedTuple):
    """Values that are blended, front to back.

    Attributes:
      colors: [C, R] colour or features.
      depth: [R] depth by which Gaussians are ordered.
      probe: [2, R] zeros that collect the absolute gradient, or None.
      alpha_min: [] replaces `RasterConfig.alpha_min`, or None; no derivative is taken.
      normals: [3, R] unit normals in camera coordinates, or None.
    """

    colors: Array
    depth: Array
    probe: Array | None = None
    alpha_min: Array | None = None
    normals: Array | None = None


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

    def replaces_colors(self, config: RasterConfig) -> bool:
        """Return whether features stand in for the SH colours."""
        if self.features is None:
            return False
        return "features" not in config.outputs or "rgb" not in config.outputs


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
      form: the `Form` of its splats; None for the Gaussian form of `Splat`, which has
        kernels of its own.
      ray_form: the form with `RasterConfig.ray_depth`, if ``form`` is None and depth is
        blended; `project` then returns the numbers for it.
      key: (numbers of `Splat.key`, offsets dx, dy of a pixel from the centre) → the
        depth by which the pixel orders its splats, without derivative; None for the
        depth of ``form``.
    """

    name: str
    bounds: Callable[..., Bounds]
    order_depth: Callable[..., Any]
    project: Callable[..., Projection]
    occluders: Callable[..., Splat] | None = None
    form: Form | None = None
    ray_form: Form | None = None
    key: Callable[[tuple[Array, ...], Array, Array], Array] | None = None


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
      depth: [H, W] expected depth Σ w z / Σ w; 0 where nothing is. Or None. With w = α
        T, z is the depth of the mean, or with `RasterConfig.ray_depth` that of the
        point where the ray of the pixel meets the Gaussian.
      median_depth: [H, W] depth z of the Gaussian at which T falls through 1/2; 0 where
        it never does. Or None.
      features: [H, W, C] features Σ w f, without background; or None.
      normals: [H, W, 3] Σ w n of unit normals that face the camera, in its coordinates.
        Their length tells how well they agree. Or None.
      misordered: [] int32, number of times that a pixel blends a Gaussian behind one
        that it should be in front of, over all cameras; 0 with ``order="pixel"``, None
        with "center". The image is that of exact order if it is 0.
      distortion: [H, W] Σ_{i<j} w_i w_j (1 / z_i − 1 / z_j)², the depth distortion of
        Huang et al. (2024) over the square of near far / (far − near). Or None.
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
    features: Array | None = None
    normals: Array | None = None
    distortion: Array | None = None
    misordered: Array | None = None

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
