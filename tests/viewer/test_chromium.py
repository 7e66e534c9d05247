"""The viewer in headless Chromium; skipped where it is not installed."""

import contextlib
import http.server
import threading
from collections.abc import Iterator

import jax
import numpy as np
import pytest
from conftest import LIGHT
from viewing import CHROMIUM, page_requests, screenshots, wait_for

import gsjax
from gsjax.cli.main import main
from gsjax.math.sh import rgb_to_dc
from gsjax.viewer.cameras import UPS, viewpoint_of_gaussians
from gsjax.viewer.opening import load_content
from gsjax.viewer.page import write_page
from gsjax.viewer.server import ViewerServer

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium"),
]
pytest.importorskip("viser", reason="needs gsjax[viewer]")
ORANGE, BLUE = np.array([0.9, 0.5, 0.1]), np.array([0.1, 0.3, 0.9])
GREEN = np.array([0.1, 0.9, 0.2])


def share_of(color, page) -> float:
    """Share of the pixels that have about this colour."""
    return float((np.abs(page - 255 * color).max(-1) < 40).mean())


def directions(count: int) -> np.ndarray:
    found = np.random.default_rng(0).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def opaque(means, size: float, sh) -> gsjax.Gaussians:
    """Opaque round Gaussians."""
    count = len(means)
    return gsjax.make_gaussians(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.full((count, 3), np.log(size)),
        logit_opacities=np.full(count, 6.0),
        sh=sh,
    )


def shell_and_core() -> gsjax.Gaussians:
    """An orange sphere around a green one, in mixed order in the file."""
    shell = np.arange(1200)[:, None] // 300 % 2 == 0
    sh = np.asarray(rgb_to_dc(np.where(shell, ORANGE, GREEN)))[:, None]
    return opaque(directions(1200) * np.where(shell, 1.0, 0.6), 0.08, sh)


def orange_but_blue_from(position) -> gsjax.Gaussians:
    """A ball: orange at SH degree 0, and with degree 1 blue from one position."""
    means = directions(1000)
    away = means - position
    x, y, z = away.T / np.linalg.norm(away, axis=1)
    sh = np.zeros((len(means), 4, 3))
    sh[:, 0] = rgb_to_dc(ORANGE)
    sh[:, 1:] = np.stack([-y, z, -x], -1)[..., None] * (BLUE - ORANGE) / 0.4886025
    return opaque(means, 0.1, sh)


def test_a_page_from_a_disk_makes_no_requests_and_sorts_its_splats(tmp_path, capsys):
    """Nothing of the core is visible in the end; a request that is added is found."""
    ply, out = tmp_path / "a.ply", tmp_path / "a.html"
    gsjax.save(ply, shell_and_core())
    assert main(["view", str(ply), "--html", str(out)]) == 0
    capsys.readouterr()
    html, asked = page_requests(out.as_uri(), tmp_path)
    assert "<canvas" in html, "the page has run"
    assert asked == []

    def sorted_(page) -> bool:
        red, green, blue = np.moveaxis(page.astype(float), -1, 0)
        shell = ((red > 60) & (red > 1.3 * green) & (green > 1.5 * blue)).mean()
        core = ((green > 60) & (green > 1.3 * red)).mean()
        return shell >= 0.02 and core <= 0.01 * shell

    pages = screenshots(out.as_uri(), tmp_path / "profile")
    wait_for(lambda: sorted_(next(pages)), 120)
    pages.close()
    elsewhere = "http://127.0.0.1:9/a.png"
    script = f"<script>new Image().src = '{elsewhere}'</script>"
    out.write_text(out.read_text().replace("<head>", f"<head>{script}", 1))
    assert page_requests(out.as_uri(), tmp_path)[1] == [elsewhere]


@contextlib.contextmanager
def halting(data: bytes, at: int) -> Iterator[tuple[str, threading.Event]]:
    """Serve a page: its address, and an event that the rest of its bytes awaits."""
    go_on = threading.Event()

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data[:at])
            if go_on.wait(120):
                self.wfile.write(data[at:])

        def log_message(self, format, *args):
            del format, args

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/", go_on
    finally:
        go_on.set()
        server.shutdown()
        server.server_close()


def test_a_page_shows_its_first_part_while_the_rest_loads(tmp_path):
    """A large orange ball, and then many small green Gaussians around it as well."""
    ball = directions(100) * 0.4
    ring = directions(900) * [1.0, 0.05, 1.0]
    sh = rgb_to_dc(np.repeat([ORANGE, GREEN], [100, 900], axis=0))[:, None]
    scene = opaque(np.concatenate([ball, ring]), 0.06, sh)
    logs = jax.numpy.log(np.repeat([0.2, 0.06], [100, 900])[:, None]) * np.ones(3)
    scene = scene.replace(params=scene.params.replace(log_scales=logs))
    gsjax.save(tmp_path / "a.ply", scene)
    content = load_content(tmp_path / "a.ply").content
    write_page(content, tmp_path / "a.html", title="ball", parts=2)
    data = (tmp_path / "a.html").read_bytes()
    first = data.index(b"<script>gsjaxParts.add(")
    with halting(data, first) as (address, go_on):
        pages = screenshots(address, tmp_path / "profile")
        wait_for(lambda: share_of(ORANGE, next(pages)) > 0.02, 120)
        assert share_of(GREEN, next(pages)) == 0
        go_on.set()
        wait_for(lambda: share_of(GREEN, next(pages)) > 0.01, 120)
        assert share_of(ORANGE, next(pages)) > 0.02
        pages.close()


def test_a_browser_shows_the_splats_and_then_an_exact_image(tmp_path):
    """A click on *Render* shows the harmonics that viser cannot."""
    ball = opaque(directions(1000), 0.1, np.zeros((1000, 1, 3)))
    position = viewpoint_of_gaussians(ball, UPS["-y"]).position
    gsjax.save(tmp_path / "a.ply", orange_but_blue_from(position))
    content = load_content(tmp_path / "a.ply").content
    content.renderer.config = content.renderer.config.replace(**LIGHT)
    server = ViewerServer(content, port=8590)
    pages = screenshots(server.url, tmp_path / "profile", "900,600")
    try:
        wait_for(lambda: share_of(ORANGE, next(pages)) > 0.1, 120)
        assert share_of(BLUE, next(pages)) < 0.01
        (session,) = server.sessions.values()
        session.height.value = "270"
        pages.send(
            "[...document.querySelectorAll('button')]"
            ".find((button) => button.textContent.trim() == 'Render').click()"
        )
        wait_for(lambda: share_of(BLUE, next(pages)) > 0.1, 120)
    finally:
        pages.close()
        server.close()
