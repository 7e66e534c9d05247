"""Fusion of depth images in a truncated signed distance field (Curless and Levoy 1996).

Axis legend: X Y Z voxels of the grid, B images, H W image, V points.
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
_LEAST = 1e-4  # of the cube of contracted space, next to its faces


class Grid(NamedTuple):
    """A box of cubic voxels, or all of space contracted to a cube.

    Attributes:
      origin: [3] coordinates of the centre of the first voxel: of the world, or of the
        cube from −2 to 2.
      voxel: side of a voxel, in the units of ``origin``.
      shape: numbers of voxels along x, y and z.
      inner: (centre [3], half the side) of the cube that is not contracted, world
        units; None for a box.
    """

    origin: np.ndarray
    voxel: float
    shape: tuple[int, int, int]
    inner: tuple[np.ndarray, float] | None = None

    def places(self, indices: np.ndarray) -> np.ndarray:
        """Return world coordinates [V, 3] of points, in voxels from the first."""
        x, y, z = np.moveaxis(self.origin + self.voxel * indices, -1, 0)
        return np.stack(_places((x, y, z), self.inner)[0], -1)


class Field(NamedTuple):
    """A truncated signed distance field.

    Attributes:
      distance: [X, Y, Z] signed distance over the truncation, in −1 … 1, positive in
        front of the surface; 1 where no image counts.
      weight: [X, Y, Z] number of images that count.
      inside: [X, Y, Z] bool: no image counts, and more of them show a surface in front
        of the voxel than nothing.
      colors: [X, Y, Z, 3] mean colour near the surface, or None.
      grid: where the voxels are.
    """

    distance: Array
    weight: Array
    inside: Array
    colors: Array | None
    grid: Grid


class DepthImage(NamedTuple):
    """A depth image with its camera.

    Attributes:
      camera: a single camera.
      depth: [H, W] of the camera's lens; 0 where nothing is, NaN where it is unknown.
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


def make_unbounded_grid(centre, half: float, resolution: int) -> Grid:
    """Return a grid over all of space, fine in a cube and ever coarser outside.

    Outside, a point at m times the half side from the centre (in its largest
    coordinate) is drawn in to 2 − 1 / m (Barron et al. 2022, "Mip-NeRF 360", eq. 10).

    Args:
      centre: [3] of the cube, world units.
      half: half the side of the cube, which gets half of the voxels of each axis.
      resolution: voxels along each axis.

    Raises:
      InputError: if the cube is empty or not finite, or ``resolution`` too small.
    """
    centre = np.asarray(centre, np.float64)
    make_grid(centre - half, centre + half, resolution)
    grid = make_grid([-2.0] * 3, [2.0] * 3, resolution)
    return grid._replace(inner=(centre, float(half)))


def _places(coordinates, inner):
    """Return world coordinates (x, y, z), and by how much lengths are stretched."""
    if inner is None:
        return coordinates, 1.0
    x, y, z = coordinates
    xp = jnp if isinstance(x, jax.Array) else np
    centre, half = inner
    most = xp.maximum(xp.maximum(abs(x), abs(y)), abs(z))
    outside = most > 1
    far = 1 / xp.maximum(2 - most, _LEAST)  # 2 − 1 / far = most
    factor = half * xp.where(outside, far / xp.maximum(most, 1), 1)
    world = tuple(c + factor * v for c, v in zip(centre, (x, y, z)))
    return world, half * xp.where(outside, far * far, 1)


def fuse(images: Iterable[DepthImage], grid: Grid, *, truncation: float = 4.0) -> Field:
    """Return the distance field of depth images.

    A voxel takes the mean over the images of (depth − its depth) over the truncation,
    limited to 1. An image does not count where it has no depth, or where the voxel is
    farther behind the surface than the truncation.

    Args:
      images: of any sizes and lenses; each size and lens is compiled once.
      grid: voxels.
      truncation: in voxels; of contracted space, in their longest side.

    Raises:
      InputError: if no image has any depth in the box.
      CapacityError: if the grid does not fit in memory.
    """
    count = int(np.prod(grid.shape))
    require(
        Estimate({"for the sums": 26 * count, "for the surface": 24 * count}),
        f"a grid of {' × '.join(map(str, grid.shape))} voxels of {grid.voxel:.4g}",
        "lower the resolution, or pass a smaller box",
    )
    state = _Sums(*(jnp.zeros(grid.shape, jnp.float32) for _ in range(3)))
    state = state._replace(
        colors=jnp.zeros((*grid.shape, 3), jnp.float32),
        behind=jnp.zeros(grid.shape, jnp.int16),
    )
    frame = jax.tree.map(
        partial(jnp.asarray, dtype=jnp.float32), (grid.origin, grid.voxel, grid.inner)
    )
    colored = False
    for image in images:
        rgb = image.rgb
        colored |= rgb is not None
        if rgb is None:
            rgb = jnp.zeros((*image.depth.shape, 3), jnp.float32)
        state = _add(state, image.camera, image.depth, rgb, frame, truncation)
    if not bool(jnp.any(state.near > 0)):
        raise InputError(
            "images: no depth image shows a surface in the box; check the box, or "
            "lower the opacity that a surface needs"
        )
    counted = state.weight > 0
    distance = jnp.where(counted, state.distance / jnp.maximum(state.weight, 1), 1)
    mean = state.colors / jnp.maximum(state.near, 1)[..., None] if colored else None
    inside = ~counted & (state.behind > 0)
    return Field(distance, state.weight, inside, mean, grid)


class _Sums(NamedTuple):
    """Sums over images of [X, Y, Z].

    Attributes:
      distance, weight: of images that count.
      near: number of images with a surface within the truncation.
      colors: [X, Y, Z, 3] of those images.
      behind: images with a surface in front of the voxel, less those with nothing.
    """

    distance: Array
    weight: Array
    near: Array
    colors: Array = None  # pyright: ignore
    behind: Array = None  # pyright: ignore


@partial(jax.jit, donate_argnums=0)
def _add(state: _Sums, camera: Camera, depth, rgb, frame, truncation) -> _Sums:
    """Add a depth image."""
    origin, voxel, inner = frame
    _, height, depths = state.distance.shape
    y = origin[1] + voxel * jnp.arange(height, dtype=jnp.float32)[:, None]
    z = origin[2] + voxel * jnp.arange(depths, dtype=jnp.float32)[None]
    view, size = camera.viewmat, jnp.asarray(depth.shape)

    def slab(index, state: _Sums) -> _Sums:
        (px, py, pz), stretch = _places((origin[0] + voxel * index, y, z), inner)
        a, b, c = (
            view[i, 0] * px + view[i, 1] * py + view[i, 2] * pz + view[i, 3]
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
        signed = (there - mine) / (truncation * voxel * stretch)
        seen = good & (there > 0)
        counts, near = seen & (signed > -1), seen & (jnp.abs(signed) < 1)
        hidden = (seen & (signed <= -1)).astype(jnp.int16)
        free = (good & (there == 0)).astype(jnp.int16)
        more = _Sums(
            jnp.where(counts, jnp.minimum(signed, 1), 0),
            counts.astype(jnp.float32),
            near.astype(jnp.float32),
            jnp.where(near[..., None], rgb[row, column], 0),
            hidden - free,
        )

        def add(total: Array, more: Array) -> Array:
            return total.at[index].add(more.astype(total.dtype))

        return jax.tree.map(add, state, more)

    return lax.fori_loop(0, state.distance.shape[0], slab, state)
