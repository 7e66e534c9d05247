"""Runs and their folders: started, replaced, resumed, initialised, evaluated."""

import json
import math
import os
import shutil
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hostile import HOSTILE, harmless, write_hostile

import gsjax
from gsjax.cli.main import main
from gsjax.data.dataset import load_dataset
from gsjax.densify.mcmc import McmcSettings
from gsjax.errors import InputError
from gsjax.io.ply import render_mode
from gsjax.raster.types import RasterConfig
from gsjax.runs import folder as run_folder
from gsjax.runs import initialisation, report
from gsjax.runs import run as run_module
from gsjax.runs.checkpoint import load_latest
from gsjax.runs.config_json import config_from_json
from gsjax.runs.evaluation import evaluate_run
from gsjax.runs.folder import RunSettings, load_settings, load_split
from gsjax.runs.history import read_metrics
from gsjax.runs.report import Reporter
from gsjax.runs.run import RunResult, resume_run, start_run
from gsjax.runs.scene_source import open_scene_source
from gsjax.runtime.files import locked_folder
from gsjax.train.config import Level, TrainConfig
from gsjax.train.initialisation import initial_state
from gsjax.train.loop import Progress
from gsjax.train.state import Metrics

pytestmark = pytest.mark.usefixtures("float32", "shared_programs")

CONFIG = TrainConfig(
    steps=4,
    sh_degree=0,
    strategy="mcmc",
    mcmc=McmcSettings(start=0, stop=0, max_gaussians=60),
    raster=RasterConfig(num_size_buckets=1, devices=1, chunk_size=4, occlusion=False),
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """Return a folder with a dataset and a finished run, which no test changes."""
    folder = tmp_path_factory.mktemp("whole")
    data = write_hostile(folder / "data", harmless())
    assert start_run(RunSettings(data, CONFIG), folder / "run").finished
    return folder


@pytest.fixture
def made(whole, tmp_path) -> Path:
    """Return a copy of it."""
    folder = tmp_path / "made"
    shutil.copytree(whole, folder)
    change(folder / "run" / "config.json", dataset=str(folder / "data"))
    return folder


def change(path: Path, **changes) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def contents(folder: Path) -> dict[Path, bytes]:
    return {p: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def train(dataset: Path, run: Path, *words) -> int:
    """Run the command line, and return its exit code."""
    return main(["train", *map(str, (dataset, "-o", run, *words))])


def repeat(run: Path) -> None:
    """Resume a run as if killed before its first checkpoint; the bits are equal."""
    before = (run / "splat.ply").read_bytes()
    shutil.rmtree(run / "checkpoints")
    (run / "splat.ply").unlink()
    assert resume_run(run).finished
    assert (run / "splat.ply").read_bytes() == before


@pytest.mark.parametrize("name", ["config.json", "other.json"])
def test_only_a_run_is_replaced(whole, tmp_path, name):
    (tmp_path / "renders" / "precious").mkdir(parents=True)
    (tmp_path / "renders" / "precious" / "a.blend").write_text("mine")
    (tmp_path / name).write_text('{"my": "app"}')
    before = contents(tmp_path)
    with pytest.raises(InputError, match=r"config\.json"):
        start_run(RunSettings(whole / "data", CONFIG), tmp_path, overwrite=True)
    assert contents(tmp_path) == before


def test_a_run_is_replaced_only_when_the_next_can_start(made, tmp_path, monkeypatch):
    """A run that cannot start fails before it reads photographs, and leaves nothing."""
    run = made / "run"
    bad = write_hostile(tmp_path / "bad", HOSTILE["no points"]())
    before = contents(run)
    points = RunSettings(bad, CONFIG.replace(initial="points"))
    with monkeypatch.context() as patch:
        patch.setattr(run_module, "load_photos", None)
        for folder in (run, tmp_path / "new"):
            with pytest.raises(InputError, match="--initial random"):
                start_run(points, folder, overwrite=True)
    assert contents(run) == before
    assert not (tmp_path / "new").exists()

    def refused(_):
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", refused)
        with pytest.raises(InputError, match="checkpoints: cannot be removed: Permis"):
            start_run(RunSettings(made / "data", CONFIG), run, overwrite=True)
    assert load_settings(run).config.seed == 0, "it still is a run"
    # Of links, the targets stay, and those without a target are replaced.
    for name in ("checkpoints", "renders"):
        (run / name).rename(tmp_path / name)
        (run / name).symlink_to(tmp_path / name)
    shutil.rmtree(tmp_path / "renders")
    kept = contents(tmp_path / "checkpoints")
    other = RunSettings(made / "data", CONFIG.replace(seed=3))
    assert start_run(other, run, overwrite=True).finished
    assert load_settings(run).config.seed == 3
    assert contents(run)[run / "splat.ply"] != before[run / "splat.ply"]
    assert not any((run / name).is_symlink() for name in ("checkpoints", "renders"))
    assert contents(tmp_path / "checkpoints") == kept


HOLDS_A_LOCK = """
import pathlib, sys, time
from gsjax.runtime.files import locked_folder
with locked_folder(pathlib.Path(sys.argv[1])):
    print("held", flush=True), time.sleep(600)
"""


def test_one_training_at_a_time_in_a_folder(made):
    run, settings = made / "run", RunSettings(made / "data", CONFIG)
    before = contents(run)
    arguments = [sys.executable, "-c", HOLDS_A_LOCK, str(run)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE) as other:
        try:
            assert other.stdout.readline() == b"held\n"
            with pytest.raises(InputError, match="another"):
                start_run(settings, run, overwrite=True)
        finally:
            other.kill()
    # A killed process holds nothing.
    with locked_folder(run), pytest.raises(InputError, match="another"):
        resume_run(run)
    assert contents(run) == before


def steps_of(path: Path) -> list[int]:
    return [json.loads(line)["step"] for line in path.read_text().splitlines()]


def test_each_step_is_logged_once(whole, tmp_path, capsys, monkeypatch):
    """After a kill or an error in the third step, and if a finished run is resumed.

    A checkpoint and evaluations were due in the second step.
    """

    def watch(*_):
        def look(_, progress):
            if progress.metrics.step == 3:
                shutil.copytree(tmp_path / "error", tmp_path / "kill")
                raise RuntimeError("after a copy")

        return look

    config = CONFIG.replace(every_eval=1, every_checkpoint=2)
    with pytest.raises(RuntimeError, match="after a copy"):
        start_run(RunSettings(whole / "data", config), tmp_path / "error", watch=watch)
    for run in (tmp_path / "kill", tmp_path / "error"):
        assert steps_of(run / "held_out.jsonl") == [1, 2]
        for devices in (2, 1):
            monkeypatch.setattr(run_module, "device_count", lambda _, n=devices: n)
            assert resume_run(run).finished
            notes = capsys.readouterr().err
            assert ("2 devices (cores) instead of 1" in notes) == (devices == 2)
            for log in ("held_out.jsonl", "metrics.jsonl"):
                assert steps_of(run / log) == [1, 2, 3, 4]


def test_leftovers_of_killed_processes_are_removed(made):
    """Newer ones may be another process's."""
    run = made / "run"
    for folder in (folders := (run, run / "checkpoints")):
        for name, seconds in ((".gsjax-0f.tmp", 1), (".gsjax-1f.tmp", 2**32), ("a", 1)):
            (folder / name).write_bytes(b"half")
            os.utime(folder / name, (seconds, seconds))
    assert resume_run(run).finished
    for folder in folders:
        names = {path.name for path in folder.iterdir()}
        assert ".gsjax-0f.tmp" not in names
        assert {".gsjax-1f.tmp", "a"} <= names


def test_a_dataset_without_points_starts_at_random(whole, tmp_path, capsys):
    """The choice is kept, also if points exist when the run is resumed."""
    assert load_settings(whole / "run").config == CONFIG.replace(initial="points")
    bare, run = HOSTILE["no points"](), tmp_path / "run"
    data = write_hostile(tmp_path / "data", bare)
    config = CONFIG.replace(initial_count=50, every_checkpoint=0)
    assert start_run(RunSettings(data, config), run).finished
    assert "no points: initialising at random" in capsys.readouterr().err
    assert load_settings(run).config == config.replace(initial="random")
    shutil.rmtree(data)
    write_hostile(data, replace(bare, dataset=harmless().dataset))
    repeat(run)
    assert "--initial" not in capsys.readouterr().err


def test_a_mip_run_is_resumed_and_drawn_by_its_filters(whole, tmp_path):
    """Its file holds the smoothed Gaussians; a kill before the edit changes no bit."""
    edits = McmcSettings(start=0, stop=3, every=2, max_gaussians=60)
    config = CONFIG.replace(mip=True, mcmc=edits, every_checkpoint=2)
    run, files = tmp_path / "run", run_folder.run_files(tmp_path / "run")
    assert start_run(RunSettings(whole / "data", config), run).finished
    arrays = load_latest(files.checkpoints).arrays
    active = arrays[".gaussians.active"]
    radii = arrays[".model.buffers['radii']"][active]
    assert (radii > 0).all()
    sharp = np.exp(arrays[".gaussians.params.log_scales"][active])
    wide = np.exp(np.asarray(gsjax.load(files.splat).params.log_scales))
    np.testing.assert_allclose(wide**2, sharp**2 + radii[:, None] ** 2, rtol=1e-5)
    assert render_mode(files.splat) == "mip"
    for source in (run, files.splat):
        found = open_scene_source(source, raster=RasterConfig.accurate()).config
        assert (found.dilation, found.antialias) == (0.1, True)
    before = files.splat.read_bytes()
    (files.checkpoints / "step_000000004.npz").unlink()
    files.splat.unlink()
    assert resume_run(run).finished
    assert files.splat.read_bytes() == before
    repeat(run)


@pytest.mark.parametrize("degree", [0, 2])
def test_initial_gaussians_are_kept_bit_by_bit(whole, degree):
    """Except for bands that are dropped or added."""
    dataset, config = load_dataset(whole / "data"), CONFIG.replace(sh_degree=degree)
    given = gsjax.with_sh_degree(gsjax.load(whole / "run" / "splat.ply"), 1)
    keep = np.arange(given.capacity) % 3 != 0
    wanted = gsjax.compact(gsjax.select(given, keep), int(keep.sum()))
    wanted = gsjax.with_sh_degree(wanted, degree)
    state = initial_state(dataset, config, gsjax.select(given, keep))
    assert int(state.step) == 0
    active = np.asarray(state.gaussians.active)
    assert active.sum() == keep.sum() > 0
    ours = jax.tree.map(lambda leaf: leaf[active], state.gaussians.params)
    jax.tree.map(np.testing.assert_array_equal, ours, wanted.params)
    few = config.replace(max_gaussians=given.capacity - 1)
    for count in (0, given.capacity):
        some = gsjax.select(given, np.arange(given.capacity) < count)
        with pytest.raises(InputError, match=f"1 to {given.capacity - 1}"):
            initial_state(dataset, few, some)


def test_a_run_starts_from_a_scene(made, capsys):
    """And starts from it again if a kill came before the first checkpoint."""
    splat, run = made / "run" / "splat.ply", made / "next"
    settings = RunSettings(made / "data", CONFIG, start=splat)
    assert start_run(settings, run).finished
    notes = capsys.readouterr().err
    assert f"starting from the scene of {splat}\n" in notes
    assert "was trained on" not in notes
    assert load_settings(run).start == splat
    first, *_ = read_metrics(run / "metrics.jsonl")
    begun, *_, last = read_metrics(made / "run" / "metrics.jsonl")
    assert first["loss"] < begun["loss"]
    assert first["gaussians"] == last["gaussians"]
    repeat(run)
    shutil.rmtree(run / "checkpoints")
    splat.unlink()
    with pytest.raises(InputError, match=r"splat\.ply"):
        resume_run(run)


def test_a_scene_of_another_dataset_is_rejected(made, tmp_path, monkeypatch, capsys):
    """Before photographs are read, as is one with too many Gaussians."""
    monkeypatch.setattr(run_module, "load_photos", None)
    splat, settings = made / "run" / "splat.ply", load_settings(made / "run")
    initialisation.warn_of_trained_views(splat, (*settings.trained, "new"))
    assert "trained on 2 of the 3 held-out views" in capsys.readouterr().err
    initialisation.warn_of_trained_views(splat, settings.held_out)
    assert capsys.readouterr().err == ""
    given = gsjax.load(splat)
    count, means = given.capacity, given.params.means + 1e3  # far out
    far = given.replace(params=given.params.replace(means=means))
    gsjax.save(tmp_path / "far.ply", far)
    gsjax.save(tmp_path / "bands.ply", gsjax.with_sh_degree(given, 2))
    few = ["--max-gaussians", count - 1]
    reduced = "SH degree 2 is reduced to 1"
    for scene, options, message in (
        (tmp_path / "far.ply", [], "in any of 2 views"),
        (made / "run", few, f"1 to {count - 1}"),
        (tmp_path / "bands.ply", [*few, "--sh-degree", 1], reduced),
    ):
        words = ("--initial", scene, *options)
        assert train(made / "data", tmp_path / "new", *words) == 3
        assert message in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_dense_initialisation_counts_as_training(whole, tmp_path, monkeypatch, capsys):
    """After a kill before the first checkpoint, it is repeated with equal bits."""

    def found(dataset, photos, config):
        assert len(photos) == len(dataset.views)
        assert config.initial == "dense"
        time.sleep(0.5)
        points = np.concatenate([dataset.points, dataset.points[:7] + 0.01])
        colors = np.concatenate([dataset.colors, dataset.colors[:7]])
        return replace(dataset, points=points, colors=colors)

    monkeypatch.setattr(initialisation, "add_dense_points", found)
    run = tmp_path / "run"
    start_run(RunSettings(whole / "data", CONFIG.replace(initial="dense")), run)
    assert "7 points added in " in capsys.readouterr().err
    first, *_ = read_metrics(run / "metrics.jsonl")
    assert first["seconds"] > first["compile_seconds"] + 0.5
    assert load_settings(run).config.initial == "dense"
    repeat(run)
    assert "7 points added in " in capsys.readouterr().err


def test_a_dataset_with_other_views_is_rejected(made):
    settings = load_settings(made / "run")
    assert (settings.held_out, settings.trained) == (("1.png",), ("0.png", "2.png"))
    # As if the last view were new, and others were removed.
    held_out, trained = ["1.png", "3.png"], ["0.png", "4.png"]
    change(made / "run" / "config.json", held_out=held_out, trained=trained)
    before = contents(made / "run")
    for use in (evaluate_run, resume_run):
        with pytest.raises(InputError, match="views are not those of the run") as error:
            use(made / "run")
        for difference in ("+2.png -4.png (trained on)", "-3.png (held out)"):
            assert difference in str(error.value)
    assert contents(made / "run") == before


def test_the_split_of_a_run_is_fixed(made):
    config = made / "run" / "config.json"
    for every in (8, 0, None):
        change(config, held_out=["2.png"], trained=["0.png", "1.png"], every=every)
        split = load_split(load_settings(made / "run"))
        assert (split.train, split.test) == ([0, 1], [2])
        change(config, held_out=[], trained=["0.png", "1.png", "2.png"])
        assert load_split(load_settings(made / "run")).test == []
    # Older runs have no names, and 8 was the default.
    data = json.loads(config.read_text())
    data = {k: v for k, v in data.items() if k not in ("trained", "held_out")}
    for every, wanted in ((8, None), (5, 5), (0, 0)):
        config.write_text(json.dumps({**data, "every": every}))
        assert load_settings(made / "run").every == wanted


def test_a_dataset_that_was_moved(made, capsys):
    run, there = made / "run", made / "elsewhere"
    (made / "data").rename(there)
    with pytest.raises(InputError, match="train NEW_PLACE -o RUN --resume"):
        evaluate_run(run)
    before = contents(run)
    assert train(there, run, "--resume") == 0
    notes = capsys.readouterr().err
    assert f"dataset is now {there}" in notes
    assert "finished before" in notes
    assert load_settings(run).dataset == there
    assert before[run / "splat.ply"] == contents(run)[run / "splat.ply"]
    evaluate_run(run)
    # If the old place exists, the new one is another dataset.
    shutil.copytree(there, made / "data")
    assert train(made / "data", run, "--resume") == 2
    assert "was trained on" in capsys.readouterr().err


@pytest.fixture
def started(monkeypatch):
    """Replace training; return the initial scenes of runs that were started."""
    scenes = []

    def start(settings, folder, **_):
        scenes.append(settings.start)
        folder.mkdir(exist_ok=True)
        settings = run_folder.with_views(settings, load_split(settings))
        run_folder.save_settings(folder, settings)
        return RunResult(run_folder.run_files(folder), False, 0, 0.0, 0, None)

    def resume(folder, **_):
        return start(load_settings(folder), folder)

    monkeypatch.setattr(run_module, "start_run", start)
    monkeypatch.setattr(run_module, "resume_run", resume)
    return scenes


@pytest.mark.parametrize("filters", ["--antialias", "--mip"])
def test_a_run_is_resumed_with_its_own_options_only(made, started, capsys, filters):
    """Options that are not given are those of the run."""
    data, run = made / "data", made / "again"
    options = f"--preset fast --steps 2 --max-gaussians 40 {filters} --test-images"
    options = [*options.split(), "0.png"]
    for more in (options, [*options, "--resume"], ["--resume"]):
        assert train(data, run, *more) == 130
    assert len(started) == 3
    for option in (["--seed", "1"], ["--initial", "random"]):
        capsys.readouterr()
        assert train(data, run, *option, "--resume") == 2
        assert f"leave out {option[0]}" in capsys.readouterr().err
    config = load_settings(run).config
    dilation = 0.1 if filters == "--mip" else 0.3
    assert (config.mip, config.raster.antialias) == (filters == "--mip", True)
    assert config.raster.dilation == dilation
    change(run / "config.json", every=8)
    assert train(data, run, *options, "--resume") == 130
    settings = json.loads((run / "config.json").read_text())["train"]
    change(run / "config.json", train={**settings, "initial": "dense"})
    for initial, code in (([], 130), (["dense"], 130), (["points"], 2)):
        words = ["--initial"] * len(initial) + initial
        assert train(data, run, *options, "--resume", *words) == code


def test_an_initial_scene_is_named_by_its_run_or_file(made, started, capsys):
    data, run = made / "data", made / "next"
    splat = (made / "run" / "splat.ply").resolve()
    (made / "other.ply").write_bytes(splat.read_bytes())

    def start(*words):
        return train(data, run, "--steps", 2, *words)

    for given in (made / "run", splat):
        assert start("--initial", given) == 130
        assert start("--initial", given, "--resume") == start("--resume") == 130
        assert started == [splat] * 3
        for other in ("dense", made / "other.ply"):
            assert start("--initial", other, "--resume") == 2
            assert "leave out --steps, --initial" in capsys.readouterr().err
        if given != splat:  # it may be gone when the run is resumed
            given.rename(made / "moved")
            assert start("--initial", given, "--resume") == 130
            (made / "moved").rename(given)
        started.clear()
        (run / "config.json").unlink()
    (made / "run" / "cameras.json").write_text("[]")
    assert start("--initial", made / "run") == 130
    assert "has refined cameras" in capsys.readouterr().err
    # A trained scene is used in full from the first step.
    config = load_settings(run).config
    assert (config.levels, config.sh_every) == ((Level(0.0, 1),), 1)


def test_renders_of_a_run_use_its_settings_with_occlusion_culling(whole):
    raster = open_scene_source(whole / "run").config
    assert CONFIG.raster != raster == CONFIG.raster.replace(occlusion=True)


def test_settings_of_older_versions_are_read():
    """Their rates lack the cooling."""
    rates = CONFIG.rates._replace(cooling=0.5, cooling_from=0.3)
    data = json.loads(json.dumps(asdict(CONFIG.replace(rates=rates))))
    assert config_from_json(data).rates == rates
    for wanted in (rates._replace(cooling_from=0.6), CONFIG.rates):
        del data["rates"][-1]
        assert config_from_json(data).rates == wanted
    del data["rates"][-1]
    with pytest.raises(InputError, match="not the settings"):
        config_from_json(data)


# Progress that a run reports.

LEVELS = TrainConfig(steps=100, levels=(Level(0.0, 4), Level(0.5, 2), Level(0.8, 1)))


def progress(step: int, compile_seconds: float = 0.0, **changes) -> Progress:
    values = {**dict.fromkeys(Metrics._fields, 0), **changes, "step": step}
    metrics = Metrics(*map(jnp.asarray, values.values()))
    return Progress(metrics, 200.0, compile_seconds, 1, LEVELS.divisor(step), 64)


def test_time_left_weighs_image_sizes_and_excludes_compilation(monkeypatch):
    monkeypatch.setattr(report, "_LINE_SECONDS", 0.0)
    clock = [time.time()]
    reporter = Reporter(LEVELS)
    monkeypatch.setattr(reporter.bar, "_time", lambda: clock[0])
    reporter.bar.start_t = reporter.bar.last_print_t = clock[0]
    clock[0] += 20.0
    reporter.step(progress(1, compile_seconds=20.0))
    for step in range(2, 51):
        clock[0] += 1.0  # a step at a quarter of the size
        reporter.step(progress(step, compile_seconds=20.0))
    left = (reporter.bar.total - reporter.bar.n) / reporter.bar.format_dict["rate"]
    assert left == pytest.approx(30 * 2 + 20 * 4, rel=0.02)
    reporter.close()


def test_the_mean_ignores_values_that_are_not_finite(capsys):
    """The PSNR of a fully masked photograph is infinite."""
    reporter, most = Reporter(LEVELS), LEVELS.max_gaussians
    reporter.step(progress(1, psnr=math.inf))
    assert math.isnan(reporter.psnr)
    for step, psnr in enumerate((20.0, math.inf, math.nan), 2):
        reporter.step(progress(step, psnr=psnr, wanted=most))
        assert reporter.psnr == 20.0
    reporter.step(progress(5, psnr=30.0))
    assert 20 < reporter.psnr < 30
    # Reaching the maximum is reported once.
    for wanted in (most, most + 1, most + 2):
        reporter.report_if_full(wanted)
    assert capsys.readouterr().err.count(f"asks for {most + 1:,} Gaussians") == 1
    reporter.close()
