"""The viewer: the browser's numbers, our picture for its camera, panels, live runs."""

import contextlib
import logging
import re
import socket
import threading
import time

import chex
import jax
import numpy as np
import pytest
import training
from conftest import LIGHT, frustum_points, gaussians_at, needs_two_devices
from viewing import COUNT, scene, wait_for

import gsjax
from gsjax.data.types import Photo
from gsjax.errors import InputError
from gsjax.math.rotations import covariance, quaternion_to_matrix
from gsjax.plots.contact_sheets import depth_colors
from gsjax.train.config import TrainConfig
from gsjax.train.initialisation import initial_state
from gsjax.train.loop import Progress
from gsjax.train.state import Metrics
from gsjax.viewer.exact import ExactRenderer, camera_of, picture
from gsjax.viewer.live import copy_on_one_device
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
    photo_distances,
    stop_server,
)

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


# --- live ---


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
        self.encode = msgspec.msgpack.encode
        self.socket.send(self.encode(CAMERA))
        self.reader = threading.Thread(target=lambda: list(self.socket), daemon=True)
        self.reader.start()

    def look_from(self, position) -> None:
        """Say that the camera is there now."""
        self.socket.send(
            self.encode(CAMERA | {"position": tuple(map(float, position))})
        )

    def click(self, session, name: str) -> None:
        """On what has this name in the scene of its own session."""
        click = {
            "type": "SceneNodeClickMessage", "name": name, "instance_index": None,
            "ray_origin": (0.0, 0.0, 0.0), "ray_direction": (0.0, 0.0, 1.0),
            "screen_pos": (0.5, 0.5), "modifier": None,
            "owner": str(session.client.client_id),
        }  # fmt: skip
        self.socket.send(self.encode(click))

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


def session_of(window):
    """That of its only browser, once Gaussians are sent."""
    wait_for(lambda: window.sessions and next(iter(window.sessions.values())).splats)
    return next(iter(window.sessions.values()))


def test_a_session_cuts_renders_and_moves(window):
    browser = Browser(window.url)
    session = session_of(window)
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


@pytest.fixture
def joined(window):
    """A browser that looks into the window, and its session."""
    browser = Browser(window.url)
    yield browser, session_of(window)
    browser.close()


def test_a_click_on_a_camera_stands_there_and_shows_its_photograph(window, joined):
    """Once photographs are loaded; then one at a time, whichever way it is chosen."""
    browser, session = joined
    views = training.scene().views

    def stands_at(view) -> bool:
        camera = session.client.camera
        place = np.allclose(camera.position, view.centre, atol=1e-6)
        turn = np.asarray(quaternion_to_matrix(camera.wxyz))
        half = view.height / 2 / view.K[1, 1]
        return (
            place
            and np.allclose(turn, view.viewmat[:3, :3].T, atol=1e-6)
            and np.isclose(np.tan(camera.fov / 2), half)
        )

    browser.click(session, "/cameras/0003")
    wait_for(lambda: stands_at(views[3]))
    assert session.photo is None
    flat = [np.full((24, 32, 3), 60 * index, np.uint8) for index in range(len(views))]
    photos = [Photo(pixels, None, None, views[0].K) for pixels in flat]
    window.show_cameras(frusta_of(views, photos))
    wait_for(lambda: not window.busy)
    browser.click(session, "/cameras/0002")
    wait_for(lambda: session.photo and session.photo.label == views[2].name)
    assert stands_at(views[2])
    first = session.photo
    np.testing.assert_array_equal(first.image, flat[2])
    session.go_to.value = views[1].name
    wait_for(lambda: session.photo.label == views[1].name)
    assert stands_at(views[1])
    assert session.photo is first
    np.testing.assert_array_equal(first.image, flat[1])


def test_what_the_view_stands_in_is_not_drawn_before_it(window, joined):
    """Of all cameras only that one, and it comes back when the view has left; over an
    exact picture is none.
    """
    browser, session = joined
    views = training.scene().views

    def drawn() -> list[bool]:
        return [handle.visible for handle in session.cameras]

    wait_for(lambda: drawn() == [True] * (1 + len(views)))
    browser.click(session, "/cameras/0003")
    wait_for(lambda: session.go_to.value == views[3].name)
    assert drawn() == [True, *(view is not views[3] for view in views)]
    # As far as the photograph is from the camera that took it.
    (reach,) = photo_distances(window.exhibit.frusta, session.cameras[1].scale)[3:4]
    back = -views[3].viewmat[2, :3]
    near = views[3].centre + 0.9 * reach * back
    browser.look_from(near)
    wait_for(lambda: np.allclose(session.client.camera.position, near, atol=1e-6))
    session.look_around()
    assert not session.cameras[4].visible
    browser.look_from(views[3].centre + 1.1 * reach * back)
    wait_for(lambda: drawn() == [True] * (1 + len(views)))
    wait_for(lambda: session.go_to.value not in [view.name for view in views])
    session.go_to.value = views[3].name  # so it can be chosen again
    wait_for(lambda: not session.cameras[4].visible)
    session.height.value = "270"
    wait_for(lambda: session.render() or session.covered)
    assert not session.cameras[0].visible, "the parent of all"
    browser.look_from((0, 0, 0))
    wait_for(lambda: drawn() == [True] * (1 + len(views)))


def test_photographs_are_drawn_as_far_as_the_browser_has_them():
    """viser: pyramids of one size have one volume, whatever their angles."""
    view = frusta_of(training.scene().views)[0]
    wide = view._replace(fov=np.pi / 2, aspect=3.0)
    np.testing.assert_allclose(photo_distances([wide], 2.0), [2.0])
    for fov, aspect in ((0.3, 1.5), (2.0, 0.5)):
        (depth,) = photo_distances([view._replace(fov=fov, aspect=aspect)], 2.0)
        np.testing.assert_allclose(depth**3 * np.tan(fov / 2) ** 2 * aspect / 3, 8.0)


def test_the_count_is_of_what_is_drawn(window, joined):
    """The browser leaves out what is fainter than its floor, and the panel says so."""
    _, session = joined
    logits = scene().params.logit_opacities.at[:3].set(-9.0)
    params = scene().params.replace(logit_opacities=logits)
    window.show(scene().replace(params=params))
    told = (
        f"**{COUNT - 3}** of {COUNT} Gaussians<br/>3 of opacity below {LEAST_OPACITY}"
    )
    wait_for(lambda: told in session.counts.content)
    assert session.splats.buffer.shape == (COUNT - 3, 8)
    session.render()
    assert int(window.calls[-1][0].active.sum()) == COUNT, "the exact picture has all"


def test_the_scale_slider_sends_the_smallest_so_many_percent(window, joined):
    """By the longest axis, and together with the opacity one."""
    _, session = joined
    opacities, longest = opacities_of(scene()), longest_axes(scene())
    limit = np.percentile(longest, 40)

    def sends(kept) -> bool:
        told = f"**{kept.sum()}** of {COUNT} Gaussians"
        if told not in session.counts.content:
            return False
        centers = session.splats.buffer[:, :3].view(np.float32) * session.splats.scale
        wanted = np.asarray(scene().params.means)[kept]
        return centers.shape == wanted.shape and np.allclose(centers, wanted, rtol=1e-5)

    session.scale.value = 40
    wait_for(lambda: sends(longest <= limit))
    assert f"scales up to {limit:.3g}" in session.counts.content
    session.opacity.value = 0.5
    kept = (longest <= limit) & (opacities >= 0.5)
    wait_for(lambda: sends(kept))
    session.render()
    np.testing.assert_array_equal(window.calls[-1][0].active, kept)
    session.scale.value = 100
    wait_for(lambda: sends(opacities >= 0.5))
    assert "scales" not in session.counts.content


def test_a_scene_may_begin_with_an_opacity_beyond_the_slider(window):
    """As `gsjax view PLY --min-opacity 0.995` does."""
    window.exhibit.min_opacity = 0.995
    window.exhibit.gaussians = brightest = scene().replace(
        params=scene().params.replace(logit_opacities=jax.numpy.linspace(0, 9, COUNT))
    )
    browser = Browser(window.url)
    session = session_of(window)
    kept = (opacities_of(brightest) >= 0.995).sum()
    wait_for(lambda: f"**{kept}** of {COUNT} Gaussians" in session.counts.content)
    assert session.splats.buffer.shape == (kept, 8)
    browser.close()


@pytest.mark.long
def test_the_exact_picture_of_a_session_is_what_it_says(window, monkeypatch):
    """Rgb, then depth, then alpha, as they are chosen, each with a line about it."""
    monkeypatch.setattr("gsjax.viewer.session._HEIGHTS", ("24", "540"))
    config, background = gsjax.RasterConfig(**LIGHT), (0.1, 0.2, 0.3)
    window.exhibit.renderer = ExactRenderer(config, background)
    browser = Browser(window.url)
    session = session_of(window)
    session.height.value, session.place.value = "24", "in the panel"
    session.render()
    camera = camera_of((1, 0, 0, 0), (0, 0, 0), 0.7, 32, 24)
    wanted = gsjax.reference_render(scene(), camera, config, np.array(background))
    depths, near, far = depth_colors(np.asarray(wanted["depth"]))
    alphas = np.repeat(255 * np.asarray(wanted["alpha"])[..., None], 3, axis=2)
    for kind, image, line in (
        ("rgb", 255 * np.asarray(wanted["rgb"]), "rgb"),
        ("depth", depths, f"depth {near:.3g} (red) to {far:.3g} (blue)"),
        ("alpha", alphas, "alpha"),
    ):
        session.kind.value = kind
        wait_for(
            lambda line=line: session.told.content.startswith(f"{line}, 32 × 24 px")
        )
        with session.render.busy:  # until it is shown, too
            shown = session.result.image.astype(float)
        assert np.std(image) > 20
        # A level of depth more or less is another colour.
        np.testing.assert_allclose(shown, image, atol=8 if kind == "depth" else 0.51)
    browser.close()


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


@needs_two_devices
def test_the_copy_that_is_shown_is_of_one_device_and_outlives_the_step():
    """The step leaves its state on all devices, and takes its memory over."""
    mesh = jax.sharding.Mesh(np.array(jax.local_devices()), ("devices",))
    everywhere = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
    step = jax.jit(
        lambda state: jax.tree.map(
            lambda a: a ^ True if a.dtype == bool else -a, state
        ),
        out_shardings=everywhere,
        donate_argnums=0,
    )
    state = step(jax.device_put(scene(), everywhere))
    kept, copy = jax.tree.map(np.array, state), copy_on_one_device(state)
    after = step(state)
    assert len(after.params.means.devices()) > 1
    assert state.params.means.is_deleted()
    chex.assert_trees_all_equal(copy, kept)
    first = {jax.local_devices()[0]}
    assert all(array.devices() == first for array in jax.tree.leaves(copy))
    camera = camera_of((1, 0, 0, 0), (0, 0, 0), 0.7, 32, 24)
    view = gsjax.render_exact(copy, camera, gsjax.RasterConfig(**LIGHT))
    assert view.rgb.devices() == first


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
