"""Set-up of all tests: float64, two CPU devices, small scenes, shared compilations.

Compiling dominates the run time. So the scenes of the catalogue share one number of
Gaussians and one image size, tests share jitted functions, and XLA optimises little.
"""

import gc
import os
import signal
import subprocess
import sys
import tempfile
from functools import partial
from importlib.metadata import version
from pathlib import Path

import hypothesis

# XLA compiles a third as long with its older kernel emitters. Results are the same but
# for rounding, which then depends on the position of a number in an array.
QUICK_FLAGS = (
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_parallel_codegen_split_count=1",  # the other tests use the other cores
)
# Undo these flags for one program: `jax.jit(…, compiler_options=AS_USERS)`. Tests
# marked as_users run in a process without them, for what rests on how kernels round.
AS_USERS = {
    "xla_cpu_use_fusion_emitters": True,
    "xla_backend_optimization_level": 3,
    "xla_llvm_disable_expensive_passes": False,
}

# For this process, the workers of xdist, and processes of tests.
if "GSJAX_TESTS_CACHE" not in os.environ:
    _FOLDER = tempfile.TemporaryDirectory(prefix="gsjax-tests-")
    flags = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=131072"
    if version("jaxlib").startswith("0.10."):  # XLA aborts at flags it does not know
        flags = " ".join([flags, *QUICK_FLAGS])
    os.environ |= {
        "GSJAX_AUTO_SETUP": "0",
        "GSJAX_TESTS_CACHE": _FOLDER.name,
        "XDG_CACHE_HOME": _FOLDER.name,
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip(),
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }

import jax
import jax.numpy as jnp
import numpy as np
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
# A commit always passes, or never; --hypothesis-profile=default searches anew.
hypothesis.settings.register_profile("gate", derandomize=True, deadline=None)
hypothesis.settings.load_profile("gate")
# A shell starts background processes with Ctrl-C ignored, and ours would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import gsjax
import gsjax.runtime.setup
from gsjax import Camera, Gaussians, RasterConfig
from gsjax.stress.scenes import gaussian_fields

gc.set_threshold(200_000, 20, 50)  # tracing makes millions of objects, few in cycles
# Thousands of programs of all sizes in one process: kept memory would pile up.
gsjax.runtime.setup.keep_memory = lambda: False

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"

# Small programs: one array size, one device, and no search for what is hidden. Tests of
# the oracle, of equal bits, of batches and of bad numbers use `WHOLE` and `PRESETS`.
LIGHT = {"num_size_buckets": 1, "devices": 1, "pair_capacity": 8192, "occlusion": False}
ALL = ("rgb", "alpha", "depth", "median_depth")
COMPAT = RasterConfig.compat(**LIGHT, outputs=ALL)
WHOLE = COMPAT.replace(occlusion=True)
PRESETS = {
    name: getattr(RasterConfig, name)(**{**LIGHT, "outputs": ALL, "occlusion": True})
    for name in ("compat", "accurate", "fast")
}

COUNT, WIDTH, HEIGHT = 192, 45, 29
BACKGROUND = np.array([0.2, 0.5, 0.9])


def run_python(*words: str, cwd=None, **changes: str):
    """Run Python in a process of its own, with a changed environment."""
    command = [sys.executable, *words]
    env = os.environ | changes
    return subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True)


class _AsUsers(pytest.Item):
    """The tests of a module that are marked as_users, in a process of their own."""

    tests: list[str]

    def runtest(self):
        flags = [f for f in os.environ["XLA_FLAGS"].split() if f not in QUICK_FLAGS]
        done = run_python(
            *("-m", "pytest", "-n0", "-q", *self.tests),
            cwd=self.config.rootpath,
            GSJAX_TESTS_AS_USERS="1",
            JAX_DISABLE_MOST_OPTIMIZATIONS="0",
            PYTEST_XDIST_WORKER="",
            PYTEST_XDIST_WORKER_COUNT="",
            XLA_FLAGS=" ".join(flags),
        )
        if done.returncode:
            pytest.fail(f"{done.stdout}\n{done.stderr[-3000:]}", pytrace=False)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    """Run the slowest modules first, lest one process waits for another at the end."""
    marked: dict[Path, list] = {}
    for item in items:
        if item.get_closest_marker("as_users"):
            marked.setdefault(item.path, []).append(item)
    slow = {x.path for x in items if x.get_closest_marker("long")} | set(marked)
    if "GSJAX_TESTS_AS_USERS" not in os.environ:
        for tests in marked.values():
            whole = _AsUsers.from_parent(tests[0].parent, name="as_users")
            whole.tests = [test.nodeid for test in tests]
            items[items.index(tests[0])] = whole
            items[:] = [item for item in items if item not in tests]
    paths = list(dict.fromkeys(item.path for item in items))
    items.sort(key=lambda item: (item.path not in slow, paths.index(item.path)))


@pytest.fixture(autouse=True, scope="module")
def _clear_programs():
    """Free compiled programs beyond 2 GB or 30 000 memory mappings.

    Linux gives a process 65 530 of these. XLA crashes or hangs when they run out.
    """
    yield
    if not os.path.exists("/proc/self/maps"):
        return
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    mappings = Path("/proc/self/maps").read_bytes().count(b"\n")
    if mappings > 30_000 or pages * os.sysconf("SC_PAGE_SIZE") > 2e9:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="module")
def float32():
    """Compute in float32, as users do; the tests compute in float64 otherwise."""
    jax.config.update("jax_enable_x64", False)
    yield
    jax.config.update("jax_enable_x64", True)


def as_compiled(config):
    """A `TrainConfig` without what no program of a step depends on."""
    host = ("seed", "max_size", "levels", "prune_invisible")
    host += ("initial", "initial_count", "dense_count", "max_initial")
    host += ("every_eval", "every_checkpoint")
    return config.replace(**{name: getattr(type(config)(), name) for name in host})


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
        key = (settings, extent, frames.valid is None, parts)
        compiler = self.compiler
        compiler.by_sizes, compiler.by_slots = compiled.setdefault(key, ({}, {}))
        return compile_one(self, state, frames, raster)

    fit_module._Run.program = program
    yield compiled
    fit_module._Run.program = compile_one


@pytest.fixture
def in_a_process():
    """Return ``run(code, option=True)``: what code prints in a process of its own.

    XLA has no flags there, but for the default number of bytes if not ``option``, so
    that `gsjax.use_all_cores` leaves only small loops kernels.
    """
    default = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1024"

    def run(code: str, option: bool = True) -> str:
        folder = Path(__file__).parent
        path = os.pathsep.join(map(str, (folder, folder.parent)))
        changes = {"XLA_FLAGS": "" if option else default, "PYTHONPATH": path}
        changes |= {"GSJAX_TESTS_CACHE": "", "JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}
        done = run_python("-c", code, **changes)
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout

    return run


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


def reference(gaussians, camera, config, background=None, features=None) -> dict:
    """`gsjax.reference_render`, jitted, of scenes without inactive slots."""
    if config is not None:  # only these matter; the rest would compile it again
        names = ("alpha_min", "alpha_max", "transmittance_min", "stop_rule")
        names += ("dilation", "antialias", "order")
        config = RasterConfig(**{name: getattr(config, name) for name in names})
    return _reference(gaussians, camera, config, background, features)


@jax.jit
def loss_and_gradients(gaussians: Gaussians, camera: Camera):
    """Of a loss over three outputs: (images, gradients of params and camera)."""
    rng = np.random.default_rng(2)
    weights = {n: rng.normal(size=(HEIGHT, WIDTH)) for n in ("rgb", "alpha", "depth")}
    weights["rgb"] = weights["rgb"][..., None]

    def loss(params, camera):
        out = gsjax.render(gaussians.replace(params=params), camera, WHOLE)
        weighted = [
            jnp.sum(getattr(out, name) * weight)
            for name, weight in cast(weights, out.rgb.dtype).items()
        ]
        return sum(weighted), out

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
    fields = gaussian_fields(points, scales, opacities, viewmat, seed, degree)
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


# The catalogue: name → (seed, Gaussians, camera), of COUNT Gaussians and one size.


def _random(rng):
    scales = np.exp(rng.normal(-2.3, 0.9, (COUNT, 3)))
    return gaussians_at(frustum_points(rng), scales, rng.beta(0.6, 0.8, COUNT))


def _needles(rng, length):
    """Needles ``length`` px long, a hundredth of a pixel wide, half of them far out."""
    points = frustum_points(rng)
    points[::2, :2] *= max(1, length / 200)
    long = length * points[:, 2] / 40 * rng.uniform(0.5, 1, COUNT)
    thin = np.full(COUNT, 1e-3)
    return gaussians_at(points, np.column_stack([thin, long, thin]), 0.3)


def _huge(rng):
    return gaussians_at(frustum_points(rng), rng.uniform(20, 500, (COUNT, 1)), 0.05)


def _tiny(rng):
    scales = np.exp(rng.uniform(-40, -6, (COUNT, 3)))
    return gaussians_at(frustum_points(rng), scales, rng.uniform(0.1, 0.99, COUNT))


def _fog(rng):
    scales = rng.uniform(0.5, 2, (COUNT, 3))
    return gaussians_at(frustum_points(rng), scales, rng.uniform(0.002, 0.03, COUNT))


def _wall(rng):
    """A wall between what stands in front of it and what it hides altogether."""
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


def _equal_depths(rng):
    points = frustum_points(rng)
    points[:, 2] = rng.choice([2.0, 3.0, 4.0], COUNT)
    scales = np.exp(rng.normal(-2, 0.5, (COUNT, 3)))
    return gaussians_at(points, scales, 0.4, viewmat=np.eye(4))


def _around(rng):
    """All around the camera: behind it, beside it, and on either side of near."""
    points = rng.normal(0, 2, (COUNT, 3))
    points[: COUNT // 4, 2] = rng.normal(0.01, 0.01, COUNT // 4)
    scales = np.exp(rng.normal(-2, 0.7, (COUNT, 3)))
    return gaussians_at(points, scales, rng.uniform(0.05, 0.9, COUNT))


def _saturated(rng):
    scene = _random(rng)
    logits = np.resize(np.float32([9, 17, 40, 88, 120, 500]), COUNT)
    params = scene.params.replace(logit_opacities=jnp.asarray(logits, float))
    return scene.replace(params=params)


SCENES = {
    "random": (1, _random, {}),
    "needles_10": (2, partial(_needles, length=10.0), {}),
    "needles_1000": (2, partial(_needles, length=1e3), {}),
    "needles_10000": (2, partial(_needles, length=1e4), {}),
    "huge": (3, _huge, {}),
    "tiny": (4, _tiny, {}),
    "fog": (5, _fog, {}),
    "wall": (6, _wall, {}),
    "equal_depths": (7, _equal_depths, {"viewmat": np.eye(4)}),
    "around": (8, _around, {}),
    "off_centre": (1, _random, {"centre": (-6.0, 33.0)}),
    "saturated": (1, _saturated, {}),
}


def scene_of(kind: str) -> tuple[Gaussians, Camera]:
    """A scene of the catalogue with its camera, in float64."""
    seed, make, changes = SCENES[kind]
    return make(np.random.default_rng(seed)), camera_of(**changes)
