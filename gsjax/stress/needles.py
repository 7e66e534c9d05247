"""Needles, and extreme but visible splats, against the float64 reference."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians
from gsjax.math.numerics import in_float64
from gsjax.raster.reference import reference_project
from gsjax.stress import scenes
from gsjax.stress.scenes import COMPAT, FIELDS, FOCAL, SIZE, SLOTS, camera_of, scene_of
from gsjax.stress.types import Measurement, StressCase

# A splat whose α is below this everywhere may be culled.
VISIBLE = 1 / 255


@cache
def needles(length: float, seed: int = 0, far: float = 1_000) -> Gaussians:
    """Return needles of σ = ``length`` px, a few hundredths wide, across the image.

    Half of them are centred outside, by their length and at most ``far`` px.
    """
    rng = np.random.default_rng(seed)
    points = scenes.frustum_points(rng)
    unit = points[:, 2] / FOCAL  # world units of a px
    along = rng.normal(size=(SLOTS, 2))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    away = np.where(np.arange(SLOTS) % 2, 0, rng.uniform(0.3, 1, SLOTS))
    away *= min(length, far)
    points[:, :2] *= 0.6
    points[:, :2] += away[:, None] * along * unit[:, None]
    thin = rng.uniform(0.003, 0.03, SLOTS) * unit
    scales = np.column_stack([length * unit, thin, thin])
    fields = scenes.gaussian_fields(points, scales, 0.8, np.eye(4))
    # The long axis points along the displacement of the centre.
    angle = np.arctan2(along[:, 1], along[:, 0]) + rng.normal(0, 0.02 / length, SLOTS)
    turn = np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)
    fields["quats"] = np.stack(turn, 1).astype(np.float32)
    return scene_of(fields)


def level_camera() -> Camera:
    """Return the camera at the origin that looks along z."""
    return camera_of(np.eye(4))


def alpha_error(length: float, far: float, full: bool) -> Measurement:
    """Measure the largest |Δα| of single needles, float32 against the reference."""
    worst, seen = 0.0, 0
    for seed in range(8 if full else 1):
        scene, camera = needles(length, seed, far), level_camera()
        found = scenes.to_float64(scenes.alpha_per_gaussian(scene, camera)[0])
        wanted = scenes.reference_alpha(scene, camera)
        worst = np.maximum(worst, float(np.max(np.abs(found - wanted))))
        seen += int(np.sum(wanted.max((1, 2)) > VISIBLE))
    return Measurement(worst if seen else np.nan, f"{seen} needles in view")


def gradient_error(full: bool) -> Measurement:
    """Measure the 99 % quantile of the relative gradient error of single needles."""
    errors, camera = [], level_camera()
    for seed in range(4 if full else 1):
        scene = needles(1_000, seed)
        for slot in range(0, SLOTS, 1 if full else 4):
            alone = scenes.with_active(scene, np.arange(SLOTS) == slot)
            _, inside, wanted = scenes.reference(alone, camera)
            weights = np.where(inside[..., None], scenes.loss_weights(), 0)
            _, found = scenes.render_and_gradients(alone, camera, weights=weights)
            a, b = (
                np.concatenate([np.ravel(getattr(g.params, f)[slot]) for f in FIELDS])
                for g in (found, wanted)
            )
            if np.any(b != 0):
                errors.append(np.linalg.norm(a - b) / np.linalg.norm(b))
    return Measurement(
        float(np.quantile(errors, 0.99)) if errors else np.nan,
        f"{len(errors)} needles, median {np.median(errors):.1e}, "
        f"largest {np.max(errors):.1e}",
    )


# Culls nothing in view; opacities are compensated.
_SHARP = COMPAT.replace(alpha_min=1e-30, antialias=True)


def projected_means(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Return the means [N, 2] in px, computed in float32, as float64."""
    splat = scenes.projected(gaussians, camera, config=_SHARP).splat
    return scenes.to_float64(np.stack([splat.u, splat.v], -1))


_reference_project = jax.jit(reference_project)


def reference_projected(gaussians: Gaussians, camera: Camera):
    """Return `reference_project` of the Gaussians in float64."""
    with jax.enable_x64(True):
        return scenes.to_numpy(_reference_project(*in_float64((gaussians, camera))))


def antialias_ratio(full: bool) -> Measurement:
    """Measure the relative error of √(det₀/det) of needles of 1000 px."""
    worst, seeds = 0.0, 8 if full else 1
    for seed in range(seeds):
        given = needles(1_000, seed), level_camera()
        wanted = np.sqrt(np.maximum(reference_projected(*given)[3], 0.005**2))
        splat = scenes.projected(*given, config=_SHARP).splat
        found = splat.shape[3] / jax.nn.sigmoid(given[0].params.logit_opacities)
        worst = np.maximum(worst, float(np.max(np.abs(found / wanted - 1))))
    return Measurement(worst, f"{SLOTS * seeds} needles")


def projection_error(full: bool) -> Measurement:
    """Measure the distance in px between means in float32 and in float64."""
    worst, seeds = 0.0, 64 if full else 8
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        viewmat = np.eye(4)
        viewmat[:3, 3] = rng.uniform(-1, 1, 3)
        points = scenes.frustum_points(rng)
        scene = scene_of(scenes.gaussian_fields(points, 0.1, 0.5, viewmat, seed))
        camera = camera_of(viewmat, focal=float(rng.uniform(20, 60)))
        found = projected_means(scene, camera)
        wanted = reference_projected(scene, camera)[0]
        worst = np.maximum(worst, float(np.max(np.abs(found - wanted))))
    return Measurement(worst, f"{SLOTS * seeds} Gaussians")


def extreme_but_valid(seed: int = 0) -> Gaussians:
    """Return splats of twelve extreme kinds, each visible in the image."""
    rng = np.random.default_rng(seed)
    points = scenes.frustum_points(rng, near=1.0, far=9.0, spread=0.4)
    kind = np.arange(SLOTS) % 12
    z = np.ones(SLOTS)
    z[kind == 0] = 0.01 * (1 + 2e-6)  # a few ulp beyond the near plane
    z[kind == 1] = 0.99e10  # in front of the far plane
    z[kind == 2] = 1e-1
    away = np.isin(kind, (0, 1, 2))
    points[away] *= (z / points[:, 2])[away, None]
    unit = points[:, 2] / FOCAL
    scales = np.exp(rng.normal(0, 0.5, (SLOTS, 3))) * unit[:, None]
    opacities = np.full(SLOTS, 0.9)
    opacities[kind == 3] = 1.02 * VISIBLE  # centred on pixels, see below
    fields = scenes.gaussian_fields(points, scales, opacities, np.eye(4), seed)

    def on_pixel(where):
        """Move means onto the nearest pixel centres of `level_camera`."""
        mean = scenes.to_float64(fields["means"][where])
        K = scenes.to_float64(level_camera().K)
        size = SIZE - 1
        for axis in (0, 1):
            uv = K[axis, axis] * mean[:, axis] / mean[:, 2] + K[axis, 2]
            uv = np.clip(np.floor(uv), 0, size) + 0.5
            mean[:, axis] = (uv - K[axis, 2]) / K[axis, axis] * mean[:, 2]
        fields["means"][where] = mean

    on_pixel(np.isin(kind, (0, 1, 3)))
    fields["log_scales"][kind == 4] = -40.0  # a point: only the dilation remains
    fields["log_scales"][kind == 5] = 14.0  # a million units wide
    fields["log_scales"][kind == 6, 1] = -30.0  # flat
    fields["quats"][kind == 7] *= 1e-23
    fields["quats"][kind == 8] *= 1e20
    fields["logit_opacities"][kind == 9] = 80.0
    fields["log_scales"][kind == 10] = 80.0  # clipped, not culled
    fields["sh"][kind == 11] *= 1e6
    longest, scene = needles(10_000, seed, far=10_000), scene_of(fields)
    some = (np.arange(SLOTS) // 12) % 4 == 3
    params = scenes.where_slots(some, longest.params, scene.params)
    return scene.replace(params=params)  # pyright: ignore


def clipped(gaussians: Gaussians) -> Gaussians:
    """Clip log scales as documented, which the reference does not."""
    scales = jnp.clip(gaussians.params.log_scales, -40.0, 20.0)
    return scenes.with_params(gaussians, log_scales=scales)


def wrongly_culled(full: bool) -> Measurement:
    """Count single splats that the reference shows and the library does not."""
    lost, seen = 0, 0
    for seed in range(16 if full else 2):
        scene, camera = extreme_but_valid(seed), level_camera()
        found, radii = scenes.alpha_per_gaussian(scene, camera)
        wanted = scenes.reference_alpha(clipped(scene), camera)
        visible = wanted.max((1, 2)) >= VISIBLE
        seen += int(visible.sum())
        gone = (found.max((1, 2)) < 0.9 * VISIBLE) | (radii == 0)
        lost += int(np.sum(visible & gone))
    return Measurement(lost if seen > SLOTS // 2 else np.nan, f"of {seen} in view")


def beside_bad(full: bool) -> Measurement:
    """Count valid splats lost beside bad ones, and bad ones that are drawn."""
    wrong, seen, bad = 0, 0, np.arange(SLOTS) % 5 == 0
    values = np.resize(scenes.to_float32([np.nan, np.inf, -np.inf]), SLOTS)
    for seed in range(16 if full else 2):
        scene, camera = extreme_but_valid(seed), level_camera()
        visible = scenes.reference_alpha(clipped(scene), camera).max((1, 2)) >= VISIBLE
        fields = scenes.numpy_fields(scene)
        for place, slot in enumerate(np.flatnonzero(bad)):
            field = fields[FIELDS[place % len(FIELDS)]]
            field.reshape(SLOTS, -1)[slot, place % field[slot].size] = values[place]
        changed = scenes.with_params(scene, **fields)
        out, gradients = scenes.render_and_gradients(changed, camera)
        lost = visible & ~bad & (out.radii == 0)
        wrong += int(lost.sum() + (out.radii[bad] > 0).sum())
        wrong += scenes.count_nonfinite((scenes.images_of(out), gradients))
        seen += int(np.sum(visible & ~bad))
    return Measurement(
        wrong if seen > SLOTS // 2 else np.nan, f"{seen} beside {bad.sum()}"
    )


CASES = (
    *(
        StressCase(
            f"needles/alpha at {length} px",
            "largest |Δα|",
            1e-3,
            partial(alpha_error, length, 1_000),
        )
        for length in (10, 100, 1_000, 10_000)
    ),
    StressCase(
        "needles/centred 10000 px away",
        "largest |Δα|",
        1e-3,
        partial(alpha_error, 10_000, 10_000),
    ),
    StressCase("needles/gradient at 1000 px", "relative, 99 %", 5e-3, gradient_error),
    StressCase("needles/antialias ratio", "relative, 1000 px", 2e-3, antialias_ratio),
    StressCase(
        "projection/float32", "centres against float64", 1e-3, projection_error, "px"
    ),
    StressCase("extremes/wrongly culled", "visible, but culled", 0, wrongly_culled),
    StressCase("extremes/beside bad ones", "lost, or bad and drawn", 0, beside_bad),
)
