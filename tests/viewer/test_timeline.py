"""The time of a scene that moves, in the panel of a browser and in a page."""

from functools import partial
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from viewing import CHROMIUM, Browser, screenshots, wait_for

import gsjax
from gsjax.math.sh import rgb_to_dc
from gsjax.train.models import SceneParams, init_model
from gsjax.train.motion.scene import MovingScene
from gsjax.train.motion.settings import TrajectorySettings
from gsjax.train.motion.trajectories import trajectory_model
from gsjax.train.optimiser import Rates
from gsjax.viewer.exact import ExactRenderer
from gsjax.viewer.opening import make_content
from gsjax.viewer.page import MOMENTS, write_page
from gsjax.viewer.server import ViewerServer
from gsjax.viewer.splats import Cut, within
from gsjax.viewer.timeline import Timeline, page_moments

pytest.importorskip("viser", reason="needs gsjax[viewer]")
pytestmark = pytest.mark.usefixtures("float32")
ORANGE, BLUE = np.array([0.9, 0.5, 0.1]), np.array([0.1, 0.3, 0.9])
STILL, MOVING = 300, 200


def moving_scene() -> MovingScene:
    """Return a still orange ball, and a blue one that goes from left to right."""
    rng, count = np.random.default_rng(0), STILL + MOVING
    directions = rng.normal(size=(count, 3))
    means = 0.4 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    means[STILL:, 1] += 0.9
    blue = np.arange(count)[:, None] >= STILL
    gaussians = gsjax.make_gaussians(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.full((count, 3), np.log(0.07)),
        logit_opacities=np.full(count, 6.0),
        sh=np.asarray(rgb_to_dc(np.where(blue, BLUE, ORANGE)))[:, None],
    )
    model = init_model(trajectory_model(TrajectorySettings(), Rates(), 5.0), gaussians)
    path = jnp.asarray(np.where(blue, [1.2, 0, 0], 0.0), jnp.float32)
    paths = (path, *model.slots["paths"][1:])
    buffers = {**model.buffers, "moving": jnp.asarray(blue[:, 0], jnp.float32)}
    model = model._replace(slots={**model.slots, "paths": paths}, buffers=buffers)
    return MovingScene("trajectories", SceneParams(gaussians, model))


def content_of(scene: MovingScene):
    renderer = ExactRenderer(gsjax.RasterConfig(), (0, 0, 0))
    content = make_content(scene.at(0.0), renderer, [])
    content.moving = scene
    return content


def test_what_stands_still_is_stored_once():
    still, moments = page_moments(moving_scene(), 3, partial(within, cut=Cut(0.01)))
    assert (len(still.centers), [len(m.centers) for m in moments]) == (
        STILL,
        3 * [MOVING],
    )
    places = [(m.centers * m.scale)[:, 0].mean() for m in moments]
    np.testing.assert_allclose(np.diff(places), [1.2, 1.2], rtol=1e-4)


class Panel:
    """Stands in for the panel of viser: a value that calls back when it is set."""

    class Input:
        def __init__(self, value):
            self._value, self.callbacks = value, []

        @property
        def value(self):
            return self._value

        @value.setter
        def value(self, value):
            self._value = value
            for call in self.callbacks:
                call(SimpleNamespace())

        def on_update(self, call):
            self.callbacks.append(call)

    def add_slider(self, name, **options):
        del name
        return self.Input(options["initial_value"])

    def add_checkbox(self, name, value, hint=""):
        del name, hint
        return self.Input(value)


def test_time_runs_while_it_plays_and_begins_again():
    shown = []
    timeline = Timeline(Panel(), shown.append)
    timeline.slider.value = 0.9
    assert shown == [0.9]
    timeline.play.value = True
    wait_for(lambda: len(shown) > 2 and min(shown[1:]) < 0.5)
    assert max(shown) <= 1
    timeline.play.value = False
    assert timeline.running is not None
    timeline.running.join(10)
    assert not timeline.running.is_alive()
    timeline.play.value = True
    timeline.close()
    timeline.running.join(10)
    assert not timeline.running.is_alive()


def test_the_slider_of_a_browser_moves_the_scene():
    server = ViewerServer(content_of(moving_scene()), port=8290)
    browser = Browser(server.url)
    try:
        wait_for(
            lambda: server.sessions and next(iter(server.sessions.values())).splats
        )
        (session,) = server.sessions.values()

        def mean() -> float:
            buffer = session.splats.buffer[:, :3].view(np.float32)
            return float((buffer * session.splats.scale)[STILL:, 0].mean())

        before = mean()
        session._show_time(1.0)
        wait_for(lambda: abs(mean() - before - 2.4) < 1e-3)
    finally:
        browser.close()
        server.close()


def test_a_page_holds_all_moments_and_a_slider(tmp_path):
    out = tmp_path / "page.html"
    page = write_page(content_of(moving_scene()), out, title="balls")
    text = out.read_text()
    assert page.moments == MOMENTS
    assert page.size == out.stat().st_size
    assert text.count('GaussianSplatsMessage\\"') == MOMENTS
    assert 'id="gsjax-slider"' in text


def blue_column(picture: np.ndarray) -> float:
    """Return the mean column of blue pixels; NaN if there are few."""
    red, _, blue = np.moveaxis(picture[:-60].astype(int), -1, 0)
    columns = np.nonzero(blue > red + 60)[1]
    return float(columns.mean()) if len(columns) > 50 else float("nan")


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
def test_the_slider_of_a_page_moves_the_scene(tmp_path):
    out = tmp_path / "page.html"
    write_page(content_of(moving_scene()), out, title="balls")
    pictures = screenshots(out.as_uri(), tmp_path / "profile")

    def column(script: str = "0", other: float = np.nan) -> float:
        """Wait until the picture is at rest, and other than before."""
        seen = [blue_column(pictures.send(script))]

        def rests() -> bool:
            seen.append(blue_column(next(pictures)))
            return len(set(seen[-4:])) == 1 and len(seen) > 4 and seen[-1] != other

        wait_for(rests, 60)
        return seen[-1]

    set_time = """{
        const slider = document.getElementById("gsjax-slider");
        slider.value = %s;
        slider.dispatchEvent(new Event("input"));
    }"""
    try:
        next(pictures)
        first = column()
        last = column(set_time % 1, other=first)
        middle = column(set_time % 0.5, other=last)
    finally:
        pictures.close()
    assert abs(last - first) > 30
    np.testing.assert_allclose(middle, (first + last) / 2, atol=0.1 * abs(last - first))
