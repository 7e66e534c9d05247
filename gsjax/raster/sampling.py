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
from gsjax.raster.compositing.blending import Chunk, evaluated, tables_of
from gsjax.raster.compositing.chunked import take_rows
from gsjax.raster.compositing.ordered import blend_ordered, keys_at
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
    tables = tables_of(projection.splat, projection.channels, config)
    # Each point is the only pixel of a tile whose corner it is.
    chunk, pixel = Chunk(take_rows(tables, ranks), points), np.zeros((2, 1))
    at = evaluated(chunk, pixel, config)
    if config.sorts_pixels:
        keys = keys_at(chunk, at, pixel, config)
    else:
        # All are equal, so the order of the list stays.
        keys, config = jnp.zeros_like(at.alpha), config.replace(order="pixel")
    return blend_ordered(at, chunk.parts, keys, config)["sums"][:, :-1, 0]


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
