"""A server of the viewer: an exhibit, and a session for each browser that looks."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from gsjax.gaussians import Gaussians
from gsjax.runtime.console import note, one_line
from gsjax.viewer.session import Exhibit, Session
from gsjax.viewer.stage import (
    Frustum,
    open_server,
    paint_background,
    set_eye,
    stop_server,
)


class Window:
    """Serves an exhibit until it is closed.

    Raises:
      MissingExtraError, InputError: as `open_server`.
    """

    def __init__(self, exhibit: Exhibit, *, host: str = "127.0.0.1", port: int = 8080):
        self.exhibit = exhibit
        self.sessions: dict[int, Session] = {}
        self.server = open_server(host, port)
        self.left = threading.Event()  # set whenever a browser goes
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="viewer")
        self._pending: Future | None = None
        set_eye(self.server, exhibit.eye)
        paint_background(self.server.scene, exhibit.renderer.background)
        self.server.on_client_connect(self._joined)
        self.server.on_client_disconnect(self._parted)

    @property
    def url(self) -> str:
        """Where to look."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    @property
    def watched(self) -> bool:
        """Whether a browser is connected."""
        return bool(self.sessions)

    @property
    def busy(self) -> bool:
        """Whether what was last shown is still on its way."""
        return self._pending is not None and not self._pending.done()

    def show(self, gaussians: Gaussians, status: str = "") -> None:
        """Replace the scene in all browsers, from a thread of the window's own."""
        self.exhibit.gaussians, self.exhibit.status = gaussians, status
        self._each(lambda session: session.refresh())

    def show_cameras(self, frusta: list[Frustum]) -> None:
        """Replace the cameras in all browsers."""
        self.exhibit.frusta = frusta
        self._each(lambda session: session.show_cameras())

    def close(self) -> None:
        """Stop serving."""
        for session in list(self.sessions.values()):
            session.close()
        self._worker.shutdown(wait=True, cancel_futures=True)
        stop_server(self.server)

    def _each(self, act: Callable[[Session], None]) -> None:
        def work():
            for session in list(self.sessions.values()):
                try:
                    act(session)
                except Exception as error:  # costs this browser a picture, no more
                    note(f"warning: viewer: {type(error).__name__}: {one_line(error)}")

        self._pending = self._worker.submit(work)

    def _joined(self, client: Any) -> None:
        self.sessions[client.client_id] = Session(client, self.exhibit)
        # Gone meanwhile: viser calls from several threads.
        if client.client_id not in self.server.get_clients():
            self._parted(client)

    def _parted(self, client: Any) -> None:
        session = self.sessions.pop(client.client_id, None)
        if session is not None:
            session.close()
        self.left.set()
