"""float32 against float64: random scenes, far worlds; slopes against differences."""

from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras.camera import Camera, look_at
from gsjax.data.rebase import rebase
from gsjax.data.types import Dataset, View
from gsjax.gaussians import Gaussians, num_active
from gsjax.math.numerics import in_float64
from gsjax.math.rotations import quaternion_to_matrix
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.types import Inputs
from gsjax.stress.needles import projected
from gsjax.stress.scenes import (
    COMPAT,
    FIELDS,
    FOCAL,
    SIZE,
    SLOTS,
    WIDE,
    camera_of,
    double,
    fields_at,
    frustum,
    oracle,
    pose,
    scene_of,
    single,
    usual_gradients,
    weights,
)
from gsjax.stress.types import Case, Measured, worse

SHORT, FULL = 50, 1000
DIRECTIONS = 32
_POINTS = ("50 %", "99 %", "99.9 %", "largest")


def random_scene(seed: int) -> tuple[Gaussians, Camera]:
    """A scene and a view drawn from a wide family, by its seed alone."""
    rng = np.random.default_rng([seed, 20])
    viewmat = pose(int(rng.integers(2**31)))
    focal = float(np.exp(rng.uniform(np.log(12), np.log(200))))
    near = float(np.exp(rng.uniform(np.log(0.05), np.log(5))))
    points = frustum(rng, near=near, far=near * rng.uniform(1.2, 20), spread=0.6)
    points[:, :2] *= FOCAL / focal
    unit = points[:, 2:] / focal
    size = np.exp(
        rng.uniform(-1, 3) + rng.uniform(0.1, 1.5) * rng.normal(size=(SLOTS, 3))
    )
    opacities = rng.beta(rng.uniform(0.3, 2), rng.uniform(0.3, 2), SLOTS)
    fields = fields_at(points, size * unit, opacities.clip(0.005, 0.995), viewmat, seed)
    live = rng.integers(8, WIDE + 1)
    scene = scene_of(fields).replace(active=jnp.arange(SLOTS) < live)  # pyright: ignore
    centre = tuple(SIZE * rng.uniform(0.3, 0.7, 2))
    return scene, camera_of(viewmat, focal=focal, centre=centre)


def scene_errors(seed: int) -> tuple[float, float, float]:
    """Of a random scene: the largest error of a channel of alpha and colour away from
    thresholds; the relative L2 error of the gradient by the worst kind of parameter;
    the share of pixels away from thresholds.
    """
    scene, camera = random_scene(seed)
    channels, clear, wanted = oracle(scene, camera)
    weigh = np.where(clear[..., None], weights(), 0)
    out, found = usual_gradients(scene, camera, weigh=weigh)
    images = np.concatenate([out.rgb, out.alpha[..., None]], -1)
    image = np.abs(images - channels[..., :4])[clear].max(initial=0)
    worst = 0.0
    for field in FIELDS:
        a, b = getattr(found.params, field), getattr(wanted.params, field)
        norm = np.linalg.norm(b)
        worst = worse(worst, float(np.linalg.norm(a - b) / norm) if norm > 0 else 0.0)
    return float(image), worst, float(clear.mean())


@cache
def _errors(full: bool) -> np.ndarray:
    """[scenes, 3], see `scene_errors`."""
    return np.array([scene_errors(seed) for seed in range(FULL if full else SHORT)])


def of_scenes(column: int):
    """99.9 % point over random scenes of the image (0) or gradient (1) errors."""

    def measure(full: bool) -> Measured:
        errors = _errors(full)[:, column]
        points = np.quantile(errors, (0.5, 0.99, 0.999, 1))
        worst = int(np.argmax(errors))
        told = dict(zip(_POINTS, points.tolist()))
        note = f"{len(errors)} scenes, median {points[0]:.1e}, "
        note += f"largest {points[-1]:.1e} (scene {worst})"
        clear = float(_errors(full)[:, 2].mean())
        more = {**told, "worst seed": worst, "pixels compared": clear}
        return Measured(float(points[2]), note, more)

    return measure


def far_scene(offset: float) -> tuple[Dataset, np.ndarray]:
    """Eight cameras around points, ``offset`` metres from the origin on each axis."""
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
    return Dataset(Path("none"), "none", tuple(views), points, colors), points


def far_world(offset: float):
    """px between float32 after rebasing, and float64 in the original coordinates."""

    def shown(scene: Dataset, view: View) -> np.ndarray:
        fields = fields_at(np.zeros((SLOTS, 3)), 0.05, 0.5)
        fields["means"] = scene.points.astype(np.float32)
        camera = camera_of(view.viewmat, centre=(view.K[0, 2], view.K[1, 2]))
        return np.asarray(projected(scene_of(fields), camera)[0], np.float64)

    def measure(full: bool) -> Measured:
        del full
        scene, points = far_scene(offset)
        near, errors = rebase(scene), {"rebased": 0.0, "plain": 0.0}
        for before, after in zip(scene.views, near.views):
            rotation = before.viewmat[:3, :3]
            x, y, z = rotation @ (points - before.centre).T
            K = double(single(before.K))
            wanted = np.stack([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]], 1)
            for name, seen, view in (
                ("rebased", near, after),
                ("plain", scene, before),
            ):
                error = float(np.max(np.abs(shown(seen, view) - wanted)))
                errors[name] = worse(errors[name], error)
        return Measured(errors["rebased"], f"{errors['plain']:.2g} px without rebasing")

    return measure


def _numbers(gaussians: Gaussians, camera: Camera, weigh) -> jax.Array:
    """A smooth number that every output of the projection has a part in."""
    order = jnp.arange(SLOTS)
    inputs, count = Inputs(gaussians, camera), num_active(gaussians)
    footprint, splat, channels = ELLIPSOID.project(inputs, COMPAT, order, count)
    inv_sx, slope, inv_sy, _ = splat.shape
    parts = (splat.u, splat.v, jnp.log(inv_sx), slope, jnp.log(inv_sy))
    rows = jnp.stack([*parts, jnp.log(footprint.var_y), *channels.colors])
    return jnp.sum(weigh * rows)


@jax.jit
def _slopes_and_differences(gaussians, camera, weigh, directions):
    def along(by_params, by_camera):
        def moved(step):
            params = jax.tree.map(
                lambda a, d: a + step * d, gaussians.params, by_params
            )
            return gaussians.replace(params=params), Camera(
                **{**vars(camera), "viewmat": camera.viewmat + step * by_camera}
            )

        def value(step):
            return _numbers(*moved(step), weigh)

        size = 1e-5
        _, slope = jax.jvp(value, (0.0,), (1.0,))
        return slope, (value(size) - value(-size)) / (2 * size)

    return jax.vmap(along)(*directions)


def off_axis(full: bool) -> Measured:
    """Slopes against central differences in float64, beyond the limits of the lens.

    The principal point lies off the centre; a third of the Gaussians lies outside
    what the projection is linearised within; colours are of degree 3.
    """
    worst, camera = 0.0, camera_of(centre=(-6.0, 21.0))
    for seed in range(4 if full else 1):
        rng = np.random.default_rng(seed)
        points = frustum(rng, spread=1.5)
        scene = scene_of(fields_at(points, 0.2, 0.5, seed=seed))
        by_params = jax.tree.map(
            lambda a, r=rng: r.normal(size=(DIRECTIONS, *a.shape)), scene.params
        )
        by_camera = rng.normal(size=(DIRECTIONS, 4, 4))
        with jax.enable_x64(True):
            given = in_float64((scene, camera, rng.normal(size=(9, SLOTS))))
            directions = jax.tree.map(jnp.asarray, (by_params, 0.01 * by_camera))
            slopes, differences = _slopes_and_differences(*given, directions)
            errors = np.abs(np.asarray(slopes) - np.asarray(differences))
            size = np.sqrt(np.mean(np.square(np.asarray(differences))))
        worst = worse(worst, float(errors.max() / size))
    return Measured(worst, f"{DIRECTIONS} directions")


@jax.jit
def _covariances(gaussians: Gaussians, camera: Camera) -> tuple[jax.Array, ...]:
    """Of the slots: xx, xy, yy of the projection, and whether it is drawn."""
    inputs, count = Inputs(gaussians, camera), num_active(gaussians)
    out = ELLIPSOID.project(inputs, COMPAT, jnp.arange(SLOTS), count).footprint
    xx = 1 / jnp.square(out.inv_sx)
    return xx, xx * out.slope, out.var_y, out.reach > 0


def limits(full: bool) -> Measured:
    """Error of covariances, relative to their trace, beyond the sides of the image.

    Against the formula in float64: J at x / z and y / z that are kept within 30 % of
    half the image beyond *each* side. The principal point lies outside the image, where
    limits that are alike on both sides would be far off.
    """
    del full
    camera = camera_of(np.eye(4), centre=(-6.0, 21.0))
    points = frustum(np.random.default_rng(0), spread=2.5)
    scene = scene_of(fields_at(points, (0.3, 0.1, 0.05), 0.5, np.eye(4)))
    xx, xy, yy, drawn = (np.asarray(a) for a in _covariances(scene, camera))
    means, scales = (double(a) for a in (scene.params.means, scene.params.log_scales))
    rotations = double(quaternion_to_matrix(scene.params.quats))
    K, z = double(camera.K), means[:, 2]
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
    errors = np.stack([xx, xy, yy], 1) - wanted[:, (0, 0, 1), (0, 1, 1)]
    error = float(np.max(np.abs(errors[drawn]) / trace[drawn, None]))
    count = int(np.sum(beyond & drawn))
    return Measured(error if count > SLOTS // 4 else np.nan, f"{count} beyond a side")


CASES = (
    Case("scenes/image", "error of α and colour, 99.9 %", 1e-4, of_scenes(0)),
    Case("scenes/gradient", "relative L2 error, 99.9 %", 1e-3, of_scenes(1)),
    *(
        Case(f"far world/1e{n} m", "centres, rebased", 1e-3, far_world(10.0**n), "px")
        for n in (5, 6, 7)
    ),
    Case("projection/beyond the sides", "error of a covariance", 1e-5, limits),
    Case("projection/slopes", "against differences", 1e-3, off_axis, full_only=True),
)
