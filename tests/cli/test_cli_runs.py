"""The command line on a run: the demonstration makes it, the others show it."""

import contextlib
import io
import json
import shlex
import shutil
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from captures import to_opengl

import gsjax
from gsjax.cli import common
from gsjax.cli import main as cli_main
from gsjax.gaussians import activate

WIDTH, HEIGHT, PHOTOS, STEPS = 64, 48, 9, 20
HELD_OUT = ["photo_000", "photo_008"]
DEMO = ["--photos", str(PHOTOS), "--size", f"{WIDTH}x{HEIGHT}", "--steps", str(STEPS)]


class Demo(NamedTuple):
    """A small demonstration: its folder, and what it said."""

    folder: Path
    out: str
    err: str


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Demo:
    folder = tmp_path_factory.mktemp("demo") / "out"
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        assert cli_main.main(["demo", "-o", str(folder), *DEMO]) == 0
    return Demo(folder, out.getvalue(), err.getvalue())


@pytest.fixture
def demo(made) -> Path:
    return made.folder


def read_image(path: Path) -> np.ndarray:
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    return image[..., ::-1] if image.ndim == 3 else image


def read_movie(path: Path) -> np.ndarray:
    """[F, H, W, 3] RGB."""
    done, movie = cv2.imreadanimation(str(path))
    assert done
    return np.stack([frame[..., 2::-1] for frame in movie.frames])


def error_of(capsys) -> str:
    """The one line on stderr."""
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("gsjax: error: ")
    return lines[0]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# --- demo ---


@pytest.mark.long
def test_demo(made, capsys):
    """Everything that it tells is there, and it learns."""
    out = made.folder
    *paths, result = made.out.splitlines()
    assert all(Path(path).exists() for path in paths)
    run = out / "run"
    wanted = [run / "splat.ply", run / "preview.png", run / "curves.png"]
    assert [Path(p) for p in paths] == [*wanted, out / "turntable.webp"]
    assert "2 held-out views: PSNR " in result
    quality = json.loads((run / "eval.json").read_text())
    lines = (run / "metrics.jsonl").read_text().splitlines()
    losses = [json.loads(line)["loss"] for line in lines]
    assert len(losses) == STEPS
    assert np.mean(losses[-5:]) < 0.85 * np.mean(losses[:5])
    assert quality["psnr"] > 17
    assert len(names(out / "dataset" / "images")) == PHOTOS
    turntable = read_movie(out / "turntable.webp")
    assert turntable.shape == (48, HEIGHT, WIDTH, 3)
    assert turntable.std() > 20, "the pictures are not empty"
    assert np.abs(turntable[0].astype(int) - turntable[24]).mean() > 2, "it turns"
    # The commands that it says to try next are commands.
    tries = [line.split()[2:] for line in made.err.splitlines() if "  gsjax " in line]
    wanted = ["view", "info", "render", "export", "sfm", "train"]
    assert [line[0] for line in tries] == wanted
    for line in tries[1:4]:  # to view is to serve until Ctrl-C
        assert cli_main.main(line) == 0
    capsys.readouterr()
    assert cli_main.main(["demo", "-o", str(out), *DEMO]) == 3
    told = "exists; pass --overwrite, or another folder with -o"
    assert told in error_of(capsys)


def test_a_hint_says_what_it_needs(monkeypatch):
    monkeypatch.setattr(common, "find_spec", lambda _: None)
    needs = "gsjax view a/run  # needs pip install 'gsjax[viewer]'"
    assert common.view_hint(Path("a/run")) == needs
    monkeypatch.setattr(common, "find_spec", lambda _: object())
    assert common.view_hint(Path("a/run")) == "gsjax view a/run"


def test_a_hint_is_a_line_for_a_shell():
    words = ["render", Path("my runs/it's"), "-o", Path("a;b/flight.webm")]
    line = common.command_line(*words)
    assert shlex.split(line) == ["gsjax", *map(str, words)]
    assert common.command_line("info", Path("a/run")) == "gsjax info a/run"


# --- render ---


@pytest.mark.long
def test_held_out_views_are_those_of_the_evaluation(demo, tmp_path, capsys):
    args = ["render", str(demo / "run"), "--path", "test", "-o", str(tmp_path)]
    assert cli_main.main(args) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines == [str(tmp_path / f"{name}.png") for name in HELD_OUT]
    for name in HELD_OUT:
        wanted = read_image(demo / "run" / "renders" / "images" / f"{name}.png")
        found = read_image(tmp_path / f"{name}.png")
        assert found.shape == (HEIGHT, WIDTH, 3)
        assert found.std() > 20
        assert np.abs(found.astype(int) - wanted).max() <= 1
    assert cli_main.main(args) == 3
    assert "exists; pass --overwrite" in error_of(capsys)


@pytest.mark.long
def test_a_path_to_movies(demo, tmp_path, capsys):
    """By default an orbit; depth in colours, over one range for all frames."""
    args = ["render", str(demo / "run"), "--frames", "3", "--fps", "2"]
    for kind in ("rgb", "depth"):
        path = tmp_path / "new" / f"{kind}.webp"
        assert cli_main.main([*args, "-o", str(path), "--what", kind]) == 0
        said = capsys.readouterr()
        assert said.out.splitlines() == [str(path)]
        assert "3 frames, a movie of 1.5 s" in said.err
        assert read_movie(path).shape == (3, HEIGHT, WIDTH, 3)
    depth = read_movie(tmp_path / "new" / "depth.webp").astype(int)
    seen = (depth.max(-1) - depth.min(-1)) > 100
    assert 0.05 < seen.mean() < 0.95
    assert cli_main.main([*args, "-o", str(path)]) == 3
    assert "exists" in error_of(capsys)


@pytest.mark.long
def test_a_file_before_the_cameras_of_a_dataset(demo, tmp_path, capsys):
    """The same pictures as of the run; without a path, all views."""
    ply, dataset = demo / "run" / "splat.ply", demo / "dataset"
    of_file = ["render", str(ply), "--cameras", str(dataset), "--preset", "compat"]
    of_run = ["render", str(demo / "run"), "--preset", "compat"]
    flight = ["--path", "spiral", "--frames", "2", "-o"]
    assert cli_main.main([*of_file, *flight, str(tmp_path / "a")]) == 0
    assert cli_main.main([*of_run, *flight, str(tmp_path / "b")]) == 0
    assert names(tmp_path / "a") == names(tmp_path / "b")
    for name in names(tmp_path / "a"):
        pictures = [read_image(tmp_path / x / name) for x in "ab"]
        np.testing.assert_array_equal(*pictures)
        assert pictures[0].std() > 20
    assert cli_main.main([*of_file, "-o", str(tmp_path / "c")]) == 0
    assert len(names(tmp_path / "c")) == PHOTOS
    capsys.readouterr()
    assert cli_main.main([*of_file, "--path", "test", "-o", str(tmp_path / "d")]) == 2
    assert "names none; train has all of its views" in error_of(capsys)


def test_a_file_before_the_cameras_of_a_dataset_without_photographs(
    demo, tmp_path, capsys
):
    dataset = tmp_path / "dataset"
    shutil.copytree(demo / "dataset", dataset)
    shutil.rmtree(dataset / "images")
    args = ["render", str(demo / "run" / "splat.ply"), "--preset", "compat", "-o"]
    assert cli_main.main([*args, str(tmp_path / "a"), "--cameras", str(dataset)]) == 0
    whole = ["--cameras", str(demo / "dataset")]
    assert cli_main.main([*args, str(tmp_path / "b"), *whole]) == 0
    assert len(names(tmp_path / "a")) == PHOTOS
    for name in names(tmp_path / "b"):
        first, second = (tmp_path / x / name for x in "ab")
        assert first.read_bytes() == second.read_bytes()
    capsys.readouterr()


@pytest.mark.long
def test_the_test_views_of_a_dataset(demo, tmp_path, capsys):
    """Those that it names so, which need not have photographs."""
    dataset = tmp_path / "dataset"
    dataset.mkdir()
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": 60.0, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    for split, seen in (("train", "abc"), ("test", "de")):
        frames = [
            {
                "file_path": f"{name}.png",
                "transform_matrix": to_opengl(
                    gsjax.look_at((3, ord(name) - 99, 1), (0, 0, 0))
                ).tolist(),
            }
            for name in seen
        ]
        content = json.dumps({**lens, "frames": frames})
        (dataset / f"transforms_{split}.json").write_text(content)
    args = ["render", str(demo / "run" / "splat.ply"), "--preset", "compat"]
    args += ["--cameras", str(dataset), "-o", str(tmp_path / "views"), "--path"]
    assert cli_main.main([*args, "test"]) == 0
    assert names(tmp_path / "views") == ["d.png", "e.png"]
    assert cli_main.main([*args, "train", "--overwrite"]) == 0
    assert names(tmp_path / "views") == [f"{name}.png" for name in "abcde"]
    capsys.readouterr()


@pytest.mark.long
def test_a_path_to_a_folder(demo, tmp_path, capsys):
    more = ["--path", "interpolate", "--frames", "2", "--size", "32x24", "--npy"]
    more += ["--what", "rgb,alpha", "--background", "1,1,1"]
    assert cli_main.main(["render", str(demo / "run"), "-o", str(tmp_path), *more]) == 0
    capsys.readouterr()
    stems = [f"frame_000{n}{kind}" for n in (1, 2) for kind in ("", ".alpha")]
    wanted = [f"{stem}{suffix}" for stem in stems for suffix in (".npy", ".png")]
    assert names(tmp_path) == sorted(wanted)
    rgb = np.load(tmp_path / "frame_0001.npy")
    alpha = np.load(tmp_path / "frame_0001.alpha.npy")
    assert rgb.shape == (24, 32, 3)
    assert 0.05 < (alpha > 0.5).mean() < 0.95
    assert (rgb[alpha == 0] == 1).all()


@pytest.mark.long
def test_a_run_with_cameras_is_its_file_with_cameras(demo, tmp_path, capsys):
    cameras = str(demo / "dataset" / "transforms.json")
    for name, more in (("run", []), ("run/splat.ply", ["--preset", "compat"])):
        out = tmp_path / Path(name).name
        args = ["render", str(demo / name), "--cameras", cameras, "-o", str(out)]
        assert cli_main.main([*args, *more]) == 0
    capsys.readouterr()
    first, second = tmp_path / "run", tmp_path / "splat.ply"
    assert names(first) == [f"photo_00{n}.png" for n in range(PHOTOS)]
    for name in names(first):
        assert (first / name).read_bytes() == (second / name).read_bytes()


# --- eval ---


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.long
def test_training_views_are_measured_beside_the_others(demo, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(demo / "run", run)
    before = contents(run)
    assert cli_main.main(["eval", str(run), "--views", "train"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(run / "preview_train.png")
    after = contents(run)
    assert {path: after[path] for path in before} == before
    told = json.loads((run / "eval_train.json").read_text())
    assert (told["which"], told["views"]) == ("train", PHOTOS - len(HELD_OUT))
    wanted = [f"{Path(view['name']).stem}.png" for view in told["each"]]
    assert names(run / "renders_train" / "images") == wanted


def test_every_render_has_a_name_of_its_own():
    from gsjax.data.image_files import short_names

    assert short_names(["a/1.jpg", "b/1.jpg"]) == ["a/1", "b/1"]
    for photos in (["1.jpg", "1.png"], ["1.jpg", "1.PNG", "1.jpg.png"], ["A.x", "a.y"]):
        assert len({name.casefold() for name in short_names(photos)}) == len(photos)


# --- export, info ---


def test_export(demo, tmp_path, capsys):
    run, out = demo / "run", tmp_path / "new" / "a.ply"
    whole = gsjax.load(run / "splat.ply")
    opacities = np.asarray(activate(whole.params)["opacities"])
    least = float(np.median(opacities))
    args = ["export", str(run), str(out), "--sh-degree", "0"]
    assert cli_main.main([*args, "--min-opacity", repr(least)]) == 0
    kept = opacities >= least
    told = f"{out}  {kept.sum():,} of {len(kept):,} Gaussians"
    assert capsys.readouterr().out.startswith(told)
    found = gsjax.load(out)
    assert found.sh_degree == 0
    np.testing.assert_array_equal(found.params.means, whole.params.means[kept])
    np.testing.assert_array_equal(found.params.sh, whole.params.sh[kept, :1])
    assert cli_main.main(args) == 3
    assert f"{out}: exists; pass --overwrite" in error_of(capsys)
    assert cli_main.main([*args, "--overwrite", "--sh-degree", "3"]) == 0
    assert f"{out}  {len(kept):,} Gaussians" in capsys.readouterr().out
    assert gsjax.load(out).sh_degree == 3
    again = tmp_path / "b.ply"
    assert cli_main.main(["export", str(out), str(again)]) == 0
    assert again.read_bytes() == out.read_bytes()
    capsys.readouterr()
    few = ["export", str(run), str(tmp_path / "c.ply"), "--min-opacity", "0.9999"]
    assert cli_main.main(few) == 3
    assert "the greatest is 0." in error_of(capsys)
    assert not (tmp_path / "c.ply").exists()


def test_info_of_a_run(demo, tmp_path, capsys, monkeypatch):
    assert cli_main.main(["info", str(demo / "run"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    run, gaussians = facts["run"], gsjax.load(demo / "run" / "splat.ply")
    assert facts["count"] == gaussians.capacity
    assert Path(run["dataset"]) == (demo / "dataset").resolve()
    assert (run["steps_done"], run["steps"]) == (STEPS, STEPS)
    assert run["evaluation"]["views"] == 2
    assert cli_main.main(["info", str(demo / "run")]) == 0
    text = capsys.readouterr().out
    assert f"steps             {STEPS} of {STEPS}" in text
    assert f"PSNR {run['evaluation']['psnr']:.2f} dB" in text
    assert f"Gaussians         {facts['count']:,}" in text
    with monkeypatch.context() as patch:  # its plot has the name of the run
        titles = []
        patch.setattr(
            "gsjax.plots.histograms.histograms_png",
            lambda *_, title: titles.append(title),
        )
        plot = ["--plot", str(tmp_path / "a.png")]
        for scene in (demo / "run", demo / "run" / "splat.ply"):
            assert cli_main.main(["info", str(scene), *plot]) == 0
        assert titles == ["run", "splat.ply"]
        capsys.readouterr()
    # A run that was killed has no Gaussians yet, and is told of all the same.
    young = tmp_path / "young"
    young.mkdir()
    shutil.copy(demo / "run" / "config.json", young)
    assert cli_main.main(["info", str(young)]) == 0
    assert f"steps             0 of {STEPS}" in capsys.readouterr().out


# --- errors ---


def no_run(_: Path, tmp_path: Path) -> list[str]:
    return ["render", str(tmp_path), "-o", str(tmp_path / "o")]


def no_splat(demo: Path, tmp_path: Path) -> list[str]:
    shutil.copy(demo / "run" / "config.json", tmp_path)
    return ["export", str(tmp_path), str(tmp_path / "a.ply")]


def bad_eval(demo: Path, tmp_path: Path) -> list[str]:
    no_splat(demo, tmp_path)
    (tmp_path / "eval.json").write_text("[]")
    return ["info", str(tmp_path)]


def no_dataset(demo: Path, tmp_path: Path) -> list[str]:
    config = json.loads((demo / "run" / "config.json").read_text())
    config["dataset"] = str(tmp_path / "gone")
    (tmp_path / "config.json").write_text(json.dumps(config))
    return ["render", str(tmp_path), "-o", str(tmp_path / "o")]


def render(*more: str):
    """Arguments of `render RUN`."""
    return lambda demo, _: ["render", str(demo / "run"), *more]


BAD = {
    "no run": (3, no_run, "no run is here"),
    "outer folder": (3, lambda d, _: ["info", str(d)], "but one is in "),
    "a file to train into": (
        3,
        lambda d, _: ["train", str(d / "dataset"), "-o", str(d / "run" / "splat.ply")],
        "splat.ply: is a file; pass a folder with -o",
    ),
    "the dataset to train into": (
        3,
        lambda d, _: ["train", str(d / "dataset"), "-o", str(d / "dataset")],
        "dataset: is the dataset's own folder",
    ),
    "no viewer": (
        2,
        lambda _d, _t: ["train", "a", "-o", "b", "--viewer-port", "9000"],
        "--viewer-port goes with --viewer",
    ),
    "frames of photos": (
        2,
        lambda d, t: ["sfm", str(d), "-o", str(t / "o"), "--frames", "9"],
        "--frames are of a video",
    ),
    "missing run": (
        3,
        lambda _d, t: ["info", str(t / "none")],
        "none: does not exist; pass what `gsjax train -o` made",
    ),
    "dataset for a run": (
        3,
        lambda d, _: ["info", str(d / "dataset")],
        "dataset: a dataset; train on it first (gsjax train ",
    ),
    "file for a run": (
        3,
        lambda d, _: ["eval", str(d / "run" / "splat.ply")],
        "splat.ply: a file, where the folder of a run is wanted; pass what `gsjax tr",
    ),
    "no splat": (3, no_splat, "--resume"),
    "bad evaluation": (3, bad_eval, "eval.json: the top is [], an object is wanted"),
    "no dataset": (3, no_dataset, "gone: does not exist"),
    "both": (2, render("--path", "test", "--cameras", "a", "-o", "o"), "exclude"),
    "frames": (2, render("--path", "train", "--frames", "5", "-o", "o"), "--frames"),
    "no frames": (2, render("--frames", "0", "-o", "o"), "--frames 0"),
    "movie": (2, render("-o", "a.mp4"), ".webm are written"),
    "picture": (2, render("-o", "o.png"), "a folder is wanted, for a PNG of each view"),
    "no names": (
        2,
        lambda _d, _t: ["train", "a", "-o", "b", "--test-images"],
        "--test-images wants the name of one view at least",
    ),
    "two kinds": (2, render("-o", "a.gif", "--what", "rgb,depth"), "one of --what"),
    "arrays": (2, render("-o", "a.gif", "--npy"), "no --npy"),
    "rate": (2, render("-o", "o", "--fps", "5"), "--fps 5"),
    "opacity": (2, lambda _d, _t: ["export", "a", "b", "--min-opacity", "1"], "below"),
    "photos": (2, lambda _d, _t: ["demo", "--photos", "1"], "--photos"),
    "size": (2, lambda _d, _t: ["demo", "--size", "8x8"], "--size"),
    "seed": (2, lambda _d, _t: ["demo", "--seed", "-1"], "--seed"),
}


@pytest.mark.parametrize("name", BAD)
def test_an_error_is_one_line_and_a_code(name, demo, tmp_path, capsys):
    code, args, text = BAD[name]
    assert cli_main.main(args(demo, tmp_path)) == code
    assert text in error_of(capsys)
    assert not (tmp_path / "o").exists()
