"""A small dataset to train on in tests: 4 views of 32 × 24 px, 60 points."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from conftest import LIGHT

import gsjax
from gsjax import RasterConfig
from gsjax.data.extent import extent_of
from gsjax.data.types import Dataset, Photo, View
from gsjax.io.images import to_8_bit

VIEWS, POINTS, WIDTH, HEIGHT = 4, 60, 32, 24
RASTER = RasterConfig(**{**LIGHT, "pair_capacity": 4096})
# Without thresholds, for finite differences.
SMOOTH = RASTER.replace(
    alpha_min=1e-14, alpha_max=1 - 1e-9, transmittance_min=0, stop_rule="after"
)


@cache
def dataset() -> Dataset:
    """Return cameras around coloured points; no files."""
    rng = np.random.default_rng(0)
    views = []
    for index in range(VIEWS):
        turn = 2 * np.pi * index / VIEWS
        eye = (3 * np.cos(turn), 3 * np.sin(turn), 1.0 + 0.2 * index)
        K = np.asarray([[30.0, 0, 16.3], [0, 31, 11.8], [0, 0, 1]])
        viewmat = gsjax.look_at(eye, (0, 0, 0.1))
        name = f"view_{index}.png"
        views.append(View(name, Path(name), viewmat, K, WIDTH, HEIGHT))
    points = rng.uniform(-0.8, 0.8, (POINTS, 3))
    colors = rng.integers(40, 256, (POINTS, 3)).astype(np.uint8)
    return Dataset(Path("made"), "made", tuple(views), points, colors)


EXTENT = extent_of(dataset())


def true_gaussians() -> gsjax.Gaussians:
    """Return the Gaussians that the photographs show."""
    return gsjax.init_gaussians(dataset(), sh_degree=0, opacity=0.8, scale=0.6)


@cache
def photos() -> list[Photo]:
    """Return the photographs of the dataset."""
    with jax.enable_x64(False):
        return [photo_of(true_gaussians(), view) for view in dataset().views]


_render = jax.jit(
    lambda g, c, b: gsjax.render(g, c, RASTER.replace(outputs=("rgb",)), b).rgb
)


def camera_at(view: View) -> gsjax.Camera:
    """Return the camera of a view."""
    sizes = {"width": WIDTH, "height": HEIGHT}
    return gsjax.make_camera(viewmat=view.viewmat, K=view.K, **sizes)


def photo_of(gaussians: gsjax.Gaussians, view: View, background=(0.0, 0.0, 0.0)):
    """Return the photograph of a view."""
    image = _render(gaussians, camera_at(view), jnp.asarray(background))
    return Photo(to_8_bit(np.asarray(image)), None, None, view.K)


def rough_start(sh_degree: int, capacity: int, seed: int = 1) -> gsjax.Gaussians:
    """Return initial Gaussians near the true ones: too wide, with wrong colours."""
    start = dataset()
    rng = np.random.default_rng(seed)
    points = start.points + 0.05 * rng.normal(size=start.points.shape)
    colors = rng.integers(0, 256, start.colors.shape).astype(np.uint8)
    made = gsjax.init_gaussians(
        replace(start, points=points, colors=colors),
        sh_degree=sh_degree,
        opacity=0.5,
        capacity=capacity,
    )
    # Not spheres: their gradient by the rotation is rounding, which Adam amplifies.
    params = made.params
    stretch = jnp.asarray(rng.normal(0, 0.4, params.log_scales.shape))
    quats = jnp.asarray(rng.normal(size=params.quats.shape), params.quats.dtype)
    log_scales = params.log_scales + stretch.astype(params.log_scales.dtype)
    return made.replace(params=params.replace(quats=quats, log_scales=log_scales))


def copy(tree):
    """Return a copy that may be donated."""
    return jax.tree.map(jnp.copy, tree)


def bits(tree) -> list[tuple]:
    """Return name, dtype, shape and bytes of each leaf, random keys included."""
    out = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaf = jax.random.key_data(leaf)
        name = jax.tree_util.keystr(path)
        out.append((name, leaf.dtype, leaf.shape, np.asarray(leaf).tobytes()))
    return out


def changed(first, second) -> list[str]:
    """Return the names of the leaves that are not bit-equal."""
    return [a[0] for a, b in zip(bits(first), bits(second), strict=True) if a != b]
