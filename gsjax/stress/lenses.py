"""Cases of lenses and shutters: poison, bad coefficients, and culling.

Tiles and blending do not depend on the lens, and other cases check them. These cases
blend the projected splats at every pixel within their bounds, in one program per lens.
The oracle is NumPy in float64 with the published formulas of the lenses.

Axis legend: N slots, H W image, P points.
"""

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.cameras import lenses
from gsjax.cameras.camera import Camera, make_camera, with_shutter
from gsjax.gaussians import Gaussians, make_gaussians
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.primitives.unscented import period_of
from gsjax.raster.types import Inputs, RasterConfig
from gsjax.stress import lens_formulas as formulas
from gsjax.stress import lens_pictures, scenes
from gsjax.stress.types import Measurement, StressCase

Array = jax.Array
SLOTS, WIDTH, HEIGHT = 48, 24, 16
OPEN = scenes.NO_CUTOFFS
UNSCENTED = OPEN.replace(projection="unscented")
VALUES = (np.nan, np.inf, -np.inf, 0.0, 1e-45, -1.0, 1e10, -1e19, 3e38)
TWIST = (0.02, -0.05, 0.03, 0.04, 0.1, -0.03)
BEAMS = lenses.lidar_coefficients(
    np.linspace(0.35, -0.4, HEIGHT), np.linspace(1.4, -1.5, WIDTH)
)
_OPENCV = (-0.12, 0.03, 0.004, -0.006, 0.01, 0.02, -0.01, 0.003)
# Compiling takes longest by far, and running milliseconds.
QUICK = {
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
}


class Spec(NamedTuple):
    """A camera of these cases.

    Attributes:
      lens: name of the lens, or "lidar".
      coefficients: of the lens.
      focal: in px.
      config: static settings.
      shutter: name of the shutter.
      full_only: whether the short form omits it.
    """

    lens: str
    coefficients: tuple[float, ...] = ()
    focal: float = 14.0
    config: RasterConfig = OPEN
    shutter: str = "global"
    full_only: bool = False


_FISHEYE = Spec("fisheye", (0.06, -0.02, 0.004, -0.001), 6.0, full_only=True)
_FTHETA = (0.0, 6.0, 0.1, -0.2, 0.05, 0.0, 1.01, 0.002, -0.003, 1.9)
_INVERSE = (0.0, 0.16, 1e-3, -1e-4, 1e-5, 0.0, 1.01, 0.002, -0.003, 1.9)
SPECS = {
    "opencv 4": Spec("opencv", _OPENCV[:4], full_only=True),
    "opencv 5": Spec("opencv", _OPENCV[:5], full_only=True),
    "opencv 8": Spec("opencv", _OPENCV, full_only=True),
    "opencv 12": Spec("opencv", (*_OPENCV, 0.002, -1e-3, 3e-3, 1e-3), full_only=True),
    "fisheye": _FISHEYE,
    "thin_prism_fisheye": Spec(
        "thin_prism_fisheye",
        (0.05, -0.02, 0.002, -0.001, 0.003, -5e-4, 0.001, -0.002),
        6.0,
        full_only=True,
    ),
    "rad_tan_thin_prism_fisheye": Spec(
        "rad_tan_thin_prism_fisheye",
        (*(0.05, -0.02, 0.003, -5e-4, 0, 0), 0.002, -0.001, 1e-3, 2e-4, -1e-3, 1e-4),
        6.0,
        full_only=True,
    ),
    "fov": Spec("fov", (0.8,), full_only=True),
    "division": Spec("division", (-0.2,), full_only=True),
    "division, bounded": Spec("division", (0.2,), full_only=True),
    "eucm": Spec("eucm", (0.6, 1.1), 7.0, full_only=True),
    "ftheta": Spec("ftheta", _FTHETA, 1.0, full_only=True),
    "ftheta_inverse": Spec("ftheta_inverse", _INVERSE, 1.0, full_only=True),
    "equirectangular": Spec("equirectangular", full_only=True),
    "lidar": Spec("lidar", tuple(BEAMS), 1.0),
    "unscented": Spec("equirectangular", config=UNSCENTED, full_only=True),
    "rolling": _FISHEYE._replace(shutter="top_to_bottom", full_only=False),
    "rolling, unscented": _FISHEYE._replace(shutter="right_to_left", config=UNSCENTED),
}


def specs(full: bool) -> dict[str, Spec]:
    """Return the cameras of the full or the short form."""
    return {name: s for name, s in SPECS.items() if full or not s.full_only}


def camera_of(spec: Spec, viewmat=None) -> Camera:
    """Return the camera of a spec, by default at the origin."""
    lens = lenses.lidar_lens(HEIGHT, WIDTH) if spec.lens == "lidar" else spec.lens
    K = np.diag([spec.focal, 1.1 * spec.focal, 1.0])
    K[:2, 2] = 0.52 * WIDTH, 0.47 * HEIGHT
    if spec.lens == "lidar":
        K[:2] = (1, 0, 0.5), (0, 1, 0.5)
    if spec.lens == "equirectangular":
        K = lenses.panorama_intrinsics(WIDTH, HEIGHT)
    coefficients = scenes.to_float32(spec.coefficients) if spec.coefficients else None
    camera = make_camera(
        viewmat=scenes.to_float32(np.eye(4) if viewmat is None else viewmat),
        K=scenes.to_float32(K),
        width=WIDTH,
        height=HEIGHT,
        lens=lens,
        coefficients=coefficients,
    )
    if spec.shutter == "global":
        return camera
    return with_shutter(camera, spec.shutter, twist=scenes.to_float32(TWIST))


class View(NamedTuple):
    """A picture with the gradients of its weighted sum.

    Attributes:
      image: [H, W, 3] over black.
      drawn: [N] bool, whether the splat was drawn.
      params, camera: the gradients.
    """

    image: Any
    drawn: Any
    params: Any
    camera: Any


def _shifts(camera: Camera) -> tuple[Array, Array]:
    """Return the turns [T] of the image in px, and intrinsics [T, 3, 3] shifted so."""
    period = period_of(camera)
    turns = jnp.zeros(1) if period is None else jnp.arange(-1, 2) * period
    K = jnp.broadcast_to(camera.K, (len(turns), 3, 3))
    return turns, K.at[:, 0, 2].add(turns)


def _blend(camera: Camera, config: RasterConfig, bounds, out) -> Array:
    """Blend splats, front to back, at all pixels within their boxes [T, R]."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32) + 0.5
    inv_sx, slope, inv_sy, opacity = (a[:, None, None] for a in out.splat.shape)
    turns, _ = _shifts(camera)
    z, box = jax.tree.map(lambda a: a[..., None, None], (bounds.z, bounds.box))
    left = jnp.ones((z.shape[1], HEIGHT, WIDTH))
    for turn in range(len(turns)):
        dx = columns - (out.splat.u[:, None, None] + turns[turn])
        dy = rows - out.splat.v[:, None, None]
        live = z[turn] < jnp.inf
        dx, dy = jnp.where(live, dx, 0), jnp.where(live, dy, 0)
        square = (inv_sx * dx) ** 2 + (inv_sy * (dy - slope * dx)) ** 2
        seen = live & (square < out.footprint.reach[:, None, None])
        seen &= jnp.abs(columns - box.u[turn]) <= box.half_width[turn]
        seen &= jnp.abs(rows - box.v[turn]) <= box.half_height[turn]
        alpha = opacity * jnp.exp(-0.5 * jnp.where(seen, square, 0))
        alpha = jnp.where(alpha < config.alpha_max, alpha, config.alpha_max)
        left = left * (1 - jnp.where(seen, alpha, 0))
    clear = jnp.cumprod(jnp.concatenate([jnp.ones_like(left[:1]), left]), axis=0)
    weights = clear[:-1] * (1 - left)
    colors = out.channels.colors
    return jnp.stack([jnp.sum(weights * c[:, None, None], 0) for c in colors], -1)


@scenes.with_numpy
@partial(jax.jit, static_argnames="config", compiler_options=QUICK)
def view(gaussians: Gaussians, camera: Camera, config: RasterConfig = OPEN) -> View:
    """Return the picture of degree-0 Gaussians in `SLOTS` slots, and its gradients."""
    p = gaussians.params
    values = (p.means, p.log_scales, p.logit_opacities, p.quats)
    bounds = jax.vmap(
        lambda K: ELLIPSOID.bounds(
            gaussians.active, values, camera.replace(K=K), config
        )
    )(_shifts(camera)[1])
    nearest = jnp.min(bounds.z, axis=0)
    order, count = jnp.argsort(nearest), jnp.sum(nearest < jnp.inf)
    bounds = jax.tree.map(lambda a: a[:, order], bounds)
    weights = np.cos(np.arange(HEIGHT * WIDTH * 3, dtype=np.float32))

    def loss(params, camera):
        scene = gaussians.replace(params=params)  # pyright: ignore
        out = ELLIPSOID.project(Inputs(scene, camera), config, order, count)
        image = _blend(camera, config, bounds, out)
        return jnp.sum(weights.reshape(image.shape) * image), (image, out)

    slopes, (image, out) = jax.grad(loss, (0, 1), has_aux=True)(p, camera)
    live = (jnp.arange(SLOTS) < count) & (out.footprint.reach > 0)
    return View(image, jnp.zeros(SLOTS, bool).at[order].set(live), *slopes)


def _scene(points, scales, seed: int = 0) -> dict[str, np.ndarray]:
    """Return fields of Gaussians at camera points [N, 3] of a camera at the origin."""
    rng = np.random.default_rng(seed)
    opacities = rng.uniform(0.2, 0.9, len(points))
    return scenes.gaussian_fields(points, scales, opacities, np.eye(4), seed, degree=0)


@cache
def _around(seed: int = 0) -> dict[str, np.ndarray]:
    """Return splats in all directions, of all sizes, most of them ahead."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(SLOTS, 3)) + (0, 0, 1.0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance = rng.uniform(1, 4, (SLOTS, 1))
    scales = distance * np.exp(rng.uniform(-4, -1.5, (SLOTS, 3)))
    return _scene(distance * direction, scales, seed)


def _gaussians(fields: dict[str, np.ndarray]) -> Gaussians:
    return make_gaussians(**fields, capacity=SLOTS)


def _special_points(spec: Spec) -> np.ndarray:
    """Return camera points at which a lens ends or a direction is undefined."""
    fold = formulas.fold_angle(spec.lens, np.array(spec.coefficients))
    angles = np.array([fold, fold + 1e-7, fold - 1e-7, 1.5, 3.1415925])
    rim = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], -1)
    axes = np.concatenate([np.eye(3), -np.eye(3), 1e-7 * np.eye(3), np.zeros((1, 3))])
    seam = np.array([[1e-30, 0, -1], [-1e-30, 0.1, -1], [0, 1e-17, -2], [0, 0, 1e-30]])
    return np.concatenate([axes, rim, 2 * rim[:, [1, 0, 2]], seam])


def poisoned(spec: Spec) -> list[dict[str, np.ndarray]]:
    """Return fields of scenes of which the even slots are poisoned."""
    found, special = [], _special_points(spec)
    fields = {name: a.copy() for name, a in _around().items()}
    fields["means"][: 2 * len(special) : 2] = special[: SLOTS // 2]
    found.append(fields)
    for value in VALUES:
        fields = {name: a.copy() for name, a in _around().items()}
        flat = [
            (name, i) for name in fields for i in np.ndindex(fields[name].shape[1:])
        ]
        for place, (name, index) in enumerate(flat):
            fields[name][2 * place % SLOTS, *index] = value
        found.append(fields)
    return found


def _violations(spec: Spec, fields) -> tuple[int, int]:
    """Return the numbers of non-finite and of changed values of a scene."""
    camera, scene = camera_of(spec), _gaussians(fields)
    found = view(scene, camera, config=spec.config)
    clean = scenes.where_slots(found.drawn, scene.params, _gaussians(_around()).params)
    without = scene.replace(params=clean, active=found.drawn)  # pyright: ignore
    wanted = view(without, camera, config=spec.config)
    leaves = jax.tree.leaves(wanted._replace(drawn=None))
    pairs = zip(jax.tree.leaves(found._replace(drawn=None)), leaves)
    changed = 0
    for a, b in pairs:  # non-finite ones are counted apart
        size = np.abs(b).max(initial=1)
        changed += int(np.sum(np.abs(a - b) > 1e-5 * size))
    changed += int(found.drawn.sum() < SLOTS // 8)
    return scenes.count_nonfinite(found), changed


def _counted(words: list[str], count: int, full: bool) -> Measurement:
    note = "; ".join([f"{len(specs(full))} lenses and shutters", *words[:3]])
    return Measurement(count, note, {"wrong": words})


def gaussians(full: bool) -> Measurement:
    """Count violations over poisoned Gaussians."""
    count, words = 0, []
    for name, spec in specs(full).items():
        for number, fields in enumerate(poisoned(spec)):
            some = _violations(spec, fields)
            count += sum(some)
            if sum(some):
                value = VALUES[number - 1] if number else "special points"
                words.append(f"{name}, {value}: non-finite and changed {some}")
    return _counted(words, count, full)


def bad_cameras(spec: Spec, full: bool) -> list[tuple[str, Camera]]:
    """Return cameras with one bad number, and cameras that fold anywhere."""
    camera, found = camera_of(spec), []
    rng = np.random.default_rng(0)
    for name in ("K", "viewmat", "coefficients", "twist"):
        array = getattr(camera, name)
        if array is None:
            continue
        places = list(np.ndindex(array.shape))
        places = places if full or len(places) <= 12 else places[:: len(places) // 12]
        for place, value in ((p, v) for p in places for v in VALUES):
            changed = np.array(array)
            changed[place] = value
            found.append(
                (f"{value:g} in {name}{place}", camera.replace(**{name: changed}))
            )
        if name in ("coefficients", "twist"):
            for _ in range(64 if full else 16):
                scale = np.exp(rng.uniform(-2, 4))
                changed = scenes.to_float32(scale * rng.normal(size=array.shape))
                found.append((f"{name} {changed}", camera.replace(**{name: changed})))
    return found


def cameras(full: bool) -> Measurement:
    """Count non-finite values over bad cameras."""
    count, words = 0, []
    scene = _gaussians(_around())
    for name, spec in specs(full).items():
        for what, camera in bad_cameras(spec, full):
            wrong = scenes.count_nonfinite(view(scene, camera, config=spec.config))
            count += wrong
            if wrong:
                words.append(f"{name}, {what}: {wrong}")
    return _counted(words, count, full)


def culling(full: bool) -> Measurement:
    """Return the largest error of colours against the oracle."""
    worst, words = 0.0, []
    for name, spec in specs(full).items():
        camera, unscented = camera_of(spec), None
        optics = lens_pictures.optics_of(camera, spec.lens)
        if spec.config.projection == "unscented":
            unscented = spec.config.unscented
        for seed in range(20 if full else 4):
            fields = _around(seed)
            if spec.shutter != "global":
                fields = lens_pictures.within_limits(fields, optics)
            found = view(_gaussians(fields), camera, config=spec.config)
            wanted = lens_pictures.picture(fields, optics, unscented)
            error = float(np.abs(found.image - wanted).max())
            if not error <= worst:
                worst, words = error, [f"worst: {name}, scene {seed}"]
    return _counted(words, worst, full)  # pyright: ignore


CASES = (
    StressCase("lenses/poison", "non-finite, or changed by undrawn", 0, gaussians),
    StressCase("lenses/camera", "non-finite images and gradients", 0, cameras),
    StressCase("lenses/culling", "largest colour error", 1e-3, culling),
)
