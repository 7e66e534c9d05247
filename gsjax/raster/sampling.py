"""Single places of a picture, whole pixels or not, evaluated against all Gaussians.

For measurements that need a picture between its pixels. It projects and blends as
`render` does, without tiles. Axis legend: N Gaussians, R ranks, M points, L splats at a
point, C channels.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians, capacity_bucket
from gsjax.raster.compositing.alpha import evaluate
from gsjax.raster.compositing.blending import Parts
from gsjax.raster.compositing.ordered import blend_ordered
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.primitives.table import with_primitive
from gsjax.raster.render_camera import visible_order
from gsjax.raster.types import Array, Inputs, Projection, RasterConfig

_TOGETHER = 2**22  # Gaussians at points that are evaluated together


@partial(jax.jit, static_argnames="config")
def _project(inputs: Inputs, config: RasterConfig) -> Projection:
    primitive = config.primitive or ELLIPSOID
    order, count = visible_order(primitive, inputs, config)
    return primitive.project(inputs, config, order, count)


@partial(jax.jit, static_argnames="config")
def _alphas(projection: Projection, points: Array, config: RasterConfig) -> Array:
    """Return α [R, M]."""
    splat = projection.splat
    columns = tuple(a[None] for a in (*splat.shape, splat.u, splat.v))
    return evaluate(columns, points.T, config).alpha[0]  # pyright: ignore


@partial(jax.jit, static_argnames="config")
def _blended(
    projection: Projection, ranks: Array, points: Array, config: RasterConfig
) -> Array:
    """Return colours [M, C] of the splats ``ranks`` [M, L] at points [M, 2]."""
    splat, colors = projection.splat, projection.channels.colors.T

    def some(values: Array) -> Array:
        return values.at[ranks].get(mode="fill", fill_value=0)

    columns = [some(a) for a in splat.shape]
    dx, dy = (points[:, i, None] - some(a) for i, a in enumerate((splat.u, splat.v)))
    # A pixel of its own for each point, at the origin.
    at = evaluate((*columns, -dx, -dy), np.zeros((2, 1)), config)
    if not config.sorts_pixels:
        # All are equal, so the order of the list stays.
        keys, config = jnp.zeros_like(at.alpha), config.replace(order="pixel")
    elif splat.key:
        numbers = tuple(some(a)[..., None] for a in splat.key)
        keys = config.primitive.key(numbers, dx[..., None], dy[..., None])
    else:
        assert at.depth is not None
        keys = at.depth
    values = some(colors)
    channels = jnp.concatenate([values, jnp.ones_like(values[..., :1])], -1)
    parts = Parts(columns[0][..., None], channels)
    return blend_ordered(at, parts, keys, config)["sums"][:, :-1, 0]


def sample(
    gaussians: Gaussians,
    camera: Camera,
    points: np.ndarray,
    config: RasterConfig,
    features: Array | None = None,
) -> np.ndarray:
    """Render single places of a picture, over black.

    All Gaussians are evaluated at each, so it suits some thousands.

    Args:
      gaussians: N slots.
      camera: a single camera.
      points: [M, 2] places in px, whole or not.
      config: its primitive, limits and order apply; only colours are rendered.
      features: [N, C] in place of the SH colours.

    Returns:
      [M, C] colours.
    """
    config = with_primitive(config.replace(outputs=("rgb",)))
    projection = _project(Inputs(gaussians, camera, features), config)
    dtype, none = projection.splat.u.dtype, projection.splat.u.shape[0]
    count, block = len(points), min(1024, max(16, _TOGETHER // none))
    padded = np.pad(points, ((0, -count % block), (0, 0)), mode="edge")
    colors = []
    for start in range(0, len(padded), block):
        some = jnp.asarray(padded[start : start + block], dtype)
        seen = np.asarray(_alphas(projection, some, config) > 0).T
        room = capacity_bucket(max(1, int(seen.sum(1).max())))
        ranks = np.full((block, room), none, np.int32)
        for row, shows in zip(ranks, seen):
            found = np.flatnonzero(shows)
            row[: len(found)] = found
        colors.append(np.asarray(_blended(projection, ranks, some, config)))
    return np.concatenate(colors)[:count]
