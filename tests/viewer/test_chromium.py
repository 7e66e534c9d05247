"""The viewer in headless Chromium; skipped where it is not installed."""

import time

import numpy as np
import pytest
from conftest import LIGHT
from viewing import CHROMIUM, page_requests, scene, screenshots

import gsjax
from gsjax.cli.main import main
from gsjax.math.sh import rgb_to_dc
from gsjax.viewer.cameras import UPS, viewpoint_of_gaussians
from gsjax.viewer.opening import load_content
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


def test_a_page_from_a_disk_sorts_its_splats(tmp_path, capsys):
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

    pages = screenshots(out.as_uri(), tmp_path / "profile")
    first_where(sorted_, pages)
    pages.close()


def test_a_browser_shows_the_splats_and_then_an_exact_image(tmp_path):
    """A click on *Render* shows the harmonics that viser cannot."""
    far = sphere(1000, 0.1, sh=lambda direction: np.zeros((len(direction), 1, 3)))
    position = viewpoint_of_gaussians(far, UPS["-y"]).position
    gsjax.save(tmp_path / "a.ply", orange_but_blue_from(position))
    content = load_content(tmp_path / "a.ply").content
    content.renderer.config = content.renderer.config.replace(**LIGHT)
    server = ViewerServer(content, port=8590)
    pages = screenshots(server.url, tmp_path / "profile", "900,600")
    try:
        splats = first_where(lambda page: share_of(ORANGE, page) > 0.1, pages)
        assert share_of(BLUE, splats) < 0.01
        (session,) = server.sessions.values()
        session.height.value = "270"
        pages.send(
            "[...document.querySelectorAll('button')]"
            ".find((button) => button.textContent.trim() == 'Render').click()"
        )
        first_where(lambda page: share_of(BLUE, page) > 0.1, pages)
    finally:
        pages.close()
        server.close()
