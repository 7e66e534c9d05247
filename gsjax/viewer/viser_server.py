"""Starting and stopping viser."""

import contextlib
import errno
import logging
import socket
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from gsjax.errors import InputError, MissingExtraError
from gsjax.io import images
from gsjax.mesh.surface import Mesh, as_trimesh


def require_viser() -> Any:
    """Return the module viser; raise `MissingExtraError` if absent or too old."""
    try:
        import viser
    except ImportError as error:
        what = f"viser, which shows scenes in the browser, does not load ({error})"
        raise MissingExtraError(f"{what}; install it: pip install viser") from error
    has_page = hasattr(viser.SceneApi, "as_html")
    if not has_page or not hasattr(viser.ViserServer, "initial_camera"):
        what = f"viser {viser.__version__} is too old"
        raise MissingExtraError(f"{what}; pip install -U viser")
    return viser


def open_server(host: str, port: int) -> Any:
    """Return a listening, silent `viser.ViserServer`; takes the next free port.

    Raises:
      MissingExtraError: as `require_viser`.
      InputError: if the host is not this machine, or no port is free.
    """
    viser = require_viser()
    try:
        free = _free_port(host, port)
        logging.getLogger("websockets.server").addFilter(_sent_a_request)
        with quiet():
            return viser.ViserServer(host=host, port=free, label="gsjax", verbose=False)
    except (OSError, UnicodeError) as error:
        raise InputError(
            f"{host}:{port}: cannot listen there: {error}; pass 127.0.0.1 to serve "
            "this machine only, or 0.0.0.0 to serve others too"
        ) from error


def _sent_a_request(record: logging.LogRecord) -> bool:
    """Filter out clients that leave without a request; viser does after the first."""
    error = record.exc_info[1] if record.exc_info else None
    silent = isinstance(getattr(error, "__cause__", None), EOFError)
    return not (silent and record.getMessage() == "opening handshake failed")


def _free_port(host: str, port: int) -> int:
    """Return the first free port from ``port`` on; viser waits forever if none is."""
    flags = socket.AI_PASSIVE
    found = socket.getaddrinfo(host or None, port, type=socket.SOCK_STREAM, flags=flags)
    family, (address, *_) = found[0][0], found[0][4]
    for free in range(port, 2**16):
        try:
            with socket.create_server((address, free), family=family):
                return free
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
    raise OSError(f"no port from {port} on is free")


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Silence viser, which prints results and progress."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def stop_server(server: Any) -> None:
    """Stop a server silently."""
    with quiet():
        server.stop()


def set_background(scene: Any, color: Sequence[float]) -> None:
    """Set the RGB background of a `viser.SceneApi`."""
    pixels = np.broadcast_to(images.to_8_bit(np.asarray(color)), (2, 2, 3))
    scene.set_background_image(np.ascontiguousarray(pixels), format="png")


def add_mesh(scene: Any, mesh: Mesh) -> Any:
    """Add a mesh to a `viser.SceneApi` and return its handle.

    Raises:
      MissingExtraError: if trimesh is not installed.
    """
    return scene.add_mesh_trimesh("/mesh", as_trimesh(mesh))
