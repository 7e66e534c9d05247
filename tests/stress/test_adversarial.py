"""Training on hostile datasets, divergence, low memory, Ctrl-C and full disks.

Runs share compiled programs; see the fixture `shared_programs`.
"""

import errno
import json
import os
import signal
import warnings
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest
from captures import dataset_of_views, save_photo
from hostile import HOSTILE, harmless, write_hostile

import gsjax
import gsjax.runs.run as run_module
import gsjax.runs.session as session_module
import gsjax.train.loop as loop_module
from gsjax.cli.main import main
from gsjax.cli.train import TrainCommand
from gsjax.data import camera_paths
from gsjax.data.colmap_writer import write_colmap
from gsjax.data.dataset import load_dataset
from gsjax.data.photos import load_photos
from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.densify.mcmc import McmcSettings
from gsjax.errors import CapacityError, DivergedError, InputError
from gsjax.init.gaussians import init_gaussians
from gsjax.raster.types import RasterConfig
from gsjax.runs.checkpoint import load_checkpoint
from gsjax.runs.evaluation import evaluate_run
from gsjax.runs.folder import RunSettings
from gsjax.runs.history import read_metrics
from gsjax.runs.run import resume_run, start_run
from gsjax.runs.scene_source import splat_file
from gsjax.runs.trajectories import path_entries, view_entries
from gsjax.runtime import memory
from gsjax.train.config import TrainConfig
from gsjax.train.evaluation import evaluate
from gsjax.train.frames import make_frames
from gsjax.train.health import Health, check_points
from gsjax.train.state import Metrics

pytestmark = pytest.mark.usefixtures("float32", "shared_programs")

STEPS = 24
MAX_GAUSSIANS = 60  # on 16 tiles, so that one pair capacity serves all runs
CONFIG = TrainConfig(
    steps=STEPS,
    sh_degree=0,
    every_checkpoint=10,
    adaptive=AdaptiveSettings(
        start=0,
        stop=20,
        every=5,
        threshold=1e-6,
        reset_every=10,
        max_gaussians=MAX_GAUSSIANS,
    ),
    mcmc=McmcSettings(
        start=0, stop=20, every=5, growth=1.3, max_gaussians=MAX_GAUSSIANS
    ),
    raster=RasterConfig(num_size_buckets=1, devices=1, chunk_size=4, occlusion=False),
)
ONE_PHOTO = "one photograph"
# Not of the usual shape or extent, so trained with one strategy to compile less.
ONE_STRATEGY = (ONE_PHOTO, "two that are one")
REJECTED = {
    "all behind the cameras": "all 5,000 behind all 2;",
    "all masked": "2 that are masked completely",
}


def settings_of(folder, made, strategy="mcmc") -> RunSettings:
    data = write_hostile(folder / "data", made)
    return RunSettings(data, CONFIG.replace(strategy=strategy))


def load_checked(run) -> gsjax.Gaussians:
    """Load the result of a run; it and the log have to be finite."""
    with warnings.catch_warnings():
        # Far from the origin a warning reports the rounding to float32.
        warnings.filterwarnings("ignore", message=".*jax_enable_x64")
        gaussians = gsjax.load(run / "splat.ply")
    for leaf in jax.tree.leaves(gaussians.params):
        assert np.isfinite(leaf).all()
    lines = [json.loads(x) for x in (run / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == list(range(1, STEPS + 1))
    assert all(line["finite"] and line["loss"] is not None for line in lines)
    return gaussians


@pytest.mark.filterwarnings("ignore:.*are masked completely", "ignore:.*was in view")
@pytest.mark.parametrize(
    ("name", "strategy"),
    [
        (name, strategy)
        for name in HOSTILE
        for strategy in ("adaptive", "mcmc")
        if strategy == "mcmc" or name not in ONE_STRATEGY
    ],
)
def test_hostile_datasets_end_in_a_finite_scene_or_one_error(name, strategy, tmp_path):
    settings, run = settings_of(tmp_path, HOSTILE[name](), strategy), tmp_path / "run"
    if name in REJECTED:
        with pytest.raises(InputError, match=REJECTED[name]):
            start_run(settings, run)
        assert not (run / "splat.ply").exists()
        return
    result = start_run(settings, run)
    assert result.finished
    gaussians = load_checked(run)
    assert result.gaussians == int(gaussians.active.sum()) <= MAX_GAUSSIANS
    if result.summary is None:
        assert name == ONE_PHOTO
        with pytest.raises(InputError, match=r"no test views.*--views train"):
            evaluate_run(run)
        return
    assert np.isfinite(json.loads((run / "eval.json").read_text())["ssim"])
    assert result.summary.views == 1


def in_units(dataset, unit: float):
    """Multiply all lengths by ``unit``."""
    scale = np.diag([unit, unit, unit, 1.0])
    inverse = np.linalg.inv(scale)
    views = [replace(v, viewmat=scale @ v.viewmat @ inverse) for v in dataset.views]
    return replace(dataset, views=tuple(views), points=dataset.points * unit)


def test_points_nearer_than_the_near_plane_are_reported():
    dataset = dataset_of_views(count=3)
    check_points(dataset)
    with pytest.raises(InputError, match=r"beyond the near plane 0\.01"):
        check_points(in_units(dataset, 1e-4))
    view = dataset.views[0]
    tight = view.centre + 0.005 * view.viewmat[2, :3]
    few = np.stack([tight, tight, tight, view.centre + view.viewmat[2, :3]])
    with pytest.warns(UserWarning, match=r"75% of the points .* 0\.01 and not drawn"):
        check_points(replace(dataset, points=few, views=(view,)))


@pytest.mark.parametrize("unit", [1e-6, 1e3])
def test_renders_do_not_depend_on_the_unit_of_length(unit, tmp_path):
    """The near planes of all ways to make cameras scale with it."""
    seen = {}
    for factor in (0.1, unit):
        folder = tmp_path / str(factor)
        dataset = in_units(dataset_of_views(count=3), factor)
        write_colmap(folder / "sparse/0", dataset)
        for view in dataset.views:
            save_photo(folder / "images" / view.name)
        found = load_dataset(folder)
        check_points(found)
        photos, gaussians = load_photos(found.views), init_gaussians(found, sh_degree=0)
        first = next(evaluate(gaussians, found.views, photos))
        entries = view_entries(found.views[:2])
        entries += path_entries(found, camera_paths.orbit, frames=2)
        cameras = [make_frames(found.views, photos).camera]
        cameras += [entry.camera for entry in entries]
        near = np.concatenate([np.atleast_1d(camera.near) for camera in cameras])
        seen[factor] = first.render, near / factor
    (wanted, usual), (render, near) = seen.values()
    assert wanted.std() > 0.02  # not empty
    np.testing.assert_allclose(render, wanted, atol=1e-4)
    np.testing.assert_allclose(near, near[0], rtol=1e-6)
    if unit < 1:
        np.testing.assert_allclose(near, usual, rtol=1e-6)


# --- divergence ---


def diverging(state):
    """Return the state as huge learning rates leave it: the next steps overflow."""
    params = state.gaussians.params
    params = params.replace(means=params.means * np.float32(np.inf))
    return state.replace(gaussians=state.gaussians.replace(params=params))


def garish(state):
    """Return the state with colours that no image has."""
    params = state.gaussians.params
    params = params.replace(sh=params.sh + 1e3)
    return state.replace(gaussians=state.gaussians.replace(params=params))


FAULTS = {
    diverging: "not finite in 12",
    garish: "the PSNR was below 0 dB in 12",
}


@pytest.mark.filterwarnings("ignore:.*was in view")
@pytest.mark.parametrize("change", FAULTS, ids=lambda change: change.__name__)
def test_a_diverging_run_stops_and_keeps_the_last_good_scene(
    change, tmp_path, monkeypatch, capsys
):
    """It stops after half of the steps of a short run."""
    settings, run, step = settings_of(tmp_path, harmless()), tmp_path / "run", 11
    with_slots = loop_module.with_slots

    def changed(state, *rest):
        state = with_slots(state, *rest)
        return change(state) if state.step == step else state

    monkeypatch.setattr(loop_module, "with_slots", changed)
    with pytest.raises(DivergedError, match=FAULTS[change]) as caught:
        start_run(settings, run)
    assert caught.value.exit_code == 5
    assert len(read_metrics(run / "metrics.jsonl")) == step + STEPS // 2 - 1
    (kept,) = (run / "checkpoints").iterdir()
    good = load_checkpoint(kept)
    assert good.step == 10  # 20 was due, but not good
    for name, array in good.arrays.items():
        assert not name.startswith(".gaussians.params") or np.isfinite(array).all()
    told = capsys.readouterr().err
    assert f"the scene of step 10 is kept: {run / 'splat.ply'}" in told
    scene = gsjax.load(splat_file(run))
    active = good.arrays[".gaussians.active"]
    means = good.arrays[".gaussians.params.means"][active]
    np.testing.assert_array_equal(scene.params.means[scene.active], means)
    assert evaluate_run(run, which="train").views > 0


def metrics_of(step, **changes) -> Metrics:
    fine = {"loss": 0.2, "psnr": 15.0, "pairs": 99, "finite": True}
    rest = {**dict.fromkeys(Metrics._fields, 0), "overflowed": False}
    values = {**rest, **fine, **changes, "step": step}
    return Metrics(**{name: np.asarray(value) for name, value in values.items()})


@pytest.mark.filterwarnings("ignore:.*was in view")
def test_divergence_is_a_number_of_failed_steps():
    def run(bad, steps=1000, start=1):
        health = Health(steps)
        for step in range(start):
            health.check(metrics_of(step))
        for step in range(start, start + 50):
            health.check(metrics_of(step, **bad))
        return health

    nothing = {"pairs": 0}
    for bad, span in (({"finite": False}, 51), ({"psnr": -0.1}, 51), (nothing, 50)):
        message = rf"in 50 of the last {span} steps, up to step 50"
        with pytest.raises(DivergedError, match=message):
            run(bad)
    with pytest.raises(DivergedError, match=r"in 8 of the last 9 steps"):
        run({"finite": False}, steps=16)
    with pytest.raises(DivergedError, match=r"in view in 50 of the last 50 steps"):
        run(nothing, start=0)
    # An empty photograph matches an empty view.
    assert run({**nothing, "loss": 0.001}).bad == 0
    for fine in ({"psnr": 0.1}, {"psnr": np.inf}, {"loss": 50.0}):
        assert run(fine).bad == 0
    health = run({})
    for step in range(200):
        health.check(metrics_of(step, finite=bool(step % 40)))
    assert health.bad == 0
    for step in range(200):
        health.check(metrics_of(step, pairs=step % 2))
    for step in range(99):
        health.check(metrics_of(step, finite=bool(step % 2 == 0)))
    with pytest.raises(DivergedError, match=r"in 50 of the last 100 steps"):
        health.check(metrics_of(99, finite=False))


# --- memory ---


def test_a_run_that_does_not_fit_is_rejected(tmp_path, monkeypatch):
    settings, run = settings_of(tmp_path, harmless()), tmp_path / "run"
    monkeypatch.setattr(memory, "available", lambda: 10**8)
    with pytest.raises(CapacityError, match=r"100 MB is free; lower"):
        start_run(settings, run)
    assert not run.exists()
    with memory.unlimited():
        assert start_run(settings, run).finished


# --- the command line: interrupted, and out of space ---


@pytest.fixture
def train(tmp_path, monkeypatch, capsys):
    """Run `gsjax train` on a small dataset; return its code and lines on stderr."""
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    settings = settings_of(tmp_path, harmless())
    monkeypatch.setattr(TrainCommand, "_settings", lambda *_: settings)

    def run(folder, *more):
        code = main(["train", str(settings.dataset), "-o", str(folder), *more])
        return code, capsys.readouterr().err.splitlines()

    yield run
    signal.signal(signal.SIGINT, handler)


class Whole(NamedTuple):
    """The results of an undisturbed run, and the number of bytes it wrote."""

    results: tuple
    written: int


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    settings, plenty = settings_of(folder, harmless()), 10**9
    with pytest.MonkeyPatch.context() as patched:
        left = limit_disk(patched, plenty)
        start_run(settings, folder / "run")
    return Whole(results_of(folder / "run"), plenty - left[0])


def results_of(run):
    """Return everything that has to be equal between two runs."""
    lines = read_metrics(run / "metrics.jsonl")
    varying = ("seconds", "compile_seconds", "compilations")
    log = [{k: v for k, v in x.items() if k not in varying} for x in lines]
    assert not list(run.rglob("*.tmp"))
    (last,) = list((run / "checkpoints").glob(f"step_*{STEPS}.npz"))
    arrays = {k: v.tobytes() for k, v in load_checkpoint(last).arrays.items()}
    scores = json.loads((run / "eval.json").read_text())["each"]
    return log, arrays, scores, (run / "splat.ply").read_bytes()


@pytest.mark.parametrize(
    "error", [CapacityError("too much"), MemoryError("too much")], ids=repr
)
def test_a_run_that_outgrows_the_memory_is_saved(
    error, whole, tmp_path, monkeypatch, capsys
):
    """It resumes to the same bits; a MemoryError loses steps since a checkpoint."""
    step = 12 if isinstance(error, CapacityError) else 10
    compile_one, calls = loop_module._Run.program, []

    def program(self, *sizes):
        calls.append(1)
        if len(calls) == 13:
            raise error
        return compile_one(self, *sizes)

    monkeypatch.setattr(loop_module._Run, "program", program)
    run = tmp_path / "run"
    with pytest.raises(type(error), match="too much"):
        start_run(settings_of(tmp_path, harmless()), run)
    kept = sorted(path.name for path in (run / "checkpoints").iterdir())
    assert kept == [f"step_{n:09d}.npz" for n in sorted({10, step})]
    told = capsys.readouterr().err
    assert f"the scene of step {step} is kept" in told
    assert f"step {step} is saved; resume with --resume" in told
    assert resume_run(run).finished
    assert results_of(run) == whole.results


# Where a Ctrl-C comes, how often, and the step that is saved then, if any.
INTERRUPTED = {
    "loading": (1, None),
    "compiling": (1, 1),
    "compiling, twice": (2, None),
    "stepping": (1, 7),
    "densifying": (1, 5),
    "saving": (1, 10),
    "saving, twice": (2, 10),
    "evaluating": (1, STEPS),
}


def interrupt(monkeypatch, where, times):
    """Raise that many signals at the first time the run gets there."""
    done = []

    def before(owner, name, when=lambda *_: True):
        original = getattr(owner, name)

        def replaced(*args, **kwargs):
            if when(*args) and not done:
                done.append(1)
                for _ in range(times):
                    signal.raise_signal(signal.SIGINT)
            return original(*args, **kwargs)

        monkeypatch.setattr(owner, name, replaced)

    phase = where.partition(",")[0]
    if phase == "loading":
        before(run_module, "load_photos")
    elif phase == "compiling":
        before(loop_module._Run, "program")
    elif phase == "stepping":
        before(loop_module, "with_slots", lambda state, *_: state.step == 7)
    elif phase == "densifying":  # after the fifth step, in its program
        before(loop_module._Run, "program", lambda _r, s, *_: s.step == 4)
    elif phase == "saving":  # the file is written, but not yet renamed
        before(os, "replace", lambda _, to: to.name.endswith("010.npz"))
    else:
        before(session_module, "write_evaluation")


@pytest.mark.parametrize("where", INTERRUPTED)
def test_ctrl_c_at_any_time(where, train, whole, tmp_path, monkeypatch):
    """Exit code 130, no traceback, and a folder that resumes to the same bits."""
    times, step = INTERRUPTED[where]
    run = tmp_path / "run"
    with monkeypatch.context() as patched:
        interrupt(patched, where, times)
        code, told = train(run)
    assert code == 130
    assert not any("Traceback" in line for line in told)
    kept = sorted(run.glob("checkpoints/*"))
    if where == "saving, twice":  # as if saving had not begun
        step = None
    if step is None:
        assert kept == []
        saved = "no step is saved yet; --resume starts again"
        assert ("nothing is saved yet" if where == "loading" else saved) in told[-2]
    else:
        assert kept[-1].name == f"step_{step:09d}.npz"
        assert "resume with --resume" in "".join(told[-2:])
    code, told = train(run, "--resume")
    assert code == 0, told
    assert results_of(run) == whole.results


class LimitedFile:
    """A file on a disk with ``left[0]`` bytes of space."""

    def __init__(self, file, left):
        self._file, self._left = file, left

    def __getattr__(self, name):
        return getattr(self._file, name)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._file.close()

    def write(self, data):
        if len(data) > self._left[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        self._left[0] -= len(data)
        return self._file.write(data)


def limit_disk(monkeypatch, budget):
    """Limit the bytes of all files opened for writing; return the bytes left."""
    left, open_ = [budget], Path.open

    def opened(self, mode="r", *args, **kwargs):
        file = open_(self, mode, *args, **kwargs)
        return LimitedFile(file, left) if {"w", "a", "x"} & set(mode) else file

    monkeypatch.setattr(Path, "open", opened)
    return left


# Shares of all bytes written (settings, log, three checkpoints, scene, images), and how
# many checkpoints fit.
SHARES = [(0, 0), (0.15, 0), (0.4, 1), (0.65, 2), (0.99, 2)]


@pytest.mark.parametrize(("share", "saved"), SHARES)
def test_a_full_disk_loses_nothing(share, saved, train, whole, tmp_path, monkeypatch):
    """One line reports it; once there is space, the run resumes to the same bits."""
    run = tmp_path / "run"
    with monkeypatch.context() as patched:
        limit_disk(patched, int(share * whole.written))
        code, told = train(run)
    assert code == 3
    assert "No space left on device; free some space" in told[-1]
    if share:  # otherwise the run does not start
        step = {0: "no step", 1: "step 10", 2: f"step {20 if share < 0.8 else STEPS}"}
        assert f"{step[saved]} is saved" in told[-2]
    assert not list(run.rglob("*.tmp"))
    kept = sorted(run.glob("checkpoints/*"))
    assert len(kept) == saved
    for path in kept:
        load_checkpoint(path)
    code, told = train(run, "--resume")
    assert code == 0, told
    assert results_of(run) == whole.results
