"""Datasets that no one should train on end in a finite scene, or in one clear line.

By the real entry, both strategies. Programs are shared among runs: compiling would be
all that is done here.
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
import gsjax.runs.session as sitting_module
import gsjax.train.loop as fit_module
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
MOST = 60  # on 16 tiles: one capacity of pairs does for all
CONFIG = TrainConfig(
    steps=STEPS,
    sh_degree=0,
    every_checkpoint=10,
    adaptive=AdaptiveSettings(
        start=0, stop=20, every=5, threshold=1e-6, reset_every=10, max_gaussians=MOST
    ),
    mcmc=McmcSettings(start=0, stop=20, every=5, growth=1.3, max_gaussians=MOST),
    raster=RasterConfig(num_size_buckets=1, devices=1, chunk_size=4, occlusion=False),
)
# Of another shape: with one strategy, to compile less.
ONE_PROGRAM_MORE = "one photograph"
REFUSED = {
    "all behind the cameras": "all 5,000 points lie behind all 2 cameras",
    "all masked": "all 2 photographs are masked altogether",
}


def settings_of(folder, made, strategy, **changes) -> RunSettings:
    data = write_hostile(folder / "data", made)
    return RunSettings(data, CONFIG.replace(strategy=strategy, **changes))


def assert_sound(run) -> gsjax.Gaussians:
    """Its scene loads and is finite, as is all that was logged."""
    with warnings.catch_warnings():
        # Far from the origin what float32 rounds is told.
        warnings.filterwarnings("ignore", message=".*jax_enable_x64")
        gaussians = gsjax.load(run / "splat.ply")
    for leaf in jax.tree.leaves(gaussians.params):
        assert np.isfinite(leaf).all()
    lines = [json.loads(x) for x in (run / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == list(range(1, STEPS + 1))
    assert all(line["finite"] and line["loss"] is not None for line in lines)
    return gaussians


@pytest.mark.filterwarnings("ignore:.*masked altogether and teach nothing")
@pytest.mark.parametrize(
    ("name", "strategy"),
    [
        (name, strategy)
        for name in HOSTILE
        for strategy in ("adaptive", "mcmc")
        if strategy == "mcmc" or name != ONE_PROGRAM_MORE
    ],
)
def test_ends_in_a_finite_scene_or_in_one_line(name, strategy, tmp_path):
    settings, run = settings_of(tmp_path, HOSTILE[name](), strategy), tmp_path / "run"
    if name in REFUSED:
        with pytest.raises(InputError, match=REFUSED[name]):
            start_run(settings, run)
        assert not (run / "splat.ply").exists()
        return
    result = start_run(settings, run)
    assert result.finished
    gaussians = assert_sound(run)
    assert result.gaussians == int(gaussians.active.sum()) <= MOST
    if result.summary is None:
        assert name == ONE_PROGRAM_MORE
        with pytest.raises(InputError, match=r"no test views .* --views train"):
            evaluate_run(run)
        return
    told = json.loads((run / "eval.json").read_text())
    assert np.isfinite(told["ssim"])
    assert result.summary.views == 1


def in_units(scene, unit: float):
    """All lengths times ``unit``."""
    scale = np.diag([unit, unit, unit, 1.0])
    views = [
        replace(v, viewmat=scale @ v.viewmat @ np.linalg.inv(scale))
        for v in scene.views
    ]
    return replace(scene, views=tuple(views), points=scene.points * unit)


def test_a_unit_too_large_is_told():
    """Of points alone: what is too near would never be drawn, nor ever move."""
    scene = dataset_of_views(count=3)
    check_points(scene)
    small = in_units(scene, 1e-4)
    with pytest.raises(InputError, match=r"nearer than 0\.01 .* one unit of length"):
        check_points(small)
    view = scene.views[0]
    tight = view.centre + 0.005 * view.viewmat[2, :3]
    few = np.stack([tight, tight, tight, view.centre + view.viewmat[2, :3]])
    with pytest.warns(UserWarning, match="75% of the points .* 0.01, and not drawn"):
        check_points(replace(scene, points=few, views=(view,)))


@pytest.mark.parametrize("unit", [1e-6, 1e-3, 1e3])
def test_a_dataset_may_be_in_any_unit(unit, tmp_path):
    """What is drawn of it does not depend on that, wherever cameras are made."""
    seen = {}
    for factor in (0.1, unit):  # of an extent below the usual one
        folder = tmp_path / str(factor)
        scene = in_units(dataset_of_views(count=3), factor)
        write_colmap(folder / "sparse/0", scene)
        for view in scene.views:
            save_photo(folder / "images" / view.name)
        found = load_dataset(folder)
        check_points(found)
        photos, gaussians = load_photos(found.views), init_gaussians(found, sh_degree=0)
        first = next(evaluate(gaussians, found.views, photos))
        frames = make_frames(found.views, photos)
        cameras = [frames.camera]
        entries = view_entries(found.views[:2])
        entries += path_entries(found, camera_paths.orbit, frames=2)
        cameras += [entry.camera for entry in entries]
        near = np.concatenate([np.atleast_1d(camera.near) for camera in cameras])
        seen[factor] = first.render, near / factor
    (wanted, usual), (render, near) = seen.values()
    assert wanted.std() > 0.02  # something is seen
    np.testing.assert_allclose(render, wanted, atol=1e-4)
    np.testing.assert_allclose(near, near[0], rtol=1e-6)
    if unit < 1:
        np.testing.assert_allclose(near, usual, rtol=1e-6)


# --- divergence ---


def wild(state):
    """As absurd learning rates leave it: with steps that lead out of the numbers."""
    mu = jax.tree.map(lambda a: a + 1e30, state.moments.mu)
    return state.replace(moments=state.moments._replace(mu=mu))


def garish(state):
    """Colours that no picture has."""
    params = state.gaussians.params
    params = params.replace(sh=params.sh + 1e3)
    return state.replace(gaussians=state.gaussians.replace(params=params))


FAULTS = {
    wild: "a Gaussian was not finite in 12",
    garish: "farther from the photograph than any can be in 12",
}


@pytest.mark.parametrize("change", FAULTS, ids=lambda change: change.__name__)
def test_a_diverging_run_is_stopped_and_what_was_good_is_kept(
    change, tmp_path, monkeypatch, capsys
):
    """After step 11 something happens; half of so short a run is time enough."""
    settings = settings_of(tmp_path, harmless(), "mcmc")
    run, happened = tmp_path / "run", 11
    with_slots = fit_module.with_slots

    def changed(state, wanted, config):
        state = with_slots(state, wanted, config)
        return change(state) if state.step == happened else state

    monkeypatch.setattr(fit_module, "with_slots", changed)
    with pytest.raises(DivergedError, match=FAULTS[change]) as caught:
        start_run(settings, run)
    assert caught.value.exit_code == 5
    assert len(read_metrics(run / "metrics.jsonl")) == happened + STEPS // 2 - 1
    (kept,) = (run / "checkpoints").iterdir()
    good = load_checkpoint(kept)
    assert good.step == 10  # and not 20, though that was due
    for name, array in good.arrays.items():
        assert not name.startswith(".gaussians.params") or np.isfinite(array).all()
    # And as a scene, which every command takes.
    told = capsys.readouterr().err
    assert f"the scene of step 10 is kept: {run / 'splat.ply'}" in told
    scene = gsjax.load(splat_file(run))
    active = good.arrays[".gaussians.active"]
    np.testing.assert_array_equal(
        scene.params.means[scene.active], good.arrays[".gaussians.params.means"][active]
    )
    assert evaluate_run(run, which="train").views > 0


def metrics_of(step, **changes) -> Metrics:
    fine = {"loss": 0.2, "psnr": 15.0, "pairs": 99, "finite": True}
    rest = dict.fromkeys(Metrics._fields, 0)
    told = {**rest, "overflowed": False, **fine, **changes, "step": step}
    return Metrics(**{name: np.asarray(value) for name, value in told.items()})


def test_what_counts_as_diverging():
    """So many of the last steps, and only what can be nothing else."""

    def run(bad, steps=1000, start=1):
        health = Health(steps)
        for step in range(start):
            health.check(metrics_of(step))
        for step in range(start, start + 50):
            health.check(metrics_of(step, **bad))
        return health

    nothing = {"pairs": 0}
    for bad, span in (({"finite": False}, 51), ({"psnr": -0.1}, 51), (nothing, 50)):
        told = rf"in 50 of the last {span} steps, up to step 50"
        with pytest.raises(DivergedError, match=told):
            run(bad)
    with pytest.raises(DivergedError, match=r"in 8 of the last 9 steps"):
        run({"finite": False}, steps=16)
    with pytest.raises(DivergedError, match=r"in view in 50 of the last 50 steps"):
        run(nothing, start=0)
    # Photographs of nothing are shown by nothing.
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


def test_a_run_that_would_not_fit_does_not_start(tmp_path, monkeypatch):
    settings, run = settings_of(tmp_path, harmless(), "mcmc"), tmp_path / "run"
    monkeypatch.setattr(memory, "available", lambda: 10**8)
    with pytest.raises(CapacityError, match=r"this run .* 100 MB is free; lower"):
        start_run(settings, run)
    assert not run.exists()
    with memory.unlimited():
        assert start_run(settings, run).finished


@pytest.mark.parametrize(
    "error", [CapacityError("too much"), MemoryError("too much")], ids=repr
)
def test_a_run_that_outgrows_the_memory_is_saved(error, tmp_path, monkeypatch, capsys):
    """And ends, once it may, as if nothing had been; nobody foresees a MemoryError,
    which costs the steps since the last checkpoint.
    """
    step = 12 if isinstance(error, CapacityError) else 10
    whole = start_run(settings_of(tmp_path, harmless(), "mcmc"), tmp_path / "whole")
    compile_one, calls = fit_module._Run.program, []

    def program(self, *sizes):
        calls.append(1)
        if len(calls) == 13:
            raise error
        return compile_one(self, *sizes)

    monkeypatch.setattr(fit_module._Run, "program", program)
    run = tmp_path / "run"
    with pytest.raises(type(error), match="too much"):
        start_run(settings_of(tmp_path / "again", harmless(), "mcmc"), run)
    kept = sorted(path.name for path in (run / "checkpoints").iterdir())
    assert kept == [f"step_{n:09d}.npz" for n in sorted({10, step})]
    told = capsys.readouterr().err
    assert f"the scene of step {step} is kept" in told
    assert f"step {step} is saved; go on with --resume" in told
    assert resume_run(run).finished
    splats = (f.read_bytes() for f in (run / "splat.ply", whole.files.splat))
    assert len(set(splats)) == 1


# --- the command line: interrupted, and out of space ---

# Where a Ctrl-C comes, how often, and the step that is then saved; None: none is.
INTERRUPTED = {
    "loading": (1, None),
    "compiling": (1, 1),
    "compiling, twice": (2, None),
    "stepping": (1, 7),
    "densifying": (1, 5),
    "saving": (1, 10),
    "saving, twice": (2, 10),
    "at the end": (1, STEPS),
    "evaluating": (1, STEPS),
}


@pytest.fixture
def train(tmp_path, monkeypatch, capsys):
    """`gsjax train` of a small dataset: its code, and the lines on stderr."""
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    settings = settings_of(tmp_path, harmless(), "mcmc")
    monkeypatch.setattr(TrainCommand, "_settings", lambda *_: settings)

    def run(folder, *more):
        code = main.main(["train", str(settings.dataset), "-o", str(folder), *more])
        return code, capsys.readouterr().err.splitlines()

    yield run
    signal.signal(signal.SIGINT, handler)


class Whole(NamedTuple):
    """What a run leaves behind, and how many bytes it wrote on the way."""

    left: tuple
    written: int


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What a run leaves that nothing happened to."""
    folder = tmp_path_factory.mktemp("whole")
    settings, plenty = settings_of(folder, harmless(), "mcmc"), 10**9
    with pytest.MonkeyPatch.context() as patched:
        left = full_after(patched, plenty)
        start_run(settings, folder / "run")
    return Whole(left_behind(folder / "run"), plenty - left[0])


def left_behind(run):
    """All that may not differ, and nothing that may."""
    lines = read_metrics(run / "metrics.jsonl")
    varying = ("seconds", "compile_seconds", "compilations")
    log = [{k: v for k, v in x.items() if k not in varying} for x in lines]
    assert not list(run.rglob("*.tmp"))
    (last,) = list((run / "checkpoints").glob(f"step_*{STEPS}.npz"))
    arrays = {k: v.tobytes() for k, v in load_checkpoint(last).arrays.items()}
    scores = json.loads((run / "eval.json").read_text())["each"]
    return log, arrays, scores, (run / "splat.ply").read_bytes()


def interrupt(monkeypatch, where, times):
    """Raise that many signals there, the first time that it is come to."""
    done = []

    def now():
        if not done:
            done.append(1)
            for _ in range(times):
                signal.raise_signal(signal.SIGINT)

    def before(owner, name, when=lambda *_: True):
        original = getattr(owner, name)

        def replaced(*args, **kwargs):
            if when(*args):
                now()
            return original(*args, **kwargs)

        monkeypatch.setattr(owner, name, replaced)

    phase = where.partition(",")[0]
    if phase == "loading":
        before(run_module, "load_photos")
    elif phase == "compiling":
        before(fit_module._Run, "program")
    elif phase == "stepping":
        before(fit_module, "with_slots", lambda state, *_: state.step == 7)
    elif phase == "densifying":  # after the fifth step, in its program
        before(fit_module._Run, "program", lambda _r, s, *_: s.step == 4)
    elif phase == "saving":  # the file is written, and has no name yet
        before(os, "replace", lambda _, to: to.name.endswith("010.npz"))
    elif phase == "at the end":
        before(os, "replace", lambda _, to: to.name == "splat.ply")
    else:
        before(sitting_module, "write_evaluation")


@pytest.mark.parametrize("where", INTERRUPTED)
def test_ctrl_c_at_any_time(where, train, whole, tmp_path, monkeypatch):
    """130, no traceback, and a folder to go on with to the same bits."""
    times, step = INTERRUPTED[where]
    run = tmp_path / "run"
    with monkeypatch.context() as patched:
        interrupt(patched, where, times)
        code, told = train(run)
    assert code == 130
    assert not any("Traceback" in line for line in told)
    kept = sorted(run.glob("checkpoints/*"))
    if where == "saving, twice":  # in the middle: as if it had not begun
        step = None
    if step is None:
        assert kept == []
        saved = "no step is saved yet; --resume starts from the beginning"
        assert ("nothing is saved yet" if where == "loading" else saved) in told[-2]
    else:
        assert kept[-1].name == f"step_{step:09d}.npz"
        assert "go on with --resume" in "".join(told[-2:])
    code, told = train(run, "--resume")
    assert code == 0, told
    assert left_behind(run) == whole.left


class Full:
    """A file on a disk that takes so many bytes more, ``left``."""

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


def full_after(monkeypatch, budget):
    """Let whatever is opened to write take so many bytes together; what is left."""
    left, open_ = [budget], Path.open

    def opened(self, mode="r", *args, **kwargs):
        file = open_(self, mode, *args, **kwargs)
        return Full(file, left) if {"w", "a", "x"} & set(mode) else file

    monkeypatch.setattr(Path, "open", opened)
    return left


# Shares of all that is written (settings, log, three checkpoints, scene, pictures), and
# how many checkpoints fit. Clear of where one just does: times have digits that vary.
SHARES = [(0, 0), (0.01, 0), (0.15, 0), (0.4, 1), (0.65, 2), (0.9, 2), (0.99, 2)]


@pytest.mark.parametrize(("share", "saved"), SHARES)
def test_a_full_disk_loses_nothing(share, saved, train, whole, tmp_path, monkeypatch):
    """What was saved stays; one line says so; once there is room, the same bits."""
    run = tmp_path / "run"
    with monkeypatch.context() as patched:
        full_after(patched, int(share * whole.written))
        code, told = train(run)
    assert code == 3
    assert "No space left on device; free some space" in told[-1]
    if share:  # else the run could not even begin
        step = {0: "no step", 1: "step 10", 2: f"step {20 if share < 0.8 else STEPS}"}
        assert f"{step[saved]} is saved" in told[-2]
    assert not list(run.rglob("*.tmp"))
    kept = sorted(run.glob("checkpoints/*"))
    assert len(kept) == saved
    for path in kept:
        load_checkpoint(path)
    code, told = train(run, "--resume")
    assert code == 0, told
    assert left_behind(run) == whole.left
