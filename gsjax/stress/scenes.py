"""Scenes and compiled functions that the cases share.

Compilation dominates the run time, so all cases have one number of slots, one image
size and one configuration; the active mask selects the Gaussians of a case.

Axis legend: N slots, H W image, C channels (colour, alpha, depth).
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera, look_at, make_camera
from gsjax.gaussians import (
    GaussianParams,
    Gaussians,
    make_gaussians,
    num_active,
    select,
)
from gsjax.math.numerics import in_float64
from gsjax.math.sh import num_bases
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.reference import reference_render
from gsjax.raster.render import render
from gsjax.raster.types import Inputs, RasterConfig, Render

Array = jax.Array
SLOTS, SIZE, FOCAL = 128, 32, 40.0
# Number of splats over all 16 tiles that the pair capacity has room for.
MAX_FULL = 125
COMPAT = RasterConfig(
    num_size_buckets=1, devices=1, pair_capacity=MAX_FULL * 16, occlusion=False
)
# Without thresholds at which rounding could add or remove a whole Gaussian.
NO_CUTOFFS = COMPAT.replace(
    alpha_min=1e-6, alpha_max=1 - 1e-6, transmittance_min=0.0, outputs=("alpha",)
)
BACKGROUND = np.array([0.2, 0.5, 0.9], np.float32)
# Relative distance to a threshold at which a pixel may differ by a whole Gaussian.
THRESHOLD_BAND = 1e-3
FIELDS = ("means", "quats", "log_scales", "logit_opacities", "sh")


class Gradients(NamedTuple):
    """Gradients of a weighted sum over colour, alpha and depth."""

    params: GaussianParams
    camera: Camera
    background: Array


def to_float32(values) -> np.ndarray:
    """Convert to an array of float32."""
    return np.asarray(values, np.float32)


def to_float64(values) -> np.ndarray:
    """Convert to an array of float64."""
    return np.asarray(values, np.float64)


def to_numpy(tree):
    """Convert the leaves of a pytree to NumPy arrays."""
    return jax.tree.map(np.asarray, tree)


def with_numpy(function):
    """Wrap a jitted function to take and return NumPy arrays.

    Otherwise every placement of the arguments on devices would compile a program.
    """

    def call(*args, **kwargs):
        return to_numpy(function(*to_numpy(args), **kwargs))

    return call


def random_pose(seed: int = 0) -> np.ndarray:
    """Return a general world → camera matrix, rounded to float32."""
    rng = np.random.default_rng(seed)
    eye, target, up = rng.normal(size=3), rng.normal(size=3) + 4, rng.normal(size=3)
    return look_at(eye, target, up).astype(np.float32)


def camera_of(viewmat=None, focal=FOCAL, centre=(16.6, 15.1), **kwargs) -> Camera:
    """Return a camera with a general principal point, by default at `random_pose`."""
    K = np.array([[focal, 0, centre[0]], [0, 1.07 * focal, centre[1]], [0, 0, 1]])
    viewmat = random_pose() if viewmat is None else viewmat
    size = {"width": SIZE, "height": SIZE}
    return make_camera(viewmat=viewmat, K=to_float32(K), **{**size, **kwargs})


def gaussian_fields(
    points, scales, opacities, viewmat=None, seed: int = 0, degree: int = 3
) -> dict:
    """Return arguments of `make_gaussians` for camera coordinates ``points`` [N, 3].

    Values are rounded to float32, so both precisions see the same numbers. Colours stay
    clear of the clip at 0.
    """
    rng = np.random.default_rng(seed)
    points = np.asarray(points, np.float64)
    count = len(points)
    viewmat = np.asarray(random_pose() if viewmat is None else viewmat, np.float64)
    opacities = np.broadcast_to(np.asarray(opacities, np.float64), count)
    sh = rng.uniform(-0.1, 0.1, (count, num_bases(degree), 3))
    sh[:, 0] = rng.uniform(0.2, 1.7, (count, 3))
    means = np.linalg.solve(viewmat[:3, :3], (points - viewmat[:3, 3]).T).T
    fields = {
        "means": means,
        "quats": rng.normal(size=(count, 4)) * rng.uniform(0.3, 3, (count, 1)),
        "log_scales": np.log(np.broadcast_to(scales, (count, 3))),
        "logit_opacities": np.log(opacities) - np.log1p(-opacities),
        "sh": sh,
    }
    return {name: value.astype(np.float32) for name, value in fields.items()}


def scene_of(fields: dict) -> Gaussians:
    """Return Gaussians of `gaussian_fields` in `SLOTS` slots."""
    return make_gaussians(**fields, capacity=SLOTS)


def frustum_points(
    rng, count: int = SLOTS, near=2.0, far=8.0, spread=0.5
) -> np.ndarray:
    """Return camera coordinates [count, 3] over the view and a little beyond it."""
    z = rng.uniform(near, far, count)
    xy = rng.uniform(-spread, spread, (count, 2)) * (SIZE / FOCAL)
    return np.column_stack([xy * z[:, None], z])


def default_scene(seed: int = 1) -> Gaussians:
    """Return a scene of ordinary Gaussians, all slots active."""
    rng = np.random.default_rng(seed)
    scales = np.exp(rng.normal(-2.3, 0.8, (SLOTS, 3)))
    points, opacities = frustum_points(rng), rng.beta(0.8, 0.8, SLOTS).clip(0.02, 0.98)
    return scene_of(gaussian_fields(points, scales, opacities, seed=seed))


def loss_weights(seed: int = 2) -> np.ndarray:
    """Return weights [H, W, 5] of colour, alpha and depth in the loss."""
    drawn = np.random.default_rng(seed).normal(size=(SIZE, SIZE, 5))
    return drawn.astype(np.float32)


def with_active(gaussians: Gaussians, active) -> Gaussians:
    """Return the Gaussians with another mask of active slots."""
    return gaussians.replace(active=jnp.asarray(active))  # pyright: ignore


def with_params(gaussians: Gaussians, **fields) -> Gaussians:
    """Return the Gaussians with some parameters replaced."""
    held = {name: jnp.asarray(value) for name, value in fields.items()}
    params = gaussians.params.replace(**held)  # pyright: ignore
    return gaussians.replace(params=params)  # pyright: ignore


def where_slots(mask, chosen, others):
    """Return slots of ``chosen`` where ``mask`` [N] is set, else of ``others``."""

    def one(a, b):
        return jnp.where(jnp.reshape(mask, (-1, *(1,) * (a.ndim - 1))), a, b)

    return jax.tree.map(one, chosen, others)


def numpy_fields(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return writable copies of the parameters."""
    return {name: np.array(getattr(gaussians.params, name)) for name in FIELDS}


def images_of(out):
    """Return the images of a render that are compared."""
    return out.rgb, out.alpha, out.depth


def _channels(rgb, alpha, depth) -> Array:
    return jnp.concatenate([rgb, alpha[..., None], depth[..., None]], -1)


@with_numpy
@partial(jax.jit, static_argnames="config")
def _render_and_gradients(
    gaussians: Gaussians,
    camera: Camera,
    background: Array,
    weights: Array,
    config: RasterConfig = COMPAT,
) -> tuple[Render, Gradients]:
    def loss(params, camera, background):
        scene = gaussians.replace(params=params)  # pyright: ignore
        out = render(scene, camera, config, background)
        return jnp.sum(weights * _channels(out.rgb, out.alpha, out.depth)), out

    given = gaussians.params, camera, background
    slopes, out = jax.grad(loss, (0, 1, 2), has_aux=True)(*given)
    return out, Gradients(*slopes)


def render_and_gradients(
    gaussians: Gaussians,
    camera: Camera | None = None,
    background: np.ndarray = BACKGROUND,
    weights: np.ndarray | None = None,
    config: RasterConfig = COMPAT,
) -> tuple[Any, Any]:
    """Return a render and the gradients of Σ weights · channels, as NumPy arrays.

    Args:
      gaussians: in `SLOTS` slots.
      camera: default `camera_of()`.
      background: [3] RGB.
      weights: [H, W, 5], default `loss_weights()`.
      config: static settings.
    """
    camera = camera_of() if camera is None else camera
    weights = loss_weights() if weights is None else weights
    given = to_float32(background), to_float32(weights)  # one dtype, one program
    return _render_and_gradients(gaussians, camera, *given, config=config)


def project_slots(gaussians: Gaussians, camera: Camera, config: RasterConfig = COMPAT):
    """Return the footprints, splats and channels of all slots, in slot order."""
    inputs, count = Inputs(gaussians, camera), num_active(gaussians)
    return ELLIPSOID.project(inputs, config, jnp.arange(SLOTS), count)


projected = with_numpy(jax.jit(project_slots, static_argnames="config"))


def _hide_inactive(params: GaussianParams, active: Array) -> Gaussians:
    """Give inactive slots opacity 0: the reference does not know the mask."""
    logits = jnp.where(active, params.logit_opacities, -jnp.inf)
    params = params.replace(logit_opacities=logits)  # pyright: ignore
    return Gaussians(params=params, active=np.ones(SLOTS, bool))  # pyright: ignore


@jax.jit
def _reference(params, active, camera, background, weights):
    def loss(params, camera, background):
        out = reference_render(
            _hide_inactive(params, active), camera, COMPAT, background
        )
        inside = out["margin"] > THRESHOLD_BAND
        channels = _channels(out["rgb"], out["alpha"], out["depth"])
        weighed = jnp.where(inside[..., None], weights, 0) * channels
        return jnp.sum(weighed), (channels, inside)

    given = params, camera, background
    slopes, images = jax.grad(loss, (0, 1, 2), has_aux=True)(*given)
    return *images, Gradients(*slopes)


def reference(gaussians: Gaussians, camera: Camera):
    """Render with the dense float64 reference.

    Returns:
      Images [H, W, 5]; [H, W] bool, which pixels are clear of all thresholds; the
      gradients of Σ weights · images over those pixels.
    """
    with jax.enable_x64(True):
        given = in_float64((gaussians.params, camera, BACKGROUND, loss_weights()))
        params, *rest = given
        return to_numpy(_reference(params, np.asarray(gaussians.active), *rest))


@with_numpy
@jax.jit
def alpha_per_gaussian(gaussians: Gaussians, camera: Camera) -> tuple[Array, Array]:
    """Return α [N, H, W] of each Gaussian alone, without cut-offs, and radii [N]."""

    def one(slot):
        alone = select(gaussians, jnp.arange(SLOTS) == slot)
        out = render(alone, camera, NO_CUTOFFS)
        return out.alpha, out.radii[slot]

    return jax.lax.map(one, jnp.arange(SLOTS))


@jax.jit
def _reference_alpha(params, camera):
    def one(params):
        row = jax.tree.map(lambda a: a[None], params)
        alone = Gaussians(params=row, active=np.ones(1, bool))  # pyright: ignore
        return reference_render(alone, camera)["alpha"]

    return jax.lax.map(one, params)


def reference_alpha(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Return α [N, H, W] of each Gaussian alone by the dense float64 reference."""
    with jax.enable_x64(True):
        return np.asarray(_reference_alpha(*in_float64((gaussians.params, camera))))


def count_nonfinite(tree) -> int:
    """Return how many numbers of a pytree are not finite."""
    return sum(int(np.sum(~np.isfinite(leaf))) for leaf in jax.tree.leaves(tree))


def count_unequal(a, b) -> int:
    """Return how many numbers of two pytrees differ; NaN differs from everything."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return sum(int(np.sum(np.asarray(x) != np.asarray(y))) for x, y in pairs)
