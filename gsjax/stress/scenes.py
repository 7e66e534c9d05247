"""Scenes and compiled functions that the cases share.

Compiling takes most of the time, so there is one number of slots, one image size and
one configuration; which Gaussians a case is about is a matter of the active mask.

Axis legend: N slots, H W image, C channels (colour, alpha, depth).
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera, look_at, make_camera
from gsjax.gaussians import GaussianParams, Gaussians, make_gaussians, select
from gsjax.math.numerics import in_float64
from gsjax.math.sh import num_bases
from gsjax.raster.reference import reference_render
from gsjax.raster.render import render
from gsjax.raster.types import RasterConfig, Render

Array = jax.Array
SLOTS, SIZE, FOCAL, BASES = 128, 32, 40.0, 16
# Room for 125 splats over all 16 tiles: enough for usual scenes, and not for any.
WIDE = 125
COMPAT = RasterConfig(num_size_buckets=1, devices=1, pair_capacity=WIDE * 16)
# No threshold that an error of rounding could carry a whole Gaussian across.
SMOOTH = COMPAT.replace(
    alpha_min=1e-6, alpha_max=1 - 1e-6, transmittance_min=0.0, outputs=("alpha",)
)
BACKGROUND = np.array([0.2, 0.5, 0.9], np.float32)
# A pixel this near a threshold, relatively, may rightly differ by a whole Gaussian.
BAND = 1e-3
FIELDS = ("means", "quats", "log_scales", "logit_opacities", "sh")


class Gradients(NamedTuple):
    """Of a weighted sum over colour, alpha and depth."""

    params: GaussianParams
    camera: Camera
    background: Array


def single(values) -> np.ndarray:
    """An array of float32."""
    return np.asarray(values, np.float32)


def double(values) -> np.ndarray:
    """An array of float64."""
    return np.asarray(values, np.float64)


def on_host(tree):
    """The same pytree as numpy arrays."""
    return jax.tree.map(np.asarray, tree)


def pose(seed: int = 0) -> np.ndarray:
    """A general world → camera matrix, in values of float32."""
    rng = np.random.default_rng(seed)
    eye, target, up = rng.normal(size=3), rng.normal(size=3) + 4, rng.normal(size=3)
    return look_at(eye, target, up).astype(np.float32)


def camera_of(viewmat=None, focal=FOCAL, centre=(16.6, 15.1), **kwargs) -> Camera:
    """A view with a general principal point; at `pose` by default."""
    K = np.array([[focal, 0, centre[0]], [0, 1.07 * focal, centre[1]], [0, 0, 1]])
    viewmat = pose() if viewmat is None else viewmat
    size = {"width": SIZE, "height": SIZE}
    return make_camera(viewmat=viewmat, K=single(K), **{**size, **kwargs})


def fields_at(
    points, scales, opacities, viewmat=None, seed: int = 0, degree: int = 3
) -> dict:
    """Arrays of `make_gaussians` for camera coordinates ``points`` [N, 3].

    Values of float32, so that both precisions see the same numbers. Colours stay
    clear of the clip at 0.
    """
    rng = np.random.default_rng(seed)
    points = np.asarray(points, np.float64)
    count = len(points)
    viewmat = np.asarray(pose() if viewmat is None else viewmat, np.float64)
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
    """Gaussians of arrays, in `SLOTS` slots."""
    return make_gaussians(**fields, capacity=SLOTS)


def frustum(rng, count: int = SLOTS, near=2.0, far=8.0, spread=0.5) -> np.ndarray:
    """Camera coordinates over the view and a little beyond it."""
    z = rng.uniform(near, far, count)
    xy = rng.uniform(-spread, spread, (count, 2)) * (SIZE / FOCAL)
    return np.column_stack([xy * z[:, None], z])


def usual(seed: int = 1) -> Gaussians:
    """An unremarkable scene."""
    rng = np.random.default_rng(seed)
    scales = np.exp(rng.normal(-2.3, 0.8, (SLOTS, 3)))
    points, opacities = frustum(rng), rng.beta(0.8, 0.8, SLOTS).clip(0.02, 0.98)
    return scene_of(fields_at(points, scales, opacities, seed=seed))


def weights(seed: int = 2) -> np.ndarray:
    """[H, W, 5] of colour, alpha and depth in the loss."""
    drawn = np.random.default_rng(seed).normal(size=(SIZE, SIZE, 5))
    return drawn.astype(np.float32)


def changed(gaussians: Gaussians, **fields) -> Gaussians:
    """With some of the parameters replaced."""
    held = {name: jnp.asarray(value) for name, value in fields.items()}
    params = gaussians.params.replace(**held)  # pyright: ignore
    return gaussians.replace(params=params)  # pyright: ignore


def host_fields(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Writable copies of the parameters."""
    return {name: np.array(getattr(gaussians.params, name)) for name in FIELDS}


def _channels(rgb, alpha, depth) -> Array:
    return jnp.concatenate([rgb, alpha[..., None], depth[..., None]], -1)


@partial(jax.jit, static_argnames="config")
def gradients(
    gaussians: Gaussians,
    camera: Camera,
    background: Array,
    weigh: Array,
    config: RasterConfig = COMPAT,
) -> tuple[Render, Gradients]:
    """A render, and the slopes of Σ weigh · channels."""

    def loss(params, camera, background):
        scene = gaussians.replace(params=params)  # pyright: ignore
        out = render(scene, camera, config, background)
        return jnp.sum(weigh * _channels(out.rgb, out.alpha, out.depth)), out

    given = gaussians.params, camera, background
    slopes, out = jax.grad(loss, (0, 1, 2), has_aux=True)(*given)
    return out, Gradients(*slopes)


def usual_gradients(
    gaussians: Gaussians,
    camera: Camera | None = None,
    background: np.ndarray = BACKGROUND,
    weigh: np.ndarray | None = None,
    config: RasterConfig = COMPAT,
) -> tuple[Any, Any]:
    """`gradients` on the host; default the usual camera, background and weights."""
    camera = camera_of() if camera is None else camera
    weigh = weights() if weigh is None else weigh
    # Always of one type: another would be compiled again.
    given = single(background), single(weigh)
    return on_host(gradients(gaussians, camera, *given, config=config))


def _only(params: GaussianParams, active: Array) -> Gaussians:
    """What the oracle sees of slots that are not active: opacity 0."""
    logits = jnp.where(active, params.logit_opacities, -jnp.inf)
    params = params.replace(logit_opacities=logits)  # pyright: ignore
    return Gaussians(params=params, active=np.ones(SLOTS, bool))  # pyright: ignore


@jax.jit
def _oracle(params, active, camera, background, weigh):
    def loss(params, camera, background):
        out = reference_render(_only(params, active), camera, COMPAT, background)
        inside = out["margin"] > BAND
        channels = _channels(out["rgb"], out["alpha"], out["depth"])
        weighed = jnp.where(inside[..., None], weigh, 0) * channels
        return jnp.sum(weighed), (channels, inside)

    given = params, camera, background
    slopes, images = jax.grad(loss, (0, 1, 2), has_aux=True)(*given)
    return *images, Gradients(*slopes)


def oracle(gaussians, camera, background=BACKGROUND, weigh=None):
    """The dense float64 reference: images [H, W, 5], pixels clear of any threshold
    [H, W], and the slopes of Σ weigh · images over those pixels.
    """
    weigh = weights() if weigh is None else weigh
    with jax.enable_x64(True):
        given = in_float64((gaussians.params, camera, background, weigh))
        params, *rest = given
        return on_host(_oracle(params, gaussians.active, *rest))


@jax.jit
def each_alpha(gaussians: Gaussians, camera: Camera) -> tuple[Array, Array]:
    """α [N, H, W] of each Gaussian on its own, without cut-offs, and radii [N]."""

    def one(slot):
        alone = select(gaussians, jnp.arange(SLOTS) == slot)
        out = render(alone, camera, SMOOTH)
        return out.alpha, out.radii[slot]

    return jax.lax.map(one, jnp.arange(SLOTS))


@partial(jax.jit, static_argnames="antialias")
def _each_alpha_oracle(params, camera, antialias):
    def one(params):
        row = jax.tree.map(lambda a: a[None], params)
        alone = Gaussians(params=row, active=np.ones(1, bool))  # pyright: ignore
        return reference_render(alone, camera, antialias=antialias)["alpha"]

    return jax.lax.map(one, params)


def each_alpha_oracle(gaussians: Gaussians, camera: Camera, antialias=False):
    """`each_alpha` by the dense float64 reference."""
    with jax.enable_x64(True):
        given = in_float64((gaussians.params, camera))
        return np.asarray(_each_alpha_oracle(*given, antialias))


def not_finite(tree) -> int:
    """How many numbers of a pytree are not finite."""
    return sum(int(np.sum(~np.isfinite(leaf))) for leaf in jax.tree.leaves(tree))


def unequal(a, b) -> int:
    """How many numbers of two pytrees differ in their values; NaN equals nothing."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return sum(int(np.sum(np.asarray(x) != np.asarray(y))) for x, y in pairs)
