"""The viewer: the browser's numbers, our picture for its camera, pages, live runs."""

import base64
import contextlib
import json
import logging
import re
import shutil
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.request

import cv2
import jax
import numpy as np
import pytest
import training
from conftest import LIGHT, frustum_points, gaussians_at

import gsjax
from gsjax import cli
from gsjax.errors import InputError
from gsjax.rotations import covariance, quaternion_to_matrix
from gsjax.scene.types import Photo
from gsjax.sh import rgb_to_dc
from gsjax.train.config import TrainConfig
from gsjax.train.fit import Progress, initial_state
from gsjax.train.step import Metrics
from gsjax.viewer.exact import ExactRenderer, camera_of, picture
from gsjax.viewer.splats import (
    LEAST_OPACITY,
    Cut,
    longest_axes,
    most_important,
    opacities_of,
    pack,
    within,
)
from gsjax.viewer.stage import (
    UPS,
    eye_of_cameras,
    eye_of_gaussians,
    frusta_of,
    open_server,
    stop_server,
)

COUNT = 64


def wait_for(condition, seconds=30.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def scene(spread=1.0, degree=1):
    """Gaussians of all sizes and opacities, orange, as large as ``spread``."""
    rng = np.random.default_rng(0)
    points = spread * frustum_points(rng, COUNT)
    scales = spread * np.exp(rng.normal(-2.0, 0.7, (COUNT, 3)))
    found = gaussians_at(points, scales, rng.uniform(0.02, 0.99, COUNT), degree=degree,
                         viewmat=np.eye(4))  # fmt: skip
    sh = np.zeros_like(found.params.sh)
    sh[:, 0] = (np.array([0.9, 0.5, 0.1]) - 0.5) / 0.28209479177387814
    return found.replace(params=found.params.replace(sh=jax.numpy.asarray(sh)))


# --- numbers ---


@pytest.mark.parametrize("spread", [1e-4, 1.0, 1e5])
def test_half_precision_holds_a_scene_of_any_size(spread):
    gaussians = scene(spread)
    splats = pack(gaussians, within(gaussians, Cut()))
    scales = np.exp(gaussians.params.log_scales)
    wanted = np.asarray(covariance(gaussians.params.quats, scales))
    stored = splats.covariances.astype(np.float16).astype(float) * splats.scale**2
    largest = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(stored / largest, wanted / largest, atol=1e-3)
    means = np.asarray(gaussians.params.means)
    np.testing.assert_allclose(splats.centers * splats.scale, means, rtol=1e-5)
    np.testing.assert_allclose(splats.rgbs, [[0.9, 0.5, 0.1]] * COUNT, atol=1e-6)
    np.testing.assert_allclose(
        splats.opacities[:, 0], opacities_of(gaussians), rtol=1e-6
    )


def test_giants_are_cut_and_do_not_starve_the_others():
    gaussians = scene()
    logs = gaussians.params.log_scales.at[0].set(np.log(1e9))
    giant = gaussians.replace(params=gaussians.params.replace(log_scales=logs))
    splats = pack(giant, within(giant, Cut()))
    stored = splats.covariances.astype(np.float16)
    assert np.isfinite(stored).all()
    assert (np.trace(stored[1:], axis1=1, axis2=2) > 0).all()


def test_what_is_not_there_is_not_shown():
    gaussians = scene()
    params, active = gaussians.params, np.ones(COUNT, bool)
    active[0] = False
    params = params.replace(
        means=params.means.at[1, 2].set(np.nan),
        log_scales=params.log_scales.at[2].set(np.inf),
        logit_opacities=params.logit_opacities.at[3].set(np.nan).at[4].set(-9.0),
        quats=params.quats.at[5].set(0.0),
    )
    broken = gaussians.replace(params=params, active=jax.numpy.asarray(active))
    shown = within(broken, Cut())
    assert list(np.flatnonzero(~shown)) == [0, 1, 2, 3]
    splats = pack(broken, shown)
    assert len(splats.centers) == COUNT - 5  # nor what is never drawn
    assert all(np.isfinite(each).all() for each in splats)
    assert splats.opacities.min() >= LEAST_OPACITY


def test_cuts_and_thinning_keep_what_they_say():
    gaussians = scene()
    opacities, longest = opacities_of(gaussians), longest_axes(gaussians)
    half = float(np.median(longest))
    shown = within(gaussians, Cut(0.4, half))
    np.testing.assert_array_equal(shown, (opacities >= 0.4) & (longest <= half))
    kept = most_important(gaussians, shown, 5)
    assert kept.sum() == 5
    assert not (kept & ~shown).any()
    np.testing.assert_array_equal(most_important(gaussians, shown, COUNT), shown)
    # Of equal shapes the most opaque, of equal opacities the largest.
    logs = np.linspace(-5, 0, COUNT)
    flat = gaussians_at(frustum_points(np.random.default_rng(0), COUNT),
                        np.exp(logs)[:, None], 0.5)  # fmt: skip
    kept = most_important(flat, np.ones(COUNT, bool), 9)
    np.testing.assert_array_equal(np.flatnonzero(kept), np.arange(COUNT - 9, COUNT))


def test_the_camera_of_a_browser():
    wxyz, position = np.array([0.9, -0.2, 0.3, 0.1]), np.array([1.0, 2, 3])
    camera = camera_of(wxyz, position, 0.8, 40, 30)
    rotation = np.asarray(quaternion_to_matrix(wxyz))
    np.testing.assert_allclose(camera.viewmat[:3, :3], rotation.T, atol=1e-12)
    edge = position + rotation @ (0, -np.tan(0.4), 1)  # the middle of the upper edge
    local = camera.viewmat[:3, :3] @ edge + camera.viewmat[:3, 3]
    pixel = camera.K @ local
    np.testing.assert_allclose(pixel[:2] / pixel[2], (20, 0), atol=1e-9)


@pytest.mark.parametrize("up", UPS)
def test_where_one_looks_from(up):
    eye = eye_of_gaussians(scene(), UPS[up])
    means = np.asarray(scene().params.means)
    np.testing.assert_allclose(eye.target, np.median(means, axis=0), atol=1.0)
    assert (eye.position - eye.target) @ UPS[up] > 0
    if up in ("-y", "+y"):  # on the side from which COLMAP's, and OpenGL's, look
        assert (eye.position - eye.target)[2] * UPS[up][1] > 0
    frusta = frusta_of(training.scene().views)
    eye = eye_of_cameras(frusta)
    view = gsjax.look_at(eye.position, eye.target, eye.up)
    points = training.scene().points @ view[:3, :3].T + view[:3, 3]
    assert (points[:, 2] > 0).all()
    assert (np.abs(points[:, :2] / points[:, 2:]) < 1).all()


@pytest.mark.long
def test_exact_pictures_are_the_renderers():
    gaussians, background = scene(), (0.1, 0.2, 0.3)
    config = gsjax.RasterConfig(**LIGHT)
    renderer = ExactRenderer(config, background)
    camera = camera_of((1, 0, 0, 0), (0, 0, 0), 0.7, 32, 24)
    view = renderer(gaussians, camera)
    wanted = gsjax.reference_render(gaussians, camera, config, np.array(background))
    np.testing.assert_allclose(view.rgb, wanted["rgb"], atol=1e-6)
    for kind, image in (("rgb", wanted["rgb"]), ("alpha", wanted["alpha"][..., None])):
        pixels, what = picture(view, kind)
        assert what == kind
        np.testing.assert_allclose(pixels / 255, image * np.ones(3), atol=0.51 / 255)
    pixels, what = picture(view, "depth")
    assert pixels.shape == (24, 32, 3)
    assert re.match(r"depth \d.* \(red\) to \d.* \(blue\)", what)


# --- the command ---


@pytest.fixture
def ply(tmp_path):
    path = tmp_path / "a.ply"
    gsjax.save(path, scene())
    return path


def test_without_viser_the_line_that_installs_it(ply, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    for args in (["view", str(ply)], ["train", "x", "-o", str(tmp_path), "--viewer"]):
        assert cli.main(args) == 6
        said = capsys.readouterr()
        assert said.out == ""
        assert "install it: pip install viser" in said.err


@pytest.mark.parametrize(
    "args", [["--min-opacity", "1"], ["--max-gaussians", "0"], ["--port", "0"],
             ["--up", "z"]],
)  # fmt: skip
def test_usage(ply, args, capsys):
    assert cli.main(["view", str(ply), *args]) == 2
    assert args[0] in capsys.readouterr().err


def splats_of(text: str) -> np.ndarray:
    """Packed splats [M, 8] of a page: the largest of its buffers, and the only one."""
    import msgspec
    import zstandard

    data = base64.b64decode(re.search(r'EMBED_DATA__="([^"]*)"', text)[1])
    inner = zstandard.ZstdDecompressor().decompressobj().decompress(data[8:])
    length = 8 + struct.unpack("<Q", inner[:8])[0]
    told = msgspec.msgpack.decode(inner[8:length])
    kinds = [message["type"] for _, message in told["messages"]]
    assert kinds.count("GaussianSplatsMessage") == 1
    assert "BackgroundImageMessage" in kinds
    (size,) = told["binaryBufferLengths"]
    return np.frombuffer(inner[len(inner) - size :], np.uint32).reshape(-1, 8)


def test_a_page_holds_the_scene_and_needs_nothing_else(ply, tmp_path, capsys):
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    out = tmp_path / "new" / "a.html"
    assert cli.main(["view", str(ply), "--html", str(out)]) == 0
    size = out.stat().st_size / 2**20
    assert capsys.readouterr().out == f"{out}  {COUNT} Gaussians, {size:.2f} MiB\n"
    text = out.read_text()
    links = set(re.findall(r"(?:src|href)=.?https?://[^\"' ]+", text))
    assert not links
    assert "SH degree 0" in text
    packed = splats_of(text)
    rgb = packed[:, 7:].copy().view(np.uint8)[:, :3] / 255
    np.testing.assert_allclose(rgb, [[0.9, 0.5, 0.1]] * COUNT, atol=1 / 255)
    assert cli.main(["view", str(ply), "--html", str(out)]) == 3
    assert "exists" in capsys.readouterr().err
    args = ["--overwrite", "--max-gaussians", "20", "--min-opacity", "0.5"]
    assert cli.main(["view", str(ply), "--html", str(out), *args]) == 0
    assert f"20 of {COUNT} Gaussians" in capsys.readouterr().out
    args = ["--overwrite", "--min-opacity", "0.999"]
    assert cli.main(["view", str(ply), "--html", str(out), *args]) == 3
    assert "lower --min-opacity" in capsys.readouterr().err


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.fixture
def pictures_of_page(tmp_path):
    """A function: pictures [H, W, 3] of a page in Chromium, one after another.

    What is sent to it is a script, which the page runs before the next.
    """
    client = pytest.importorskip("websockets.sync.client", reason="needs viser")
    profile, browsers = tmp_path / "profile", []

    def look(url: str, size: str = "500,400"):
        browsers.append(
            subprocess.Popen(
                [CHROMIUM, "--headless", "--no-sandbox", "--use-angle=swiftshader",
                 "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
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

            while True:
                data = base64.b64decode(told("Page.captureScreenshot")["data"])
                picture = cv2.imdecode(np.frombuffer(data, np.uint8), 1)[..., ::-1]
                script = yield picture
                if script is not None:
                    told("Runtime.evaluate", expression=script)

    yield look
    for browser in browsers:
        browser.kill()
        browser.wait()


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
    assert cli.main(["view", str(ply), "--html", str(out)]) == 0
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


# --- live ---


ORANGE, BLUE = np.array([0.9, 0.5, 0.1]), np.array([0.1, 0.3, 0.9])


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


CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 0.0), "fov": 0.7, "image_height": 24,
    "image_width": 32, "near": 0.01, "far": 100.0, "look_at": (0.0, 0.0, 1.0),
    "up_direction": (0.0, -1.0, 0.0),
}  # fmt: skip


class Browser:
    """Connects as a browser does, says where its camera is, and draws nothing."""

    def __init__(self, url: str):
        import msgspec
        import viser
        from websockets.sync.client import connect

        self.socket = connect(
            url.replace("http", "ws"),
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=None,
        )
        self.socket.send(msgspec.msgpack.encode(CAMERA))
        self.reader = threading.Thread(target=lambda: list(self.socket), daemon=True)
        self.reader.start()

    def close(self) -> None:
        self.socket.close()
        self.reader.join(10)


@pytest.fixture
def window():
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    from gsjax.viewer.opening import _exhibit
    from gsjax.viewer.window import Window

    def render(gaussians, camera):
        calls.append((gaussians, camera))
        shape = (camera.height, camera.width)
        image = np.full((*shape, 3), 0.5)
        return gsjax.Render(**dict.fromkeys(gsjax.Render._fields))._replace(rgb=image)

    calls = []
    renderer = ExactRenderer(gsjax.RasterConfig(), (0, 0, 0))
    exhibit = _exhibit(scene(), renderer, frusta_of(training.scene().views), None)
    made = Window(exhibit, port=8190)
    render.background = (0, 0, 0)
    exhibit.renderer = render
    made.calls = calls
    yield made
    made.close()


def test_a_session_cuts_renders_and_moves(window):
    browser = Browser(window.url)
    wait_for(lambda: window.sessions and next(iter(window.sessions.values())).splats)
    session = next(iter(window.sessions.values()))
    assert session.splats.buffer.shape == (COUNT, 8)
    assert f"**{COUNT}** of {COUNT} Gaussians" in session.counts.content
    assert len(session.cameras) == 1 + training.VIEWS
    session.opacity.value = 0.5
    kept = int((opacities_of(scene()) >= 0.5).sum())
    wait_for(lambda: session.splats.buffer.shape == (kept, 8))
    assert not window.calls  # nothing was asked for
    session.height.value = "270"
    # What the browser first says of its camera may be heard after a render: the view
    # is uncovered then, as by any movement.
    wait_for(lambda: session.render() or session.covered)
    gaussians, camera = window.calls[-1]
    assert (camera.height, camera.width) == (270, 360)
    assert int(gaussians.active.sum()) == kept
    assert not session.splats.visible
    session.place.value = "in the panel"
    wait_for(lambda: session.pictures.visible)
    assert session.splats.visible
    assert not session.covered
    window.show(scene(2.0), "step 7 of 9")
    wait_for(lambda: "step 7 of 9" in session.counts.content)
    session._go(window.exhibit.frusta[2])
    np.testing.assert_allclose(
        session.client.camera.position, training.scene().views[2].centre, atol=1e-6
    )
    browser.close()
    wait_for(lambda: not window.watched)


@pytest.mark.timeout(60)  # viser would wait for ever
def test_where_nothing_can_be_listened_on():
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    for host in ("192.0.2.1", "no-such-host.invalid", "a..b"):
        with pytest.raises(InputError, match=f"{host}:8390: cannot be listened on"):
            open_server(host, 8390)
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # taken by somebody else
            stack.enter_context(socket.create_server(("127.0.0.1", 65535)))
        stack.enter_context(pytest.raises(InputError, match="no port from 65535 on"))
        open_server("127.0.0.1", 65535)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        server = open_server("127.0.0.1", port)
    assert server.get_port() > port
    stop_server(server)


def test_who_connects_and_goes_costs_no_line(monkeypatch, caplog):
    """As Chromium does before it asks, in case it will want more than one."""
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    logger = logging.getLogger("websockets.server")
    monkeypatch.setattr(logger, "filters", [])  # those of earlier servers
    told: list[logging.LogRecord] = []
    logger.addFilter(lambda record: told.append(record) is None)
    server = open_server("127.0.0.1", 8790)
    socket.create_connection(("127.0.0.1", server.get_port())).close()
    wait_for(lambda: told)
    stop_server(server)
    assert caplog.records == []


def test_a_training_is_shown_by_copies_of_its_own():
    pytest.importorskip("viser", reason="needs gsjax[viewer]")
    from gsjax.viewer.live import LiveViewer

    config = TrainConfig(steps=9, sh_degree=0, raster=training.RASTER)
    start, viewer = training.scene(), LiveViewer(port=8290)
    blank = np.zeros((training.HEIGHT, training.WIDTH, 3), np.uint8)
    photos = [Photo(blank, None, None, view.K) for view in start.views]
    hook = viewer.begin(start, photos, config)

    def after(step):
        """The hook, and then what the next step does to the state it was given."""
        state = initial_state(start, config)
        means = state.gaussians.params.means + step
        params = state.gaussians.params.replace(means=means)
        gaussians = state.gaussians.replace(params=params)
        kept = np.array(means)
        metrics = Metrics(*[0] * len(Metrics._fields))._replace(step=step)
        hook(state.replace(gaussians=gaussians), Progress(metrics, 0, 0, 0, 1, 64))
        np.testing.assert_array_equal(means, kept)
        jax.tree.map(lambda a: a.delete(), gaussians)
        return kept

    def shown():
        return np.asarray(viewer.window.exhibit.gaussians.params.means)

    first = after(1)
    after(2)  # it is too early: no copy
    np.testing.assert_array_equal(shown(), first)
    viewer.due = 0.0
    second = after(2)  # nobody looks: whoever comes then finds it
    np.testing.assert_array_equal(shown(), second)
    browser = Browser(viewer.window.url)
    wait_for(lambda: viewer.window.watched)
    viewer.due = time.monotonic() + 60
    after(3)  # too early again
    np.testing.assert_array_equal(shown(), second)
    viewer.due = 0.0
    fourth = after(4)
    np.testing.assert_array_equal(shown(), fourth)
    session = next(iter(viewer.window.sessions.values()))
    wait_for(lambda: "step 4 of 9" in session.counts.content)
    assert viewer.due > time.monotonic()
    last = after(9)  # the last is always shown
    np.testing.assert_array_equal(shown(), last)
    wait_for(lambda: "step 9 of 9" in session.counts.content)
    browser.close()
    viewer.stay()  # nobody looks any more
    viewer.close()
