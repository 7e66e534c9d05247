"""The command line: files, results, exit codes and one-line errors."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import gsjax
from gsjax.cli import main as cli_main
from gsjax.cli.main import main
from gsjax.data.transforms import CameraEntry, load_transforms
from gsjax.data.transforms_writer import transforms_json
from gsjax.raster.types import Demand, Render
from gsjax.synthetic.torus_knot import torus_knot_scene

WIDTH, HEIGHT = 32, 24
CONFIG = gsjax.RasterConfig(
    outputs=("rgb",), num_size_buckets=1
)  # one rung compiles faster


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """A folder with scene.ply and cameras.json (two cameras)."""
    folder = tmp_path_factory.mktemp("scene")
    made = torus_knot_scene(count=60, frames=2, width=WIDTH, height=HEIGHT)
    gsjax.save(folder / "scene.ply", made.gaussians)
    entries = [CameraEntry(f"view {i}", c) for i, c in enumerate(made.cameras)]
    (folder / "cameras.json").write_text(transforms_json(entries))
    return folder


def render_args(scene: Path, out: Path, *more: str) -> list[str]:
    cameras = str(scene / "cameras.json")
    args = ["render", str(scene / "scene.ply"), "--cameras", cameras]
    return [*args, "-o", str(out), *more]


def read_image(path: Path) -> np.ndarray:
    import cv2

    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    return image[..., ::-1] if image.ndim == 3 else image


def error_of(capsys) -> str:
    """The one line on stderr."""
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("gsjax: error: ")
    return lines[0]


def test_what_files_say_is_neither_obeyed_nor_endless(tmp_path, capsys):
    assert cli_main.main(["info", f"{tmp_path}/\x1b[2J.ply"]) == 3
    assert r"\x1b[2J.ply: cannot be read" in error_of(capsys)
    name = "A" * 10_000 + "\x1b"
    matrix = np.eye(4).tolist()
    frame = {"transform_matrix": matrix, "camera_model": name, "file_path": "a.png"}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"w": 8, "h": 6, "fl_x": 8, "frames": [frame]}))
    (tmp_path / "a.png").touch()
    for args in (["train", str(path)], ["render", "a.ply", "--cameras", str(path)]):
        assert cli_main.main([*args, "-o", str(tmp_path / "out")]) == 3
        told = error_of(capsys)
        assert "camera_model 'AAA" in told
        assert len(told) < 1000
    assert cli_main.main(["info", "a" * 5000 + ".ply"]) == 3
    assert "File name too long; check the path" in error_of(capsys)


# --- render ---


def test_render_writes_what_render_exact_gives(scene, tmp_path, capsys):
    out = tmp_path / "new" / "views"
    assert cli_main.main(render_args(scene, out, "--npy")) == 0
    said = capsys.readouterr()
    assert said.out.splitlines() == [str(out / f"view {i}.png") for i in (0, 1)]
    assert "views 2/2" in said.err
    assert re.search(r"memory: about \d+ MB a view", said.err)
    names = sorted(path.name for path in out.iterdir())
    assert names == ["view 0.npy", "view 0.png", "view 1.npy", "view 1.png"]
    gaussians = gsjax.load(scene / "scene.ply")
    for name, camera in load_transforms(scene / "cameras.json"):
        wanted = np.asarray(gsjax.render_exact(gaussians, camera, CONFIG).rgb)
        found = np.load(out / f"{name}.npy")
        assert found.dtype == np.float32
        assert found.std() > 0.05, "the picture is not empty"
        np.testing.assert_array_equal(found, wanted.astype(np.float32))
        pixels = read_image(out / f"{name}.png")
        assert pixels.dtype == np.uint8
        rounded = np.rint(np.clip(found, 0, 1) * 255)
        np.testing.assert_array_equal(pixels, rounded)


def test_kinds_size_preset_and_background(scene, tmp_path, capsys):
    more = ["--what", "depth,alpha,rgb", "--npy", "--size", "20x10"]
    more += ["--preset", "fast", "--background", "0.25,.5,1"]
    assert cli_main.main(render_args(scene, tmp_path, *more)) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 6
    depth, alpha = (
        np.load(tmp_path / "view 0.npy"),
        np.load(tmp_path / "view 0.alpha.npy"),
    )
    assert depth.shape == alpha.shape == (10, 20)
    picture = read_image(tmp_path / "view 0.png")
    assert picture.dtype == np.uint16
    near, far = map(
        float, re.findall(r"depth (\S+) \(1\) to (\S+) \(65535\)", lines[0])[0]
    )
    back = near + (picture.astype(float) - 1) / 65534 * (far - near)
    seen = picture > 0
    assert seen.any()
    np.testing.assert_array_equal(seen, depth > 0)
    np.testing.assert_allclose(back[seen], depth[seen], rtol=2e-5)
    grey = read_image(tmp_path / "view 0.alpha.png")
    assert (grey.dtype, grey.ndim) == (np.uint8, 2)
    rgb = np.load(tmp_path / "view 0.rgb.npy")
    empty = alpha == 0
    assert empty.any()
    assert (rgb[empty] == np.float32([0.25, 0.5, 1])).all()


def test_of_many_images_the_first_and_the_last_are_named(
    scene, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("gsjax.runs.views._LISTED", 3)
    few, many = tmp_path / "few", tmp_path / "many"
    assert cli_main.main(render_args(scene, few)) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2
    assert cli_main.main(render_args(scene, many, "--what", "rgb,alpha")) == 0
    told = f"{many / 'view 0.png'} … view 1.alpha.png, 4 images\n"
    assert capsys.readouterr().out == told
    assert len(list(many.iterdir())) == 4
    more = ["--what", "rgb,depth", "--overwrite"]
    assert cli_main.main(render_args(scene, many, *more)) == 0
    told = capsys.readouterr().out
    assert len(re.findall(r"view .*\.png  depth \S+ \(1\) to", told)) == 2


def test_capacity_grows_once_and_stays(scene, tmp_path, monkeypatch):
    used = []

    def pretended(_gaussians, camera, config, _background):
        used.append(config)
        wanted = 1_000_000 if len(used) == 1 else 5
        return Render(
            rgb=np.zeros((camera.height, camera.width, 3)),
            alpha=None,
            depth=None,
            median_depth=None,
            radii=np.zeros(1),
            demand=Demand(visible=1, pairs=wanted, capacity=wanted),
            overflowed=np.False_,
        )

    monkeypatch.setattr("gsjax.runs.views.render_exact", pretended)
    assert cli_main.main(render_args(scene, tmp_path, "--preset", "accurate")) == 0
    first, second = used
    assert first.pair_capacity < 1_000_000
    assert second.pair_capacity == gsjax.capacity_bucket(1_000_000)
    assert first.alpha_min == gsjax.RasterConfig.accurate().alpha_min
    assert first.outputs == ("rgb",)


def test_nothing_is_overwritten_unasked(scene, tmp_path, capsys):
    (tmp_path / "view 1.png").write_text("mine")
    assert cli_main.main(render_args(scene, tmp_path)) == 3
    told = "view 1.png: exists; pass --overwrite, or another folder with -o"
    assert told in error_of(capsys)
    assert [p.name for p in tmp_path.iterdir()] == ["view 1.png"]
    assert cli_main.main(render_args(scene, tmp_path, "--overwrite")) == 0
    assert read_image(tmp_path / "view 1.png").shape == (HEIGHT, WIDTH, 3)


def test_two_images_of_one_name_are_refused(scene, tmp_path, capsys):
    content = json.loads((scene / "cameras.json").read_text())
    names = ("a.png", "a.alpha.png")
    for frame, name in zip(content["frames"], names):
        frame["file_path"] = name
    cameras = tmp_path / "cameras.json"
    cameras.write_text(json.dumps(content))
    args = ["render", str(scene / "scene.ply"), "--cameras", str(cameras)]
    assert cli_main.main([*args, "-o", str(tmp_path / "o"), "--what", "rgb,alpha"]) == 3
    assert "two images would have this name" in error_of(capsys)


# --- errors ---


def bad_json(scene: Path, tmp_path: Path) -> list[str]:
    (tmp_path / "bad.json").write_text("{")
    args = render_args(scene, tmp_path)
    args[args.index("--cameras") + 1] = str(tmp_path / "bad.json")
    return args


def bad_ply(_: Path, tmp_path: Path) -> list[str]:
    (tmp_path / "bad.ply").write_bytes(b"ply\n")
    return ["info", str(tmp_path / "bad.ply")]


def folder_is_file(scene: Path, tmp_path: Path) -> list[str]:
    (tmp_path / "file").write_text("")
    return render_args(scene, tmp_path / "file")


BAD = {
    "missing": (3, lambda _s, t: ["info", str(t / "none.ply")], "none.ply"),
    "json": (3, bad_json, "not JSON"),
    "ply": (3, bad_ply, "end_header"),
    "folder": (3, folder_is_file, "cannot be made a folder"),
    "suffix": (3, lambda _s, _t: ["info", "a.ksplat"], "no known format"),
    "command": (2, lambda _s, _t: ["xyz"], "xyz: no such command (there are demo"),
    "like a command": (2, lambda _s, _t: ["rendr", "x"], "(did you mean render?); see"),
    "like a command, with more": (
        2,
        lambda _s, _t: ["trian", "a", "-o", "b"],
        "error: trian: no such command (did you mean train?); see gsjax --help",
    ),
    "like the version": (2, lambda _s, _t: ["--verison"], "(did you mean --version?)"),
    "version and more": (2, lambda _s, _t: ["--version", "a"], "--version: alone"),
    "before the command": (
        2,
        lambda _s, _t: ["--seed", "1", "demo"],
        "--seed: no such option without a command; see",
    ),
    "nothing": (2, lambda _s, _t: [""], "'': no such command (there are demo"),
    "like an option": (
        2,
        lambda _s, _t: ["train", "a", "-o", "b", "--step", "9"],
        "error: --step: no such option (did you mean --steps?); see gsjax train --help",
    ),
    "two things": (
        2,
        lambda _s, _t: ["train", "a", "--prest", "fast"],
        "(did you mean --preset?); -o RUN, --out RUN is missing; see gsjax train --h",
    ),
    "too many": (2, lambda _s, _t: ["info", "a", "b"], "error: b: not expected; see"),
    "no value": (
        2,
        lambda _s, _t: ["info", "a", "--plot"],
        "--plot: a value is wanted; see",
    ),
    "no command": (2, lambda _s, _t: ["--foo"], "no such option without a command"),
    "option": (2, lambda s, _t: ["info", str(s / "scene.ply"), "--foo"], "foo"),
    "no cameras": (2, lambda _s, t: ["render", "a.ply", "-o", str(t)], "--cameras"),
    "missing option": (2, lambda _s, _t: ["render", "a.ply"], "--out"),
    "choice": (
        2,
        lambda s, t: render_args(s, t, "--preset", "best"),
        "--preset best: no such choice (there are compat, accurate, fast); see gsjax r",
    ),
    "like a choice": (
        2,
        lambda s, t: render_args(s, t, "--path", "orbti"),
        "--path orbti: no such choice (did you mean orbit?); see",
    ),
    "short choice": (2, lambda _s, _t: ["view", "a", "--up", "z"], "(there are +x, -x"),
    "None": (
        2,
        lambda s, t: render_args(s, t, "--frames", "None"),
        "--frames 'None': a whole number is wanted; see",
    ),
    "option of another": (
        2,
        lambda _s, _t: ["train", "a", "-o", "b", "--path", "orbit"],
        "error: --path: no such option; see gsjax train --help",
    ),
    "size": (2, lambda s, t: render_args(s, t, "--size", "0x3"), "--size '0x3'"),
    "what": (2, lambda s, t: render_args(s, t, "--what", "rgb,x"), "--what"),
    "colour": (2, lambda s, t: render_args(s, t, "--background", "1,2"), "R,G,B"),
    "glare": (2, lambda s, t: render_args(s, t, "--background", "1e99,1,1"), "0 to 1"),
    "below black": (2, lambda s, t: render_args(s, t, "--background=0,0,-1"), "0 to 1"),
    "steps": (2, lambda _s, _t: ["demo", "--steps", "0"], "--steps"),
    "int32": (
        2,
        lambda _s, t: ["demo", "-o", str(t), "--steps", "2147483647"],
        "to 2147483646",
    ),
    "count": (
        2,
        lambda _s, _t: ["train", "a", "-o", "b", "--steps", "nan"],
        "error: --steps 'nan': a whole number is wanted; see gsjax train --help",
    ),
    "whole": (
        2,
        lambda _s, _t: ["demo", "--seed", "1.5"],
        "error: --seed '1.5': a whole number is wanted; see gsjax demo --help",
    ),
    "number": (
        2,
        lambda s, t: render_args(s, t, "--fps", "fast"),
        "error: --fps 'fast': a number is wanted; see gsjax render --help",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_an_error_is_one_line_and_a_code(name, scene, tmp_path, capsys):
    code, args, text = BAD[name]
    assert cli_main.main(args(scene, tmp_path)) == code
    assert text in error_of(capsys)


def test_debug_shows_the_traceback(tmp_path, capsys):
    assert cli_main.main(["info", str(tmp_path / "none.ply"), "--debug"]) == 3
    told = capsys.readouterr().err
    assert "Traceback" in told
    assert told.splitlines()[-1].startswith("gsjax: error: ")


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (KeyboardInterrupt(), 130),
        (gsjax.CapacityError("too\nmuch"), 3),
        (RuntimeError("x" * 999), 1),
        (PermissionError(13, "Permission denied"), 3),
    ],
)
def test_other_errors(error, code, scene, capsys, monkeypatch):
    def fail(*_):
        raise error

    monkeypatch.setattr("gsjax.io.formats.load", fail)
    assert cli_main.main(["info", str(scene / "scene.ply")]) == code
    assert len(error_of(capsys)) < 400


def test_without_opencv_the_remedy_is_named(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert cli_main.main(render_args(scene, tmp_path)) == 6
    assert "pip install opencv-contrib-python-headless" in error_of(capsys)


def test_a_warning_is_one_line(tmp_path, capsys):
    made = torus_knot_scene(count=20, frames=1, width=4, height=4).gaussians
    opacities = made.params.logit_opacities.at[:7].set(np.inf)
    params = made.params.replace(logit_opacities=opacities)  # pyright: ignore
    path = tmp_path / "hard.ply"
    with pytest.warns(UserWarning, match="infinite"):
        gsjax.save(path, made.replace(params=params))  # pyright: ignore
    assert cli_main.main(["info", str(path)]) == 0
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1
    assert told[0].startswith(f"gsjax: warning: {path}: 7 opacities of ±inf")


def test_process_has_the_code_and_no_traceback(tmp_path):
    args = ["-m", "gsjax.cli.main", "info", str(tmp_path / "none.ply")]
    done = subprocess.run([sys.executable, *args], capture_output=True, text=True)
    assert done.returncode == 3
    assert done.stdout == ""
    assert done.stderr.startswith("gsjax: error: ")
    assert done.stderr.count("\n") == 1


def test_only_a_program_of_its_own_starts_anew(monkeypatch):
    done = []
    monkeypatch.setattr(
        cli_main, "restart_with_large_pages", lambda: done.append("anew")
    )
    monkeypatch.setattr(sys, "argv", ["gsjax", "--version"])
    assert cli_main.main() == cli_main.main(["--version"]) == 0
    assert not done
    assert main.program() == 0
    assert done == ["anew"]


PROGRAMS = {
    "package": ["-m", "gsjax"],
    "module": ["-m", "gsjax.cli.main"],
    "script": [
        "-c",
        "import sys; from gsjax.cli.main import program; sys.exit(program())",
    ],
}


def started(program: str, *args: str, path: str = "", **more) -> subprocess.Popen:
    """The command line as a process of its own, with ``path`` before ours."""
    places = [path, str(Path(gsjax.__file__).parents[1])]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(places), **more}
    command = [sys.executable, *PROGRAMS[program], *args]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=env)


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("module", ["tyro", "jax"])
def test_ctrl_c_while_importing_is_one_line(module, program, scene, tmp_path):
    """Even in a module that makes something else of it, as JAX's extensions do."""
    (tmp_path / f"{module}.py").write_text(
        "import os, signal, time\n"
        "try:\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    time.sleep(9)\n"
        "except BaseException:\n"
        "    raise ImportError('the extension') from None\n"
    )
    process = started(program, "info", str(scene / "scene.ply"), path=str(tmp_path))
    assert process.communicate() == ("", "gsjax: error: interrupted\n")
    assert process.returncode == 130


def test_each_line_is_written_as_it_is_said(scene):
    """Where stdout is no terminal, too: the address of a server is wanted at once."""
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    path = str(scene / "scene.ply")
    process = started("package", "view", path, PYTHONUNBUFFERED="")
    at_last = threading.Timer(120, process.kill)
    at_last.start()
    assert process.stdout is not None
    assert process.stdout.readline().startswith("http://127.0.0.1:")
    at_last.cancel()
    process.send_signal(signal.SIGINT)
    process.communicate()
    assert process.returncode == 0


@pytest.mark.parametrize("args", [["info"], ["--help"]], ids=lambda args: args[-1])
def test_who_reads_no_further_is_told_nothing(args, scene):
    """As `gsjax info … | head` does."""
    files = [str(scene / "scene.ply")] * (args == ["info"])
    process = started("module", *args, *files)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    with process.stderr as stderr:
        assert stderr.read() == ""
    assert process.wait() == 141


def test_what_the_terminal_lacks_is_replaced(scene, tmp_path, monkeypatch):
    path = tmp_path / "größe.ply"
    path.write_bytes((scene / "scene.ply").read_bytes())
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="ascii"))
    assert cli_main.main(["info", str(path)]) == 0
    assert b"gr??e.ply" in raw.getvalue()


def test_import_is_light():
    heavy = "{'cv2', 'pycolmap', 'tyro', 'tqdm'}"
    code = f"import gsjax, sys; assert not {heavy} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True)


# --- info, doctor ---


def test_info(scene, capsys):
    path = scene / "scene.ply"
    assert cli_main.main(["info", str(path)]) == 0
    text = capsys.readouterr().out
    gaussians = gsjax.load(path)
    assert f"Gaussians         {gaussians.capacity:,}" in text
    assert cli_main.main(["info", str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    means = np.asarray(gaussians.params.means)
    assert facts["count"] == gaussians.capacity
    assert facts["sh_degree"] == 1
    assert facts["numbers_per_gaussian"] == 23
    assert facts["file_bytes"] == path.stat().st_size
    assert facts["parameter_bytes"] == gaussians.capacity * 23 * means.itemsize
    assert facts["zero_quaternions"] == 0
    np.testing.assert_allclose(facts["bounds"], [means.min(0), means.max(0)])
    np.testing.assert_allclose(facts["anisotropy"]["50%"], 1 / 0.15, rtol=1e-5)
    assert 0.5 < facts["opacity"]["50%"] < facts["opacity"]["75%"] < 1


def test_info_of_an_empty_scene(tmp_path, capsys):
    zeros = np.zeros
    gsjax.save(
        tmp_path / "empty.ply",
        gsjax.make_gaussians(
            means=zeros((0, 3)),
            quats=zeros((0, 4)),
            log_scales=zeros((0, 3)),
            logit_opacities=zeros(0),
            sh=zeros((0, 1, 3)),
        ),
    )
    assert cli_main.main(["info", str(tmp_path / "empty.ply"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["count"], facts["bounds"], facts["scale"]["50%"]) == (0, None, None)
    assert cli_main.main(["info", str(tmp_path / "empty.ply")]) == 0


def test_doctor(capsys, monkeypatch):
    assert cli_main.main(["doctor"]) == 0
    text = capsys.readouterr().out
    assert re.search(r"render .*: well$", text, re.M)
    assert "NOT WELL" not in text
    monkeypatch.setattr(
        "gsjax.cli.doctor_checks.render_error", lambda: (float("nan"), 9)
    )
    assert cli_main.main(["doctor"]) == 1
    assert "NOT WELL" in capsys.readouterr().out


ABSENT = {
    "pycolmap": r"pycolmap  NOT WELL, absent .*; gsjax sfm needs it: pip install pycol",
    "cv2": r"opencv    NOT WELL, absent .*; photographs and images need it: pip inst",
}


@pytest.mark.parametrize("module", ABSENT)
def test_doctor_misses_what_the_package_requires(module, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr("gsjax.cli.doctor_checks.render_error", lambda: (0.0, 9))
    assert cli_main.main(["doctor"]) == 1
    text = capsys.readouterr().out
    assert re.search(ABSENT[module], text)
    assert re.search(r"render .*: well$", text, re.M)


def test_help_has_no_default_that_nobody_types(capsys):
    """What is off or left open; a default that is a value is there."""
    for command in main._commands():
        assert cli_main.main([command, "--help"]) == 0
        told = " ".join(re.sub("[│╭╮╰╯─]", " ", capsys.readouterr().out).split())
        assert not re.search(r"None|False|\(default: ?\)", told), command
        if command == "train":
            assert "--steps INT How many" in told
            assert "same bits on a CPU, with as many cores. (default: 0)" in told


def test_help_and_version(capsys):
    assert cli_main.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("gsjax ")
    for args in ([], ["--help"], ["render", "--help"], ["export", "--help"]):
        assert cli_main.main(args) == 0
        assert "usage: gsjax" in capsys.readouterr().out
