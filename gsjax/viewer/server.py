"""A server of the viewer: shared content, and a session for each browser.

A training in the browser is shown copies that are made between two steps, for at most a
fiftieth of the time, so a run yields the same bits with and without a viewer.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp

from gsjax.data.types import Dataset, Photo
from gsjax.gaussians import Gaussians
from gsjax.runtime.console import note, one_line
from gsjax.train.config import TrainConfig
from gsjax.train.loop import Progress
from gsjax.train.state import TrainState, shown_gaussians
from gsjax.viewer import viser_server
from gsjax.viewer.cameras import Frustum, set_viewpoint
from gsjax.viewer.opening import training_content
from gsjax.viewer.session import Session, ViewerContent

_INTERVAL = 2.0  # least seconds between two copies
_SHARE = 0.02  # of the time, at most


class ViewerServer:
    """Serves content until it is closed; raises errors as `open_server` does."""

    def __init__(
        self, content: ViewerContent, *, host: str = "127.0.0.1", port: int = 8080
    ):
        self.content = content
        self.sessions: dict[int, Session] = {}
        self.server = viser_server.open_server(host, port)
        self.left = threading.Event()  # set whenever a browser disconnects
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="viewer")
        self._pending: Future | None = None
        set_viewpoint(self.server, content.viewpoint)
        viser_server.set_background(self.server.scene, content.renderer.background)
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    @property
    def has_browsers(self) -> bool:
        """True if a browser is connected."""
        return bool(self.sessions)

    @property
    def busy(self) -> bool:
        """True while the last update is being sent."""
        return self._pending is not None and not self._pending.done()

    def show(self, gaussians: Gaussians, status: str = "") -> None:
        """Replace the scene in all browsers, in a thread of the server."""
        self.content.gaussians, self.content.status = gaussians, status
        self._for_each(lambda session: session.refresh())

    def show_cameras(self, frusta: list[Frustum]) -> None:
        """Replace the cameras in all browsers, in a thread of the server."""
        self.content.frusta = frusta
        self._for_each(lambda session: session.show_cameras())

    def close(self) -> None:
        """Stop serving."""
        for session in list(self.sessions.values()):
            session.close()
        self._worker.shutdown(wait=True, cancel_futures=True)
        viser_server.stop_server(self.server)

    def _for_each(self, act: Callable[[Session], None]) -> None:
        def work():
            for session in list(self.sessions.values()):
                try:
                    act(session)
                except Exception as error:  # the other browsers go on
                    note(f"warning: viewer: {type(error).__name__}: {one_line(error)}")

        self._pending = self._worker.submit(work)

    def _connected(self, client: Any) -> None:
        self.sessions[client.client_id] = Session(client, self.content)
        # It may have disconnected meanwhile: viser calls from several threads.
        if client.client_id not in self.server.get_clients():
            self._disconnected(client)

    def _disconnected(self, client: Any) -> None:
        session = self.sessions.pop(client.client_id, None)
        if session is not None:
            session.close()
        self.left.set()


class LiveViewer:
    """Shows one run on an address; raises `MissingExtraError` if viser is absent."""

    def __init__(self, *, host: str = "127.0.0.1", port: int = 8080):
        viser_server.require_viser()
        self.host, self.port = host, port
        self.server: ViewerServer | None = None
        self.due = 0.0

    def begin(
        self, dataset: Dataset, photos: Sequence[Photo], config: TrainConfig
    ) -> Callable[[TrainState, Progress], None]:
        """Return the hook for `gsjax.Hooks.state`; its first call starts the server."""

        def after_step(state: TrainState, progress: Progress) -> None:
            step = int(progress.metrics.step)
            server, now = self.server, time.monotonic()
            early = server is not None and (now < self.due or server.busy)
            if early and step != config.steps:
                return
            gaussians = copy_to_one_device(shown_gaussians(state, config))
            jax.block_until_ready(gaussians)
            if server is None:
                content = training_content(gaussians, dataset, photos, config)
                server = ViewerServer(content, host=self.host, port=self.port)
                self.server = server
                note(f"viewer: {server.url}")
            server.show(gaussians, f"step {step:,} of {config.steps:,}")
            took = time.monotonic() - now
            self.due = now + max(_INTERVAL, took / _SHARE)

        return after_step

    def wait_for_browsers(self) -> None:
        """Block until no browser is connected, or Ctrl-C."""
        server = self.server
        if server is None or not server.has_browsers:
            return
        note(f"viewer: {server.url} stays until its last page is closed, or Ctrl-C")
        with contextlib.suppress(KeyboardInterrupt):
            while server.has_browsers:
                server.left.wait(1.0)
                server.left.clear()

    def close(self) -> None:
        """Stop serving."""
        if self.server is not None:
            self.server.close()


def copy_to_one_device(gaussians: Gaussians) -> Gaussians:
    """Copy to memory of the first device, which the next step does not reuse."""
    # This alone copies nothing to a device that holds the array already.
    local = jax.device_put(gaussians, jax.local_devices()[0])
    return jax.tree.map(jnp.copy, local)
