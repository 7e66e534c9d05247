"""The viewer in headless Chromium; skipped where it is not installed."""

import threading
import time

import cv2
import numpy as np
import pytest
import training
from conftest import LIGHT
from viewing import CHROMIUM, page_requests, run_at, scene, screenshots

import gsjax
from gsjax.cli.main import main
from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.math.sh import rgb_to_dc
from gsjax.train.config import TrainConfig
from gsjax.viewer.cameras import UPS, Frustum, viewpoint_of_gaussians
from gsjax.viewer.exact import ExactRenderer, camera_of, picture
from gsjax.viewer.live import LiveViewer
from gsjax.viewer.opening import load_content, make_content
from gsjax.viewer.server import ViewerServer

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium"),
]
pytest.importorskip("viser", reason="needs gsjax[viewer]")
ORANGE, BLUE = np.array([0.9, 0.5, 0.1]), np.array([0.1, 0.3, 0.9])
GREEN, MAGENTA = np.array([0.1, 0.9, 0.2]), np.array([0.9, 0.1, 0.9])


@pytest.fixture
def look(tmp_path):
    """A function that opens a page and yields screenshots of it."""
    opened = []

    def look(url: str, size: str = "500,400"):
        opened.append(screenshots(url, tmp_path / f"profile{len(opened)}", size))
        return opened[-1]

    yield look
    for pages in opened:
        pages.close()


def share_of(color, page) -> float:
    """Share of the pixels that have about this colour."""
    return float((np.abs(page - 255 * color).max(-1) < 40).mean())


def first_where(condition, pages) -> np.ndarray:
    """The first screenshot that meets a condition: the browser takes its time."""
    end = time.monotonic() + 120
    for page in pages:
        if condition(page):
            return page
        assert time.monotonic() < end
    raise AssertionError("no picture")


def test_a_page_makes_no_requests(tmp_path, capsys):
    """A request that is added is found, too."""
    ply, out = tmp_path / "a.ply", tmp_path / "a.html"
    gsjax.save(ply, scene())
    assert main(["view", str(ply), "--html", str(out)]) == 0
    capsys.readouterr()
    html, asked = page_requests(out.as_uri(), tmp_path)
    assert "<canvas" in html, "the page has run"
    assert asked == []
    elsewhere = "http://127.0.0.1:9/a.png"
    script = f"<script>new Image().src = '{elsewhere}'</script>"
    out.write_text(out.read_text().replace("<head>", f"<head>{script}", 1))
    assert page_requests(out.as_uri(), tmp_path)[1] == [elsewhere]


def sphere(count: int, size: float, radii=1.0, **fields) -> gsjax.Gaussians:
    """Opaque Gaussians on spheres."""
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    fields = {name: value(direction) for name, value in fields.items()}
    return gsjax.make_gaussians(
        means=direction * np.reshape(radii, (-1, 1)),
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.full((count, 3), np.log(size)),
        logit_opacities=np.full(count, 6.0),
        **fields,
    )


def shell_and_core() -> gsjax.Gaussians:
    """An orange sphere around a green one, in mixed order in the file."""
    shell = np.arange(1200) // 300 % 2 == 0
    colors = np.where(shell[:, None], ORANGE, GREEN)
    sh = np.asarray(rgb_to_dc(colors))[:, None]
    return sphere(1200, 0.08, np.where(shell, 1.0, 0.6), sh=lambda _: sh)


def orange_but_blue_from(position) -> gsjax.Gaussians:
    """A ball: orange at SH degree 0, and with degree 1 blue from one position."""

    def harmonics(direction):
        away = direction - position
        x, y, z = away.T / np.linalg.norm(away, axis=1)
        sh = np.zeros((len(direction), 4, 3))
        sh[:, 0] = rgb_to_dc(ORANGE)
        sh[:, 1:] = np.stack([-y, z, -x], -1)[..., None] * (BLUE - ORANGE) / 0.4886025
        return sh

    return sphere(1000, 0.1, sh=harmonics)


def test_a_page_from_a_disk_sorts_its_splats(tmp_path, capsys, look):
    """Nothing of the core is visible in the end."""
    ply, out = tmp_path / "a.ply", tmp_path / "a.html"
    gsjax.save(ply, shell_and_core())
    assert main(["view", str(ply), "--html", str(out)]) == 0
    capsys.readouterr()

    def sorted_(page) -> bool:
        red, green, blue = np.moveaxis(page.astype(float), -1, 0)
        shell = ((red > 60) & (red > 1.3 * green) & (green > 1.5 * blue)).mean()
        core = ((green > 60) & (green > 1.3 * red)).mean()
        return shell >= 0.02 and core <= 0.01 * shell

    first_where(sorted_, look(out.as_uri()))


def test_a_browser_shows_the_splats_and_then_an_exact_image(tmp_path, look):
    """A click on *Render* shows the harmonics that viser cannot."""
    position = viewpoint_of_gaussians(
        orange_but_blue_from(np.zeros(3)), UPS["-y"]
    ).position
    gsjax.save(tmp_path / "a.ply", orange_but_blue_from(position))
    content = load_content(tmp_path / "a.ply").content
    content.renderer.config = content.renderer.config.replace(**LIGHT)
    server = ViewerServer(content, port=8590)
    try:
        pages = look(server.url, "900,600")
        splats = first_where(lambda page: share_of(ORANGE, page) > 0.1, pages)
        assert share_of(BLUE, splats) < 0.01
        (session,) = server.sessions.values()
        session.height.value = "270"
        pages.send(
            "[...document.querySelectorAll('button')]"
            ".find((button) => button.textContent.trim() == 'Render').click()"
        )
        shown = first_where(lambda page: share_of(BLUE, page) > 0.1, pages)
        seen = session.client.camera
        width = round(270 * seen.aspect)
        camera = camera_of(seen.wxyz, seen.position, seen.fov, width, 270)
        ours = picture(content.renderer(content.gaussians, camera), "rgb")[0]
    finally:
        server.close()
    ours = cv2.resize(ours, shown.shape[1::-1]).astype(float)
    # The panel covers a part of the ball; at least half of its pixels are visible.
    ball = np.abs(ours - 255 * BLUE).max(-1) < 40
    assert 0.1 < ball.mean() < 0.9
    assert np.median(np.abs(shown - ours)[ball]) < 4
    assert np.median(np.abs(splats - ours)[ball]) > 40


def test_a_photograph_does_not_cover_the_view_of_its_camera(look):
    """*Go to* a camera from where its photograph is visible."""
    photo = np.full((12, 16, 3), 255 * MAGENTA, np.uint8)
    places = [(3 * np.sin(a), 0.0, -3 * np.cos(a)) for a in (0.0, 0.6, 1.2)]
    frusta = [
        Frustum(str(i), gsjax.look_at(place, (0, 0, 0), (0, -1, 0)), 1.0, 4 / 3, photo)
        for i, place in enumerate(places)
    ]
    renderer = ExactRenderer(gsjax.RasterConfig(**LIGHT), (0, 0, 0))
    server = ViewerServer(make_content(shell_and_core(), renderer, frusta), port=8690)
    try:
        # The panel at the right shows the photograph later.
        pages = (page[:, :550] for page in look(server.url, "900,600"))
        first_where(lambda page: share_of(ORANGE, page) > 0.1, pages)
        assert share_of(MAGENTA, next(pages)) > 0.001
        (session,) = server.sessions.values()
        session.go_to.value = frusta[0].name
        first_where(
            lambda page: (
                share_of(MAGENTA, page) < 1e-4 and share_of(ORANGE, page) > 0.2
            ),
            pages,
        )
    finally:
        server.close()


def test_a_training_is_visible_while_it_runs(tmp_path, monkeypatch, look):
    """`gsjax train --viewer`: a browser draws the Gaussians, in a unique colour, before
    the last step; the command ends when the browser has gone.
    """
    begin, wait, pages, events = LiveViewer.begin, LiveViewer.wait_for_browsers, [], []

    def begin_and_look(viewer, *args):
        show = begin(viewer, *args)

        def after_step(state, progress):
            show(state, progress)
            events.append(f"step {progress.metrics.step}")
            if not pages:
                pages.append(look(viewer.server.url, "900,600"))
                first_where(lambda page: share_of(MAGENTA, page) > 0.1, pages[0])
                events.append("Gaussians")

        return after_step

    def leave():
        events.append("left")
        pages[0].close()

    def wait_a_second(viewer):
        threading.Timer(1.0, leave).start()
        wait(viewer)
        events.append("end")

    monkeypatch.setattr(LiveViewer, "begin", begin_and_look)
    monkeypatch.setattr(LiveViewer, "wait_for_browsers", wait_a_second)
    opaque = AdaptiveSettings(initial_opacity=0.9, max_gaussians=64)
    config = TrainConfig(steps=2, sh_degree=0, max_size=32, adaptive=opaque,
                         raster=training.RASTER)  # fmt: skip
    colors = np.tile(np.uint8(255 * MAGENTA), (training.POINTS, 1))
    run = run_at(tmp_path, config, colors=colors)
    args = ["train", str(tmp_path / "data"), "-o", str(run), "--resume", "--viewer"]
    assert main([*args, "--viewer-port", "8690"]) == 0
    assert events == ["step 1", "Gaussians", "step 2", "left", "end"]
