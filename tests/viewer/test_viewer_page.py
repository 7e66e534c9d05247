"""`gsjax view` and `gsjax train --viewer` from the command line: pages, and what a
browser then shows.
"""

import base64
import json
import re
import struct
import subprocess
import sys
import threading
import time
import urllib.request
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import training
from captures import save_photo
from conftest import LIGHT
from viewing import CHROMIUM, COUNT, WEBGL, opened, scene, wait_for

import gsjax
from gsjax.cli.main import main
from gsjax.data.colmap_writer import write_colmap
from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.math.rotations import quaternion_to_matrix
from gsjax.math.sh import rgb_to_dc
from gsjax.runs.folder import (
    RunSettings,
    load_data,
    run_files,
    save_scene,
    save_settings,
    with_views,
)
from gsjax.train.config import TrainConfig
from gsjax.viewer.exact import ExactRenderer, camera_of, picture
from gsjax.viewer.stage import UPS, Frustum, eye_of_gaussians

# --- the command ---


@pytest.fixture
def ply(tmp_path):
    path = tmp_path / "a.ply"
    gsjax.save(path, scene())
    return path


def test_without_viser_the_line_that_installs_it(ply, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    for args in (["view", str(ply)], ["train", "x", "-o", str(tmp_path), "--viewer"]):
        assert main.main(args) == 6
        said = capsys.readouterr()
        assert said.out == ""
        assert "install it: pip install viser" in said.err


@pytest.mark.parametrize(
    "args", [["--min-opacity", "1"], ["--max-gaussians", "0"], ["--port", "0"],
             ["--up", "z"]],
)  # fmt: skip
def test_usage(ply, args, capsys):
    assert main.main(["view", str(ply), *args]) == 2
    assert args[0] in capsys.readouterr().err


def told_by(text: str) -> tuple[list[dict], np.ndarray]:
    """Messages of a page, and its packed splats [M, 8]: its only buffer."""
    import msgspec
    import zstandard

    data = base64.b64decode(re.search(r'EMBED_DATA__="([^"]*)"', text)[1])
    inner = zstandard.ZstdDecompressor().decompressobj().decompress(data[8:])
    length = 8 + struct.unpack("<Q", inner[:8])[0]
    told = msgspec.msgpack.decode(inner[8:length])
    messages = [message for _, message in told["messages"]]
    kinds = [message["type"] for message in messages]
    assert kinds.count("GaussianSplatsMessage") == 1
    assert "BackgroundImageMessage" in kinds
    (size,) = told["binaryBufferLengths"]
    packed = np.frombuffer(inner[len(inner) - size :], np.uint32).reshape(-1, 8)
    return messages, packed


def test_a_page_holds_the_scene_and_needs_nothing_else(ply, tmp_path, capsys):
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    out = tmp_path / "new" / "a.html"
    assert main.main(["view", str(ply), "--html", str(out)]) == 0
    size = out.stat().st_size / 2**20
    assert capsys.readouterr().out == f"{out}  {COUNT} Gaussians, {size:.2f} MiB\n"
    text = out.read_text()
    links = set(re.findall(r"(?:src|href)=.?https?://[^\"' ]+", text))
    assert not links
    assert "SH degree 0" in text
    assert "Drag to turn" in text
    assert re.search(r"<div style=[^>]*background:[^>]*>[^<]*Gaussians", text)
    _, packed = told_by(text)
    rgb = packed[:, 7:].copy().view(np.uint8)[:, :3] / 255
    np.testing.assert_allclose(rgb, [[0.9, 0.5, 0.1]] * COUNT, atol=1 / 255)
    assert main.main(["view", str(ply), "--html", str(out)]) == 3
    assert "exists" in capsys.readouterr().err
    args = ["--overwrite", "--max-gaussians", "20", "--min-opacity", "0.5"]
    assert main.main(["view", str(ply), "--html", str(out), *args]) == 0
    said = capsys.readouterr()
    assert f"20 of {COUNT} Gaussians" in said.out
    assert "left out" not in said.err, "it was asked for"
    args = ["--overwrite", "--min-opacity", "0.999"]
    assert main.main(["view", str(ply), "--html", str(out), *args]) == 3
    assert "lower --min-opacity" in capsys.readouterr().err


def test_faint_gaussians_that_are_left_out_are_said_to_be_faint(ply, tmp_path, capsys):
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    whole = gsjax.load(ply)
    faint = whole.params.logit_opacities.at[:3].set(-9.0)
    changed = whole.replace(params=whole.params.replace(logit_opacities=faint))
    gsjax.save(tmp_path / "faint.ply", changed)
    args = ["view", str(tmp_path / "faint.ply"), "--html", str(tmp_path / "a.html")]
    assert main.main(args) == 0
    told = f"3 of {COUNT} Gaussians left out: too faint (opacity below 0.01), or not"
    assert told in capsys.readouterr().err


COLORS = np.array([[200, 40, 30], [30, 180, 60], [40, 60, 190], [120, 120, 120]])
FAR = np.asarray([4e5, -3e6, 20.0])


def run_at(folder: Path, config: TrainConfig, **changes) -> Path:
    """A run that has yet to begin, on the small capture with these changes; of its
    photographs each is of one colour, 320 × 240 px.
    """
    made = replace(training.scene(), **changes)
    write_colmap(folder / "data" / "sparse" / "0", made)
    for view, color in zip(made.views, COLORS, strict=True):
        photo = np.full((240, 320, 3), color, np.uint8)
        save_photo(folder / "data" / "images" / view.name, photo)
    settings = RunSettings(folder / "data", config, every=0)
    run = folder / "run"
    run.mkdir()
    save_settings(run, with_views(settings, load_data(settings)))
    return run


@pytest.fixture
def run(tmp_path) -> Path:
    """Far from the origin, and as if it had found the true scene."""
    run = run_at(tmp_path, TrainConfig(), origin=FAR)
    far = replace(training.scene(), origin=FAR)
    save_scene(run_files(run).splat, training.true_gaussians(), far)
    return run


def about(messages: list[dict], kind: str, name: str) -> dict:
    """The only message of a kind about a node of the scene."""
    (found,) = (m for m in messages if m["type"] == kind and m["name"] == name)
    return found


def turned(wxyz) -> np.ndarray:
    return np.asarray(quaternion_to_matrix(np.asarray(wxyz)))


def test_a_page_of_a_run_holds_its_cameras_and_small_photographs(run, tmp_path, capsys):
    """Where they stood to the Gaussians; with --no-photos the cameras alone."""
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    texts = []
    for more in ([], ["--no-photos"]):
        out = tmp_path / f"{len(texts)}.html"
        assert main.main(["view", str(run), "--html", str(out), *more]) == 0
        said = capsys.readouterr()
        assert f"{training.POINTS} Gaussians, {training.VIEWS} cameras" in said.out
        assert "warning" not in said.err
        texts.append(out.read_text())
        messages, packed = told_by(texts[-1])
        splats = about(messages, "GaussianSplatsMessage", "/splats")["props"]
        means = packed[:, :3].copy().view(np.float32) * splats["scale"]
        # From the page's origin to that of the capture, which is its maker's choice.
        away = np.median(means - training.true_gaussians().params.means, axis=0)
        for index, view in enumerate(training.scene().views):
            name = f"/cameras/{index:04d}"
            place = about(messages, "SetPositionMessage", name)["position"]
            np.testing.assert_allclose(place - away, view.centre, atol=1e-4)
            turn = turned(about(messages, "SetOrientationMessage", name)["wxyz"])
            np.testing.assert_allclose(turn, view.viewmat[:3, :3].T, atol=1e-6)
            drawn = about(messages, "CameraFrustumMessage", name)["props"]
            half = np.tan(drawn["fov"] / 2)
            np.testing.assert_allclose(half, view.height / 2 / view.K[1, 1])
            np.testing.assert_allclose(drawn["aspect"], view.width / view.height)
            if more:
                assert drawn["_image_data"] is None
                continue
            photo = cv2.imdecode(np.frombuffer(drawn["_image_data"], np.uint8), 1)
            assert photo.shape == (120, 160, 3)
            assert np.abs(photo[..., ::-1] - COLORS[index].astype(int)).max() < 8
    assert len(texts[1]) < len(texts[0])


@pytest.mark.parametrize("up", [None, "+x", "-y"])
def test_up_in_a_page_is_what_was_said(run, tmp_path, capsys, up):
    """Without a word, as the cameras of the run are held; up is +y in the browser."""
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    out = tmp_path / "a.html"
    more = [] if up is None else ["--up", up]
    assert main.main(["view", str(run), "--html", str(out), *more]) == 0
    capsys.readouterr()
    messages, _ = told_by(out.read_text())
    world = turned(about(messages, "SetOrientationMessage", "")["wxyz"])
    np.testing.assert_allclose(world @ UPS[up or "+z"], (0, 1, 0), atol=1e-6)


# --- in a browser ---


@pytest.fixture
def pictures_of_page(tmp_path):
    """A function: pictures [H, W, 3] of a page in Chromium, one after another.

    What is sent to it is a script, which the page runs before the next. Once closed,
    Chromium is gone.
    """
    client = pytest.importorskip("websockets.sync.client", reason="needs viser")
    profile, browsers = tmp_path / "profile", []

    def look(url: str, size: str = "500,400"):
        browsers.append(
            subprocess.Popen(
                [CHROMIUM, "--headless", "--no-sandbox", *WEBGL,
                 "--remote-debugging-port=0", f"--user-data-dir={profile}",
                 f"--window-size={size}", url],
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )
        )  # fmt: skip
        port = profile / "DevToolsActivePort"
        wait_for(lambda: port.exists() and port.read_text())
        address = f"http://127.0.0.1:{port.read_text().split()[0]}/json"
        targets = json.loads(urllib.request.urlopen(address, timeout=30).read())
        (target,) = (one for one in targets if one["type"] == "page")
        with client.connect(target["webSocketDebuggerUrl"], max_size=None) as socket:

            def told(method: str, **params) -> dict:
                socket.send(json.dumps({"id": 0, "method": method, "params": params}))
                return json.loads(socket.recv(timeout=60))["result"]

            try:
                while True:
                    data = base64.b64decode(told("Page.captureScreenshot")["data"])
                    picture = cv2.imdecode(np.frombuffer(data, np.uint8), 1)[..., ::-1]
                    script = yield picture
                    if script is not None:
                        told("Runtime.evaluate", expression=script)
            finally:
                browsers[-1].kill()

    yield look
    for browser in browsers:
        browser.kill()
        browser.wait()


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_page_asks_the_network_for_nothing(ply, tmp_path, capsys):
    """And would be found to if it did."""
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    out, elsewhere = tmp_path / "a.html", "http://127.0.0.1:9/a.png"
    assert main.main(["view", str(ply), "--html", str(out)]) == 0
    capsys.readouterr()
    html, asked = opened(out.as_uri(), tmp_path)
    assert "<canvas" in html, "it has run"
    assert asked == []
    script = f"<script>new Image().src = '{elsewhere}'</script>"
    out.write_text(out.read_text().replace("<head>", f"<head>{script}", 1))
    assert opened(out.as_uri(), tmp_path)[1] == [elsewhere]


def shell_and_core():
    """An opaque orange sphere with a green one in it, in the file before and after."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(1200, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    shell = np.arange(1200) // 300 % 2 == 0
    colours = np.where(shell[:, None], [0.9, 0.5, 0.1], [0.1, 0.9, 0.2])
    return gsjax.make_gaussians(
        means=direction * np.where(shell, 1.0, 0.6)[:, None],
        quats=np.tile([1.0, 0, 0, 0], (1200, 1)),
        log_scales=np.full((1200, 3), np.log(0.08)),
        logit_opacities=np.full(1200, 6.0),
        sh=np.asarray(rgb_to_dc(colours))[:, None],
    )


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_page_from_a_disk_shows_what_is_before(tmp_path, capsys, pictures_of_page):
    """Nothing of the core, once the page has sorted its splats."""
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    ply, out = tmp_path / "a.ply", tmp_path / "a.html"
    gsjax.save(ply, shell_and_core())
    assert main.main(["view", str(ply), "--html", str(out)]) == 0
    capsys.readouterr()
    # The page loads and sorts its splats in workers, in its own time.
    pictures, deadline = pictures_of_page(out.as_uri()), time.monotonic() + 120
    shell, core = 0.0, 1.0
    while (shell < 0.02 or core > 0.01 * shell) and time.monotonic() < deadline:
        red, green, blue = np.moveaxis(next(pictures).astype(float), -1, 0)
        shell = ((red > 60) & (red > 1.3 * green) & (green > 1.5 * blue)).mean()
        core = ((green > 60) & (green > 1.3 * red)).mean()
    assert shell >= 0.02
    assert core <= 0.01 * shell


ORANGE, BLUE = np.array([0.9, 0.5, 0.1]), np.array([0.1, 0.3, 0.9])
MAGENTA = np.array([0.9, 0.1, 0.9])


def orange_but_blue_from(eye) -> gsjax.Gaussians:
    """A ball: orange where SH are of degree 0, and with degree 1 blue from there."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(1000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    x, y, z = (direction - eye).T / np.linalg.norm(direction - eye, axis=1)
    sh = np.zeros((1000, 4, 3))
    sh[:, 0] = rgb_to_dc(ORANGE)
    sh[:, 1:] = np.stack([-y, z, -x], -1)[..., None] * (BLUE - ORANGE) / 0.4886025
    return gsjax.make_gaussians(
        means=direction,
        quats=np.tile([1.0, 0, 0, 0], (1000, 1)),
        log_scales=np.full((1000, 3), np.log(0.1)),
        logit_opacities=np.full(1000, 6.0),
        sh=sh,
    )


def share_of(color, page) -> float:
    """Of the pixels: those of about this colour."""
    return float((np.abs(page - 255 * color).max(-1) < 40).mean())


def first_with(color, pictures) -> np.ndarray:
    """The first of them with much of this colour: the browser takes its time."""
    end = time.monotonic() + 120
    for page in pictures:
        if share_of(color, page) > 0.1:
            return page
        assert time.monotonic() < end, f"{color} is not seen"
    raise AssertionError("no picture")


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_browser_shows_the_splats_and_then_our_own_picture(
    tmp_path, pictures_of_page
):
    """`gsjax view PLY`, and a click on *Render*, which shows what viser cannot."""
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    from gsjax.viewer.opening import open_exhibit
    from gsjax.viewer.window import Window

    eye = eye_of_gaussians(orange_but_blue_from(np.zeros(3)), UPS["-y"]).position
    gsjax.save(tmp_path / "a.ply", orange_but_blue_from(eye))
    exhibit = open_exhibit(tmp_path / "a.ply").exhibit
    exhibit.renderer.config = exhibit.renderer.config.replace(**LIGHT)
    window = Window(exhibit, port=8590)
    try:
        pictures = pictures_of_page(window.url, "900,600")
        splats = first_with(ORANGE, pictures)
        assert share_of(BLUE, splats) < 0.01
        (session,) = window.sessions.values()
        session.height.value = "270"
        pictures.send(
            "[...document.querySelectorAll('button')]"
            ".find((button) => button.textContent.trim() == 'Render').click()"
        )
        shown = first_with(BLUE, pictures)
        eye, width = session.client.camera, round(270 * session.client.camera.aspect)
        camera = camera_of(eye.wxyz, eye.position, eye.fov, width, 270)
        ours = picture(exhibit.renderer(exhibit.gaussians, camera), "rgb")[0]
    finally:
        window.close()
    ours = cv2.resize(ours, shown.shape[1::-1]).astype(float)
    # The panel lies over a part of the ball; half of its pixels are seen at least.
    ball = np.abs(ours - 255 * BLUE).max(-1) < 40
    assert 0.1 < ball.mean() < 0.9
    assert np.median(np.abs(shown - ours)[ball]) < 4
    assert np.median(np.abs(splats - ours)[ball]) > 40


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_photograph_does_not_hide_what_is_seen_from_its_camera(pictures_of_page):
    """*Go to* a camera of a ball, from where its photograph is seen."""
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    from gsjax.viewer.opening import _exhibit
    from gsjax.viewer.window import Window

    photo = np.full((12, 16, 3), 255 * MAGENTA, np.uint8)
    places = [(3 * np.sin(a), 0.0, -3 * np.cos(a)) for a in (0.0, 0.6, 1.2)]
    frusta = [
        Frustum(str(i), gsjax.look_at(place, (0, 0, 0), (0, -1, 0)), 1.0, 4 / 3, photo)
        for i, place in enumerate(places)
    ]
    renderer = ExactRenderer(gsjax.RasterConfig(**LIGHT), (0, 0, 0))
    window = Window(_exhibit(shell_and_core(), renderer, frusta, None), port=8690)
    try:
        pictures = pictures_of_page(window.url, "900,600")
        first_with(ORANGE, (page[:, :550] for page in pictures))
        assert share_of(MAGENTA, next(pictures)[:, :550]) > 0.001
        (session,) = window.sessions.values()
        session.go_to.value = frusta[0].name
        # The panel, at the right, has the photograph from now on.
        end, page = time.monotonic() + 60, next(pictures)
        while share_of(MAGENTA, page) > 1e-4 or share_of(ORANGE, page) < 0.2:
            assert time.monotonic() < end, "the photograph hides the view"
            page = next(pictures)[:, :550]
    finally:
        window.close()


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_training_is_seen_while_it_goes_on(tmp_path, monkeypatch, pictures_of_page):
    """`gsjax train --viewer`: before its last step a browser draws the Gaussians, of a
    colour that nothing else there has; it ends when the browser has gone.
    """
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    from gsjax.viewer.live import LiveViewer

    begin, stay, pages, seen = LiveViewer.begin, LiveViewer.stay, [], []

    def begin_and_look(viewer, *args):
        show = begin(viewer, *args)

        def after_step(state, progress):
            show(state, progress)
            seen.append(f"step {progress.metrics.step}")
            if not pages:
                pages.append(pictures_of_page(viewer.window.url, "900,600"))
                first_with(MAGENTA, pages[0])
                seen.append("Gaussians")

        return after_step

    def leave():
        seen.append("nobody")
        pages[0].close()

    def stay_a_second(viewer):
        threading.Timer(1.0, leave).start()
        stay(viewer)
        seen.append("the end")

    monkeypatch.setattr(LiveViewer, "begin", begin_and_look)
    monkeypatch.setattr(LiveViewer, "stay", stay_a_second)
    opaque = AdaptiveSettings(initial_opacity=0.9, max_gaussians=64)
    config = TrainConfig(steps=2, sh_degree=0, max_size=32, adaptive=opaque,
                         raster=training.RASTER)  # fmt: skip
    colors = np.tile(np.uint8(255 * MAGENTA), (training.POINTS, 1))
    run = run_at(tmp_path, config, colors=colors)
    args = ["train", str(tmp_path / "data"), "-o", str(run), "--resume", "--viewer"]
    assert main.main([*args, "--viewer-port", "8690"]) == 0
    assert seen == ["step 1", "Gaussians", "step 2", "nobody", "the end"]
