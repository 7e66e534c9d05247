"""The picture of one camera: order, project, rasterise; then what lies behind it.

Axis legend: N Gaussians (capacity), H W image, B cameras, C channels.
"""

from dataclasses import dataclass, fields
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.math.numerics import safe_divide
from gsjax.raster.argument_checks import check_real
from gsjax.raster.lists import binning
from gsjax.raster.lists.depth_order import depth_order
from gsjax.raster.primitives.ellipsoid import project
from gsjax.raster.tile_render import device_count, rasterise
from gsjax.raster.types import COLOR_LIMIT, Array, Demand, RasterConfig
from gsjax.runtime.devices import on_cpu, shard_rows


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("viewmat", "K", "near", "far", "size"),
    meta_fields=("width", "height", "model"),
)
@dataclass(frozen=True)
class _Corner(Camera):
    """A camera of whose image the upper left corner is shown alone.

    Attributes:
      size: [2] its width and height, px.
    """

    size: Array | None = None

    @property
    def shown(self) -> tuple[Array, Array]:
        assert self.size is not None
        return self.size[0], self.size[1]


def _corner(camera: Camera, size: Array) -> _Corner:
    given = {field.name: getattr(camera, field.name) for field in fields(camera)}
    return _Corner(**given, size=size.astype(camera.K.dtype))


def draw(
    gaussians: Gaussians,
    config: RasterConfig,
    features: Array | None,
    camera: Camera,
    probe: Array | None,
    abs_probe: Array | None,
    mask: Array | None,
    size: Array | None,
) -> tuple[dict[str, Array], Array, Demand, Array]:
    """One camera: images before the background, radii [N], demand, overflowed."""
    if size is not None:
        camera = _corner(camera, size)
    # The names that a profile shows.
    with jax.named_scope("order"):
        order, visible = depth_order(gaussians, camera, config, features)
    if features is None and gaussians.sh_degree > 0 and on_cpu():
        # Colours that turn with the view are worth what it costs to bring the parts
        # together again; a mean and a covariance alone are not.
        order = shard_rows(order, device_count(config), fill=gaussians.capacity)
    with jax.named_scope("project"):
        out = project(
            gaussians, camera, config, order, visible, features, probe, abs_probe
        )
    radii = jnp.zeros(gaussians.capacity, out.u.dtype)
    seen = binning.radii(lax.stop_gradient(out), *camera.shown)
    sums, demand, overflowed = rasterise(out, camera.width, camera.height, config, mask)
    room = min(config.visible_capacity or gaussians.capacity, gaussians.capacity)
    return (
        sums,
        radii.at[order].set(seen, mode="drop"),
        demand._replace(visible=visible),
        overflowed | (visible > room),
    )


def finish(
    sums: dict[str, Array], config: RasterConfig, background, cameras: int, colors: int
) -> dict[str, Array]:
    """Background and normalisation: sums [B, H, W, C] to named images."""
    total = sums["sums"]
    alpha = total[..., -1]
    out = {}
    if "rgb" in config.outputs:
        rgb = total[..., :colors]
        if background is not None:
            check_real("background", background)
            background = jnp.asarray(background, rgb.dtype)
            if background.shape not in ((colors,), (cameras, colors)):
                raise InputError(
                    f"background has shape {background.shape}; ({colors},) or "
                    f"({cameras}, {colors}) is wanted"
                )
            # What is not finite would show through wherever the scene is not opaque.
            background = jnp.where(jnp.abs(background) < COLOR_LIMIT, background, 0)
            background = jnp.broadcast_to(background, (cameras, colors))
            # As a product: its transpose is one too, not a sum over few channels.
            rgb = rgb + jnp.einsum(
                "bhw,bc->bhwc", 1 - alpha, background, precision="highest"
            )
        out["rgb"] = rgb
    if "alpha" in config.outputs:
        out["alpha"] = alpha
    if "depth" in config.outputs:
        out["depth"] = safe_divide(total[..., -2], alpha, alpha > 1e-10)
    if "median_depth" in config.outputs:
        out["median_depth"] = sums["median"]
    return out
