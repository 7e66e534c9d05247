"""The still life in motion: a dataset of a moving scene that needs no download.

Over times from 0 to 1 the small ball slides along the floor, the ring turns about its
upright diameter, and the lid of the crate opens about a hinge. The rest is still.

Axis legend: R points ([3, R] arrays).
"""

from collections.abc import Iterator
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.cameras.camera import look_at, make_camera
from gsjax.data.transforms import CameraEntry, transforms_json
from gsjax.io import images
from gsjax.runtime.files import make_folder, reject_existing, write_file
from gsjax.synthetic import raycaster
from gsjax.synthetic.shapes import Solid, box
from gsjax.synthetic.still_life import solids

_BALL_PATH = np.asarray([(-0.85, -1.50, 0.24), (0.60, -1.50, 0.24)])
_RING_TURN, _LID_TURN = np.radians(150.0), np.radians(75.0)
_LID = 0.06  # half its thickness
_INSIDE = (0.82, 0.74, 0.62)


class MovingDemoSettings(NamedTuple):
    """Settings of `write_moving_dataset`.

    Attributes:
      cameras: number of fixed cameras; 0 for none.
      times: number of times at which all fixed cameras take a photograph.
      photos: number of photographs of the camera that moves, each at its own time.
      held_out: number of test photographs, at viewpoints and times of their own.
      width, height: image size, px.
      samples: a pixel is the mean of samples × samples rays.
      points: number of points in the point cloud, of the scene at time 0.
      seed: seed of the points.
    """

    cameras: int = 8
    times: int = 16
    photos: int = 32
    held_out: int = 12
    width: int = 256
    height: int = 192
    samples: int = 2
    points: int = 5000
    seed: int = 0


class Moment(NamedTuple):
    """A photograph to take.

    Attributes:
      viewmat: [4, 4] world → camera.
      time: from 0 to 1.
    """

    viewmat: np.ndarray
    time: float


def moving_solids(time: float) -> tuple[Solid, ...]:
    """Return the solids at a time from 0 to 1, the floor first.

    At 0 they look like `solids`, but for the place of the small ball.
    """
    floor, globe, crate, ring, ball = solids()
    done = time * time * (3 - 2 * time)
    ball = ball._replace(centre=_BALL_PATH[0] + done * (_BALL_PATH[1] - _BALL_PATH[0]))
    ring = ring._replace(axes=_about_z(done * _RING_TURN) @ ring.axes)
    return floor, globe, *_open_crate(crate, done * _LID_TURN), ring, ball


def _about_z(angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def _about_x(angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])


def _open_crate(crate: Solid, angle: float) -> tuple[Solid, Solid]:
    """Return the crate and its lid, which turns about an upper edge by ``angle``."""
    half = float(crate.centre[2])

    def part(height: float, low: float, turn: float) -> Solid:
        """Return a slice of the crate, from ``low`` to ``low + 2 height``."""
        middle = np.asarray([0.0, 0.0, low + height - half])
        edge = np.asarray([0.0, half, half - 2 * _LID])
        turned = _about_x(-turn)
        centre = crate.centre + crate.axes @ (edge + turned @ (middle - edge))
        inner = -height if low else height

        def albedo(points: np.ndarray) -> np.ndarray:
            colors = crate.albedo(points + middle[:, None].astype(points.dtype))
            inside = np.abs(points[2] - inner) < 1e-3
            plain = np.asarray(_INSIDE, points.dtype)[:, None]
            return np.where(inside, plain, colors)

        return Solid(box((half, half, height)), centre, crate.axes @ turned, albedo)

    body = part(half - _LID, 0.0, 0.0)
    return body, part(_LID, 2 * (half - _LID), angle)


def fixed_cameras(settings: MovingDemoSettings) -> list[Moment]:
    """Return the photographs of the fixed cameras, camera by camera."""
    viewmats, _ = raycaster.demo_cameras(settings.cameras, 1, 1)
    times = np.linspace(0, 1, settings.times)
    return [Moment(viewmat, float(time)) for viewmat in viewmats for time in times]


def travelling_camera(settings: MovingDemoSettings) -> list[Moment]:
    """Return the photographs of a camera that travels about the scene, in order."""
    times = np.linspace(0, 1, settings.photos)
    return [
        Moment(_view(-0.9 + 4 * np.pi * t, 0.55 + 0.2 * np.sin(5 * np.pi * t)), t)
        for t in times.tolist()
    ]


def held_out_moments(settings: MovingDemoSettings) -> list[Moment]:
    """Return viewpoints and times between those of the training photographs."""
    count = settings.held_out
    spacing = settings.times if settings.cameras else settings.photos
    steps = (np.arange(count) + 0.5) / count * (spacing - 1)
    times = (np.floor(steps) + 0.5) / max(1, spacing - 1)
    golden = np.pi * (3 - np.sqrt(5))
    return [
        Moment(_view(0.4 + golden * index, (0.5, 0.65, 0.75)[index % 3]), time)
        for index, time in enumerate(times.tolist())
    ]


def _view(turn: float, elevation: float) -> np.ndarray:
    """Return the pose of a camera that looks at the still life; angles in radians."""
    flat = np.cos(elevation)
    direction = flat * np.cos(turn), flat * np.sin(turn), np.sin(elevation)
    return look_at(raycaster.TARGET + 5.4 * np.asarray(direction), raycaster.TARGET)


def moving_photograph(moment: Moment, size: tuple[int, int], samples: int = 2):
    """Return a photograph [H, W, 3] float32 of the moving still life."""
    _, K = raycaster.demo_cameras(1, *size)
    scene = moving_solids(moment.time)
    return raycaster.cast(moment.viewmat, K, *size, samples, scene=scene)[0]


def write_moving_dataset(
    folder: str | PathLike[str],
    settings: MovingDemoSettings | None = None,
    *,
    overwrite: bool = False,
) -> None:
    """Write photographs, `transforms_train.json`, `transforms_test.json`, `points.ply`.

    The camera lists have the form of D-NeRF's, with a time in each frame.

    Raises:
      InputError: if a file exists and ``overwrite`` is not set, or cannot be written.
      MissingExtraError: if OpenCV is absent.
    """
    folder, settings = Path(folder), settings or MovingDemoSettings()
    size = settings.width, settings.height
    _, K = raycaster.demo_cameras(1, *size)
    entries = {
        split: [
            CameraEntry(
                name,
                make_camera(viewmat=moment.viewmat, K=K, width=size[0], height=size[1]),
                moment.time,
            )
            for name, moment in found
        ]
        for split, found in _named(settings)
    }
    lists = {split: folder / f"transforms_{split}.json" for split in entries}
    photos = [
        folder / f"{entry.name}.png" for found in entries.values() for entry in found
    ]
    points = folder / "points.ply"
    reject_existing([*photos, *lists.values(), points], overwrite)
    images.opencv()
    for split, found in _named(settings):
        for name, moment in found:
            path = folder / f"{name}.png"
            make_folder(path.parent)
            pixels = moving_photograph(moment, size, settings.samples)
            write_file(path, images.encode_png(images.to_8_bit(pixels)))
        text = transforms_json(entries[split], ply_file_path=points.name)
        write_file(lists[split], text.encode())
    scene = moving_solids(0.0)
    cloud = raycaster.surface_points(settings.points, settings.seed, scene)
    write_file(points, raycaster.points_ply(*cloud))


def _named(
    settings: MovingDemoSettings,
) -> Iterator[tuple[str, list[tuple[str, Moment]]]]:
    """Yield the splits, and their photographs by name without suffix."""
    times = max(1, settings.times)
    fixed = [
        (f"train/camera_{index // times:02d}/{index % times:03d}", moment)
        for index, moment in enumerate(fixed_cameras(settings))
    ]
    moved = [
        (f"train/moving/{index:03d}", moment)
        for index, moment in enumerate(travelling_camera(settings))
    ]
    yield "train", fixed + moved
    yield (
        "test",
        [
            (f"test/{index:03d}", moment)
            for index, moment in enumerate(held_out_moments(settings))
        ],
    )
