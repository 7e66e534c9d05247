"""float32 against float64: random scenes, distant worlds, gradients, projections."""

from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera, look_at
from gsjax.data.rebase import rebase
from gsjax.data.types import Dataset, View
from gsjax.gaussians import Gaussians
from gsjax.math.numerics import in_float64
from gsjax.math.rotations import quaternion_to_matrix
from gsjax.stress import scenes
from gsjax.stress.needles import projected_means
from gsjax.stress.scenes import COMPAT, FIELDS, FOCAL, SIZE, SLOTS, camera_of, scene_of
from gsjax.stress.types import Measurement, StressCase

_NUM_SCENES_SHORT, _NUM_SCENES_FULL = 50, 1000
_DIRECTIONS = 32
_QUANTILES = ("50 %", "99 %", "99.9 %", "largest")


def random_scene(seed: int) -> tuple[Gaussians, Camera]:
    """Return a scene and a camera drawn from a wide family."""
    rng = np.random.default_rng([seed, 20])
    viewmat = scenes.random_pose(int(rng.integers(2**31)))
    focal = float(np.exp(rng.uniform(np.log(12), np.log(200))))
    near = float(np.exp(rng.uniform(np.log(0.05), np.log(5))))
    far = near * rng.uniform(1.2, 20)
    points = scenes.frustum_points(rng, near=near, far=far, spread=0.6)
    points[:, :2] *= FOCAL / focal
    unit = points[:, 2:] / focal
    size = np.exp(
        rng.uniform(-1, 3) + rng.uniform(0.1, 1.5) * rng.normal(size=(SLOTS, 3))
    )
    opacities = rng.beta(rng.uniform(0.3, 2), rng.uniform(0.3, 2), SLOTS)
    opacities = opacities.clip(0.005, 0.995)
    fields = scenes.gaussian_fields(points, size * unit, opacities, viewmat, seed)
    live = rng.integers(8, scenes.MAX_FULL + 1)
    scene = scenes.with_active(scene_of(fields), np.arange(SLOTS) < live)
    centre = tuple(SIZE * rng.uniform(0.3, 0.7, 2))
    return scene, camera_of(viewmat, focal=focal, centre=centre)


def scene_errors(seed: int) -> tuple[float, float, float]:
    """Return the errors of a random scene, over the pixels clear of thresholds.

    Returns:
      The largest error of α and colour; the relative L2 error of the gradient by the
      worst kind of parameter; the share of pixels compared.
    """
    scene, camera = random_scene(seed)
    channels, clear, wanted = scenes.reference(scene, camera)
    weights = np.where(clear[..., None], scenes.loss_weights(), 0)
    out, found = scenes.render_and_gradients(scene, camera, weights=weights)
    images = np.concatenate([out.rgb, out.alpha[..., None]], -1)
    image = np.abs(images - channels[..., :4])[clear].max(initial=0)
    worst = 0.0
    for field in FIELDS:
        a, b = getattr(found.params, field), getattr(wanted.params, field)
        norm = np.linalg.norm(b)
        if norm > 0:
            worst = float(np.maximum(worst, np.linalg.norm(a - b) / norm))
    return float(image), worst, float(clear.mean())


@cache
def _all_errors(full: bool) -> np.ndarray:
    """Return [scenes, 3], see `scene_errors`."""
    count = _NUM_SCENES_FULL if full else _NUM_SCENES_SHORT
    return np.array([scene_errors(seed) for seed in range(count)])


def random_scenes(column: int, full: bool) -> Measurement:
    """Measure the 99.9 % quantile of image (0) or gradient (1) errors."""
    errors = _all_errors(full)[:, column]
    quantiles = np.quantile(errors, (0.5, 0.99, 0.999, 1))
    worst = int(np.argmax(errors))
    note = f"{len(errors)} scenes, median {quantiles[0]:.1e}, "
    note += f"largest {quantiles[-1]:.1e} (scene {worst})"
    more = {
        **dict(zip(_QUANTILES, quantiles.tolist())),
        "worst seed": worst,
        "pixels compared": float(_all_errors(full)[:, 2].mean()),
    }
    return Measurement(float(quantiles[2]), note, more)


def distant_dataset(offset: float) -> Dataset:
    """Return eight cameras around points, ``offset`` metres from the origin."""
    rng = np.random.default_rng(0)
    middle = offset * np.array([1, -0.7, 0.3])
    K = np.array([[FOCAL, 0, 16.6], [0, 1.07 * FOCAL, 15.1], [0, 0, 1]])
    views = []
    for turn in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        away = np.array([4 * np.cos(turn), 4 * np.sin(turn), 1.3])
        viewmat = look_at(away, (0, 0, 0))
        viewmat[:3, 3] -= viewmat[:3, :3] @ middle
        views.append(View(f"{turn:.2f}", Path("none"), viewmat, K, SIZE, SIZE))
    points = middle + rng.uniform(-1, 1, (SLOTS, 3))
    colors = np.zeros((SLOTS, 3), np.uint8)
    return Dataset(Path("none"), "none", tuple(views), points, colors)


def distant_world(offset: float, _full: bool) -> Measurement:
    """Measure the px error of float32 after rebasing, against float64 without."""

    def means(dataset: Dataset, view: View) -> np.ndarray:
        fields = scenes.gaussian_fields(np.zeros((SLOTS, 3)), 0.05, 0.5)
        fields["means"] = dataset.points.astype(np.float32)
        camera = camera_of(view.viewmat, centre=(view.K[0, 2], view.K[1, 2]))
        return projected_means(scene_of(fields), camera)

    dataset = distant_dataset(offset)
    near, rebased, plain = rebase(dataset), 0.0, 0.0
    for before, after in zip(dataset.views, near.views):
        rotation = before.viewmat[:3, :3]
        x, y, z = rotation @ (dataset.points - before.centre).T
        K = scenes.to_float64(scenes.to_float32(before.K))
        wanted = np.stack([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]], 1)
        rebased = np.maximum(rebased, np.abs(means(near, after) - wanted).max())
        plain = np.maximum(plain, np.abs(means(dataset, before) - wanted).max())
    return Measurement(rebased, f"{plain:.2g} px without rebasing")


def _smooth_sum(gaussians: Gaussians, camera: Camera, weights) -> jax.Array:
    """Return a smooth scalar that depends on every output of the projection."""
    footprint, splat, channels = scenes.project_slots(gaussians, camera)
    inv_sx, slope, inv_sy, _ = splat.shape
    parts = (splat.u, splat.v, jnp.log(inv_sx), slope, jnp.log(inv_sy))
    rows = jnp.stack([*parts, jnp.log(footprint.var_y), *channels.colors])
    return jnp.sum(weights * rows)


@jax.jit
def _derivatives_and_differences(gaussians, camera, weights, directions):
    def along(by_params, by_camera):
        def value(step):
            params = jax.tree.map(
                lambda a, d: a + step * d, gaussians.params, by_params
            )
            viewmat = camera.viewmat + step * by_camera
            moved = Camera(**{**vars(camera), "viewmat": viewmat})
            return _smooth_sum(gaussians.replace(params=params), moved, weights)

        size = 1e-5
        _, slope = jax.jvp(value, (0.0,), (1.0,))
        return slope, (value(size) - value(-size)) / (2 * size)

    return jax.vmap(along)(*directions)


def projection_gradient(full: bool) -> Measurement:
    """Measure derivatives of the projection against central differences in float64.

    The principal point is off centre, a third of the Gaussians lies beyond the limits
    of the linearisation, and colours are of degree 3.
    """
    worst, camera = 0.0, camera_of(centre=(-6.0, 21.0))
    for seed in range(4 if full else 1):
        rng = np.random.default_rng(seed)
        points = scenes.frustum_points(rng, spread=1.5)
        scene = scene_of(scenes.gaussian_fields(points, 0.2, 0.5, seed=seed))
        by_params = jax.tree.map(
            lambda a, r=rng: r.normal(size=(_DIRECTIONS, *a.shape)), scene.params
        )
        by_camera = rng.normal(size=(_DIRECTIONS, 4, 4))
        with jax.enable_x64(True):
            given = in_float64((scene, camera, rng.normal(size=(9, SLOTS))))
            directions = jax.tree.map(jnp.asarray, (by_params, 0.01 * by_camera))
            found, wanted = _derivatives_and_differences(*given, directions)
            errors = np.abs(np.asarray(found) - np.asarray(wanted))
            size = np.sqrt(np.mean(np.square(np.asarray(wanted))))
        worst = np.maximum(worst, float(errors.max() / size))
    return Measurement(worst, f"{_DIRECTIONS} directions")


def linearisation_limits(_full: bool) -> Measurement:
    """Measure the error of covariances beyond the image, relative to their trace.

    The float64 formula clips x / z and y / z in J to 15 % beyond *each* side of the
    image. The principal point is outside the image, where limits that are symmetric
    about it would be far off.
    """
    camera = camera_of(np.eye(4), centre=(-6.0, 21.0))
    points = scenes.frustum_points(np.random.default_rng(0), spread=2.5)
    fields = scenes.gaussian_fields(points, (0.3, 0.1, 0.05), 0.5, np.eye(4))
    scene = scene_of(fields)
    out = scenes.projected(scene, camera).footprint
    xx, drawn = 1 / np.square(out.inv_sx), out.reach > 0
    found = np.stack([xx, xx * out.slope, out.var_y], 1)
    means, scales = (scenes.to_float64(fields[n]) for n in ("means", "log_scales"))
    rotations = scenes.to_float64(quaternion_to_matrix(scene.params.quats))
    K, z = scenes.to_float64(camera.K), means[:, 2]
    jacobian, beyond = np.zeros((SLOTS, 2, 3)), np.zeros(SLOTS, bool)
    for row in range(2):
        focal, centre, ratio = K[row, row], K[row, 2], means[:, row] / z
        inside = (np.array([-0.15, 1.15]) * SIZE - centre) / focal
        jacobian[:, row, row] = focal / z
        jacobian[:, row, 2] = -focal / z * np.clip(ratio, *inside)
        beyond |= np.clip(ratio, *inside) != ratio
    half = jacobian @ rotations * np.exp(scales)[:, None]
    wanted = half @ half.transpose(0, 2, 1) + COMPAT.dilation * np.eye(2)
    trace = np.trace(wanted, axis1=1, axis2=2)
    errors = found - wanted[:, (0, 0, 1), (0, 1, 1)]
    error = float(np.max(np.abs(errors[drawn]) / trace[drawn, None]))
    count = int(np.sum(beyond & drawn))
    return Measurement(
        error if count > SLOTS // 4 else np.nan, f"{count} beyond a side"
    )


_IMAGE, _GRADIENT = partial(random_scenes, 0), partial(random_scenes, 1)
CASES = (
    StressCase("scenes/image", "error of α and colour, 99.9 %", 1e-4, _IMAGE),
    StressCase("scenes/gradient", "relative L2 error, 99.9 %", 1e-3, _GRADIENT),
    *(
        StressCase(
            f"far world/1e{n} m",
            "centres, rebased",
            1e-3,
            partial(distant_world, 10.0**n),
            "px",
        )
        for n in (5, 6, 7)
    ),
    StressCase(
        "projection/beyond the sides", "covariance error", 1e-5, linearisation_limits
    ),
    StressCase(
        "projection/slopes",
        "against differences",
        1e-3,
        projection_gradient,
        full_only=True,
    ),
)
