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

import cv2
import numpy as np
import pytest

import gsjax
from gsjax.cli.main import main
from gsjax.cli.parsing import COMMANDS
from gsjax.data.transforms import CameraEntry, load_transforms, transforms_json
from gsjax.synthetic.torus_knot import torus_knot_scene

WIDTH, HEIGHT = 32, 24
CONFIG = gsjax.RasterConfig(outputs=("rgb",), num_size_buckets=1)  # compiles faster


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """Return a folder with scene.ply and cameras.json (two cameras)."""
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
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    return image[..., ::-1] if image.ndim == 3 else image


def error_of(capsys) -> str:
    """Return the one line on stderr."""
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("gsjax: error: ")
    return lines[0]


def test_render_writes_the_pixels_of_render_exact(scene, tmp_path, capsys):
    out = tmp_path / "new" / "views"
    assert main(render_args(scene, out, "--npy")) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed == [str(out / f"view {i}.png") for i in (0, 1)]
    names = sorted(path.name for path in out.iterdir())
    assert names == ["view 0.npy", "view 0.png", "view 1.npy", "view 1.png"]
    gaussians = gsjax.load(scene / "scene.ply")
    for name, camera in load_transforms(scene / "cameras.json"):
        wanted = np.asarray(gsjax.render_exact(gaussians, camera, CONFIG).rgb)
        found = np.load(out / f"{name}.npy")
        assert found.dtype == np.float32
        assert found.std() > 0.05, "not empty"
        np.testing.assert_array_equal(found, wanted.astype(np.float32))
        pixels = read_image(out / f"{name}.png")
        assert pixels.dtype == np.uint8
        np.testing.assert_array_equal(pixels, np.rint(np.clip(found, 0, 1) * 255))


def test_render_in_the_order_of_each_pixel(scene, tmp_path):
    assert main(render_args(scene, tmp_path, "--npy", "--order", "pixel")) == 0
    gaussians = gsjax.load(scene / "scene.ply")
    name, camera = load_transforms(scene / "cameras.json")[0]
    config = CONFIG.replace(order="pixel", occlusion=False)
    wanted = np.asarray(gsjax.render_exact(gaussians, camera, config).rgb)
    found = np.load(tmp_path / f"{name}.npy")
    np.testing.assert_array_equal(found, wanted.astype(np.float32))
    by_mean = gsjax.render_exact(gaussians, camera, CONFIG).rgb
    assert np.abs(found - by_mean).max() > 1e-3


def test_kinds_size_preset_and_background(scene, tmp_path, capsys):
    more = ["--what", "depth,alpha,rgb", "--npy", "--size", "20x10"]
    more += ["--preset", "fast", "--background", "0.25,.5,1"]
    assert main(render_args(scene, tmp_path, *more)) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 6
    files = [tmp_path / f"view 0{kind}.npy" for kind in ("", ".alpha", ".rgb")]
    depth, alpha, rgb = map(np.load, files)
    assert depth.shape == alpha.shape == (10, 20)
    image = read_image(tmp_path / "view 0.png")
    assert image.dtype == np.uint16
    limits = re.findall(r"depth (\S+) \(1\) to (\S+) \(65535\)", lines[0])[0]
    near, far = map(float, limits)
    back = near + (image.astype(float) - 1) / 65534 * (far - near)
    seen = image > 0
    assert seen.any()
    np.testing.assert_array_equal(seen, depth > 0)
    np.testing.assert_allclose(back[seen], depth[seen], rtol=2e-5)
    grey = read_image(tmp_path / "view 0.alpha.png")
    assert (grey.dtype, grey.ndim) == (np.uint8, 2)
    empty = alpha == 0
    assert empty.any()
    assert (rgb[empty] == np.float32([0.25, 0.5, 1])).all()


def test_files_are_not_overwritten(scene, tmp_path, capsys):
    args = render_args(scene, tmp_path)
    (tmp_path / "view 1.png").write_text("mine")
    assert main(args) == 3
    expected = "view 1.png: exists; pass --overwrite, or another folder with -o"
    assert expected in error_of(capsys)
    assert [p.name for p in tmp_path.iterdir()] == ["view 1.png"]
    assert main([*args, "--overwrite"]) == 0
    assert read_image(tmp_path / "view 1.png").shape == (HEIGHT, WIDTH, 3)
    capsys.readouterr()
    # Two images of one name.
    text = (scene / "cameras.json").read_text()
    text = text.replace("view 0", "a").replace("view 1", "a.alpha")
    (tmp_path / "cameras.json").write_text(text)
    args = render_args(tmp_path, tmp_path / "o", "--what", "rgb,alpha")
    args[1] = str(scene / "scene.ply")
    assert main(args) == 3
    assert "two images would have this name" in error_of(capsys)


# Words SCENE and TMP are replaced by folders, RENDER by the start of a valid command.
ERRORS = [
    (3, "info TMP/none.ply", "none.ply"),
    (3, "info TMP/bad.ply", "end_header"),
    (3, "info a.obj", "expected a suffix of "),
    (3, "render SCENE/scene.ply -o TMP/o --cameras TMP/bad.json", "not JSON"),
    (3, "RENDER -o TMP/bad.ply/o", "bad.ply/o: cannot be "),
    (2, "xyz", "unknown command 'xyz' (choose demo, sfm, "),
    (2, "rendr x", "(did you mean render?); see gsjax --help"),
    (2, "--verison", "(did you mean --version?)"),
    (2, "--version a", "'--version' (use it alone)"),
    (2, "--seed 1 demo", "unknown command '--seed'"),
    (2, "train a -o b --step 9", "did you mean --steps of gsjax train?; see"),
    (2, "train a --prest fast", "-o RUN, --out RUN; unrecognized options: --prest"),
    (2, "train a -o b --path orbit", "misplaced options: --path orbit; did you mean"),
    (2, "info a b", "error: unrecognized options: b; see gsjax info --help"),
    (2, "info a --plot", "missing value for argument '--plot'"),
    (2, "render a.ply", "missing from gsjax render: -o DIR|MOVIE, --out DIR|MOVIE"),
    (2, "render a.ply -o TMP/o", "--cameras"),
    (2, "RENDER -o o --preset best", "'best' (choose compat, accurate, fast); see gsj"),
    (2, "RENDER -o o --path orbti", "'orbti' (did you mean orbit?)"),
    (2, "RENDER -o o --path None", "--path: unknown value 'None'"),
    (2, "RENDER -o o --frames None", "--frames: expected a whole number, got 'None'"),
    (2, "RENDER -o o --size 0x3", "--size: expected WIDTHxHEIGHT in px"),
    (2, "RENDER -o o --what rgb,x", "--what: expected rgb, alpha, depth"),
    (2, "RENDER -o o --background 1,2", "expected R,G,B, each from 0 to 1, got '1,2'"),
    (2, "RENDER -o o --background 1e99,1,1", "each from 0 to 1"),
    (2, "RENDER -o o --background=0,0,-1", "each from 0 to 1"),
    (2, "RENDER -o o --fps fast", "--fps: expected a number, got 'fast'; see gsjax r"),
    (2, "RENDER -o a.gif --fps inf", "--fps: expected at least 0.1 and below 1000"),
    (2, "view a --up z", "invalid choice 'z' for argument '--up'"),
    (2, "view a --port 70000", "--port: expected 1 to 65,535, got 70000"),
    (2, "demo --steps 0", "--steps: expected 1 to 2,147,483,646, got 0"),
    (2, "demo --steps 2147483647", "to 2,147,483,646"),
    (2, "demo --seed 1.5", "--seed: expected a whole number, got '1.5'; see"),
    (2, "demo --photos 1", "--photos: expected 2 to 1,000, got 1"),
    (2, "demo --size 8x8", "--size 8x8: expected at least 16x16"),
    (2, "export a b --min-opacity 1", "expected at least 0 and below 1, got 1"),
    (2, "info a.ply --plot a.jpg", "--plot a.jpg: expected a name ending in .png"),
    (2, "train a -o b --max-size 7", "--max-size: expected 8 to"),
    (2, "train a -o b --test-every -1", "--test-every: expected 0 to"),
    (2, "train a -o b --seed 100000000000000000000", "--seed: expected 0 to"),
    (2, "train a -o b --viewer-port 9000", "--viewer-port goes with --viewer"),
    (2, "train a -o b --test-images", "--test-images: expected the name of at least"),
    (2, "train a -o b --resume --overwrite", "exclude each other"),
    (2, "train a -o b --test-images 0.png --test-every 0", "exclude each other"),
    (2, "train a -o b --initial densely", "--initial: expected points, dense, random"),
    (3, "bench nowhere", "knot"),
    (2, "bench --repeats 0", "--repeats"),
    (2, "bench --budget x", "--budget"),
    (2, "bench --budget 2", "--budget"),
    (2, "bench --scales --budget 0.1", "exclude each other"),
    (3, "bench --plot TMP/a.png", "a.png: exists"),
    (2, "bench --plot a.jpg", ".png"),
    (3, "info SCENE/scene.ply --plot TMP/a.png", "a.png: exists"),
]


@pytest.mark.parametrize(("code", "line", "message"), ERRORS, ids=lambda v: str(v))
def test_an_error_is_one_line_and_a_code(code, line, message, scene, tmp_path, capsys):
    (tmp_path / "bad.json").write_text("{")
    (tmp_path / "bad.ply").write_bytes(b"ply\n")
    (tmp_path / "a.png").touch()
    line = line.replace("RENDER", "render SCENE/scene.ply --cameras SCENE/cameras.json")
    line = line.replace("SCENE", str(scene)).replace("TMP", str(tmp_path))
    assert main(line.split()) == code
    assert message in error_of(capsys)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (KeyboardInterrupt(), 130),
        (gsjax.CapacityError("too\nmuch"), 3),
        (MemoryError(), gsjax.CapacityError.exit_code),
        (RuntimeError("x" * 999), 1),
        (PermissionError(13, "Permission denied"), 3),
    ],
)
def test_exceptions_become_one_line(error, code, scene, capsys, monkeypatch):
    def fail(*_):
        raise error

    monkeypatch.setattr("gsjax.io.formats.load", fail)
    args = ["info", str(scene / "scene.ply")]
    assert main(args) == code
    assert len(error_of(capsys)) < 400
    assert main([*args, "--debug"]) == code
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("Traceback")
    assert lines[-1].startswith("gsjax: error: ")


def test_text_of_paths_and_files_is_escaped_and_shortened(tmp_path, capsys):
    assert main(["info", f"{tmp_path}/\x1b[2J.ply"]) == 3
    assert r"\x1b[2J.ply: cannot be read" in error_of(capsys)
    frame = {"transform_matrix": np.eye(4).tolist(), "file_path": "a.png"}
    frame["camera_model"] = "A" * 10_000 + "\x1b"
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"w": 8, "h": 6, "fl_x": 8, "frames": [frame]}))
    render = ["render", "a.ply", "--cameras", str(path), "-o", str(tmp_path / "out")]
    for args in (render, ["info", "a" * 5000 + ".ply"]):
        assert main(args) == 3
        assert 100 < len(error_of(capsys)) < 1000


def test_a_missing_opencv_is_named(scene, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert main(render_args(scene, tmp_path)) == 6
    assert "pip install opencv-contrib-python-headless" in error_of(capsys)


def test_a_warning_is_one_line(tmp_path, capsys):
    made = torus_knot_scene(count=20, frames=1, width=4, height=4).gaussians
    opacities = made.params.logit_opacities.at[:7].set(np.inf)
    made = made.replace(params=made.params.replace(logit_opacities=opacities))
    path = tmp_path / "hard.ply"
    with pytest.warns(UserWarning, match="inf"):
        gsjax.save(path, made)
    assert main(["info", str(path)]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"gsjax: warning: {path}: 7 ")


SCRIPT = "import sys; from gsjax.cli.main import program; sys.exit(program())"
PROGRAMS = {
    "package": ["-m", "gsjax"],
    "module": ["-m", "gsjax.cli.main"],
    "script": ["-c", SCRIPT],
}


def start(program: str, *args: str, path: str = "", **more) -> subprocess.Popen:
    """Start the command line as a process, with ``path`` first in its search path."""
    places = [path, str(Path(gsjax.__file__).parents[1])]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(places), **more}
    command = [sys.executable, *PROGRAMS[program], *args]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=env)


@pytest.mark.parametrize(
    ("module", "program"),
    [("jax", "package"), ("jax", "module"), ("jax", "script"), ("tyro", "script")],
)
def test_ctrl_c_while_importing_is_one_line(module, program, scene, tmp_path):
    """Even in a module that raises another exception, as JAX's extensions do."""
    (tmp_path / f"{module}.py").write_text(
        "import os, signal, time\n"
        "try:\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    time.sleep(9)\n"
        "except BaseException:\n"
        "    raise ImportError('the extension') from None\n"
    )
    process = start(program, "info", str(scene / "scene.ply"), path=str(tmp_path))
    assert process.communicate() == ("", "gsjax: error: interrupted\n")
    assert process.returncode == 130


def test_each_line_reaches_a_pipe_at_once(scene):
    """For example the address of a server."""
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    path = str(scene / "scene.ply")
    process = start("package", "view", path, PYTHONUNBUFFERED="")
    at_last = threading.Timer(120, process.kill)
    at_last.start()
    assert process.stdout.readline().startswith("http://127.0.0.1:")
    at_last.cancel()
    process.send_signal(signal.SIGINT)
    process.communicate()
    assert process.returncode == 0


@pytest.mark.parametrize("args", [["info"], ["--help"]], ids=lambda args: args[-1])
def test_a_broken_pipe_is_silent(args, scene):
    """As in `gsjax info … | head`."""
    files = [str(scene / "scene.ply")] * (args == ["info"])
    process = start("module", *args, *files)
    process.stdout.close()
    with process.stderr as stderr:
        assert stderr.read() == ""
    assert process.wait() == 141


def test_characters_that_a_terminal_lacks_are_replaced(scene, tmp_path, monkeypatch):
    path = tmp_path / "größe.ply"
    path.write_bytes((scene / "scene.ply").read_bytes())
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="ascii"))
    assert main(["info", str(path)]) == 0
    assert b"gr??e.ply" in raw.getvalue()


def test_info(scene, tmp_path, capsys):
    path = scene / "scene.ply"
    gaussians = gsjax.load(path)
    assert main(["info", str(path)]) == 0
    assert f" {gaussians.capacity:,}\n" in capsys.readouterr().out
    assert main(["info", str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    means = np.asarray(gaussians.params.means)
    assert (facts["count"], facts["sh_degree"]) == (gaussians.capacity, 1)
    assert facts["numbers_per_gaussian"] == 23
    assert facts["file_bytes"] == path.stat().st_size
    assert facts["parameter_bytes"] == gaussians.capacity * 23 * means.itemsize
    assert facts["zero_quaternions"] == 0
    np.testing.assert_allclose(facts["bounds"], [means.min(0), means.max(0)])
    np.testing.assert_allclose(facts["anisotropy"]["50%"], 1 / 0.15, rtol=1e-5)
    assert 0.5 < facts["opacity"]["50%"] < facts["opacity"]["75%"] < 1
    nothing = gsjax.select(gaussians, np.zeros(gaussians.capacity, bool))
    gsjax.save(tmp_path / "empty.ply", nothing)
    assert main(["info", str(tmp_path / "empty.ply"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["count"], facts["bounds"], facts["scale"]["50%"]) == (0, None, None)
    assert main(["info", str(tmp_path / "empty.ply")]) == 0


def test_doctor(capsys, monkeypatch):
    assert main(["doctor"]) == 0
    assert re.search(r"render .*: ok$", capsys.readouterr().out, re.M)
    checks = "gsjax.cli.doctor.render_error"
    monkeypatch.setattr(checks, lambda: (float("nan"), 9))
    assert main(["doctor"]) == 1
    assert "FAILED" in capsys.readouterr().out
    monkeypatch.setattr(checks, lambda: (0.0, 9))
    packages = {"pycolmap": "pycolmap", "cv2": "opencv-contrib-python-headless"}
    for module, package in packages.items():
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, module, None)
            assert main(["doctor"]) == 1
        text = capsys.readouterr().out
        assert re.search(rf"FAILED .*: pip install {package}$", text, re.M)
        assert re.search(r"render .*: ok$", text, re.M)


def test_help_shows_defaults_that_can_be_typed(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("gsjax ")
    assert main([]) == 0
    assert "usage: gsjax" in capsys.readouterr().out
    for command in COMMANDS:
        assert main([command, "--help"]) == 0
        shown = " ".join(re.sub("[│╭╮╰╯─]", " ", capsys.readouterr().out).split())
        assert f"usage: gsjax {command}" in shown
        assert not re.search(r"None|False|\(default: ?\)", shown), command
        if command == "demo":
            assert "--size WxH Size of the photographs. (default: 256x192)" in shown
