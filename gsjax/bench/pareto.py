"""Run time against error: one setting of accuracy or size changes at a time.

The exact image and gradient are the renderer's in float64 with cutoffs of 1e-9; orders
are compared with the exact order of each pixel. At some
pixels, including the worst of every point, the error is compared with its bound
(`gsjax.bench.pixelwise`), and the exact image with a dense one. Capacities are fitted.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.bench import pixelwise
from gsjax.bench.popping import ORDERS
from gsjax.gaussians import Gaussians, with_sh_degree
from gsjax.math.numerics import in_float64
from gsjax.planning.types import Plan
from gsjax.raster.exact import exact_config
from gsjax.raster.render import render
from gsjax.raster.types import RasterConfig
from gsjax.runtime.console import progress
from gsjax.runtime.devices import on_cpu
from gsjax.runtime.machine import usable_cores
from gsjax.runtime.timing import interleaved
from gsjax.synthetic.stress_scenes import StressScene

_CUTOFFS = {"alpha_min": 1e-9, "alpha_max": 1 - 1e-12, "transmittance_min": 1e-9}
_COMMON: dict[str, Any] = {"outputs": ("rgb",), "num_size_buckets": 1}
_EXACT = RasterConfig.accurate(**_CUTOFFS, **_COMMON, devices=1)
_SORTED = _EXACT.replace(order="pixel")
_CAPACITIES = ("pair_capacity", "visible_capacity")
_PIXELS = 48  # random pixels to compare with bounds
_LEAST = 1e-30


class Point(NamedTuple):
    """One point of the plot: the setting that changes, and its value as text.

    A ``degree`` of None keeps the SH degree of the scene; ``double`` uses float64. The
    exact image has the order of centres, or with ``sorted`` that of each pixel.
    """

    knob: str
    value: str
    config: RasterConfig
    degree: int | None = None
    double: bool = False
    sorted: bool = False


class _Program(NamedTuple):
    """Compiled calls of one point, their rgb and their gradient."""

    forward: Any
    gradient: Any
    rgb: np.ndarray
    grads: np.ndarray


def make_points(gaussians: Gaussians, plan: Plan | None = None) -> list[Point]:
    """Return the presets, `RasterConfig.accurate` with one change each, and a plan."""
    base = RasterConfig.accurate(**_COMMON)
    # The bound of the rule "before" is ε / (1 − alpha_max): it needs a low alpha_max.
    before = base.replace(transmittance_min=1e-4, stop_rule="before", alpha_max=0.99)
    changes = [
        ("cut", "1/255", {"alpha_min": 1 / 255}),
        ("cut", "1/1024", {"alpha_min": 1 / 1024}),
        ("cut", "1e-4", {"alpha_min": 1e-4}),
        ("stop after", "1e-2", {"transmittance_min": 1e-2}),
        ("stop after", "1e-3", {"transmittance_min": 1e-3}),
        ("tile", "4", {"tile_size": 4}),
        ("tile", "16", {"tile_size": 16}),
        ("chunk", "64", {"chunk_size": 64}),
    ]
    found = [
        Point("compat", "", RasterConfig.compat(**_COMMON)),
        Point("accurate", "", base),
        Point("fast", "", RasterConfig.fast(**_COMMON)),
        *(Point(knob, text, base.replace(**change)) for knob, text, change in changes),
        Point("stop before", "1e-4", before),
        *(Point("SH degree", str(d), base, d) for d in range(gaussians.sh_degree)),
        Point("dtype", "float64", base, double=True),
        *(
            Point("order", name, base.replace(**change), sorted=True)
            for name, change in ORDERS.items()
        ),
    ]
    if plan is not None:
        config = plan.config.replace(**_COMMON, **dict.fromkeys(_CAPACITIES))
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
    *exact, programs = _compile_all(scene, points, weights)
    whole = [exact[point.sorted] for point in points]
    pairs = list(zip(programs, whole))
    errors = [np.abs(each.rgb - true.rgb).max(axis=-1) for each, true in pairs]
    worst = [divmod(int(error.argmax()), shape[1])[::-1] for error in errors]
    others = rng.integers(0, shape[1::-1], (_PIXELS, 2))
    pixels = np.unique(np.concatenate([np.asarray(worst), others]), axis=0)
    bounds, gap = _bounds(scene, points, pixels, [each.rgb for each in exact])
    ms = _times(programs, points, repeats)
    rows = []
    for index, (point, (program, true)) in enumerate(zip(points, pairs)):
        size = max(float(np.linalg.norm(true.grads)), _LEAST)
        at = errors[index][pixels[:, 1], pixels[:, 0]]
        nearest = int(np.argmax(at / np.maximum(bounds[index], _LEAST)))
        mean = float(np.mean((program.rgb - true.rgb) ** 2))
        rows.append(
            {
                "scene": scene.name,
                "knob": point.knob,
                "value": point.value,
                "forward ms": ms[f"forward {index}"],
                "gradient ms": ms[f"gradient {index}"],
                "max": float(errors[index].max()),
                "psnr": -10 * np.log10(max(mean, _LEAST)),
                "gradient": float(np.linalg.norm(program.grads - true.grads)) / size,
                "at worst": float(at[nearest]),
                "bound": float(bounds[index][nearest]),
                "inside": bool((at <= bounds[index]).all()) and gap < 1e-5,
            }
        )
    return rows


def _compile_all(
    scene: StressScene, points: Sequence[Point], weights: np.ndarray
) -> tuple[_Program, _Program, list[_Program]]:
    """Return programs, all compiled: of the exact images in both orders, of points."""
    ready = partial(_compile, scene, weights, {})
    exact = [Point("exact", "", config, double=True) for config in (_EXACT, _SORTED)]
    if not any(point.sorted for point in points):
        exact[1] = exact[0]
    every = [*exact, *points]
    if on_cpu():
        # Compilations and programs would compete for the cores.
        first, second, *rest = [ready(point) for point in progress(every, "points")]
    else:
        with ThreadPoolExecutor(usable_cores()) as pool:
            first, second, *rest = pool.map(ready, every)
    return first, second, list(rest)


def _compile(
    scene: StressScene, weights: np.ndarray, known: dict, point: Point
) -> _Program:
    """Compile the calls of a point with capacities that fit, unless it has its own.

    ``known`` keeps the capacities for points of equal sizes.
    """
    with jax.enable_x64(point.double):
        gaussians, camera = scene.gaussians, scene.camera
        if point.double:
            gaussians, camera = in_float64((gaussians, camera))
        degree = gaussians.sh_degree if point.degree is None else point.degree
        config = point.config
        if config.pair_capacity is None:
            sizes = config.alpha_min, config.tile_size, config.chunk_size, point.double
            if sizes not in known:
                known[sizes] = exact_config(gaussians, camera, config)
            fitted = {n: getattr(known[sizes], n) for n in _CAPACITIES}
            config = config.replace(**fitted)
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
        if point.config not in (_EXACT, _SORTED):  # their time does not count
            jax.block_until_ready(forward(params))
        (_, rgb), grads = gradient(params, by_rgb)
        return _Program(
            partial(forward, params),
            partial(gradient, params, by_rgb),
            np.asarray(rgb, np.float64),
            np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(grads)]),
        )


def _times(
    programs: Sequence[_Program], points: Sequence[Point], repeats: int
) -> dict[str, float]:
    """Return the median ms of each call; float64 apart, as another mode of JAX."""
    ms = {}
    for double in (False, True):
        calls = {
            f"{name} {index}": getattr(program, name)
            for index, (program, point) in enumerate(zip(programs, points))
            for name in ("forward", "gradient")
            if point.double == double
        }
        with jax.enable_x64(double):
            ms |= interleaved(calls, repeats)
    return ms


def _bounds(
    scene: StressScene, points: Sequence[Point], pixels: np.ndarray, exact: list
) -> tuple[list[np.ndarray], float]:
    """Return the error bound of each point at the pixels [P].

    The second result is the difference between the dense and the exact images there.
    """
    with jax.enable_x64(True):
        gaussians, camera = in_float64((scene.gaussians, scene.camera))
        found = pixelwise.composite_dense(gaussians, camera, scene.background, pixels)
        dense, keys = [found.rgb], None
        if any(point.sorted for point in points):
            keys = pixelwise.ray_depths(found, gaussians, camera, pixels)
            dense.append(pixelwise.in_ray_order(found, keys, scene.background))
        images = [image[pixels[:, 1], pixels[:, 0]] for image in exact]
        gap = max(np.abs(a - b).max() for a, b in zip(dense, images))
        bounds = []
        for point in points:
            bound = pixelwise.error_bound(
                found, gaussians, camera, point.config, point.degree, point.double
            )
            if point.sorted:
                assert keys is not None
                bound = bound + pixelwise.order_bound(
                    found, keys, point.config, point.double
                )
            bounds.append(bound)
    return bounds, float(gap)


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

    functions = {
        "lists": lambda params: image(params).demand,
        "forward": lambda params: image(params)[:3],
        "gradient": jax.value_and_grad(lambda params: jnp.sum(image(params).rgb)),  # pyright: ignore
    }
    calls = {n: partial(jax.jit(f), params) for n, f in functions.items()}
    ms = interleaved(calls, repeats)
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
        if rows[index][error] < 0.95 * best:
            best = rows[index][error]
            kept.append(index)
    return kept
