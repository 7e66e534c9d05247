"""Sessions of browsers, the server, and the live view of a training."""

import contextlib
import logging
import socket
import threading
import time
from unittest.mock import Mock

import jax
import numpy as np
import pytest
import training
from viewing import COUNT, Browser, scene, wait_for

import gsjax
from gsjax.cli.main import main
from gsjax.data.types import Photo
from gsjax.errors import InputError
from gsjax.math.rotations import quaternion_to_matrix
from gsjax.mesh import Mesh
from gsjax.runs.folder import run_files
from gsjax.runs.run import RunResult
from gsjax.train.config import TrainConfig
from gsjax.train.initialisation import initial_state
from gsjax.train.loop import Progress
from gsjax.train.state import Metrics
from gsjax.viewer.cameras import frusta_of, photo_distances
from gsjax.viewer.exact import ExactRenderer
from gsjax.viewer.opening import make_content
from gsjax.viewer.server import ViewerServer
from gsjax.viewer.splats import MANY, MIN_DRAWN_OPACITY, longest_axes, opacities_of
from gsjax.viewer.viser_server import open_server, stop_server

pytest.importorskip("viser", reason="needs gsjax[viewer]")


def grey(_, camera):
    """Return a grey image, as an `ExactRenderer` would."""
    image = np.full((camera.height, camera.width, 3), 0.5)
    return gsjax.Render(**dict.fromkeys(gsjax.Render._fields))._replace(rgb=image)


@pytest.fixture(scope="module")
def running():
    """One server for the module."""
    views = training.dataset().views
    renderer = ExactRenderer(gsjax.RasterConfig(), (0, 0, 0))
    server = ViewerServer(make_content(scene(), renderer, frusta_of(views)), port=8190)
    yield server
    server.close()


@pytest.fixture
def server(running):
    """The server with its first content, and no browser."""
    content = running.content
    content.gaussians = scene()
    content.renderer = Mock(side_effect=grey, background=(0, 0, 0))
    content.frusta, content.status = frusta_of(training.dataset().views), ""
    content.min_opacity = 0.0
    yield running
    wait_for(lambda: not running.has_browsers)


def session_of(server):
    """The session of its only browser, once Gaussians are sent."""
    wait_for(lambda: server.sessions and next(iter(server.sessions.values())).splats)
    return next(iter(server.sessions.values()))


@pytest.fixture
def joined(server):
    """A browser that is connected to the server, and its session."""
    browser = Browser(server.url)
    yield browser, session_of(server)
    browser.close()


def sent_means(session) -> np.ndarray:
    return session.splats.buffer[:, :3].view(np.float32) * session.splats.scale


def test_a_mesh_is_shown_first_and_splats_on_demand(server):
    pytest.importorskip("trimesh")
    corners, faces = (
        np.eye(4, 3),
        np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]),
    )
    server.content.mesh = Mesh(corners, faces, np.full((4, 3), 0.5))
    browser = Browser(server.url)
    try:
        session = session_of(server)
        assert (session.mesh.visible, session.splats.visible) == (True, False)
        session.choice.value = "splats and mesh"
        session._choose()
        assert (session.mesh.visible, session.splats.visible) == (True, True)
        session._cover(np.zeros((2, 2, 3), np.uint8))
        assert (session.mesh.visible, session.splats.visible) == (False, False)
    finally:
        server.content.mesh = None
        browser.close()


def test_a_browser_first_receives_the_most_important_part(server):
    """Only of a large scene, and once."""
    count = MANY + 7
    rng = np.random.default_rng(0)
    large = gsjax.make_gaussians(
        means=rng.normal(size=(count, 3)),
        quats=rng.normal(size=(count, 4)),
        log_scales=rng.normal(-4, 1, (count, 3)),
        logit_opacities=rng.normal(size=count),
        sh=np.zeros((count, 1, 3)),
    )
    drawn = int((opacities_of(large) >= MIN_DRAWN_OPACITY).sum())
    server.content.gaussians = large
    browser = Browser(server.url)
    try:
        wait_for(lambda: drawn in browser.splat_counts())
        assert browser.splat_counts() == [round(0.1 * drawn), drawn]
        server.show(scene())
        wait_for(lambda: len(browser.splat_counts()) == 3)
        server.show(large)
        wait_for(lambda: len(browser.splat_counts()) == 4)
        assert browser.splat_counts()[3] == drawn
    finally:
        browser.close()


def test_an_image_is_over_the_view_or_in_the_panel(server, joined):
    _, session = joined
    session.height.value = "270"
    # The first message of the browser about its camera may arrive after a render, and
    # uncovers the view as any movement does.
    wait_for(lambda: session.render() or session.covered)
    _, camera = server.content.renderer.call_args.args
    assert (camera.height, camera.width) == (270, 360)
    assert not session.splats.visible
    session.place.value = "in the panel"
    wait_for(lambda: session.pictures.visible)
    assert session.splats.visible
    assert not session.covered


def test_a_click_on_a_camera_moves_there_and_shows_its_photograph(server, joined):
    browser, session = joined
    views = training.dataset().views

    def is_at(view) -> bool:
        camera = session.client.camera
        turn = np.asarray(quaternion_to_matrix(camera.wxyz))
        half = view.height / 2 / view.K[1, 1]
        return (
            np.allclose(camera.position, view.centre, atol=1e-6)
            and np.allclose(turn, view.viewmat[:3, :3].T, atol=1e-6)
            and np.isclose(np.tan(camera.fov / 2), half)
        )

    browser.click(session, "/cameras/0003")
    wait_for(lambda: is_at(views[3]))
    assert session.photo is None
    flat = [np.full((24, 32, 3), 60 * index, np.uint8) for index in range(len(views))]
    photos = [Photo(pixels, None, None, views[0].K) for pixels in flat]
    server.show_cameras(frusta_of(views, photos))
    wait_for(lambda: not server.busy)
    browser.click(session, "/cameras/0002")
    wait_for(lambda: session.photo and session.photo.label == views[2].name)
    assert is_at(views[2])
    first = session.photo
    np.testing.assert_array_equal(first.image, flat[2])
    session.go_to.value = views[1].name
    wait_for(lambda: session.photo.label == views[1].name)
    assert is_at(views[1])
    assert session.photo is first
    np.testing.assert_array_equal(first.image, flat[1])


def test_a_camera_that_the_view_is_in_is_hidden(server, joined):
    """Until the view has left it; over an exact image all are hidden."""
    browser, session = joined
    views = training.dataset().views

    def drawn() -> list[bool]:
        return [handle.visible for handle in session.cameras]

    wait_for(lambda: drawn() == [True] * (1 + len(views)))
    browser.click(session, "/cameras/0003")
    wait_for(lambda: session.go_to.value == views[3].name)
    assert drawn() == [True, *(view is not views[3] for view in views)]
    # As far as the photograph is from the camera that took it.
    (reach,) = photo_distances(server.content.frusta, session.cameras[1].scale)[3:4]
    back = -views[3].viewmat[2, :3]
    near = views[3].centre + 0.9 * reach * back
    browser.look_from(near)
    wait_for(lambda: np.allclose(session.client.camera.position, near, atol=1e-6))
    session.update_cameras()
    assert not session.cameras[4].visible
    browser.look_from(views[3].centre + 1.1 * reach * back)
    wait_for(lambda: drawn() == [True] * (1 + len(views)))
    wait_for(lambda: session.go_to.value not in [view.name for view in views])
    session.go_to.value = views[3].name  # it can be chosen again
    wait_for(lambda: not session.cameras[4].visible)
    session.height.value = "270"
    wait_for(lambda: session.render() or session.covered)
    assert not session.cameras[0].visible, "the parent of all"
    browser.look_from((0, 0, 0))
    wait_for(lambda: drawn() == [True] * (1 + len(views)))


def test_sliders_select_by_scale_and_opacity(server, joined):
    """Gaussians that viser never draws are counted apart; exact images, which are
    rendered on request only, have them.
    """
    _, session = joined
    logits = scene().params.logit_opacities.at[:3].set(-9.0)
    faint = scene().replace(params=scene().params.replace(logit_opacities=logits))
    opacities, longest = opacities_of(faint), longest_axes(faint)
    limit = np.percentile(longest, 40)

    def sends(kept) -> bool:
        drawn = kept & (opacities >= MIN_DRAWN_OPACITY)
        message = f"**{drawn.sum()}** of {COUNT} Gaussians"
        if drawn.sum() < kept.sum():
            message += f"<br/>{(kept & ~drawn).sum()} of opacity below"
        if message not in session.counts.content:
            return False
        means, expected = sent_means(session), np.asarray(faint.params.means)[drawn]
        return means.shape == expected.shape and np.allclose(means, expected, 1e-5)

    def rendered() -> np.ndarray:
        session.render()
        return np.asarray(server.content.renderer.call_args.args[0].active)

    server.show(faint)
    wait_for(lambda: sends(opacities >= 0))
    session.scale.value = 40
    wait_for(lambda: sends(longest <= limit))
    assert not server.content.renderer.called
    session.opacity.value = 0.5
    kept = (longest <= limit) & (opacities >= 0.5)
    wait_for(lambda: sends(kept))
    np.testing.assert_array_equal(rendered(), kept)
    session.scale.value = 100
    wait_for(lambda: sends(opacities >= 0.5))
    session.opacity.value = 0.0
    wait_for(lambda: sends(opacities >= 0))
    assert rendered().all()


def test_the_initial_opacity_may_exceed_the_range_of_the_slider(server):
    """As with `gsjax view PLY --min-opacity 0.995`."""
    server.content.min_opacity = 0.995
    params = scene().params.replace(logit_opacities=jax.numpy.linspace(0, 9, COUNT))
    server.content.gaussians = scene().replace(params=params)
    browser = Browser(server.url)
    kept = (opacities_of(server.content.gaussians) >= 0.995).sum()
    assert session_of(server).splats.buffer.shape == (kept, 8)
    browser.close()


@pytest.mark.timeout(60)  # viser would wait forever
def test_addresses_that_cannot_be_served():
    for host in ("192.0.2.1", "no-such-host.invalid", "a..b"):
        with pytest.raises(InputError, match=f"{host}:8390: cannot listen there"):
            open_server(host, 8390)
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # used by another process
            stack.enter_context(socket.create_server(("127.0.0.1", 65535)))
        stack.enter_context(pytest.raises(InputError, match="no port from 65535 on"))
        open_server("127.0.0.1", 65535)


def test_the_next_free_port_is_used_and_silent_clients_are_not_logged(
    monkeypatch, caplog
):
    """Chromium connects in advance, and may leave without a request."""
    logger = logging.getLogger("websockets.server")
    monkeypatch.setattr(logger, "filters", [])  # those of earlier servers
    records: list[logging.LogRecord] = []
    logger.addFilter(lambda record: records.append(record) is None)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        server = open_server("127.0.0.1", port)
    assert server.get_port() > port
    socket.create_connection(("127.0.0.1", server.get_port())).close()
    wait_for(lambda: records)
    stop_server(server)
    assert caplog.records == []


def test_a_training_is_shown_by_copies(tmp_path, monkeypatch, capsys):
    """`gsjax train --viewer`, which ends when the last browser has gone."""
    config = TrainConfig(steps=9, sh_degree=0, raster=training.RASTER)
    dataset, viewers = training.dataset(), []
    blank = np.zeros((training.HEIGHT, training.WIDTH, 3), np.uint8)
    photos = [Photo(blank, None, None, view.K) for view in dataset.views]
    state = initial_state(dataset, config)

    def shown():
        return np.asarray(viewers[0].server.content.gaussians.params.means)

    def run(*_, watch, **__):
        viewer, hook = watch.__self__, watch(dataset, photos, config)
        viewers.append(viewer)

        def after(step):
            """Call the hook, and then delete its state as the next step does."""
            gaussians = jax.tree.map(jax.numpy.copy, state.gaussians)
            means = gaussians.params.means + step
            gaussians = gaussians.replace(params=gaussians.params.replace(means=means))
            kept = np.array(means)
            metrics = Metrics(*[0] * len(Metrics._fields))._replace(step=step)
            hook(state.replace(gaussians=gaussians), Progress(metrics, 0, 0, 0, 1, 64))
            np.testing.assert_array_equal(means, kept)
            jax.tree.map(lambda a: a.delete(), gaussians)
            return kept

        first = after(1)
        after(2)  # too early for a copy
        np.testing.assert_array_equal(shown(), first)
        viewer.due = 0.0
        second = after(2)
        np.testing.assert_array_equal(shown(), second)
        browser = Browser(viewer.server.url)
        wait_for(lambda: viewer.server.has_browsers)
        viewer.due = time.monotonic() + 60
        after(3)
        np.testing.assert_array_equal(shown(), second)
        last = after(9)  # the last step is always shown
        np.testing.assert_array_equal(shown(), last)
        assert viewer.due > time.monotonic()
        session = session_of(viewer.server)
        wait_for(lambda: "step 9 of 9" in session.counts.content)
        threading.Timer(0.3, browser.close).start()
        return RunResult(run_files(tmp_path), True, 9, 1.0, training.POINTS, None)

    monkeypatch.setattr("gsjax.runs.run.start_run", run)
    args = ["train", str(tmp_path), "-o", str(tmp_path / "run"), "--viewer"]
    assert main([*args, "--viewer-port", "8290"]) == 0
    err = capsys.readouterr().err
    assert f"viewer: {viewers[0].server.url} stays until its last page" in err
    assert not viewers[0].server.has_browsers
