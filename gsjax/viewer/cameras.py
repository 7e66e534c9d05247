"""The cameras of a dataset as frusta, and viewpoints of a browser.

Cameras have OpenCV axes, in gsjax as in viser; fields of view are vertical, radians.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gsjax.cameras.lens import range_depth
from gsjax.data import camera_paths
from gsjax.data.types import Photo, View
from gsjax.gaussians import Gaussians
from gsjax.io import images
from gsjax.viewer.splats import Cut, within
from gsjax.viewer.viser_server import require_viser

THUMBNAIL = 320  # px, longest side
_AXES = dict(zip("xyz", np.eye(3)))
UPS = {f"+{name}": axis for name, axis in _AXES.items()}
UPS |= {f"-{name}": -axis for name, axis in _AXES.items()}
_MAX_FRUSTA = 200
_BEHIND, _ABOVE = 1.4, np.radians(12.0)
_FOV = np.radians(50.0)
_CAMERA_COLOR = (230, 150, 40)


class Frustum(NamedTuple):
    """A camera of the dataset, drawn as a pyramid.

    Attributes:
      name: of its photograph.
      viewmat: [4, 4] world → camera.
      fov, aspect: vertical field of view, and width over height.
      photo: [h, w, 3] uint8, small; or None.
    """

    name: str
    viewmat: np.ndarray
    fov: float
    aspect: float
    photo: np.ndarray | None = None

    @property
    def centre(self) -> np.ndarray:
        """Position [3] of the camera in the world."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


class Viewpoint(NamedTuple):
    """The initial camera of a browser.

    Attributes:
      position: [3] of the camera.
      target: [3], which it looks at and turns about.
      up: [3] unit vector of the world.
      fov: vertical field of view.
    """

    position: np.ndarray
    target: np.ndarray
    up: np.ndarray
    fov: float

    @property
    def distance(self) -> float:
        """Distance of the target, world units."""
        return float(np.linalg.norm(self.target - self.position))

    @property
    def near(self) -> float:
        """Depth below which the browser draws nothing."""
        return 1e-3 * self.distance


def frusta_of(views: Sequence[View], photos: Sequence[Photo] = ()) -> list[Frustum]:
    """Return at most 200 cameras to draw, evenly chosen; ``photos`` may be none.

    Of views from one camera that stands still, only the first is drawn.
    """
    places = {}
    for index, view in enumerate(views):
        places.setdefault((view.viewmat.tobytes(), view.K.tobytes()), index)
    firsts = list(places.values())
    few = np.linspace(0, len(firsts) - 1, min(len(firsts), _MAX_FRUSTA))
    out = []
    for index in np.take(firsts, np.unique(few.astype(int))):
        view = views[index]
        fov = 2 * np.arctan(view.height / (2 * view.K[1, 1]))
        if view.lens is not None and view.lens.lens.depth is range_depth:
            fov = min(fov, 0.5 * np.pi)  # the pyramid of a wide lens would be flat
        pixels = images.shrink(photos[index].pixels, THUMBNAIL) if len(photos) else None
        aspect = view.width / view.height
        out.append(Frustum(view.name, view.viewmat, float(fov), aspect, pixels))
    return out


def viewpoint_of_cameras(frusta: Sequence[Frustum]) -> Viewpoint:
    """Return a viewpoint behind and above the first camera, with all in view."""
    viewmats = np.stack([frustum.viewmat for frustum in frusta])
    focus = camera_paths.focus_point(viewmats)
    position, ahead = frusta[0].centre, frusta[0].viewmat[2, :3]
    away = np.linalg.norm(focus - position)
    distance = max((focus - position) @ ahead, 0.3 * away, 1e-6)
    up, target = camera_paths.up_direction(viewmats), position + distance * ahead
    behind = _BEHIND * distance * _tilted(-ahead, up)
    return Viewpoint(target + behind, target, up, frusta[0].fov)


def _tilted(direction: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Turn a unit vector towards ``up`` by `_ABOVE`, but not beyond."""
    side = up - (up @ direction) * direction
    sine = np.linalg.norm(side)
    if np.arctan2(sine, up @ direction) < 2 * _ABOVE:
        return direction
    return np.cos(_ABOVE) * direction + np.sin(_ABOVE) * side / sine


def viewpoint_of_gaussians(gaussians: Gaussians, up: np.ndarray) -> Viewpoint:
    """Return a viewpoint obliquely above a scene, with most of it in view.

    It is on the usual side of the cameras: at z < 0 if −y is up (COLMAP), at z > 0 if
    +y is.
    """
    shown = within(gaussians, Cut(min_opacity=0.1))
    means = np.asarray(gaussians.params.means, np.float64)[shown]
    means = means if len(means) else np.zeros((1, 3))
    target = np.median(means, axis=0)
    radius = float(np.percentile(np.linalg.norm(means - target, axis=1), 80)) or 1.0
    across = np.cross(np.eye(3)[np.abs(up).argmin()], up)
    direction = np.cos(0.35) * across / np.linalg.norm(across) + np.sin(0.35) * up
    position = target + 1.3 * radius / np.tan(_FOV / 2) * direction
    return Viewpoint(position, target, np.asarray(up, float), float(_FOV))


def set_viewpoint(server: Any, viewpoint: Viewpoint) -> None:
    """Set the initial camera of new browsers, and of pages."""
    server.scene.set_up_direction(tuple(viewpoint.up))
    camera = server.initial_camera
    camera.position = tuple(viewpoint.position)
    camera.look_at = tuple(viewpoint.target)
    camera.fov = viewpoint.fov
    camera.near, camera.far = viewpoint.near, 1e4 * viewpoint.distance


def add_cameras(scene: Any, frusta: Sequence[Frustum], size: float) -> list[Any]:
    """Draw frusta of a ``size`` in world units into a `viser.SceneApi`.

    Returns:
      Their handles; the first is the parent of the others.
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


def frustum_size(frusta: Sequence[Frustum], distance: float) -> float:
    """Return a size in world units: visible from ``distance``, with little overlap."""
    if len(frusta) < 2:
        return 0.03 * distance
    centres = np.stack([frustum.centre for frustum in frusta])
    gaps = np.linalg.norm(centres[:, None] - centres, axis=-1)
    nearest = np.where(gaps > 0, gaps, np.inf).min(axis=1)
    return float(np.clip(0.4 * np.median(nearest), 0.01 * distance, 0.03 * distance))


def photo_distances(frusta: Sequence[Frustum], size: float) -> np.ndarray:
    """Return the distance [B] of each photograph from its apex, in world units.

    viser scales pyramids to one volume, whatever their angles.
    """
    half = np.tan([frustum.fov / 2 for frustum in frusta])
    return size * np.cbrt(3 / (half**2 * [frustum.aspect for frustum in frusta]))


def wxyz_of(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion [4] of a rotation matrix [3, 3]."""
    return require_viser().transforms.SO3.from_matrix(rotation).wxyz
