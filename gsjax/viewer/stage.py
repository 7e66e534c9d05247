"""What stands around the splats: viser itself, the cameras, where one looks from.

Cameras have OpenCV axes, in gsjax as in viser; fields of view are vertical, radians.
"""

import contextlib
import errno
import logging
import socket
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from gsjax.data import camera_paths
from gsjax.data.types import Photo, View
from gsjax.errors import InputError, MissingExtraError
from gsjax.gaussians import Gaussians
from gsjax.io import images
from gsjax.viewer.splats import Cut, within

THUMBNAIL = 320  # px, longest side
UPS = {
    f"{sign}{axis}": value * np.eye(3)[index]
    for sign, value in (("+", 1.0), ("-", -1.0))
    for index, axis in enumerate("xyz")
}
_MOST_FRUSTA = 200
_BEHIND, _ABOVE = 1.4, np.radians(12.0)
_FOV = np.radians(50.0)
_CAMERA_COLOR = (230, 150, 40)


class Frustum(NamedTuple):
    """A camera of the dataset, drawn as a pyramid.

    Attributes:
      name: of its photograph.
      viewmat: [4, 4] world → camera.
      fov: vertical field of view.
      aspect: width over height.
      photo: [h, w, 3] uint8, small; or None.
    """

    name: str
    viewmat: np.ndarray
    fov: float
    aspect: float
    photo: np.ndarray | None = None

    @property
    def centre(self) -> np.ndarray:
        """[3] of the camera, in the world."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


class Eye(NamedTuple):
    """Where a browser looks from at first, [3] each.

    Attributes:
      position: of the camera.
      target: what it looks at and turns about.
      up: unit, of the world.
      fov: vertical field of view.
    """

    position: np.ndarray
    target: np.ndarray
    up: np.ndarray
    fov: float

    @property
    def distance(self) -> float:
        """From the target, world units."""
        return float(np.linalg.norm(self.target - self.position))

    @property
    def near(self) -> float:
        """What is nearer than that to a browser's camera is not drawn."""
        return 1e-3 * self.distance


def require_viser() -> Any:
    """The module viser.

    Raises:
      MissingExtraError: if it is absent, does not load, or is too old.
    """
    try:
        import viser
    except ImportError as error:
        raise MissingExtraError(
            f"viser, which shows scenes in the browser, does not load ({error}); "
            "install it: pip install viser"
        ) from error
    has_page = hasattr(viser.SceneApi, "as_html")
    if not has_page or not hasattr(viser.ViserServer, "initial_camera"):
        raise MissingExtraError(
            f"viser {viser.__version__} is too old; pip install -U viser"
        )
    return viser


def open_server(host: str, port: int) -> Any:
    """A `viser.ViserServer` that listens, silent; the next free port if it is taken.

    Raises:
      MissingExtraError: as `require_viser`.
      InputError: if the host is not this machine, or no port is free.
    """
    viser = require_viser()
    try:
        free = _free_port(host, port)
        logging.getLogger("websockets.server").addFilter(_asked_something)
        with quiet():
            return viser.ViserServer(host=host, port=free, label="gsjax", verbose=False)
    except (OSError, UnicodeError) as error:
        raise InputError(
            f"{host}:{port}: cannot be listened on: {error}; 127.0.0.1 is this machine "
            "for itself, 0.0.0.0 for others too"
        ) from error


def _asked_something(record: logging.LogRecord) -> bool:
    """Not who connects and goes without a word, as Chromium does; viser says the
    same, but only once a first has asked."""
    error = record.exc_info[1] if record.exc_info else None
    silent = isinstance(getattr(error, "__cause__", None), EOFError)
    return not (silent and record.getMessage() == "opening handshake failed")


def _free_port(host: str, port: int) -> int:
    """The first from ``port`` on that can be listened on.

    viser looks for it too; but where there is none, it waits for ever.

    Raises:
      OSError, UnicodeError: if there is none, or no such host.
    """
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
    """Within, viser says nothing: neither results nor progress come from it."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


def stop_server(server: Any) -> None:
    """Stop it, silent."""
    with quiet():
        server.stop()


def frusta_of(views: Sequence[View], photos: Sequence[Photo] = ()) -> list[Frustum]:
    """Cameras to draw, at most 200 of them, evenly chosen.

    Args:
      views: of the dataset.
      photos: one for each view, of any size; or none.
    """
    few = np.linspace(0, len(views) - 1, min(len(views), _MOST_FRUSTA))
    out = []
    for index in np.unique(few.astype(int)):
        view = views[index]
        fov = 2 * np.arctan(view.height / (2 * view.K[1, 1]))
        pixels = small(photos[index].pixels) if len(photos) else None
        aspect = view.width / view.height
        out.append(Frustum(view.name, view.viewmat, float(fov), aspect, pixels))
    return out


def small(pixels: np.ndarray, most: int = THUMBNAIL) -> np.ndarray:
    """A picture [H, W, 3] whose longest side is at most ``most`` px."""
    scale = most / max(pixels.shape[:2])
    if scale >= 1:
        return pixels
    height, width = (max(1, round(scale * side)) for side in pixels.shape[:2])
    cv2 = images.opencv()
    return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)


def eye_of_cameras(frusta: Sequence[Frustum]) -> Eye:
    """Behind and above the first camera, turning about what all of them look at."""
    viewmats = np.stack([frustum.viewmat for frustum in frusta])
    focus = camera_paths.focus_point(viewmats)
    position, ahead = frusta[0].centre, frusta[0].viewmat[2, :3]
    away = np.linalg.norm(focus - position)
    distance = max((focus - position) @ ahead, 0.3 * away, 1e-6)
    up, target = camera_paths.up_direction(viewmats), position + distance * ahead
    behind = _BEHIND * distance * _leant(-ahead, up)
    return Eye(target + behind, target, up, frusta[0].fov)


def _leant(direction: np.ndarray, up: np.ndarray) -> np.ndarray:
    """A unit vector, turned towards ``up`` by `_ABOVE`, but not beyond."""
    side = up - (up @ direction) * direction
    sine = np.linalg.norm(side)
    if np.arctan2(sine, up @ direction) < 2 * _ABOVE:
        return direction
    return np.cos(_ABOVE) * direction + np.sin(_ABOVE) * side / sine


def eye_of_gaussians(gaussians: Gaussians, up: np.ndarray) -> Eye:
    """From obliquely above, far enough to see most of a scene without cameras.

    From the side where cameras stand as a rule: before z = 0 where −y is up (COLMAP),
    behind it where +y is.
    """
    shown = within(gaussians, Cut(min_opacity=0.1))
    means = np.asarray(gaussians.params.means, np.float64)[shown]
    if not len(means):
        means = np.zeros((1, 3))
    target = np.median(means, axis=0)
    radius = float(np.percentile(np.linalg.norm(means - target, axis=1), 80)) or 1.0
    across = np.cross(np.eye(3)[np.abs(up).argmin()], up)
    direction = np.cos(0.35) * across / np.linalg.norm(across) + np.sin(0.35) * up
    position = target + 1.3 * radius / np.tan(_FOV / 2) * direction
    return Eye(position, target, np.asarray(up, float), float(_FOV))


def set_eye(server: Any, eye: Eye) -> None:
    """Where new browsers, and pages, look from."""
    server.scene.set_up_direction(tuple(eye.up))
    camera = server.initial_camera
    camera.position, camera.look_at = tuple(eye.position), tuple(eye.target)
    camera.fov = eye.fov
    camera.near, camera.far = eye.near, 1e4 * eye.distance


def paint_background(scene: Any, color: Sequence[float]) -> None:
    """Behind everything: the colour that the scene was trained before."""
    pixels = np.broadcast_to(images.to_8_bit(np.asarray(color)), (2, 2, 3))
    scene.set_background_image(np.ascontiguousarray(pixels), format="png")


def add_cameras(scene: Any, frusta: Sequence[Frustum], size: float) -> list[Any]:
    """Draw them into a `viser.SceneApi`; their handles, the parent of all first.

    Args:
      scene: the scene of a server, or that of one browser.
      frusta: the cameras.
      size: of a pyramid, world units.
    """
    handles = [scene.add_frame("/cameras", show_axes=False)]
    for index, frustum in enumerate(frusta):
        handle = scene.add_camera_frustum(
            f"/cameras/{index:04d}",
            fov=frustum.fov,
            aspect=frustum.aspect,
            scale=size,
            thickness=0.02 * size,
            color=_CAMERA_COLOR,
            image=frustum.photo,
            format="jpeg",
            wxyz=wxyz_of(frustum.viewmat[:3, :3].T),
            position=frustum.centre,
        )
        handles.append(handle)
    return handles


def size_of_frusta(frusta: Sequence[Frustum], distance: float) -> float:
    """World units: to be seen from ``distance``, and not to hide one another."""
    if len(frusta) < 2:
        return 0.03 * distance
    centres = np.stack([frustum.centre for frustum in frusta])
    gaps = np.linalg.norm(centres[:, None] - centres, axis=-1)
    nearest = np.where(gaps > 0, gaps, np.inf).min(axis=1)
    return float(np.clip(0.4 * np.median(nearest), 0.01 * distance, 0.03 * distance))


def photo_distances(frusta: Sequence[Frustum], size: float) -> np.ndarray:
    """[B] of each photograph from the apex of its pyramid, in world units.

    viser scales pyramids to one volume, whatever their angles.
    """
    half = np.tan([frustum.fov / 2 for frustum in frusta])
    return size * np.cbrt(3 / (half**2 * [frustum.aspect for frustum in frusta]))


def wxyz_of(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion [4] of a rotation matrix [3, 3]."""
    return require_viser().transforms.SO3.from_matrix(rotation).wxyz
