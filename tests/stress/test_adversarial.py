"""Training on hostile datasets, divergence, low memory, Ctrl-C and full disks.

Runs share compiled programs; see the fixture `shared_programs`.
"""

import errno
import json
import os
import re
import signal
import warnings
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from captures import colmap_dataset, dataset_of_views
from hostile import HOSTILE, harmless, write_hostile

import gsjax
import gsjax.runs.run as run_module
import gsjax.runs.session as session_module
import gsjax.train.loop as loop_module
from gsjax import CapacityError, DivergedError, InputError, RasterConfig, TrainConfig
from gsjax.cli.main import main
from gsjax.cli.train import TrainCommand
from gsjax.data import camera_paths
from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.densify.mcmc import McmcSettings
from gsjax.runs.checkpoint import load_checkpoint
from gsjax.runs.evaluation import evaluate_run
from gsjax.runs.folder import RunSettings
from gsjax.runs.history import read_metrics
from gsjax.runs.run import start_run
from gsjax.runs.scene_source import splat_file
from gsjax.runs.trajectories import path_entries, view_entries
from gsjax.runtime import memory
from gsjax.train.frames import make_frames
from gsjax.train.health import Health, check_points
from gsjax.train.state import Metrics

pytestmark = pytest.mark.usefixtures("float32", "shared_programs")

STEPS = 24
MAX_GAUSSIANS = 60  # on 16 tiles, so that one pair capacity serves all runs
EDITS = {"start": 0, "stop": 20, "every": 5, "max_gaussians": MAX_GAUSSIANS}
CONFIG = TrainConfig(
    steps=STEPS,
    sh_degree=0,
    every_checkpoint=10,
    adaptive=AdaptiveSettings(**EDITS, threshold=1e-6, reset_every=10),
    mcmc=McmcSettings(**EDITS, growth=1.3),
    raster=RasterConfig(num_size_buckets=1, devices=1, chunk_size=4, occlusion=False),
)
# Not of the usual shape or extent, so trained with one strategy to compile less.
ONE_STRATEGY = ("one photograph", "two that are one")
REJECTED = {
    "all behind the cameras": "all 5,000 behind all 2;",
    "all masked": "2 that are masked completely",
}


def settings_of(folder, made, strategy="mcmc") -> RunSettings:
    data = write_hostile(folder / "data", made)
    return RunSettings(data, CONFIG.replace(strategy=strategy))


@pytest.mark.filterwarnings("ignore:.*are masked completely", "ignore:.*was in view")
@pytest.mark.parametrize(
    ("name", "strategy"),
    [
        *((name, "mcmc") for name in HOSTILE),
        *((name, "adaptive") for name in HOSTILE if name not in ONE_STRATEGY),
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
    with warnings.catch_warnings():
        # Far from the origin a warning reports the rounding to float32.
        warnings.filterwarnings("ignore", message=".*jax_enable_x64")
        gaussians = gsjax.load(run / "splat.ply")
    assert result.gaussians == int(gaussians.active.sum()) <= MAX_GAUSSIANS
    for leaf in jax.tree.leaves(gaussians.params):
        assert np.isfinite(leaf).all()
    lines = read_metrics(run / "metrics.jsonl")
    assert [line["step"] for line in lines] == list(range(1, STEPS + 1))
    assert all(line["finite"] and line["loss"] is not None for line in lines)
    if result.summary is None:
        assert name == "one photograph"
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
        colmap_dataset(folder, in_units(dataset_of_views(count=3), factor))
        found = gsjax.load_dataset(folder)
        check_points(found)
        photos = gsjax.load_photos(found.views)
        gaussians = gsjax.init_gaussians(found, sh_degree=0)
        first = next(gsjax.evaluate(gaussians, found.views, photos))
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


@pytest.mark.filterwarnings("ignore:.*was in view")
@pytest.mark.parametrize(
    ("field", "change", "fault"),
    [
        # As huge learning rates leave it: the next steps overflow.
        ("means", lambda means: means * np.float32(np.inf), "not finite in 12"),
        # Colours that no image has.
        ("sh", lambda sh: sh + 1e3, "the PSNR was below 0 dB in 12"),
    ],
)
def test_a_diverging_run_stops_and_keeps_the_last_good_scene(
    field, change, fault, tmp_path, monkeypatch, capsys
):
    """It stops after half of the steps of a short run."""
    settings, run, step = settings_of(tmp_path, harmless()), tmp_path / "run", 11
    with_slots = loop_module.with_slots

    def changed(state, *rest):
        state = with_slots(state, *rest)
        if state.step != step:
            return state
        params = state.gaussians.params
        params = params.replace(**{field: change(getattr(params, field))})
        return state.replace(gaussians=state.gaussians.replace(params=params))

    monkeypatch.setattr(loop_module, "with_slots", changed)
    with pytest.raises(DivergedError, match=fault) as caught:
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


FINE, LOST, WRONG = {}, {"pairs": 0}, {"finite": False}


@pytest.mark.filterwarnings("ignore:.*was in view")
@pytest.mark.parametrize(
    ("steps", "told", "expected"),
    [
        (1000, [FINE, *[WRONG] * 50], "in 50 of the last 51 steps, up to step 50"),
        (1000, [FINE, *[{"psnr": -0.1}] * 50], "in 50 of the last 51 steps, up to"),
        (
            1000,
            [FINE, *[LOST] * 50],
            "in view in 50 of the last 50 steps, up to step 50",
        ),
        (1000, [LOST] * 50, "in view in 50 of the last 50 steps"),
        (16, [FINE, *[WRONG] * 8], "in 8 of the last 9 steps"),
        # An empty photograph matches an empty view.
        (1000, [{**LOST, "loss": 0.001}] * 50, "none"),
        *((1000, [{"psnr": psnr}] * 50, "none") for psnr in (0.1, np.inf)),
        (1000, [{"loss": 50.0}] * 50, "none"),
        (1000, [WRONG, *[FINE] * 39] * 5, "none"),
        (1000, [LOST, FINE] * 100 + [WRONG, FINE] * 49, "none"),
        (1000, [LOST, FINE] * 100 + [WRONG, FINE] * 50, "in 50 of the last 100 steps"),
    ],
    ids=str,
)
def test_divergence_is_a_number_of_failed_steps(steps, told, expected):
    usual = {**dict.fromkeys(Metrics._fields, 0), "overflowed": False}
    usual |= {"loss": 0.2, "psnr": 15.0, "pairs": 99, "finite": True}
    health, message = Health(steps), "none"
    try:
        for step, changes in enumerate(told):
            found = {**usual, **changes, "step": step}
            health.check(Metrics(**{k: np.asarray(v) for k, v in found.items()}))
        assert health.bad == 0
    except DivergedError as error:
        message = str(error)
    assert expected in message


def test_a_run_that_does_not_fit_is_rejected(tmp_path, monkeypatch):
    settings, run = settings_of(tmp_path, harmless()), tmp_path / "run"
    monkeypatch.setattr(memory, "available", lambda: 10**8)
    with pytest.raises(CapacityError, match=r"100 MB is free; lower"):
        start_run(settings, run)
    assert not run.exists()
    with memory.unlimited():
        assert start_run(settings, run).finished


# --- the command line: interrupted, and out of memory or space ---


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


def limit_disk(patch, budget):
    """Limit the bytes of all files opened for writing; return the bytes left."""
    left, open_ = [budget], Path.open

    def opened(self, mode="r", *args, **kwargs):
        file = open_(self, mode, *args, **kwargs)
        return LimitedFile(file, left) if {"w", "a", "x"} & set(mode) else file

    patch.setattr(Path, "open", opened)
    return left


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the results of an undisturbed run, and the number of bytes it wrote."""
    folder = tmp_path_factory.mktemp("whole")
    settings, plenty = settings_of(folder, harmless()), 10**9
    with pytest.MonkeyPatch.context() as patch:
        left = limit_disk(patch, plenty)
        start_run(settings, folder / "run")
    return results_of(folder / "run"), plenty - left[0]


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


def at(what, owner, name, when=lambda *_: True):
    """Return a disturbance: so many times Ctrl-C, or an error, before such a call."""

    def disturb(patch, _):
        original, done = getattr(owner, name), []

        def replaced(*args, **kwargs):
            if when(*args) and not done:
                done.append(1)
                if isinstance(what, Exception):
                    raise what
                for _ in range(what):
                    signal.raise_signal(signal.SIGINT)
            return original(*args, **kwargs)

        patch.setattr(owner, name, replaced)

    return disturb


def disk_of(share):
    """Return a disturbance: a disk with a share of the bytes that the run writes.

    They are settings, log, three checkpoints, scene, and images.
    """
    return lambda patch, written: limit_disk(patch, int(share * written))


def is_tenth(_, to):
    return to.name.endswith("010.npz")


def at_step(number):
    return lambda _, state, *__: state.step == number


RUN, STOPPED, FULL = loop_module._Run, "interrupted|stopped", "No space left .*; free"
TOO_MUCH = CapacityError("too much")
# By name: the disturbance, exit code, last line, and the steps that are saved then.
DISTURBED = {
    "loading": (at(1, run_module, "load_photos"), 130, STOPPED, ()),
    "compiling": (at(1, RUN, "program"), 130, STOPPED, (1,)),
    "compiling, twice": (at(2, RUN, "program"), 130, STOPPED, ()),
    "stepping": (
        at(1, loop_module, "with_slots", lambda state, *_: state.step == 7),
        130, STOPPED, (7,),
    ),
    # After the fifth step, in its program.
    "densifying": (at(1, RUN, "program", at_step(4)), 130, STOPPED, (5,)),
    # The file is written, but not yet renamed; then as if saving had not begun.
    "saving": (at(1, os, "replace", is_tenth), 130, STOPPED, (10,)),
    "saving, twice": (at(2, os, "replace", is_tenth), 130, STOPPED, ()),
    "evaluating": (
        at(1, session_module, "write_evaluation"), 130, STOPPED, (20, STEPS)
    ),
    "outgrown": (at(TOO_MUCH, RUN, "program", at_step(12)), 3, "too much", (10, 12)),
    "no memory": (at(MemoryError(), RUN, "program", at_step(12)), 3, "memory", (10,)),
    "no disk": (disk_of(0), 3, FULL, ()),
    "15% of a disk": (disk_of(0.15), 3, FULL, ()),
    "40% of a disk": (disk_of(0.4), 3, FULL, (10,)),
    "65% of a disk": (disk_of(0.65), 3, FULL, (10, 20)),
    "99% of a disk": (disk_of(0.99), 3, FULL, (20, STEPS)),
}  # fmt: skip


@pytest.mark.parametrize("name", DISTURBED)
def test_a_disturbed_run_loses_nothing(name, train, whole, tmp_path, monkeypatch):
    """It ends in one line, not in a traceback, and resumes to the same bits."""
    disturb, expected, message, steps = DISTURBED[name]
    (results, written), run = whole, tmp_path / "run"
    with monkeypatch.context() as patch:
        disturb(patch, written)
        code, told = train(run)
    assert code == expected
    assert not any("Traceback" in line for line in told)
    assert re.search(message, told[-1])
    kept = sorted(run.glob("checkpoints/*.npz"))
    assert [load_checkpoint(path).step for path in kept] == [*steps]
    hint = "no(thing| step) is saved yet"
    if steps:
        hint = rf"step {steps[-1]}( is saved)?; resume with --resume"
    if name != "no disk":  # otherwise the run does not start
        assert re.search(hint, "".join(told[-2:]))
    code, told = train(run, "--resume")
    assert code == 0, told
    assert results_of(run) == results
