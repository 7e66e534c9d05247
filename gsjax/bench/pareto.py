"""Time against error: one scene, one view, one knob of accuracy or size at a time.

The exact picture, and its gradient, are those of the renderer in float64 with cut and
stop at 1e-9. At some pixels, the worst of every point among them, errors are held
against what theory allows (`gsjax.bench.pixelwise`), and the exact picture against a
dense one. Capacities are fitted to the view; programs are compiled at one size.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from threading import Lock
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.bench import pixelwise
from gsjax.cameras.camera import Camera
from gsjax.gaussians import Gaussians, with_sh_degree
from gsjax.math.numerics import in_float64
from gsjax.planning.types import Plan
from gsjax.raster.render import exact_config, render
from gsjax.raster.types import RasterConfig
from gsjax.runtime.console import progress
from gsjax.runtime.devices import on_cpu
from gsjax.runtime.machine import all_of, usable_cores
from gsjax.runtime.timing import interleaved
from gsjax.synthetic.stress_scenes import StressScene

_EXACT = RasterConfig.accurate(
    alpha_min=1e-9,
    alpha_max=1 - 1e-12,
    stop=1e-9,
    outputs=("rgb",),
    num_size_buckets=1,
    devices=1,
)
_PIXELS = 48
_LEAST = 1e-30
_BETTER = 0.05  # a share


class Point(NamedTuple):
    """One setting.

    Attributes:
      knob: what is turned.
      value: to what.
      config: all settings.
      degree: of the spherical harmonics; None as the scene has.
      double: whether in float64.
    """

    knob: str
    value: str
    config: RasterConfig
    degree: int | None = None
    double: bool = False

    @property
    def label(self) -> str:
        return f"{self.knob} {self.value}".strip()


class _Runs(NamedTuple):
    """Of one point: what to call, what came of it."""

    forward: Any
    gradient: Any
    rgb: np.ndarray
    grads: list[np.ndarray]


def points(gaussians: Gaussians, made: Plan | None = None) -> list[Point]:
    """Knobs turned one at a time from `RasterConfig.accurate`, the presets, a plan."""
    base = RasterConfig.accurate(outputs=("rgb",), num_size_buckets=1)
    found = [
        Point("compat", "", RasterConfig.compat(outputs=("rgb",), num_size_buckets=1)),
        Point("accurate", "", base),
        Point("fast", "", RasterConfig.fast(outputs=("rgb",), num_size_buckets=1)),
    ]
    for cut, text in ((1 / 255, "1/255"), (1 / 1024, "1/1024"), (1e-4, "1e-4")):
        found.append(Point("cut", text, base.replace(alpha_min=cut)))
    for stop in ("1e-2", "1e-3"):
        found.append(Point("stop after", stop, base.replace(stop=float(stop))))
    # The rule's bound is ε / (1 − cap): it wants the field's cap.
    before = base.replace(stop=1e-4, stop_rule="before", alpha_max=0.99)
    found.append(Point("stop before", "1e-4", before))
    for degree in range(gaussians.sh_degree):
        found.append(Point("SH degree", str(degree), base, degree))
    for tile in (4, 16):
        found.append(Point("tile", str(tile), base.replace(tile_size=tile)))
    found.append(Point("chunk", "64", base.replace(chunk_size=64)))
    found.append(Point("dtype", "float64", base, double=True))
    if made is not None:
        config = made.config.replace(
            num_size_buckets=1,
            outputs=("rgb",),
            pair_capacity=None,
            visible_capacity=None,
        )
        found.append(Point("plan", "", config, made.gaussians.sh_degree))
    return found


def pareto(
    trial: StressScene, settings: Sequence[Point], repeats: int = 5
) -> list[dict]:
    """A row for each point: milliseconds, errors, and what theory allows.

    Its keys: knob, value; "forward ms", "gradient ms" (value and gradient); "max",
    "psnr" and "gradient" (relative L2) against the exact picture; "at worst" and
    "bound", error and bound where they are nearest to each other; "inside": whether
    every pixel looked at is within its bound.
    """
    rng = np.random.default_rng(0)
    shape = (trial.camera.height, trial.camera.width, 3)
    weights = rng.normal(size=shape)
    exact, *runs = _ready_runs(trial, settings, weights)
    errors = [np.abs(run.rgb - exact.rgb).max(axis=-1) for run in runs]
    worst = [divmod(int(error.argmax()), shape[1])[::-1] for error in errors]
    others = rng.integers(0, shape[1::-1], (_PIXELS, 2))
    pixels = np.unique(np.concatenate([np.asarray(worst), others]), axis=0)
    bounds, gap = _bounds(trial, settings, pixels, exact.rgb)
    ms = [_times(runs, settings, name, repeats) for name in ("forward", "gradient")]
    rows = []
    for index, (point, run) in enumerate(zip(settings, runs)):
        at = errors[index][pixels[:, 1], pixels[:, 0]]
        nearest = int(np.argmax(at / np.maximum(bounds[index], _LEAST)))
        mean = float(np.mean((run.rgb - exact.rgb) ** 2))
        rows.append(
            {
                "scene": trial.name,
                "knob": point.knob,
                "value": point.value,
                "forward ms": ms[0][index],
                "gradient ms": ms[1][index],
                "max": float(errors[index].max()),
                "psnr": -10 * np.log10(max(mean, _LEAST)),
                "gradient": _relative(run.grads, exact.grads),
                "at worst": float(at[nearest]),
                "bound": float(bounds[index][nearest]),
                "inside": bool((at <= bounds[index]).all()) and gap < 1e-5,
            }
        )
    return rows


def _ready_runs(
    trial: StressScene, settings: Sequence[Point], weights: np.ndarray
) -> list[_Runs]:
    """Of the exact picture, and of each point; all that will be timed is compiled."""
    exact = Point("exact", "", _EXACT, double=True)
    fits = _Fits()

    def ready(point: Point) -> _Runs:
        run = _run(trial, point, weights, fits)
        if point is not exact:
            with jax.enable_x64(point.double):
                jax.block_until_ready(run.forward())
        return run

    every = [exact, *settings]
    if on_cpu():
        # All cores compile one, and the programs, which take them all, would meet.
        return [ready(point) for point in progress(every, "pictures")]
    with ThreadPoolExecutor(usable_cores()) as pool:
        # One core for each; an accelerator is idle meanwhile.
        return all_of(pool, ready, every)


class _Fits:
    """Capacities that fit a view, found once for all points of equal sizes."""

    def __init__(self):
        self.found: dict[tuple, RasterConfig] = {}
        self.locks: dict[tuple, Lock] = {}

    def __call__(self, point: Point, scene: Gaussians, camera: Camera) -> RasterConfig:
        """The point's settings, with capacities; its own where it has them."""
        config = point.config
        if config.pair_capacity is not None:
            return config
        sizes = config.alpha_min, config.tile_size, config.chunk_size, point.double
        with self.locks.setdefault(sizes, Lock()):
            if sizes not in self.found:
                self.found[sizes] = exact_config(scene, camera, config)
        fit = self.found[sizes]
        return config.replace(
            pair_capacity=fit.pair_capacity, visible_capacity=fit.visible_capacity
        )


def _run(trial: StressScene, point: Point, weights: np.ndarray, fits: _Fits) -> _Runs:
    """Compile, run once, and hand out what to time; ``fits`` keeps the capacities."""
    with jax.enable_x64(point.double):
        scene, camera = trial.gaussians, trial.camera
        if point.double:
            scene, camera = in_float64((scene, camera))
        degree = scene.sh_degree if point.degree is None else point.degree
        config = fits(point, scene, camera)
        dtype = scene.params.means.dtype
        behind = jnp.asarray(trial.background, dtype)
        weigh = jnp.asarray(weights, dtype)

        def picture(params):
            seen = with_sh_degree(scene.replace(params=params), degree)  # pyright: ignore
            return render(seen, camera, config, behind).rgb

        def loss(params, weigh):
            rgb = picture(params)
            return jnp.sum(rgb * weigh), rgb

        # What is not called is not compiled: of the exact picture, the first.
        forward = jax.jit(picture)
        gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))
        (_, seen), grads = gradient(scene.params, weigh)
        rgb = np.asarray(seen, np.float64)
        leaves = [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(grads)]
        params = scene.params
        return _Runs(
            lambda: forward(params), lambda: gradient(params, weigh), rgb, leaves
        )


def _times(
    runs: Sequence[_Runs], settings: Sequence[Point], name: str, repeats: int
) -> list[float]:
    """Median ms of each, in turn; float64 apart, as it is another mode of JAX."""
    out = [0.0] * len(runs)
    for double in (False, True):
        chosen = {
            str(i): getattr(run, name)
            for i, (run, point) in enumerate(zip(runs, settings))
            if point.double == double
        }
        with jax.enable_x64(double):
            for index, ms in interleaved(chosen, repeats).items():
                out[int(index)] = ms
    return out


def _bounds(
    trial: StressScene, settings: Sequence[Point], pixels: np.ndarray, exact: np.ndarray
) -> tuple[list[np.ndarray], float]:
    """What theory allows each point at the pixels; how far dense and exact differ."""
    with jax.enable_x64(True):
        scene, camera = in_float64((trial.gaussians, trial.camera))
        found = pixelwise.dense(scene, camera, trial.background, pixels)
        gap = np.abs(found.picture - exact[pixels[:, 1], pixels[:, 0]]).max()
        bounds = [
            pixelwise.allowed(
                found,
                scene,
                camera,
                point.config,
                degree=scene.sh_degree if point.degree is None else point.degree,
                dtype="float64" if point.double else "float32",
            )
            for point in settings
        ]
    return bounds, float(gap)


def _relative(found: Sequence[np.ndarray], wanted: Sequence[np.ndarray]) -> float:
    """Relative L2 of all gradients together."""
    off = sum(np.sum((a - b) ** 2) for a, b in zip(found, wanted))
    return float(np.sqrt(off / max(sum(np.sum(b**2) for b in wanted), 1e-300)))


def stages(trial: StressScene, repeats: int = 5) -> dict[str, float]:
    """Milliseconds of a render's parts with the default settings.

    "lists" is projecting, binning and sorting; composite and backward are what the
    whole picture, and the gradient, take beyond what comes before them.
    """
    config = exact_config(trial.gaussians, trial.camera)
    camera = trial.camera
    behind = jnp.asarray(trial.background, trial.gaussians.params.means.dtype)

    def picture(params):
        scene = trial.gaussians.replace(params=params)  # pyright: ignore
        return render(scene, camera, config, behind)

    functions = {
        "lists": jax.jit(lambda params: picture(params).demand),
        "forward": jax.jit(lambda params: picture(params)[:3]),
        "gradient": jax.jit(
            jax.value_and_grad(lambda params: jnp.sum(jnp.asarray(picture(params).rgb)))
        ),
    }
    params = trial.gaussians.params
    ms = interleaved({n: lambda f=f: f(params) for n, f in functions.items()}, repeats)
    return {
        "lists": ms["lists"],
        "composite": ms["forward"] - ms["lists"],
        "backward": ms["gradient"] - ms["forward"],
        "forward": ms["forward"],
        "value and gradient": ms["gradient"],
    }


def front(rows: Sequence[dict], time: str = "forward ms", error: str = "max"):
    """Indices of rows that no other beats in both, by time.

    To be slower, a row has to be better by `_BETTER`: an error that is less by a
    thousandth is worth no time.
    """
    order = sorted(range(len(rows)), key=lambda i: (rows[i][time], rows[i][error]))
    best, kept = float("inf"), []
    for index in order:
        if rows[index][error] < (1 - _BETTER) * best:
            best = rows[index][error]
            kept.append(index)
    return kept
