"""Fusion of depth images in a truncated signed distance field (Curless and Levoy 1996).

Axis legend: X Y Z voxels of the grid, B images, H W image.
"""

from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from gsjax.cameras.camera import Camera
from gsjax.errors import InputError
from gsjax.runtime.memory import Estimate, require

Array = jax.Array

_MARGIN = 0.5  # px at the border of an image that do not count


class Grid(NamedTuple):
    """A box of cubic voxels.

    Attributes:
      origin: [3] world coordinates of the centre of the first voxel.
      voxel: side of a voxel, world units.
      shape: numbers of voxels along x, y and z.
    """

    origin: np.ndarray
    voxel: float
    shape: tuple[int, int, int]


class Field(NamedTuple):
    """A truncated signed distance field.

    Attributes:
      distance: [X, Y, Z] signed distance over the truncation, in −1 … 1, positive in
        front of the surface; 1 where no image counts.
      weight: [X, Y, Z] number of images that count.
      colors: [X, Y, Z, 3] mean colour near the surface, or None.
      grid: where the voxels are.
    """

    distance: Array
    weight: Array
    colors: Array | None
    grid: Grid


class DepthImage(NamedTuple):
    """A depth image with its camera.

    Attributes:
      camera: a single camera.
      depth: [H, W] of the camera's lens; 0 where nothing is.
      rgb: [H, W, 3], or None.
    """

    camera: Camera
    depth: Array
    rgb: Array | None = None


def make_grid(low, high, resolution: int) -> Grid:
    """Return a grid over a box, with ``resolution`` voxels along the longest side.

    Args:
      low, high: [3] corners of the box, world units.
      resolution: at least 8.

    Raises:
      InputError: if the box is empty or not finite, or ``resolution`` too small.
    """
    low, high = (np.asarray(v, np.float64) for v in (low, high))
    size = high - low
    if low.shape != (3,) or not (np.isfinite(size).all() and (size > 0).all()):
        raise InputError(
            f"box: expected two corners [3] with low < high, got {low} and {high}; "
            "pass a box that holds the object"
        )
    if not 8 <= resolution <= 4096:
        raise InputError(f"resolution: expected 8 to 4096 voxels, got {resolution}")
    voxel = float(size.max()) / resolution
    shape = tuple(int(n) for n in np.maximum(np.ceil(size / voxel), 2).astype(int))
    return Grid(low + voxel / 2, voxel, shape)  # pyright: ignore


def fuse(
    images: Iterable[DepthImage], grid: Grid, *, truncation: float | None = None
) -> Field:
    """Return the distance field of depth images.

    A voxel takes the mean over the images of (depth − its depth) over the truncation,
    limited to 1. An image does not count where it has no depth, or where the voxel is
    farther behind the surface than the truncation.

    Args:
      images: of any sizes and lenses; each size and lens is compiled once.
      grid: voxels.
      truncation: world units; default four voxels.

    Raises:
      InputError: if no image has any depth in the box.
      CapacityError: if the grid does not fit in memory.
    """
    truncation = truncation or 4 * grid.voxel
    count = int(np.prod(grid.shape))
    require(
        Estimate({"for voxels": 4 * count * 5, "for the step": 4 * count}),
        f"a grid of {' × '.join(map(str, grid.shape))} voxels of {grid.voxel:.4g}",
        "lower the resolution, or pass a smaller box",
    )
    shapes = grid.shape, grid.shape, (*grid.shape, 3), grid.shape
    state = tuple(jnp.zeros(shape, jnp.float32) for shape in shapes)
    origin = jnp.asarray(grid.origin, jnp.float32)
    seen = False
    colored = False
    for image in images:
        rgb = image.rgb
        colored |= rgb is not None
        if rgb is None:
            rgb = jnp.zeros((*image.depth.shape, 3), jnp.float32)
        sizes = grid.voxel, truncation
        state = _add(state, image.camera, image.depth, rgb, origin, *sizes)
        seen = True
    total, weight, colors, near = state
    if not seen or not bool(jnp.any(near > 0)):
        raise InputError(
            "images: no depth image shows a surface in the box; check the box, or "
            "lower the opacity that a surface needs"
        )
    distance = jnp.where(weight > 0, total / jnp.maximum(weight, 1), 1)
    mean = colors / jnp.maximum(near, 1)[..., None]
    return Field(distance, weight, mean if colored else None, grid)


@partial(jax.jit, donate_argnums=0)
def _add(state, camera: Camera, depth, rgb, origin, voxel, truncation):
    """Add a depth image to sums of distances, weights, colours and their weights."""
    _, height, depths = state[0].shape
    y = origin[1] + voxel * jnp.arange(height, dtype=jnp.float32)[:, None]
    z = origin[2] + voxel * jnp.arange(depths, dtype=jnp.float32)[None]
    view, size = camera.viewmat, jnp.asarray(depth.shape)

    def slab(index, state):
        x = origin[0] + voxel * index
        a, b, c = (
            view[i, 0] * x + view[i, 1] * y + view[i, 2] * z + view[i, 3]
            for i in range(3)
        )
        mine = camera.lens.depth((a, b, c))
        ahead = mine > camera.near
        point = (jnp.where(ahead, a, 0), jnp.where(ahead, b, 0), jnp.where(ahead, c, 1))
        good = ahead & camera.lens.valid(camera.K, camera.coefficients, point)
        u, v = camera.project(point)
        good &= (u >= _MARGIN) & (u < size[1] - _MARGIN)
        good &= (v >= _MARGIN) & (v < size[0] - _MARGIN)
        column = jnp.where(good, u, 0).astype(jnp.int32)
        row = jnp.where(good, v, 0).astype(jnp.int32)
        there = depth[row, column]
        signed = (there - mine) / truncation
        good &= (there > 0) & (signed > -1)
        near = good & (signed < 1)
        sums = (
            jnp.where(good, jnp.minimum(signed, 1), 0),
            good.astype(jnp.float32),
            jnp.where(near[..., None], rgb[row, column], 0),
            near.astype(jnp.float32),
        )

        def add(total: Array, more: Array) -> Array:
            return total.at[index].add(more.astype(total.dtype))

        return jax.tree.map(add, state, sums)

    return lax.fori_loop(0, state[0].shape[0], slab, state)
