"""The folder of a run: replaced only where it is one, and true to its dataset."""

import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import jax
import numpy as np
import pytest
from hostile import HOSTILE, harmless, write_hostile

import gsjax
import gsjax.runs.initialisation as beginning
import gsjax.runs.run as run_module
from gsjax.cli.main import main
from gsjax.data.dataset import load_dataset
from gsjax.densify.mcmc import McmcSettings
from gsjax.errors import InputError
from gsjax.raster.types import RasterConfig
from gsjax.runs.config_json import from_json, to_json
from gsjax.runs.folder import (
    RunSettings,
    load_data,
    load_settings,
    run_files,
    save_settings,
    with_views,
)
from gsjax.runs.held_out import evaluate_run
from gsjax.runs.history import read_metrics
from gsjax.runs.run import RunResult, resume_run, start_run
from gsjax.runs.scene_source import open_scene_source
from gsjax.runtime.files import alone_in
from gsjax.train.config import Level, TrainConfig, continuation_config, preset
from gsjax.train.initialisation import initial_state

pytestmark = pytest.mark.usefixtures("float32", "shared_programs")

CONFIG = TrainConfig(
    steps=3,
    sh_degree=0,
    strategy="mcmc",
    mcmc=McmcSettings(start=0, stop=0, max_gaussians=60),
    raster=RasterConfig(num_size_buckets=1, devices=1, chunk_size=4, occlusion=False),
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A folder with a dataset and a run that came to its end: never written to."""
    folder = tmp_path_factory.mktemp("whole")
    data = write_hostile(folder / "data", harmless())
    assert start_run(RunSettings(data, CONFIG), folder / "run").finished
    return folder


@pytest.fixture
def made(whole, tmp_path) -> Path:
    """A copy of it in another place, which its run knows."""
    folder = tmp_path / "made"
    shutil.copytree(whole, folder)
    change(folder / "run" / "config.json", dataset=str(folder / "data"))
    return folder


def change(path: Path, **changes) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def contents(folder: Path) -> dict[Path, bytes]:
    return {p: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


# --- replaced ---


@pytest.mark.parametrize("config", ['{"my": "app"}', None])
def test_only_a_run_is_replaced(whole, tmp_path, config):
    folder = tmp_path / "mine"
    (folder / "renders" / "precious").mkdir(parents=True)
    (folder / "renders" / "precious" / "a.blend").write_text("mine")
    if config is not None:
        (folder / "config.json").write_text(config)
    before = contents(folder)
    with pytest.raises(InputError, match=r"config\.json|no run is here"):
        start_run(RunSettings(whole / "data", CONFIG), folder, overwrite=True)
    assert contents(folder) == before


def test_a_run_is_replaced_once_the_next_can_begin(made, tmp_path):
    bad = write_hostile(tmp_path / "bad", HOSTILE["no points"]())
    before = contents(made / "run")
    points = CONFIG.replace(initial="points")
    with pytest.raises(InputError, match="no points to start from"):
        start_run(RunSettings(bad, points), made / "run", overwrite=True)
    assert contents(made / "run") == before
    # Of two views, three steps see others than those of seed 0.
    other = RunSettings(made / "data", CONFIG.replace(seed=3))
    assert start_run(other, made / "run", overwrite=True).finished
    assert load_settings(made / "run").config.seed == 3
    splat = made / "run" / "splat.ply"
    assert contents(made / "run")[splat] != before[splat]


def test_a_start_that_fails_leaves_nothing(tmp_path, monkeypatch):
    """And does so before photographs are read, which may take minutes."""
    bad = write_hostile(tmp_path / "bad", HOSTILE["no points"]())
    run, loaded = tmp_path / "run", []
    monkeypatch.setattr(run_module, "load_photos", lambda *_: loaded.append(1))
    with pytest.raises(InputError, match="--initial random"):
        start_run(RunSettings(bad, CONFIG.replace(initial="points")), run)
    assert not run.exists()
    assert not loaded


def test_links_are_replaced_and_what_they_lead_to_stays(made, tmp_path):
    """Also of what is gone by now."""
    run, there = made / "run", tmp_path / "there"
    for name in ("checkpoints", "renders"):
        (run / name).rename(there.with_name(name))
        (run / name).symlink_to(there.with_name(name))
    shutil.rmtree(tmp_path / "renders")
    before = contents(tmp_path / "checkpoints")
    other = RunSettings(made / "data", CONFIG.replace(seed=1))
    assert start_run(other, run, overwrite=True).finished
    for name in ("checkpoints", "renders"):
        assert not (run / name).is_symlink()
        assert any((run / name).iterdir())
    assert contents(tmp_path / "checkpoints") == before


def test_a_run_that_cannot_be_removed_still_is_one(made, monkeypatch):
    def refused(_):
        raise PermissionError(13, "Permission denied")

    settings = load_settings(made / "run")
    again = RunSettings(made / "data", CONFIG)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", refused)
        with pytest.raises(InputError, match="checkpoints: cannot be removed: Permis"):
            start_run(again, made / "run", overwrite=True)
    assert load_settings(made / "run") == settings
    assert start_run(again, made / "run", overwrite=True).finished


def test_one_training_at_a_time_in_a_folder(made):
    before, settings = contents(made / "run"), RunSettings(made / "data", CONFIG)
    with alone_in(made / "run"):
        for begin in (
            lambda: start_run(settings, made / "run", overwrite=True),
            lambda: resume_run(made / "run"),
        ):
            with pytest.raises(InputError, match="another training is at work in it"):
                begin()
            assert contents(made / "run") == before
    assert resume_run(made / "run").finished


def test_what_is_held_is_free_once_its_process_is_killed(tmp_path):
    program = (
        "import sys, time, pathlib\nfrom gsjax.runtime.files import alone_in\n"
        "with alone_in(pathlib.Path(sys.argv[1])):\n"
        "    print('held', flush=True)\n    time.sleep(600)\n"
    )
    arguments = [sys.executable, "-c", program, str(tmp_path)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE) as other:
        try:
            assert other.stdout is not None
            assert other.stdout.readline() == b"held\n"
            with pytest.raises(InputError, match="another"), alone_in(tmp_path):
                pass
        finally:
            other.kill()
    with alone_in(tmp_path):
        assert not list(tmp_path.iterdir())


# --- killed, and gone on with ---


@pytest.fixture(scope="module")
def killed(whole, tmp_path_factory) -> Path:
    """What a kill leaves in the third step: after it are a checkpoint and measurements,
    which were due in the second. Never written to."""
    folder = tmp_path_factory.mktemp("killed")
    data, run = folder / "data", folder / "run"
    shutil.copytree(whole / "data", data)

    def watch(*_):
        def look(_, progress):
            if progress.metrics.step == 3:
                shutil.copytree(run, folder / "killed")
                raise RuntimeError("after a copy")

        return look

    config = CONFIG.replace(steps=4, every_eval=1, every_checkpoint=2)
    with pytest.raises(RuntimeError, match="after a copy"):
        start_run(RunSettings(data, config), run, watch=watch)
    return folder


def steps_of(path: Path) -> list[int]:
    return [json.loads(line)["step"] for line in path.read_text().splitlines()]


@pytest.mark.parametrize("name", ["killed", "run"])
def test_each_step_due_is_measured_once(killed, tmp_path, name):
    """After a kill and after an error, and where a run is finished twice."""
    run = shutil.copytree(killed / name, tmp_path / "run")
    assert steps_of(run / "held_out.jsonl") == [1, 2]
    for _ in range(2):
        assert resume_run(run).finished
        for log in ("held_out.jsonl", "metrics.jsonl"):
            assert steps_of(run / log) == [1, 2, 3, 4]


@pytest.mark.parametrize("now", [1, 2])
def test_another_number_of_devices_is_told(killed, tmp_path, now, monkeypatch, capsys):
    run = shutil.copytree(killed / "killed", tmp_path / "run")
    monkeypatch.setattr(run_module, "device_count", lambda _: now)
    assert resume_run(run).finished
    told = [line for line in capsys.readouterr().err.splitlines() if "before" in line]
    wanted = "gsjax: with 2 devices (cores), and 1 before: the same training to "
    assert [line.startswith(wanted) for line in told] == [True] * (now - 1)


@pytest.mark.parametrize("again", ["resumed", "replaced"])
def test_what_a_kill_left_half_written_goes(made, again):
    """But not what another process may be writing now."""
    run = made / "run"
    folders = (run, run / "checkpoints") if again == "resumed" else (run,)
    for folder in folders:
        for name, seconds in ((".gsjax-0f.tmp", 1), (".gsjax-1f.tmp", 2**32), ("a", 1)):
            (folder / name).write_bytes(b"half")
            os.utime(folder / name, (seconds, seconds))
    if again == "resumed":
        assert resume_run(run).finished
    else:
        start_run(RunSettings(made / "data", CONFIG), run, overwrite=True)
    for folder in folders:
        assert not (folder / ".gsjax-0f.tmp").exists()
        assert (folder / ".gsjax-1f.tmp").exists()
        assert (folder / "a").exists()


# --- what it starts from ---


def test_without_points_it_starts_from_random_ones(tmp_path, capsys):
    """It says so, and stays with it, also where points come before it goes on."""
    bare, run = HOSTILE["no points"](), tmp_path / "run"
    data = write_hostile(tmp_path / "data", bare)
    config = CONFIG.replace(initial_count=50, every_checkpoint=0)
    assert start_run(RunSettings(data, config), run).finished
    told = capsys.readouterr().err
    assert "no points: starting from random ones (--initial random)" in told
    assert "for 50 Gaussians, " in told
    assert load_settings(run).config == config.replace(initial="random")
    splat = (run / "splat.ply").read_bytes()
    explicit = RunSettings(data, config.replace(initial="random"))
    start_run(explicit, tmp_path / "explicit")
    assert (tmp_path / "explicit" / "splat.ply").read_bytes() == splat
    shutil.rmtree(run / "checkpoints")
    shutil.rmtree(data)
    write_hostile(data, replace(bare, scene=harmless().scene))
    capsys.readouterr()
    assert resume_run(run).finished
    assert (run / "splat.ply").read_bytes() == splat
    assert "--initial" not in capsys.readouterr().err


def test_with_points_it_starts_from_them(whole):
    assert load_settings(whole / "run").config == CONFIG.replace(initial="points")


@pytest.mark.parametrize("degree", [0, 2])
def test_gaussians_to_start_from_are_as_they_were(whole, degree):
    """Bit for bit, whatever is inactive among them, but for bands cut or added."""
    scene = load_dataset(whole / "data")
    given = gsjax.load(whole / "run" / "splat.ply")
    given = gsjax.with_sh_degree(given, 1)
    keep = np.arange(given.capacity) % 3 != 0
    wanted = gsjax.compact(gsjax.select(given, keep), int(keep.sum()))
    wanted = gsjax.with_sh_degree(wanted, degree)
    config = CONFIG.replace(sh_degree=degree)
    state = initial_state(scene, config, gsjax.select(given, keep))
    assert int(state.step) == 0
    active = np.asarray(state.gaussians.active)
    assert active.sum() == keep.sum() > 0
    for ours, theirs in zip(
        jax.tree.leaves(state.gaussians.params), jax.tree.leaves(wanted.params)
    ):
        np.testing.assert_array_equal(ours[active], theirs)
    few = replace(config.mcmc, max_gaussians=given.capacity - 1)
    for count in (0, given.capacity):
        some = gsjax.select(given, np.arange(given.capacity) < count)
        told = f"^{count} Gaussians .* 1 to {given.capacity - 1} are wanted"
        with pytest.raises(InputError, match=told):
            initial_state(scene, config.replace(mcmc=few), some)


def test_a_scene_that_was_trained_is_used_as_a_whole():
    """All bands and the finest photographs, from the first steps on."""
    config = preset("default")
    assert config.divisor(0) > 1
    changed = continuation_config(config)
    assert changed.divisor(0) == 1
    assert changed == config.replace(sh_every=1, levels=(Level(0.0, 1),))


def test_a_run_starts_from_a_scene(made, capsys):
    """And starts from it again where a kill came before anything was saved."""
    splat, run = made / "run" / "splat.ply", made / "next"
    settings = RunSettings(made / "data", continuation_config(CONFIG), start=splat)
    assert start_run(settings, run).finished
    told = capsys.readouterr().err
    assert f"starting from the scene of {splat}\n" in told
    assert load_settings(run).start == splat
    first, *_ = read_metrics(run / "metrics.jsonl")
    *_, last = read_metrics(made / "run" / "metrics.jsonl")
    begun, *_ = read_metrics(made / "run" / "metrics.jsonl")
    assert first["loss"] < begun["loss"]
    assert first["gaussians"] == last["gaussians"]
    assert "views held out were trained on" not in told
    before = (run / "splat.ply").read_bytes()
    shutil.rmtree(run / "checkpoints")
    (run / "splat.ply").unlink()
    assert resume_run(run).finished
    assert (run / "splat.ply").read_bytes() == before
    shutil.rmtree(run / "checkpoints")
    splat.unlink()
    with pytest.raises(InputError, match=r"splat\.ply"):
        resume_run(run)


def test_a_scene_of_elsewhere_is_refused(made, tmp_path, monkeypatch, capsys):
    """And one of too many, before photographs are read."""
    monkeypatch.setattr(run_module, "load_photos", None)
    given = gsjax.load(made / "run" / "splat.ply")
    settings = load_settings(made / "run")
    beginning._tell_seen(made / "run" / "splat.ply", (*settings.trained, "new"))
    told = f"{len(settings.trained)} of the {len(settings.trained) + 1} views held out"
    assert told in capsys.readouterr().err
    beginning._tell_seen(made / "run" / "splat.ply", settings.held_out)
    assert capsys.readouterr().err == ""
    count, means = given.capacity, given.params.means + 1e3  # far out
    gsjax.save(
        tmp_path / "far.ply", given.replace(params=given.params.replace(means=means))
    )
    args = ["train", str(made / "data"), "-o", str(tmp_path / "new"), "--initial"]
    few = ["--max-gaussians", str(count - 1)]
    assert main.main([*args, str(tmp_path / "far.ply")]) == 3
    assert f"none of its {count} Gaussians is in the view" in capsys.readouterr().err
    assert main.main([*args, str(made / "run"), *few]) == 3
    told = f"{count} Gaussians to start from; 1 to {count - 1} are wanted (max_g"
    assert told in capsys.readouterr().err
    gsjax.save(tmp_path / "bands.ply", gsjax.with_sh_degree(given, 2))
    few += ["--sh-degree", "1"]
    assert main.main([*args, str(tmp_path / "bands.ply"), *few]) == 3
    assert "SH degree 2 the run has 1 (--sh-degree)" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_looking_for_points_counts_as_training(whole, tmp_path, monkeypatch, capsys):
    """Where a kill came before anything was saved, it is done again, to the same."""

    def found(scene, photos, config):
        assert len(photos) == len(scene.views)
        assert config.initial == "dense"
        time.sleep(0.5)
        points = np.concatenate([scene.points, scene.points[:7] + 0.01])
        colors = np.concatenate([scene.colors, scene.colors[:7]])
        return replace(scene, points=points, colors=colors)

    monkeypatch.setattr(beginning, "add_dense_points", found)
    settings = RunSettings(whole / "data", CONFIG.replace(initial="dense"))
    start_run(settings, tmp_path / "run")
    assert "7 more points, after " in capsys.readouterr().err
    files = run_files(tmp_path / "run")
    first, *_ = read_metrics(files.metrics)
    assert first["seconds"] > first["compile_seconds"] + 0.5
    scene = files.splat.read_bytes()
    shutil.rmtree(files.checkpoints)
    files.splat.unlink()
    assert load_settings(tmp_path / "run").config.initial == "dense"
    resume_run(tmp_path / "run")
    assert "7 more points, after " in capsys.readouterr().err
    assert files.splat.read_bytes() == scene


# --- true to its dataset ---


def test_a_dataset_with_other_views_is_refused(made):
    settings = load_settings(made / "run")
    assert (settings.held_out, settings.trained) == (("0.png",), ("1.png", "2.png"))
    evaluate_run(made / "run")
    # As if the run had been made before the last one came, and others have gone.
    held_out, trained = ["1.png", "3.png"], ["0.png", "4.png"]
    change(made / "run" / "config.json", held_out=held_out, trained=trained)
    before = contents(made / "run")
    for go_on in (evaluate_run, resume_run):
        with pytest.raises(InputError, match="no longer the views") as caught:
            go_on(made / "run")
        for told in ("+2.png -4.png (trained on)", "-3.png (held out)"):
            assert told in str(caught.value)
    assert contents(made / "run") == before


def test_a_run_keeps_the_views_that_it_held_out(made):
    """Whatever rule would choose now: that of an older version was another."""
    config = made / "run" / "config.json"
    for every in (8, 2, 0, None):
        held_out, trained = ["2.png"], ["0.png", "1.png"]
        change(config, held_out=held_out, trained=trained, every=every)
        data = load_data(load_settings(made / "run"))
        assert (data.train, data.test) == ([0, 1], [2])
        change(config, held_out=[], trained=["0.png", "1.png", "2.png"])
        assert load_data(load_settings(made / "run")).test == []


def test_an_old_run_without_names(made):
    """Its 8 was no wish: the dataset's own split went before it."""
    config = made / "run" / "config.json"
    for every, wanted in ((8, None), (5, 5), (0, 0)):
        change(config, every=every)
        told = json.loads(config.read_text())
        told = {k: v for k, v in told.items() if k not in ("trained", "held_out")}
        config.write_text(json.dumps(told))
        assert load_settings(made / "run").every == wanted


def test_a_dataset_that_was_moved(made, capsys):
    run, there = made / "run", made / "elsewhere"
    (made / "data").rename(there)
    with pytest.raises(InputError, match="train NEW_PLACE -o RUN --resume"):
        evaluate_run(run)
    before = contents(run)
    assert main.main(["train", str(there), "-o", str(run), "--resume"]) == 0
    told = capsys.readouterr().err
    assert f"dataset is now {there}" in told
    assert "nothing is left to train; its results are made anew" in told
    assert "going on" not in told
    assert load_settings(run).dataset == there
    assert before[run / "splat.ply"] == contents(run)[run / "splat.ply"]
    evaluate_run(run)
    # Where the old one is still there, a new one is another.
    shutil.copytree(there, made / "data")
    code = main.main(["train", str(made / "data"), "-o", str(run), "--resume"])
    assert code == 2
    assert "was trained on" in capsys.readouterr().err


# --- the command line ---


def test_going_on_with_other_settings_is_refused(made, capsys):
    data, run = str(made / "data"), str(made / "run")
    before = contents(made / "run")
    for options in (["--steps", "400"], ["--seed", "3"], ["--initial", "random"]):
        assert main.main(["train", data, "-o", run, "--resume", *options]) == 2
        assert f"leave out {options[0]}" in capsys.readouterr().err
    assert contents(made / "run") == before


@pytest.mark.parametrize(
    "option",
    [
        ("--seed", "-1"), ("--seed", str(10**20)), ("--steps", "0"),
        ("--steps", str(2**31)), ("--max-size", "0"), ("--max-gaussians", "0"),
        ("--factor", "0"), ("--test-every", "-1"), ("--checkpoint-every", "-1"),
        ("--eval-every", "-1"),
    ],
    ids=" ".join,
)  # fmt: skip
def test_an_option_out_of_its_range(option, whole, tmp_path, capsys):
    run = tmp_path / "run"
    args = ["train", str(whole / "data"), "-o", str(run), *option]
    assert main.main(args) == 2
    assert f"{option[0]} {option[1]}: " in capsys.readouterr().err
    assert not run.exists()


def test_the_same_options_again_go_on(made, monkeypatch):
    """They are the run's own: what the shell's history holds, and --resume."""
    data, run = made / "data", made / "again"
    options = ["--preset", "fast", "--steps", "2", "--max-gaussians", "40"]
    options += ["--antialias", "--test-images", "0.png"]
    trained = []

    def train(settings, folder, **_):
        trained.append("started")
        save_settings(folder, with_views(settings, load_data(settings)))
        return RunResult(run_files(folder), False, 0, 0.0, 0, None)

    def go_on(folder, **_):
        trained.append("gone on with")
        return RunResult(run_files(folder), False, 0, 0.0, 0, None)

    monkeypatch.setattr(run_module, "start_run", train)
    monkeypatch.setattr(run_module, "resume_run", go_on)
    run.mkdir()
    args = ["train", str(data), "-o", str(run), *options]
    assert main.main(args) == 130
    assert main.main([*args, "--resume"]) == 130
    assert main.main(["train", str(data), "-o", str(run), "--resume"]) == 130
    assert trained == ["started", "gone on with", "gone on with"]
    assert main.main([*args, "--seed", "1", "--resume"]) == 2
    # What is not given is the run's, as in one of before it could be left open.
    change(run / "config.json", every=8)
    assert main.main([*args, "--resume"]) == 130
    for initial, other in pairwise(("random", "points", "dense", "random")):
        train = json.loads((run / "config.json").read_text())["train"]
        change(run / "config.json", train={**train, "initial": initial})
        assert main.main([*args, "--resume"]) == 130
        assert main.main([*args, "--resume", "--initial", initial]) == 130
        assert main.main([*args, "--resume", "--initial", other]) == 2


def test_a_scene_to_start_from_is_named(made, monkeypatch, capsys):
    """By its run or its file, once: a run that began so goes on without."""
    begun, run = [], made / "next"

    def train(settings, folder, **_):
        begun.append(settings.start)
        save_settings(folder, with_views(settings, load_data(settings)))
        return RunResult(run_files(folder), False, 0, 0.0, 0, None)

    monkeypatch.setattr(run_module, "start_run", train)
    monkeypatch.setattr(
        run_module, "resume_run", lambda folder, **_: train(load_settings(folder), run)
    )
    run.mkdir()
    splat = (made / "run" / "splat.ply").resolve()
    args = ["train", str(made / "data"), "-o", str(run), "--steps", "2"]
    for given in (made / "run", splat):
        assert main.main([*args, "--initial", str(given)]) == 130
        assert main.main([*args, "--initial", str(given), "--resume"]) == 130
        assert main.main([*args, "--resume"]) == 130
        assert begun == [splat] * 3
        begun.clear()
        (made / "other.ply").write_bytes(splat.read_bytes())
        for other in ("dense", str(made / "other.ply")):
            assert main.main([*args, "--initial", other, "--resume"]) == 2
            assert "leave out --steps, --initial" in capsys.readouterr().err
        if given != splat:  # gone since: it is not needed any more
            given.rename(made / "moved")
            assert main.main([*args, "--initial", str(given), "--resume"]) == 130
            (made / "moved").rename(given)
            begun.clear()
        (run / "config.json").unlink()
    refined = made / "run" / "cameras.json"
    refined.write_text("[]")
    assert main.main([*args, "--initial", str(made / "run")]) == 130
    assert "has refined cameras" in capsys.readouterr().err
    assert begun == [splat]


def test_what_is_no_scene_to_start_from_is_told(made, capsys):
    data, run = str(made / "data"), str(made / "run")
    before = contents(made / "run")

    def told_of(*options: str, code: int) -> str:
        assert main.main(["train", data, *options]) == code
        return capsys.readouterr().err

    new = ["-o", str(made / "new")]
    told = told_of(*new, "--initial", "densely", code=2)
    assert "--initial densely: points, dense, random, the folder of a run, or" in told
    assert "none.ply" in told_of(*new, "--initial", str(made / "none.ply"), code=3)
    told = told_of(*new, "--initial", data, code=3)
    assert "a dataset; train on it first" in told
    told = told_of("-o", run, "--overwrite", "--initial", run, code=2)
    assert "another folder with -o" in told
    told = told_of(*new, "--initial", run, "--antialias", code=2)
    assert "trained without --antialias, as a run from it must be" in told
    assert contents(made / "run") == before
    assert not (made / "new").exists()


def test_a_distance_and_names_exclude_each_other(whole, tmp_path, capsys):
    args = ["train", str(whole / "data"), "-o", str(tmp_path / "run")]
    args += ["--test-images", "0.png", "--test-every"]
    for every in ("8", "0"):
        assert main.main([*args, every]) == 2
        told = "--test-every and --test-images exclude each other"
        assert told in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_run_that_stopped_early_is_told_as_one(made, capsys):
    assert main.main(["eval", str(made / "run"), "--views", "train"]) == 0
    assert "not at its end" not in capsys.readouterr().err
    config = json.loads((made / "run" / "config.json").read_text())
    change(made / "run" / "config.json", train={**config["train"], "steps": 8})
    assert main.main(["eval", str(made / "run"), "--views", "train"]) == 0
    assert "not at its end: step 3 of 8 is" in capsys.readouterr().err


def test_pictures_of_a_run_are_of_its_settings_and_search_for_what_is_hidden(whole):
    """Training leaves the search out: a view from anywhere may be filled."""
    subject = open_scene_source(whole / "run")
    assert CONFIG.raster != subject.config
    assert CONFIG.raster.replace(occlusion=True) == subject.config


def test_settings_of_before_there_was_a_cooling():
    """A number or two fewer in the rates: they fall where they did, or not at all."""
    rates = CONFIG.rates._replace(cooling=0.5, cooling_from=0.3)
    data = json.loads(to_json(CONFIG.replace(rates=rates)))
    assert from_json(json.dumps(data)).rates == rates
    for wanted in (rates._replace(cooling_from=0.6), CONFIG.rates):
        del data["rates"][-1]
        assert from_json(json.dumps(data)).rates == wanted
    del data["rates"][-1]
    with pytest.raises(InputError, match="not the settings"):
        from_json(json.dumps(data))
