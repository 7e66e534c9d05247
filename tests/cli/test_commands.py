"""The README's commands one after another, and further commands on its demo.

Options that make them quick are appended to the README's commands, nothing else.
"""

import contextlib
import io
import json
import re
import shutil
import tomllib
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from captures import PIXELS, dataset_of_views, frames_of, write_transforms
from corner_room import make_room
from snippets import ROOT, blocks, commands

import gsjax
from gsjax.cli.main import main
from gsjax.compression.measure import Judge
from gsjax.gaussians import activate
from gsjax.runs.compression import compression_inputs

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("float32", "shared_programs")]

README = (ROOT / "README.md").read_text(encoding="utf-8")
WIDTH, HEIGHT, PHOTOS, STEPS = 64, 48, 9, 20
HELD_OUT = ["photo_002", "photo_006"]
# Options appended to the README's commands.
SMALLER = {
    "demo": f"--photos {PHOTOS} --size {WIDTH}x{HEIGHT} --steps {STEPS}".split(),
    "render": ["--frames", "3"],
    "train": ["--steps", "4", "--max-size", "80"],
}


def run(*words) -> SimpleNamespace:
    """Run a command, which must succeed, and return what it prints: out and err."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(word) for word in words])
    assert code == 0, err.getvalue()
    return SimpleNamespace(out=out.getvalue(), err=err.getvalue())


@pytest.fixture(scope="module")
def printed(tmp_path_factory) -> dict[str, SimpleNamespace]:
    """Return the output of each of the README's commands, run in a new folder."""
    pytest.importorskip("pycolmap", reason="pycolmap is absent")
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    folder, found = tmp_path_factory.mktemp("readme"), {}
    (folder / "photos").mkdir()
    make_room(folder / "photos")
    with contextlib.chdir(folder):
        for words in commands(README):
            found[words[0]] = run(*words, *SMALLER.get(words[0], ()))
    found["folder"] = SimpleNamespace(out=str(folder), err="")
    return found


@pytest.fixture(scope="module")
def demo(printed) -> Path:
    """Return the folder of the demo, whose settings are made to compile quickly."""
    folder = Path(printed["folder"].out) / "gsjax-demo"
    path = folder / "run" / "config.json"
    config = json.loads(path.read_text())
    config["train"]["raster"] |= {"num_size_buckets": 1, "devices": 1}
    path.write_text(json.dumps(config))
    return folder


def read_image(path: Path) -> np.ndarray:
    return cv2.imread(str(path))[..., ::-1]


def read_movie(path: Path) -> np.ndarray:
    """Return [F, H, W, 3] RGB."""
    done, movie = cv2.imreadanimation(str(path))
    assert done
    return np.stack([frame[..., 2::-1] for frame in movie.frames])


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_readme_commands_write_the_paths_in_their_comments(printed):
    folder = Path(printed["folder"].out)
    code = "".join(code for _, code in blocks(README, "sh"))
    outputs = re.findall(r"(?:-o|--html) (\S+)", code)
    paths = re.findall(r"[\w.-]+/[\w./-]*", " ".join(re.findall(r" # (.*)", code)))
    assert {"run/splat.ply", "gsjax-demo/"} <= set(paths)
    assert [path for path in (*paths, *outputs) if not (folder / path).exists()] == []
    assert all(text.out.strip() for text in printed.values())


def test_readme_installs_extras_of_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = set(re.findall(r"pip install[^`\n]*\[(\w+)\]", README))
    assert {"test", "viewer"} <= extras <= set(project["optional-dependencies"])


def test_demo_learns_and_its_outputs_exist(printed, demo):
    *paths, result = printed["demo"].out.splitlines()
    folder = Path(printed["folder"].out)
    splat, preview, curves, turntable = (folder / path for path in paths)
    assert all(path.exists() for path in (splat, preview, curves))
    assert "2 held-out views: PSNR " in result
    assert re.search(r"; training views: PSNR \d+\.\d\d dB$", result)
    quality = json.loads((demo / "run" / "eval.json").read_text())
    assert quality["psnr"] > 17
    movie = read_movie(turntable)
    assert movie.shape == (48, HEIGHT, WIDTH, 3)
    assert movie.std() > 20, "not empty"
    assert np.abs(movie[0].astype(int) - movie[24]).mean() > 2, "it turns"


def test_commands_that_demo_suggests_work(printed, demo):
    lines = [s.split()[2:] for s in printed["demo"].err.splitlines() if "  gsjax " in s]
    expected = ["view", "info", "render", "export", "sfm", "train"]
    assert [line[0] for line in lines] == expected
    with contextlib.chdir(demo.parent):
        for line in lines[1:4]:
            run(*line)
    for name in HELD_OUT:
        wanted = read_image(demo / "run" / "renders" / "images" / f"{name}.png")
        found = read_image(demo / "views" / f"{name}.png")
        assert found.std() > 20
        assert np.abs(found.astype(int) - wanted).max() <= 1


def test_render_a_path_to_movies(demo, tmp_path):
    """The default path is an orbit; depth has one range of colours for all frames."""
    args = ["render", demo / "run", "--frames", "3", "--fps", "2"]
    for kind in ("rgb", "depth"):
        path = tmp_path / "new" / f"{kind}.webp"
        text = run(*args, "-o", path, "--what", kind)
        assert text.out.splitlines() == [str(path)]
        assert "3 frames, a movie of 1.5 s" in text.err
        assert read_movie(path).shape == (3, HEIGHT, WIDTH, 3)
    depth = read_movie(path).astype(int)
    seen = (depth.max(-1) - depth.min(-1)) > 100
    assert 0.05 < seen.mean() < 0.95


def test_a_file_renders_like_its_run(demo, tmp_path):
    """With the cameras of the dataset, whose photographs need not exist."""
    dataset = shutil.copytree(demo / "dataset", tmp_path / "dataset")
    shutil.rmtree(dataset / "images")
    of_file = ["render", demo / "run" / "splat.ply", "--preset", "compat"]
    of_run = ["render", demo / "run", "--preset", "compat"]
    spiral = ["--path", "spiral", "--frames", "2"]
    cameras = ["--cameras", demo / "dataset" / "transforms.json"]
    for folder, args in {
        "a": [*of_file, "--cameras", demo / "dataset"],
        "b": [*of_file, "--cameras", dataset],
        "c": [*of_run, *cameras],
        "path a": [*of_file, "--cameras", demo / "dataset", *spiral],
        "path b": [*of_run, *spiral],
    }.items():
        run(*args, "-o", tmp_path / folder)
    assert names(tmp_path / "a") == [f"photo_00{n}.png" for n in range(PHOTOS)]
    for first, *others in (("a", "b", "c"), ("path a", "path b")):
        for name in names(tmp_path / first):
            image = read_image(tmp_path / first / name)
            assert image.std() > 20
            for other in others:
                found = read_image(tmp_path / other / name)
                np.testing.assert_array_equal(found, image)


def test_render_the_test_views_that_a_dataset_declares(demo, tmp_path):
    dataset = tmp_path / "dataset"
    lens = {**PIXELS, "w": WIDTH, "h": HEIGHT}
    frames = frames_of(dataset_of_views(5), "{}.png")
    for split, few in (("train", frames[:3]), ("test", frames[3:])):
        write_transforms(dataset, few, f"transforms_{split}.json", **lens)
    args = ["render", demo / "run" / "splat.ply", "--preset", "compat"]
    args += ["--cameras", dataset, "-o", tmp_path / "views", "--path"]
    run(*args, "test")
    assert names(tmp_path / "views") == ["3.png", "4.png"]
    run(*args, "train", "--overwrite")
    assert names(tmp_path / "views") == [f"{n}.png" for n in range(5)]


def test_evaluating_training_views_keeps_other_files(demo, tmp_path):
    folder = shutil.copytree(demo / "run", tmp_path / "run")
    text = run("eval", folder, "--json")
    assert json.loads(text.out)["which"] == "test"
    assert "unfinished" not in text.err
    config = json.loads((folder / "config.json").read_text())
    config["train"]["steps"] += 1
    (folder / "config.json").write_text(json.dumps(config))
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    text = run("eval", folder, "--views", "train")
    assert f"unfinished: step {STEPS} of {STEPS + 1}" in text.err
    assert text.out.splitlines()[-1] == str(folder / "preview_train.png")
    assert {path: path.read_bytes() for path in before} == before
    report = json.loads((folder / "eval_train.json").read_text())
    assert (report["which"], report["views"]) == ("train", PHOTOS - len(HELD_OUT))
    expected = [f"{Path(view['name']).stem}.png" for view in report["each"]]
    assert names(folder / "renders_train" / "images") == expected


def test_export(demo, tmp_path, capsys):
    source, out = demo / "run", tmp_path / "new" / "a.ply"
    whole = gsjax.load(source / "splat.ply")
    opacities = np.asarray(activate(whole.params)["opacities"])
    least = float(np.median(opacities))
    args = ["export", source, out, "--sh-degree", "0"]
    text = run(*args, "--min-opacity", repr(least))
    kept = opacities >= least
    assert text.out.startswith(f"{out}  {kept.sum():,} of {len(kept):,} Gaussians")
    found = gsjax.load(out)
    assert found.sh_degree == 0
    np.testing.assert_array_equal(found.params.means, whole.params.means[kept])
    np.testing.assert_array_equal(found.params.sh, whole.params.sh[kept, :1])
    run(*args, "--overwrite", "--sh-degree", "3")
    assert gsjax.load(out).sh_degree == 3
    run("export", out, tmp_path / "b.ply")
    assert (tmp_path / "b.ply").read_bytes() == out.read_bytes()
    none = ["export", str(source), str(tmp_path / "c.ply"), "--min-opacity", "0.9999"]
    assert main(none) == 3
    assert "the greatest is 0." in capsys.readouterr().err
    assert not (tmp_path / "c.ply").exists()


def test_mesh(demo, tmp_path, capsys):
    trimesh = pytest.importorskip("trimesh")
    out = tmp_path / "new" / "mesh.glb"
    words = ["mesh", demo / "run", "-o", out, "--resolution", "32"]
    text = run(*words, "--box=-3,-3,-1,3,3,2", "--parts", "0").out
    found = trimesh.load(out, force="mesh")
    count = len(found.faces)
    facts = rf"{count:,} triangles, open, (\d+) of \1 parts?, voxels 0\.1875"
    assert re.match(re.escape(str(out)) + "  " + facts, text)
    assert len(found.faces) > 100
    assert (np.abs(found.vertices[:, :2]) <= 3).all()
    assert main([str(word) for word in words]) == 3
    assert "exists; pass --overwrite" in capsys.readouterr().err
    for wrong, message in (("--box=1,2", "six numbers"), ("-o=a.xyz", ".stl")):
        assert main([*map(str, words), "--overwrite", wrong]) == 2
        assert message in capsys.readouterr().err
    nowhere = [*map(str, words), "--overwrite", "--box=90,90,90,91,91,91"]
    assert main(nowhere) == 3
    assert "check the box" in capsys.readouterr().err


def test_the_loss_of_a_compression_is_measured_on_the_held_out_views(demo):
    """With the cameras and photographs of `gsjax eval`."""
    inputs = compression_inputs(demo / "run")
    judge = Judge(inputs.gaussians, inputs.held_out, inputs.config, inputs.background)
    quality = judge.judge(inputs.gaussians)
    expected = json.loads((demo / "run" / "eval.json").read_text())
    assert len(inputs.held_out.cameras) == expected["views"] == len(HELD_OUT)
    assert len(inputs.cameras) == PHOTOS - len(HELD_OUT)
    assert quality.psnr == pytest.approx(expected["psnr"], abs=0.01)
    assert quality.ssim == pytest.approx(expected["ssim"], abs=1e-4)


def test_mesh_of_a_file(demo, tmp_path, capsys):
    """From a sphere, to where ``gsjax view --mesh`` finds it."""
    pytest.importorskip("trimesh")
    pytest.importorskip("viser")
    scene, page = tmp_path / "a.ply", tmp_path / "a.html"
    shutil.copy(demo / "run" / "splat.ply", scene)
    assert main(["mesh", str(scene)]) == 3
    assert "--sphere 64" in capsys.readouterr().err
    view = ["view", str(scene), "--mesh", "--html", str(page)]
    assert main(view) == 3
    assert f"make it with gsjax mesh {scene}" in capsys.readouterr().err
    words = ["--sphere", "3", "--resolution", "32", "--triangles", "500", "--closed"]
    text = run("mesh", scene, *words, "--fill-holes").out
    count = re.search(r"([\d,]+) triangles, watertight", text)[1]
    assert int(count.replace(",", "")) <= 500
    assert text.startswith(str(tmp_path / "a.mesh.ply"))
    assert f"{page}  {count} triangles, " in run(*view).out
    assert f"mesh of {count} triangles, drawn by viser" in page.read_text()


def test_info_of_a_run(demo, tmp_path):
    facts = json.loads(run("info", demo / "run", "--json").out)
    report, gaussians = facts["run"], gsjax.load(demo / "run" / "splat.ply")
    assert facts["count"] == gaussians.capacity
    assert Path(report["dataset"]) == (demo / "dataset").resolve()
    assert (report["steps_done"], report["steps"]) == (STEPS, STEPS)
    assert report["evaluation"]["views"] == 2
    plot = tmp_path / "new" / "a.png"
    text = run("info", demo / "run", "--plot", plot).out
    assert text.splitlines()[-1] == str(plot)
    assert f" {STEPS} of {STEPS}\n" in text
    assert read_image(plot).std() > 10
    # A run without Gaussians yet is described, too.
    young = tmp_path / "young"
    young.mkdir()
    shutil.copy(demo / "run" / "config.json", young)
    assert f" 0 of {STEPS}\n" in run("info", young).out


# Words DEMO and TMP are replaced by folders. TMP is an unfinished run.
ERRORS = [
    (3, "train DEMO/dataset -o TMP/o --initial DEMO/dataset", "is a dataset; train on"),
    (2, "train DEMO/dataset -o DEMO/run --initial DEMO/run", "another folder with -o"),
    (3, "train DEMO/dataset -o TMP/o --initial TMP/none.ply", "none.ply"),
    (2, "train DEMO/dataset -o TMP/o --initial DEMO/run --antialias", "--antialias"),
    (2, "train DEMO/dataset -o TMP/o --initial DEMO/run --mip", "leave out --mip"),
    (2, "train DEMO/dataset -o TMP/o --mip --antialias", "exclude each other"),
    (3, "info DEMO", "is not a run, but "),
    (3, "train DEMO/dataset -o DEMO/run/splat.ply", "is a file; pass a folder with -o"),
    (3, "train DEMO/dataset -o DEMO/dataset", "is the dataset's own folder"),
    (2, "sfm DEMO -o TMP/o --frames 9", "--frames goes with a video"),
    (3, "info TMP/none", "none: does not exist; pass a folder made by `gsjax train"),
    (3, "info DEMO/dataset", "dataset: is a dataset; train on it first (gsjax train "),
    (3, "eval DEMO/run/splat.ply", "expected the folder of a run, got a file"),
    (3, "render DEMO/dataset/images -o TMP/o", "is not a run"),
    (3, "export TMP TMP/a.ply", "--resume"),
    (3, "info TMP", "eval.json: "),
    (3, "render TMP -o TMP/o", "gone: "),
    (3, "demo -o DEMO", "exists; pass --overwrite, or another folder with -o"),
    (3, "render DEMO/run --path test -o DEMO/views", "exists; pass --overwrite"),
    (3, "render DEMO/run -o TMP/a.gif", "a.gif: exists"),
    (3, "export DEMO/run DEMO/scene.ply", "exists; pass --overwrite"),
    (2, "render DEMO/run --path test --cameras a -o o", "exclude each other"),
    (2, "render DEMO/run --path train --frames 5 -o o", "--frames goes with orbit"),
    (2, "render DEMO/run/splat.ply --cameras DEMO/dataset --path test -o o", "no test"),
    (2, "render DEMO/run -o a.mov", "or a movie: .mp4, .webm, .webp, .gif"),
    (2, "render DEMO/run -o o.png", "expected a folder for images"),
    (2, "render DEMO/run -o a.gif --what rgb,depth", "one kind of --what"),
    (2, "render DEMO/run -o a.gif --npy", "without --npy"),
    (2, "render DEMO/run -o o --fps 5", "--fps goes with a movie"),
    (2, "render DEMO/run -o o --budget 1/255 --preset fast", "exclude each other"),
]


@pytest.mark.parametrize(("code", "line", "message"), ERRORS, ids=lambda v: str(v))
def test_an_error_is_one_line_and_a_code(code, line, message, demo, tmp_path, capsys):
    config = json.loads((demo / "run" / "config.json").read_text())
    config["dataset"] = str(tmp_path / "gone")
    (tmp_path / "config.json").write_text(json.dumps(config))
    (tmp_path / "eval.json").write_text("[]")
    (tmp_path / "a.gif").write_text("mine")
    line = line.replace("DEMO", str(demo)).replace("TMP", str(tmp_path))
    assert main(line.split()) == code
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("gsjax: error: ")
    assert message in lines[0]
    assert not (tmp_path / "o").exists()
