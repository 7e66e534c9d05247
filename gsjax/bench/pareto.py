"""Run time against error: one setting of accuracy or size changes at a time.

The exact image and gradient are the renderer's in float64 with cutoffs of 1e-9. At some
pixels, including the worst of every point, the error is compared with its bound
(`gsjax.bench.pixelwise`), and the exact image with a dense one. Capacities are fitted.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.bench import pixelwise
from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians, with_sh_degree
from gsjax.math.numerics import in_float64
from gsjax.planning.types import Plan
from gsjax.raster.exact import exact_config
from gsjax.raster.render import render
from gsjax.raster.types import RasterConfig
from gsjax.runtime.console import progress
from gsjax.runtime.devices import on_cpu
from gsjax.runtime.machine import all_of, usable_cores
from gsjax.runtime.timing import interleaved
from gsjax.synthetic.stress_scenes import StressScene

_EXACT = RasterConfig.accurate(
    alpha_min=1e-9,
    alpha_max=1 - 1e-12,
    transmittance_min=1e-9,
    outputs=("rgb",),
    num_size_buckets=1,
    devices=1,
)
_CUTOFFS = {"1/255": 1 / 255, "1/1024": 1 / 1024, "1e-4": 1e-4}
_PIXELS = 48  # random pixels to compare with bounds
_LEAST = 1e-30
_BETTER = 0.05  # relative improvement that is worth more time


class Point(NamedTuple):
    """One point of the plot.

    Attributes:
      knob: the setting that changes.
      value: its value, as text.
      config: all points.
      degree: SH degree; None keeps that of the scene.
      double: use float64.
    """

    knob: str
    value: str
    config: RasterConfig
    degree: int | None = None
    double: bool = False


class _Program(NamedTuple):
    """Compiled calls of one point, and their results."""

    forward: Any
    gradient: Any
    rgb: np.ndarray
    grads: list[np.ndarray]


def make_points(gaussians: Gaussians, plan: Plan | None = None) -> list[Point]:
    """Return the presets, `RasterConfig.accurate` with one change each, and a plan."""
    common: dict[str, Any] = {"outputs": ("rgb",), "num_size_buckets": 1}
    base = RasterConfig.accurate(**common)
    # The bound of the rule "before" is ε / (1 − alpha_max): it needs a low alpha_max.
    before = base.replace(transmittance_min=1e-4, stop_rule="before", alpha_max=0.99)
    changes = [
        *(("cut", text, {"alpha_min": value}) for text, value in _CUTOFFS.items()),
        *(("stop after", t, {"transmittance_min": float(t)}) for t in ("1e-2", "1e-3")),
    ]
    sizes = [("tile", 4, "tile_size"), ("tile", 16, "tile_size")]
    sizes.append(("chunk", 64, "chunk_size"))
    found = [
        Point("compat", "", RasterConfig.compat(**common)),
        Point("accurate", "", base),
        Point("fast", "", RasterConfig.fast(**common)),
        *(Point(knob, text, base.replace(**change)) for knob, text, change in changes),
        Point("stop before", "1e-4", before),
        *(Point("SH degree", str(d), base, d) for d in range(gaussians.sh_degree)),
        *(Point(knob, str(n), base.replace(**{name: n})) for knob, n, name in sizes),
        Point("dtype", "float64", base, double=True),
    ]
    if plan is not None:
        config = plan.config.replace(
            **common, pair_capacity=None, visible_capacity=None
        )
        found.append(Point("plan", "", config, plan.gaussians.sh_degree))
    return found


def measure_points(
    scene: StressScene, points: Sequence[Point], repeats: int = 5
) -> list[dict]:
    """Return a row for each point: milliseconds, errors and their bounds.

    Its keys are knob and value; "forward ms" and "gradient ms" (value and gradient);
    "max", "psnr" and "gradient" (relative L2) against the exact image; "at worst" and
    "bound", the error and its bound at the pixel where they are closest; and "inside",
    True if every pixel compared is within its bound.
    """
    rng = np.random.default_rng(0)
    shape = (scene.camera.height, scene.camera.width, 3)
    weights = rng.normal(size=shape)
    exact, *programs = _compile_all(scene, points, weights)
    errors = [np.abs(each.rgb - exact.rgb).max(axis=-1) for each in programs]
    worst = [divmod(int(error.argmax()), shape[1])[::-1] for error in errors]
    others = rng.integers(0, shape[1::-1], (_PIXELS, 2))
    pixels = np.unique(np.concatenate([np.asarray(worst), others]), axis=0)
    bounds, gap = _bounds(scene, points, pixels, exact.rgb)
    ms = [_times(programs, points, name, repeats) for name in ("forward", "gradient")]
    rows = []
    for index, (point, program) in enumerate(zip(points, programs)):
        at = errors[index][pixels[:, 1], pixels[:, 0]]
        nearest = int(np.argmax(at / np.maximum(bounds[index], _LEAST)))
        mean = float(np.mean((program.rgb - exact.rgb) ** 2))
        rows.append(
            {
                "scene": scene.name,
                "knob": point.knob,
                "value": point.value,
                "forward ms": ms[0][index],
                "gradient ms": ms[1][index],
                "max": float(errors[index].max()),
                "psnr": -10 * np.log10(max(mean, _LEAST)),
                "gradient": _relative(program.grads, exact.grads),
                "at worst": float(at[nearest]),
                "bound": float(bounds[index][nearest]),
                "inside": bool((at <= bounds[index]).all()) and gap < 1e-5,
            }
        )
    return rows


def _compile_all(
    scene: StressScene, points: Sequence[Point], weights: np.ndarray
) -> list[_Program]:
    """Return the program of the exact image and that of each point, all compiled."""
    exact = Point("exact", "", _EXACT, double=True)
    known: dict[tuple, RasterConfig] = {}

    def ready(point: Point) -> _Program:
        program = _compile(scene, point, weights, known)
        if point is not exact:
            with jax.enable_x64(point.double):
                jax.block_until_ready(program.forward())
        return program

    every = [exact, *points]
    if on_cpu():
        # Compilations and programs would compete for the cores.
        return [ready(point) for point in progress(every, "points")]
    with ThreadPoolExecutor(usable_cores()) as pool:
        return all_of(pool, ready, every)


def _fitted(
    point: Point, gaussians: Gaussians, camera: Camera, known: dict[tuple, RasterConfig]
) -> RasterConfig:
    """Return the config of a point with capacities that fit, unless it has its own.

    ``known`` keeps them for points of equal sizes.
    """
    config = point.config
    if config.pair_capacity is not None:
        return config
    sizes = config.alpha_min, config.tile_size, config.chunk_size, point.double
    if sizes not in known:
        known[sizes] = exact_config(gaussians, camera, config)
    return config.replace(
        pair_capacity=known[sizes].pair_capacity,
        visible_capacity=known[sizes].visible_capacity,
    )


def _compile(
    scene: StressScene, point: Point, weights: np.ndarray, known: dict
) -> _Program:
    """Compile the calls of a point, and run its gradient once."""
    with jax.enable_x64(point.double):
        gaussians, camera = scene.gaussians, scene.camera
        if point.double:
            gaussians, camera = in_float64((gaussians, camera))
        degree = gaussians.sh_degree if point.degree is None else point.degree
        config = _fitted(point, gaussians, camera, known)
        params = gaussians.params
        background = jnp.asarray(scene.background, params.means.dtype)
        by_rgb = jnp.asarray(weights, params.means.dtype)

        def image(params):
            seen = with_sh_degree(gaussians.replace(params=params), degree)  # pyright: ignore
            return render(seen, camera, config, background).rgb

        def loss(params, weights):
            rgb = image(params)
            return jnp.sum(rgb * weights), rgb

        forward = jax.jit(image)
        gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))
        (_, rgb), grads = gradient(params, by_rgb)
        return _Program(
            lambda: forward(params),
            lambda: gradient(params, by_rgb),
            np.asarray(rgb, np.float64),
            [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(grads)],
        )


def _times(
    programs: Sequence[_Program], points: Sequence[Point], name: str, repeats: int
) -> list[float]:
    """Return the median ms of each, in turn; float64 apart, as another mode of JAX."""
    out = [0.0] * len(programs)
    for double in (False, True):
        chosen = {
            str(i): getattr(program, name)
            for i, (program, point) in enumerate(zip(programs, points))
            if point.double == double
        }
        with jax.enable_x64(double):
            for index, ms in interleaved(chosen, repeats).items():
                out[int(index)] = ms
    return out


def _bounds(
    scene: StressScene, points: Sequence[Point], pixels: np.ndarray, exact: np.ndarray
) -> tuple[list[np.ndarray], float]:
    """Return the error bound of each point at the pixels [P].

    The second result is the difference between the dense and the exact image there.
    """
    with jax.enable_x64(True):
        gaussians, camera = in_float64((scene.gaussians, scene.camera))
        found = pixelwise.composite_dense(gaussians, camera, scene.background, pixels)
        gap = np.abs(found.rgb - exact[pixels[:, 1], pixels[:, 0]]).max()
        bounds = [
            pixelwise.error_bound(
                found,
                gaussians,
                camera,
                point.config,
                degree=gaussians.sh_degree if point.degree is None else point.degree,
                dtype="float64" if point.double else "float32",
            )
            for point in points
        ]
    return bounds, float(gap)


def _relative(found: Sequence[np.ndarray], exact: Sequence[np.ndarray]) -> float:
    """Return the relative L2 error of all gradients together."""
    off = sum(np.sum((a - b) ** 2) for a, b in zip(found, exact))
    return float(np.sqrt(off / max(sum(np.sum(b**2) for b in exact), 1e-300)))


def time_stages(scene: StressScene, repeats: int = 5) -> dict[str, float]:
    """Return milliseconds of the parts of a render with the default settings.

    "lists" is projecting, binning and sorting; "composite" and "backward" are the
    additional time of the image and of its gradient.
    """
    config = exact_config(scene.gaussians, scene.camera)
    params = scene.gaussians.params
    background = jnp.asarray(scene.background, params.means.dtype)

    def image(params):
        gaussians = scene.gaussians.replace(params=params)  # pyright: ignore
        return render(gaussians, scene.camera, config, background)

    def total(params):
        return jnp.sum(jnp.asarray(image(params).rgb))

    functions = {
        "lists": jax.jit(lambda params: image(params).demand),
        "forward": jax.jit(lambda params: image(params)[:3]),
        "gradient": jax.jit(jax.value_and_grad(total)),
    }
    ms = interleaved({n: lambda f=f: f(params) for n, f in functions.items()}, repeats)
    return {
        "lists": ms["lists"],
        "composite": ms["forward"] - ms["lists"],
        "backward": ms["gradient"] - ms["forward"],
        "forward": ms["forward"],
        "value and gradient": ms["gradient"],
    }


def front(
    rows: Sequence[dict], time: str = "forward ms", error: str = "max"
) -> list[int]:
    """Return the indices of the rows on the Pareto front of time and error, by time.

    A slower row must have an error that is smaller by 5 % at least.
    """
    order = sorted(range(len(rows)), key=lambda i: (rows[i][time], rows[i][error]))
    best, kept = float("inf"), []
    for index in order:
        if rows[index][error] < (1 - _BETTER) * best:
            best = rows[index][error]
            kept.append(index)
    return kept
