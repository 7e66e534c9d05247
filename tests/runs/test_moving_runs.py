"""Runs of scenes that move: resumed, evaluated, rendered, exported and shown."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest

import gsjax
from gsjax.cli.main import main
from gsjax.densify.mcmc import McmcSettings
from gsjax.errors import InputError
from gsjax.io.ply import read_ply
from gsjax.raster.types import RasterConfig
from gsjax.runs.checkpoint import load_latest
from gsjax.runs.export import open_moving
from gsjax.runs.folder import RunSettings, load_settings
from gsjax.runs.moving import load_moving
from gsjax.runs.run import resume_run, start_run
from gsjax.synthetic.moving import MovingDemoSettings, write_moving_dataset
from gsjax.train.config import TrainConfig
from gsjax.train.motion.settings import FieldSettings, TrajectorySettings

pytestmark = pytest.mark.usefixtures("float32", "shared_programs")

MOTIONS = ("trajectories", "field")
CONFIG = TrainConfig(
    steps=8,
    sh_degree=0,
    strategy="mcmc",
    initial="points",
    every_checkpoint=5,
    mcmc=McmcSettings(start=0, stop=7, every=3, growth=1.2, max_gaussians=90),
    field=FieldSettings(
        channels=3, cells=6, times=4, width=8, freeze=1.0, decoder_rate=0.05
    ),
    trajectories=TrajectorySettings(freeze=0.8),
    raster=RasterConfig(num_size_buckets=1, devices=1, chunk_size=4, occlusion=False),
)
PHOTOS = MovingDemoSettings(
    cameras=2, times=3, photos=2, held_out=2, width=32, height=24, samples=1, points=60
)


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """Return a folder with a dataset, and a finished run of each motion."""
    folder = tmp_path_factory.mktemp("moving")
    write_moving_dataset(folder / "data", PHOTOS)
    for motion in MOTIONS:
        config = CONFIG.replace(motion=motion)
        assert start_run(RunSettings(folder / "data", config), folder / motion).finished
    return folder


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_resumed_run_ends_with_the_same_bits(runs, tmp_path, motion):
    """From the fifth step, in the middle of edits, motion and all its moments."""
    run = tmp_path / "run"
    shutil.copytree(runs / motion, run)
    (run / "checkpoints" / "step_000000008.npz").unlink()
    (run / "motion.npz").unlink()
    assert load_latest(run / "checkpoints").step == 5
    assert resume_run(run).finished
    for name in ("motion.npz", "splat.ply"):
        assert (run / name).read_bytes() == (runs / motion / name).read_bytes()


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_file_holds_the_scene_at_all_times(runs, motion):
    scene = open_moving(runs / motion)
    first = read_ply(runs / motion / "splat.ply")
    for a, b in zip(jax.tree.leaves(scene.at(0.0)), jax.tree.leaves(first)):
        np.testing.assert_array_equal(a, b)
    last = scene.at(1.0)
    assert np.abs(last.params.means - first.params.means).max() > 1e-5
    # Elsewhere, everything is shifted alike.
    config = load_settings(runs / motion).config
    moved = load_moving(runs / motion / "motion.npz", config, np.asarray([1.0, 2, 3]))
    shift = np.asarray(last.params.means) - np.asarray(moved.at(1.0).params.means)
    np.testing.assert_allclose(shift, np.tile([1.0, 2, 3], (len(shift), 1)), atol=1e-5)


def test_damaged_files_are_told(runs, tmp_path):
    config = load_settings(runs / "trajectories").config
    path = tmp_path / "motion.npz"
    data = (runs / "trajectories" / "motion.npz").read_bytes()
    for cut in (0, 100, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:cut])
        with pytest.raises(InputError, match=str(path)):
            load_moving(path, config, np.zeros(3))
    path.write_bytes(data)
    other = config.replace(trajectories=replace(config.trajectories, path_degree=1))
    with pytest.raises(InputError, match="expected the arrays of these settings"):
        load_moving(path, other, np.zeros(3))
    with pytest.raises(InputError, match="got a still scene"):
        open_moving(runs / "trajectories" / "splat.ply")


def command(*words) -> int:
    return main([str(word) for word in words])


def test_views_are_shown_and_measured_at_their_own_times(runs, tmp_path, capsys):
    run, out = runs / "trajectories", tmp_path / "views"
    assert command("eval", run, "--json") == 0
    each = json.loads(capsys.readouterr().out)["each"]
    assert command("render", run, "--path", "test", "-o", out) == 0
    names = sorted(path.name for path in out.glob("*.png"))
    assert names == ["000.png", "001.png"]
    for name in names:
        mine, its = (
            cv2.imread(str(p)) for p in (out / name, run / "renders/test" / name)
        )
        np.testing.assert_array_equal(mine, its)
    # The same views at other times are other pictures.
    assert (
        command("render", run, "--path", "test", "--time", 1, "-o", tmp_path / "1") == 0
    )
    assert (
        cv2.imread(str(tmp_path / "1/000.png")) != cv2.imread(str(out / "000.png"))
    ).any()
    assert len(each) == 2


def frames_of(folder: Path) -> np.ndarray:
    return np.stack([cv2.imread(str(p)) for p in sorted(folder.glob("*.png"))])


def test_camera_and_time_move_together_or_apart(runs, tmp_path):
    run = runs / "field"
    base = ("render", run, "--path", "orbit", "--frames", 3)
    for name, options in {
        "both": (),
        "camera": ("--freeze-time", "--time", "1:0"),
        "time": ("--freeze-camera",),
        "back": ("--freeze-camera", "--time", "1:0"),
    }.items():
        assert command(*base, *options, "-o", tmp_path / name) == 0
    both, camera, time, back = (
        frames_of(tmp_path / name) for name in ("both", "camera", "time", "back")
    )
    np.testing.assert_array_equal(time, back[::-1])
    np.testing.assert_array_equal(both[0], time[0])
    assert (time[0] != time[2]).any()
    np.testing.assert_array_equal(camera[2], both[2])  # the last is at time 1
    assert (camera[0] != both[0]).any()


def test_bad_options_are_told(runs, tmp_path, capsys):
    run, ply = runs / "field", runs / "field" / "splat.ply"
    for words, message in {
        (
            "render",
            ply,
            "--cameras",
            runs / "data",
            "--time",
            "0.5",
        ): "a scene that moves",
        ("render", run, "--freeze-time", "--freeze-camera"): "exclude each other",
        ("render", run, "--time", "1.5"): "expected a time from 0 to 1",
        ("render", run, "--budget", "1/255"): "a scene that moves",
        ("train", runs / "data", "--motion", "field", "--mip"): "exclude each other",
    }.items():
        assert command(*words, "-o", tmp_path / "out") != 0
        assert message in capsys.readouterr().err
    for words, message in {
        (
            "export",
            run,
            tmp_path / "a.spz",
            "--frames",
            "2",
        ): "frames are written as .ply",
        ("export", ply, tmp_path / "a.ply", "--time", "0.5"): "got a still scene",
        ("demo", "--monocular"): "goes with --moving",
    }.items():
        assert command(*words) != 0
        assert message in capsys.readouterr().err
    lists = json.loads((runs / "data" / "transforms_train.json").read_text())
    for frame in lists["frames"]:
        del frame["time"]
    still = tmp_path / "still"
    shutil.copytree(runs / "data", still)
    (still / "transforms_test.json").unlink()
    (still / "transforms_train.json").write_text(json.dumps(lists))
    assert command("train", still, "-o", tmp_path / "r", "--motion", "field") != 0
    assert "synchronised cameras need as many frames" in capsys.readouterr().err


def test_moments_keep_their_order(runs, tmp_path):
    run, out = runs / "trajectories", tmp_path / "sequence" / "s.ply"
    assert command("export", run, out, "--frames", 3) == 0
    manifest = json.loads(out.with_suffix(".json").read_text())
    assert [frame["time"] for frame in manifest["frames"]] == [0, 0.5, 1]
    scene = open_moving(run)
    for frame in manifest["frames"]:
        found = read_ply(out.parent / frame["file"])
        wanted = scene.at(frame["time"])
        assert manifest["gaussians"] == int(gsjax.num_active(found))
        np.testing.assert_array_equal(found.params.means, wanted.params.means)
    assert command("export", run, tmp_path / "m.ply", "--time", 0.5) == 0
    middle = read_ply(tmp_path / "m.ply")
    np.testing.assert_array_equal(middle.params.means, scene.at(0.5).params.means)
    assert command("export", run, out, "--frames", 3) != 0  # exists


def test_a_run_tells_that_it_moves(runs, capsys):
    assert command("info", runs / "field", "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert "field" in json.dumps(facts)
