"""The door of the rasteriser.

`render` may be called under any transformation of JAX. Outside of one it runs a
compiled program, which is kept by config and shapes.
"""

import jax
import jax.numpy as jnp
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.raster.argument_checks import batched_inputs, check_types
from gsjax.raster.lists.counting import total_count
from gsjax.raster.primitives.table import with_primitive
from gsjax.raster.render_camera import finish, mark_overflow, render_camera
from gsjax.raster.types import Array, Demand, Inputs, RasterConfig, Render
from gsjax.runtime.devices import platform_name

DEFAULT_CONFIG = RasterConfig()


def render(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
    background: Array | None = None,
    *,
    mask: Array | None = None,
    features: Array | None = None,
    probe: Array | None = None,
    alpha_min: Array | None = None,
) -> Render:
    """Render Gaussians by exact, sorted, front-to-back splatting (Kerbl et al. 2023).

    Differentiable in every float of ``gaussians``, ``camera``, ``background``,
    ``features`` and ``probe``, in any mode and order, and under `jax.vmap`. Compiled
    when called outside of `jax.jit`; compilation takes some seconds for each config and
    each set of shapes.

    Args:
      gaussians: N slots.
      camera: one camera, or a batch B, rendered one after another.
      config: static settings.
      background: [C] or [B, C]; black by default. Components that are not finite count
        as black.
      mask: [H, W] bool, or [B, H, W] for a batch: the pixels to draw. Tiles without any
        are skipped; other pixels, and gradients by them, are undefined. `Demand.pairs`
        leaves out tiles before the first and after the last masked tile of a row.
      features: [N, C] composited in place of the SH colour; or beside it with
        "features" in ``config.outputs``.
      probe: [N, 2], or [B, N, 2] for a batch, zeros: added to the projected means in
        px. Its gradient is the screen-space statistic of densification; with
        ``config.absgrad``, the sum over pixels of the absolute per-pixel gradient.
      alpha_min: [] number in place of ``config.alpha_min``, which may be traced: one
        program serves all values. No derivative goes through it.

    Returns:
      `Render`. If ``overflowed`` is set, the image is incomplete, and
      ``demand.capacity`` is the `RasterConfig.pair_capacity` that would be enough;
      `Render.check` raises an error in that case.

    Raises:
      InputError: if an argument is of the wrong class or shape, a number is complex,
        there is no camera or no slot, or the lens does not suit the primitive.
    """
    check_types(gaussians, camera, config)
    if config.absgrad and probe is None:
        raise InputError("probe: expected zeros with config.absgrad, got None")
    # Tracers cannot index NumPy arrays.
    gaussians = jax.tree.map(jnp.asarray, gaussians)
    values = (background, features, probe, mask, alpha_min)
    background, features, probe, mask, alpha_min = (
        None if value is None else jnp.asarray(value) for value in values
    )
    if "features" in config.outputs and features is None:
        raise InputError("features: expected [N, C] for that output, got None")
    inputs = Inputs(gaussians, camera, features, probe, mask, alpha_min)
    config = with_primitive(config)
    return _render_compiled(inputs, background, config, platform_name())


def _render(
    inputs: Inputs, background: Array | None, config: RasterConfig, platform: str
) -> Render:
    del platform  # part of the key of the compiled program: stages depend on it
    single = not inputs.camera.batched
    inputs = batched_inputs(inputs)
    by_camera = (inputs.camera, inputs.probe, inputs.mask)
    count = inputs.camera.viewmat.shape[0]

    def render_one(by_camera):
        camera, probe, mask = by_camera
        one = inputs._replace(camera=camera, probe=probe, mask=mask)
        return render_camera(one, config)

    # One after another: the memory of one camera at a time (a gradient keeps what it
    # needs of each), and the program of one.
    if count == 1:
        out = render_one(jax.tree.map(lambda a: a[0], by_camera))
        sums, radii, demands, flags = jax.tree.map(lambda a: a[None], out)
    else:
        sums, radii, demands, flags = lax.map(render_one, by_camera)
    images = finish(sums, inputs, config, background)
    images = mark_overflow(images, flags, config)
    if single:
        images = {name: image[0] for name, image in images.items()}
        radii = radii[0]
    return Render(
        rgb=images.get("rgb"),
        alpha=images.get("alpha"),
        depth=images.get("depth"),
        median_depth=images.get("median_depth"),
        features=images.get("features"),
        normals=images.get("normals"),
        distortion=images.get("distortion"),
        misordered=_total(sums.get("misordered")),
        radii=radii,
        demand=Demand(
            visible=jnp.max(demands.visible),
            pairs=total_count(demands.pairs)[0],
            capacity=jnp.max(demands.capacity),
        ),
        overflowed=jnp.any(flags),
    )


def _total(counts: Array | None) -> Array | None:
    """Return the sum of counts [B, H, W] as a saturating int32; None of None."""
    if counts is None:
        return None
    return total_count(lax.stop_gradient(counts).astype(jnp.int32).ravel())[0]


# XLA inlines it into the program of a caller that is traced. (With ``inline=True`` an
# eager gradient would compile each operation by itself.)
_render_compiled = jax.jit(_render, static_argnums=(2, 3))
