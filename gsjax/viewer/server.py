"""A server of the viewer: shared content, and a session for each browser."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from gsjax.gaussians import Gaussians
from gsjax.runtime.console import note, one_line
from gsjax.viewer.cameras import Frustum, set_viewpoint
from gsjax.viewer.session import Session, ViewerContent
from gsjax.viewer.viser_server import open_server, set_background, stop_server


class ViewerServer:
    """Serves content until it is closed.

    Raises:
      MissingExtraError, InputError: as `open_server`.
    """

    def __init__(
        self, content: ViewerContent, *, host: str = "127.0.0.1", port: int = 8080
    ):
        self.content = content
        self.sessions: dict[int, Session] = {}
        self.server = open_server(host, port)
        self.left = threading.Event()  # set whenever a browser disconnects
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="viewer")
        self._pending: Future | None = None
        set_viewpoint(self.server, content.viewpoint)
        set_background(self.server.scene, content.renderer.background)
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
        stop_server(self.server)

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
