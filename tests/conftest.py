"""Set-up of all tests: float64, two host devices, small scenes, shared compilations.

Compiling dominates the run time, so every scene of the catalogue has the same number
of Gaussians and the same image size, and all tests call the same jitted functions.
"""

import gc
import os
import signal
import subprocess
import sys
import tempfile
from functools import cache, partial
from pathlib import Path

import hypothesis
import jax
import numpy as np
import pytest
from jax._src import compiler

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
# A commit always passes, or never; --hypothesis-profile=default searches anew.
hypothesis.settings.register_profile("gate", derandomize=True, deadline=None)
hypothesis.settings.load_profile("gate")
# Commands keep what they compile: for as long as these tests run, and not at home.
_CACHE = tempfile.TemporaryDirectory(prefix="gsjax-tests-")
os.environ["GSJAX_AUTO_SETUP"] = "0"
os.environ["XDG_CACHE_HOME"] = _CACHE.name
# What a shell starts in the background ignores Ctrl-C, and so would our processes.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import jax.numpy as jnp

import gsjax
import gsjax.runtime.setup
from gsjax import Gaussians, RasterConfig
from gsjax.cameras.camera import Camera
from gsjax.stress.scenes import fields_at

# What is traced are objects by the million, and few of them in cycles.
gc.set_threshold(200_000, 20, 50)
# Thousands of programs of all sizes in one process: memory kept would only pile up.
gsjax.runtime.setup.keep_memory = lambda: False
gsjax.runtime.setup.compile_loops_as_kernels()  # as the command line does

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"

# One size of the ladder and one device: anything more is compiled again. Nor is what is
# hidden looked for, which compiles longer (see benchmarks/training_skips.py): tests of
# the oracle, of equal bits, of batches and of bad numbers do, by `WHOLE` and `PRESETS`.
LIGHT = {"num_size_buckets": 1, "devices": 1, "pair_capacity": 8192, "occlusion": False}
ALL = ("rgb", "alpha", "depth", "median_depth")
COMPAT = RasterConfig.compat(**LIGHT, outputs=ALL)
WHOLE = COMPAT.replace(occlusion=True)
ACCURATE = RasterConfig.accurate(**LIGHT, outputs=ALL)
FAST = RasterConfig.fast(**LIGHT, outputs=ALL)
PRESETS = {
    name: preset.replace(occlusion=True)
    for name, preset in (("compat", COMPAT), ("accurate", ACCURATE), ("fast", FAST))
}

COUNT, WIDTH, HEIGHT = 192, 45, 29
BACKGROUND = np.array([0.2, 0.5, 0.9])

# Every program is a handful of mappings, of which Linux gives a process 65 530. Where
# they run out XLA crashes, or hangs, wherever it is.
_MANY_MAPPINGS = 30_000
_MUCH_MEMORY = 2e9  # bytes: programs that are kept, too


class Programs:
    """How what this process keeps was compiled: as a mark of the test says, or quickly.

    Attributes:
      kind: "as_users": as users have it, for bounds that rest on how kernels round.
        "new_emitters": optimised little. Kernels are those of users otherwise: equal
        bits whatever the sizes, and the memory that they reserve.
        "quickly": besides, by XLA's older emitters of kernels, in a third of the time.
        The same to rounding, which depends on where in an array a number stands.
    """

    kind = "as_users"
    kinds = ("as_users", "new_emitters")


OLDER_EMITTERS = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_parallel_codegen_split_count": 1,  # other tests have the other cores
}


@cache
def older_emitters() -> dict[str, int]:
    """`OLDER_EMITTERS` where this XLA knows them, else nothing."""
    if jax.default_backend() != "cpu":
        return {}
    try:
        jax.jit(lambda x: x + 1, compiler_options=OLDER_EMITTERS)(1.0)
    except jax.errors.JaxRuntimeError:
        return {}
    return OLDER_EMITTERS


def _compiled_by_kind(get_compile_options):
    """JAX has no setting for XLA's options, and XLA's own are of a whole process."""

    def get(*args, **kwargs):
        options = get_compile_options(*args, **kwargs)
        if Programs.kind == "quickly":
            options.env_option_overrides += list(older_emitters().items())
        return options

    return get


if hasattr(compiler, "get_compile_options"):  # private; without it, tests take longer
    older_emitters()
    compiler.get_compile_options = _compiled_by_kind(compiler.get_compile_options)


def _kind(item) -> str:
    marks = (mark.name for mark in item.iter_markers() if mark.name in Programs.kinds)
    return next(marks, "quickly")


def pytest_collection_modifyitems(items):
    """Modules that take long, or hold tests that are not compiled quickly, come first,
    lest one process waits for the other; in each, tests of a kind together.
    """
    slow = {item.path for item in items if item.get_closest_marker("long")}
    slow |= {item.path for item in items if _kind(item) != "quickly"}
    paths = list(dict.fromkeys(item.path for item in items))
    items.sort(key=lambda x: (x.path not in slow, paths.index(x.path), _kind(x)))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Before any fixture; one of a module is compiled as its first test wants it."""
    kind = _kind(item)
    if kind != Programs.kind:  # they round differently, and would be compared
        jax.clear_caches()
        jax.config.update("jax_disable_most_optimizations", kind != "as_users")
        Programs.kind = kind


@pytest.fixture(autouse=True, scope="module")
def _room_for_programs():
    yield
    mappings, sizes = Path("/proc/self/maps"), Path("/proc/self/statm")
    if mappings.exists() and (
        mappings.read_bytes().count(b"\n") > _MANY_MAPPINGS
        or int(sizes.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") > _MUCH_MEMORY
    ):
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="module")
def float32():
    """As users have it: the tests compute in float64 otherwise."""
    jax.config.update("jax_enable_x64", False)
    yield
    jax.config.update("jax_enable_x64", True)


def as_compiled(config):
    """A `TrainConfig` without what no program of a step depends on."""
    host = ("seed", "max_size", "levels", "prune_invisible", "every_eval")
    begun = ("initial", "initial_count", "dense_count", "max_initial")
    names = (*host, *begun, "every_checkpoint")
    same = type(config)()
    return config.replace(**{name: getattr(same, name) for name in names})


@pytest.fixture(scope="module")
def shared_programs():
    """A program for each strategy and shape of the photographs, whosever run it is.

    So `compilations` and `compile_seconds` are of all runs. The programs, to clear.
    """
    import gsjax.train.loop as fit_module

    compiled, compile_one = {}, fit_module._Run.program

    def program(self, state, frames, raster):
        setup = self.setup
        parts = (setup.strategy.plan.__qualname__, setup.loss_terms, id(setup.model))
        extent, settings = np.float32(setup.extent), as_compiled(self.config)
        key = (Programs.kind, settings, extent, frames.valid is None, parts)
        compiler = self.compiler
        compiler.by_sizes, compiler.by_slots = compiled.setdefault(key, ({}, {}))
        return compile_one(self, state, frames, raster)

    fit_module._Run.program = program
    yield compiled
    fit_module._Run.program = compile_one


@pytest.fixture
def in_a_process():
    """``in_a_process(code, option=True)``: what Python code prints in a process of its
    own that no flags of XLA's are told; without the ``option``, not by
    `gsjax.use_all_cores` either, so that small loops alone are kernels."""

    def printed(code: str, option: bool = True) -> str:
        folder = Path(__file__).parent
        path = os.pathsep.join(map(str, (folder, folder.parent)))
        bare = "import gsjax.runtime.setup as d; d.compile_loops_as_kernels = lambda: None; "
        done = subprocess.run(
            [sys.executable, "-c", code if option else bare + code],
            env={**os.environ, "XLA_FLAGS": "", "PYTHONPATH": path},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout

    return printed


needs_two_devices = pytest.mark.skipif(
    jax.local_device_count() < 2, reason="needs two local devices"
)
on_cpu = pytest.mark.skipif(
    jax.default_backend() != "cpu", reason="bit-equality is promised on CPU"
)

render = jax.jit(gsjax.render, static_argnames="config")


@partial(jax.jit, static_argnames="config")
def _reference(gaussians, camera, config, background, features):
    active = np.ones(gaussians.capacity, bool)
    return gsjax.reference_render(
        gaussians.replace(active=active), camera, config, background, features=features
    )


def reference(
    gaussians: Gaussians,
    camera: Camera,
    config: RasterConfig | None,
    background=None,
    features=None,
) -> dict[str, jax.Array]:
    """`gsjax.reference_render`, jitted, of scenes without inactive slots."""
    if config is not None:  # only these matter; the rest would compile it again
        names = ("alpha_min", "alpha_max", "transmittance_min", "stop_rule", "dilation", "antialias")
        config = RasterConfig(**{name: getattr(config, name) for name in names})
    return _reference(gaussians, camera, config, background, features)


@jax.jit
def loss_and_gradients(gaussians: Gaussians, camera: Camera):
    """Of a loss over three outputs: (images, gradients of params and camera)."""
    rng = np.random.default_rng(2)
    weights = {n: rng.normal(size=(HEIGHT, WIDTH)) for n in ("rgb", "alpha", "depth")}

    def loss(params, camera):
        out = gsjax.render(gaussians.replace(params=params), camera, WHOLE)
        weigh = cast(weights, out.rgb.dtype)
        total = jnp.sum(out.rgb * weigh["rgb"][..., None])
        for name in ("alpha", "depth"):
            total += jnp.sum(getattr(out, name) * weigh[name])
        return total, out

    grads, out = jax.grad(loss, (0, 1), has_aux=True)(gaussians.params, camera)
    return out, grads


MEASURED: list[tuple[str, float, float]] = []


@pytest.fixture
def report(request):
    """Note a measured error beside its bar: ``report(what, error, bar)``."""
    module = request.node.module.__name__

    def note(what: str, error, bar: float):
        MEASURED.append((f"{module}: {what}", float(error), bar))

    return note


def pytest_terminal_summary(terminalreporter):
    """With ``-v``: the errors measured, those nearest to their bars first."""
    if MEASURED and terminalreporter.config.option.verbose > 0:
        terminalreporter.section("measured errors")
        for what, error, bar in sorted(MEASURED, key=lambda m: -m[1] / m[2]):
            terminalreporter.write_line(f"{error:9.2e} of {bar:7.1e}  {what}")


def oracle_data(name: str):
    """Arrays of one of the files beside the project, or a skip."""
    path = DATA / "garden" / f"{name}.npz"
    if not path.exists():
        pytest.skip(f"{path.name} is not there (../shared/data/garden)")
    return dict(np.load(path, allow_pickle=False))


def write_files(root: Path, texts: dict[str, str]) -> None:
    """Texts by their paths below ``root``."""
    for path, text in texts.items():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_text(text)


def cast(tree, dtype):
    """The same pytree with its floats as ``dtype``; gsjax follows its inputs."""

    def one(leaf):
        floating = jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating)
        return jnp.asarray(leaf, dtype) if floating else leaf

    return jax.tree.map(one, tree)


def pose(seed: int = 0) -> np.ndarray:
    """A general world → camera matrix."""
    rng = np.random.default_rng(seed)
    return gsjax.look_at(rng.normal(size=3), rng.normal(size=3) + 4, rng.normal(size=3))


def camera_of(
    width=WIDTH, height=HEIGHT, viewmat=None, centre=None, focal=(40.0, 43.0), **kwargs
) -> Camera:
    """A camera with general focal lengths and principal point."""
    cx, cy = (0.52 * width, 0.47 * height) if centre is None else centre
    K = np.array([[focal[0], 0, cx], [0, focal[1], cy], [0, 0, 1]])
    viewmat = pose() if viewmat is None else viewmat
    # Rounded once, so that float32 and float64 see the same numbers.
    viewmat, K = (np.asarray(v, np.float32) for v in (viewmat, K))
    return gsjax.make_camera(viewmat=viewmat, K=K, width=width, height=height, **kwargs)


def gaussians_at(points, scales, opacities, *, viewmat=None, seed=0, degree=3):
    """Gaussians at camera coordinates ``points`` [N, 3], the rest drawn at random.

    Values are those of float32, as float64. Colours stay clear of the clip at 0.
    """
    viewmat = np.asarray(pose() if viewmat is None else viewmat, np.float32)
    fields = fields_at(points, scales, opacities, viewmat, seed, degree)
    return gsjax.make_gaussians(**fields)


def frustum_points(rng, count=COUNT, near=2.0, far=8.0, spread=0.6) -> np.ndarray:
    """Camera coordinates spread over the view and a little beyond, distinct in z."""
    z = np.sort(rng.uniform(near, far, count))[rng.permutation(count)]
    xy = rng.uniform(-spread, spread, (count, 2)) * (WIDTH / 40, HEIGHT / 43)
    return np.column_stack([xy * z[:, None], z])


def psnr(image, wanted) -> float:
    """Peak signal-to-noise ratio in dB, for a range of 1."""
    return float(-10 * np.log10(np.mean(np.square(np.subtract(image, wanted)))))


def assert_not_empty(alpha, share=0.05):
    """At least ``share`` of the pixels are covered visibly."""
    assert np.mean(np.asarray(alpha) > 0.02) > share


# The catalogue: name → (Gaussians, camera). All have COUNT Gaussians and one size.


def _random():
    rng = np.random.default_rng(1)
    scales = np.exp(rng.normal(-2.3, 0.9, (COUNT, 3)))
    return gaussians_at(frustum_points(rng), scales, rng.beta(0.6, 0.8, COUNT))


def _needles(length):
    """Needles ``length`` px long, a hundredth of a pixel wide, half of them far out."""
    rng = np.random.default_rng(2)
    points = frustum_points(rng)
    points[::2, :2] *= max(1, length / 200)
    long = length * points[:, 2] / 40 * rng.uniform(0.5, 1, COUNT)
    thin = np.full(COUNT, 1e-3)
    return gaussians_at(points, np.column_stack([thin, long, thin]), 0.3)


def _huge():
    rng = np.random.default_rng(3)
    return gaussians_at(frustum_points(rng), rng.uniform(20, 500, (COUNT, 1)), 0.05)


def _tiny():
    rng = np.random.default_rng(4)
    scales = np.exp(rng.uniform(-40, -6, (COUNT, 3)))
    return gaussians_at(frustum_points(rng), scales, rng.uniform(0.1, 0.99, COUNT))


def _fog():
    rng = np.random.default_rng(5)
    scales = rng.uniform(0.5, 2, (COUNT, 3))
    return gaussians_at(frustum_points(rng), scales, rng.uniform(0.002, 0.03, COUNT))


def _wall():
    """A wall between what stands in front of it and what it hides altogether."""
    rng = np.random.default_rng(6)
    points = frustum_points(rng)
    order = np.argsort(points[:, 2])
    front, wall = order[:80], order[80:120]
    points[front, 2] *= 0.1
    points[front, :2] *= 0.1
    points[wall, 2] = rng.uniform(0.99, 1.01, 40)
    points[wall, :2] = rng.uniform(-0.3, 0.3, (40, 2))
    scales, opacities = np.full((COUNT, 1), 0.1), np.full(COUNT, 0.5)
    scales[front], opacities[front] = 0.01, 0.3
    scales[wall], opacities[wall] = 1.5, 0.999
    return gaussians_at(points, scales, opacities)


def _equal_depths():
    rng = np.random.default_rng(7)
    points = frustum_points(rng)
    points[:, 2] = rng.choice([2.0, 3.0, 4.0], COUNT)
    scales = np.exp(rng.normal(-2, 0.5, (COUNT, 3)))
    return gaussians_at(points, scales, 0.4, viewmat=np.eye(4))


def _around():
    """All around the camera: behind it, beside it, and on either side of near."""
    rng = np.random.default_rng(8)
    points = rng.normal(0, 2, (COUNT, 3))
    points[: COUNT // 4, 2] = rng.normal(0.01, 0.01, COUNT // 4)
    scales = np.exp(rng.normal(-2, 0.7, (COUNT, 3)))
    return gaussians_at(points, scales, rng.uniform(0.05, 0.9, COUNT))


def _saturated():
    scene = _random()
    logits = np.resize(np.float32([9, 17, 40, 88, 120, 500]), COUNT)
    params = scene.params.replace(logit_opacities=jnp.asarray(logits, float))
    return scene.replace(params=params)


SCENES = {
    "random": (_random, {}),
    "needles_10": (partial(_needles, 10.0), {}),
    "needles_1000": (partial(_needles, 1e3), {}),
    "needles_10000": (partial(_needles, 1e4), {}),
    "huge": (_huge, {}),
    "tiny": (_tiny, {}),
    "fog": (_fog, {}),
    "wall": (_wall, {}),
    "equal_depths": (_equal_depths, {"viewmat": np.eye(4)}),
    "around": (_around, {}),
    "off_centre": (_random, {"centre": (-6.0, 33.0)}),
    "saturated": (_saturated, {}),
}


def scene_of(kind: str) -> tuple[Gaussians, Camera]:
    """A scene of the catalogue with its camera, in float64."""
    make, changes = SCENES[kind]
    return make(), camera_of(**changes)
