"""Needles, and what is extreme and yet to be seen, against the float64 oracle."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians, num_active
from gsjax.math.numerics import in_float64
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.reference import reference_project
from gsjax.raster.types import Inputs
from gsjax.stress.scenes import (
    COMPAT,
    FIELDS,
    FOCAL,
    SIZE,
    SLOTS,
    camera_of,
    changed,
    double,
    each_alpha,
    each_alpha_oracle,
    fields_at,
    frustum,
    host_fields,
    not_finite,
    on_host,
    oracle,
    scene_of,
    single,
    usual_gradients,
    weights,
)
from gsjax.stress.types import Case, Measured, worse

LENGTHS = (10, 100, 1_000, 10_000)
# Of the catalogue: a splat whose α would be below this everywhere may be left out.
VISIBLE = 1 / 255


@cache
def needles(length: float, seed: int = 0, far: float = 1_000) -> Gaussians:
    """Needles of σ = ``length`` px, a few hundredths wide, that cross the image.

    Half of them are centred outside, by as much as they are long, ``far`` px at most.
    """
    rng = np.random.default_rng(seed)
    points = frustum(rng)
    unit = points[:, 2] / FOCAL  # world units that are one px there
    along = rng.normal(size=(SLOTS, 2))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    away = np.where(np.arange(SLOTS) % 2, 0, rng.uniform(0.3, 1, SLOTS))
    away *= min(length, far)
    points[:, :2] *= 0.6
    points[:, :2] += away[:, None] * along * unit[:, None]
    thin = rng.uniform(0.003, 0.03, SLOTS) * unit
    long = length * unit
    fields = fields_at(points, np.column_stack([long, thin, thin]), 0.8, np.eye(4))
    # The long axis lies along the direction that the centre was moved in.
    angle = np.arctan2(along[:, 1], along[:, 0]) + rng.normal(0, 0.02 / length, SLOTS)
    turn = np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)
    fields["quats"] = np.stack(turn, 1).astype(np.float32)
    return scene_of(fields)


def level_camera() -> Camera:
    """At the origin, along z."""
    return camera_of(np.eye(4))


def alpha_error(length: float, far: float = 1_000):
    """Largest |Δα| of needles one by one, float32 against the float64 oracle."""

    def measure(full: bool) -> Measured:
        worst, seen = 0.0, 0
        for seed in range(8 if full else 1):
            scene, camera = needles(length, seed, far), level_camera()
            found = np.asarray(each_alpha(scene, camera)[0], np.float64)
            wanted = each_alpha_oracle(scene, camera)
            worst = worse(worst, float(np.max(np.abs(found - wanted))))
            seen += int(np.sum(wanted.max((1, 2)) > VISIBLE))
        return Measured(worst if seen else np.nan, f"{seen} needles in view")

    return measure


def gradient_error(full: bool) -> Measured:
    """99 % point of the relative error of the gradient by each needle."""
    errors = []
    camera = level_camera()
    for seed in range(4 if full else 1):
        scene = needles(1_000, seed)
        for slot in range(0, SLOTS, 1 if full else 4):
            alone = scene.replace(active=jnp.arange(SLOTS) == slot)  # pyright: ignore
            _, inside, wanted = oracle(alone, camera)
            weigh = np.where(inside[..., None], weights(), 0)
            found = usual_gradients(alone, camera, weigh=weigh)[1]
            pairs = [
                (getattr(found.params, f)[slot], getattr(wanted.params, f)[slot])
                for f in FIELDS
            ]
            a, b = (np.concatenate([np.ravel(p[i]) for p in pairs]) for i in (0, 1))
            if np.any(b != 0):
                errors.append(np.linalg.norm(a - b) / np.linalg.norm(b))
    return Measured(
        float(np.quantile(errors, 0.99)) if errors else np.nan,
        f"{len(errors)} needles, median {np.median(errors):.1e}, "
        f"largest {np.max(errors):.1e}",
    )


@jax.jit
def projected(gaussians: Gaussians, camera: Camera):
    """Of every slot: mean px [N, 2], compensation [N], opacity [N] (0 if culled)."""
    order, count = jnp.arange(SLOTS), num_active(gaussians)
    sharp = COMPAT.replace(alpha_min=1e-30, antialias=True)
    splat = ELLIPSOID.project(Inputs(gaussians, camera), sharp, order, count).splat
    opacity = splat.shape[3]
    ratio = opacity / jax.nn.sigmoid(gaussians.params.logit_opacities)
    return jnp.stack([splat.u, splat.v], -1), ratio, opacity


@jax.jit
def _projected_oracle(gaussians: Gaussians, camera: Camera):
    return reference_project(gaussians, camera)


def projected_oracle(gaussians: Gaussians, camera: Camera):
    """Means px, depths, covariances, det ratios and in-range flags in float64."""
    with jax.enable_x64(True):
        return on_host(_projected_oracle(*in_float64((gaussians, camera))))


def antialias_ratio(full: bool) -> Measured:
    """Relative error of √(det₀/det) of needles of 1000 px."""
    worst = 0.0
    for seed in range(8 if full else 1):
        found = np.asarray(projected(needles(1_000, seed), level_camera())[1])
        ratio = projected_oracle(needles(1_000, seed), level_camera())[3]
        wanted = np.sqrt(np.maximum(ratio, 0.005**2))
        worst = worse(worst, float(np.max(np.abs(found / wanted - 1))))
    return Measured(worst, f"{SLOTS * (8 if full else 1)} needles")


def projection_error(full: bool) -> Measured:
    """px between the means of float32 and float64, over views of usual scenes."""
    worst = 0.0
    for seed in range(64 if full else 8):
        rng = np.random.default_rng(seed)
        viewmat = np.eye(4)
        viewmat[:3, 3] = rng.uniform(-1, 1, 3)
        scene = scene_of(fields_at(frustum(rng), 0.1, 0.5, viewmat, seed))
        camera = camera_of(viewmat, focal=float(rng.uniform(20, 60)))
        found = np.asarray(projected(scene, camera)[0], np.float64)
        wanted = projected_oracle(scene, camera)[0]
        worst = worse(worst, float(np.max(np.abs(found - wanted))))
    return Measured(worst, f"{SLOTS * (64 if full else 8)} Gaussians")


def extreme_but_valid(seed: int = 0) -> Gaussians:
    """Splats of every extreme kind, each with something to be seen in the image."""
    rng = np.random.default_rng(seed)
    points = frustum(rng, near=1.0, far=9.0, spread=0.4)
    kind = np.arange(SLOTS) % 12
    z = np.ones(SLOTS)
    z[kind == 0] = 0.01 * (1 + 2e-6)  # a few ulp behind the near plane
    z[kind == 1] = 0.99e10  # before the far plane
    z[kind == 2] = 1e-1
    away = np.isin(kind, (0, 1, 2))
    points[away] *= (z / points[:, 2])[away, None]
    unit = points[:, 2] / FOCAL
    scales = np.exp(rng.normal(0, 0.5, (SLOTS, 3))) * unit[:, None]
    opacities = np.full(SLOTS, 0.9)
    opacities[kind == 3] = 1.02 * VISIBLE  # centres stand on pixels, see below
    fields = fields_at(points, scales, opacities, np.eye(4), seed)

    def on_pixel(where):
        """Means moved onto the nearest pixel centre of `level_camera`."""
        mean = double(fields["means"][where])
        K = double(level_camera().K)
        size = SIZE - 1
        for axis in (0, 1):
            uv = K[axis, axis] * mean[:, axis] / mean[:, 2] + K[axis, 2]
            uv = np.clip(np.floor(uv), 0, size) + 0.5
            mean[:, axis] = (uv - K[axis, 2]) / K[axis, axis] * mean[:, 2]
        fields["means"][where] = mean

    on_pixel(np.isin(kind, (0, 1, 3)))
    fields["log_scales"][kind == 4] = -40.0  # a point: the dilation alone is left
    fields["log_scales"][kind == 5] = 14.0  # a million units wide
    fields["log_scales"][kind == 6, 1] = -30.0  # flat
    fields["quats"][kind == 7] *= 1e-23
    fields["quats"][kind == 8] *= 1e20
    fields["logit_opacities"][kind == 9] = 80.0
    fields["log_scales"][kind == 10] = 80.0  # clipped, not culled
    fields["sh"][kind == 11] *= 1e6
    longest = needles(10_000, seed, far=10_000)
    scene = scene_of(fields)
    half = (np.arange(SLOTS) // 12) % 4 == 3
    params = jax.tree.map(
        lambda a, b: jnp.where(half.reshape(-1, *(1,) * (a.ndim - 1)), b, a),
        scene.params,
        longest.params,
    )
    return scene.replace(params=params)  # pyright: ignore


def clipped(gaussians: Gaussians) -> Gaussians:
    """With the documented clip of log scales, which the oracle does not know."""
    params = gaussians.params
    scales = jnp.clip(params.log_scales, -40.0, 20.0)
    held = params.replace(log_scales=scales)  # pyright: ignore
    return gaussians.replace(params=held)  # pyright: ignore


def wrongly_culled(full: bool) -> Measured:
    """Splats that the oracle sees and the library does not, one by one."""
    lost, seen = 0, 0
    for seed in range(16 if full else 2):
        scene, camera = extreme_but_valid(seed), level_camera()
        found, radii = (np.asarray(a) for a in each_alpha(scene, camera))
        wanted = each_alpha_oracle(clipped(scene), camera)
        visible = wanted.max((1, 2)) >= VISIBLE
        seen += int(visible.sum())
        gone = (found.max((1, 2)) < 0.9 * VISIBLE) | (radii == 0)
        lost += int(np.sum(visible & gone))
    return Measured(lost if seen > SLOTS // 2 else np.nan, f"of {seen} in view")


def beside_bad(full: bool) -> Measured:
    """Valid splats that vanish beside bad ones, and bad ones that do not vanish."""
    wrong, seen, bad = 0, 0, np.arange(SLOTS) % 5 == 0
    values = np.resize(single([np.nan, np.inf, -np.inf]), SLOTS)
    for seed in range(16 if full else 2):
        scene, camera = extreme_but_valid(seed), level_camera()
        visible = each_alpha_oracle(clipped(scene), camera).max((1, 2)) >= VISIBLE
        fields = host_fields(scene)
        for place, slot in enumerate(np.flatnonzero(bad)):
            field = fields[FIELDS[place % len(FIELDS)]]
            field.reshape(SLOTS, -1)[slot, place % field[slot].size] = values[place]
        # Pairs may not fit, with so many over every tile; what is in view still shows.
        # What is hidden has no radius, and is not lost.
        config = COMPAT.replace(occlusion=False)
        out, slopes = usual_gradients(changed(scene, **fields), camera, config=config)
        lost = visible & ~bad & (out.radii == 0)
        wrong += int(lost.sum() + (out.radii[bad] > 0).sum())
        wrong += not_finite((out.rgb, out.alpha, out.depth, slopes))
        seen += int(np.sum(visible & ~bad))
    return Measured(
        wrong if seen > SLOTS // 2 else np.nan, f"{seen} beside {bad.sum()}"
    )


CASES = (
    *(
        Case(f"needles/alpha at {n} px", "largest |Δα|", 1e-3, alpha_error(n))
        for n in LENGTHS
    ),
    Case(
        "needles/centred 10000 px away",
        "largest |Δα|",
        1e-3,
        alpha_error(10_000, far=10_000),
    ),
    Case("needles/gradient at 1000 px", "relative, 99 % point", 5e-3, gradient_error),
    Case("needles/antialias ratio", "relative, 1000 px", 2e-3, antialias_ratio),
    Case("projection/float32", "centres against float64", 1e-3, projection_error, "px"),
    Case("extremes/wrongly culled", "visible to the oracle only", 0, wrongly_culled),
    Case("extremes/beside bad ones", "lost, or bad and seen", 0, beside_bad),
)
