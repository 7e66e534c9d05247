"""Datasets that no one should train on, and someone will: COLMAP folders by name.

All but one have three photographs of up to 32 × 32 px, one of them with a mask, and
cameras as far apart, so that one program trains on them all.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from captures import save_photo

from gsjax.cameras.camera import look_at
from gsjax.data.colmap_writer import write_colmap
from gsjax.data.types import Dataset, View

SIZE, PHOTOS, POINTS = 32, 3, 40
# The extent of the last two is then 1, as it is of cameras in one place.
APART = 2 / 1.1
FAR = np.asarray([1e7, -1e7, 1e7])  # m: ten thousand kilometres each way


@dataclass(frozen=True)
class Hostile:
    """Photographs of a scene, [H, W, 3] each, and which are masked altogether; of the
    last one a corner is anyway.
    """

    scene: Dataset
    photos: tuple[np.ndarray, ...]
    masked: tuple[int, ...] = ()


def harmless() -> Hostile:
    """What the others are changed from: coloured points, and noise for pictures."""
    rng = np.random.default_rng(3)
    views, photos = [], []
    for index in range(PHOTOS):
        eye = (APART * (index - 2), -3, 0.5)
        K = np.asarray([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]])
        name = f"{index}.png"
        views.append(View(name, Path(name), look_at(eye, (0, 0, 0)), K, SIZE, SIZE))
        photos.append(rng.integers(0, 256, (SIZE, SIZE, 3)).astype(np.uint8))
    points = rng.uniform(-0.8, 0.8, (POINTS, 3))
    colors = rng.integers(0, 256, (POINTS, 3)).astype(np.uint8)
    scene = Dataset(Path("made"), "made", tuple(views), points, colors)
    return Hostile(scene, tuple(photos))


def _with_views(change: Callable[[int, View], View]) -> Hostile:
    made = harmless()
    views = tuple(change(i, view) for i, view in enumerate(made.scene.views))
    return replace(made, scene=replace(made.scene, views=views))


def _with_points(points: np.ndarray) -> Hostile:
    made = harmless()
    colors = np.resize(made.scene.colors, (len(points), 3))
    return replace(made, scene=replace(made.scene, points=points, colors=colors))


def _with_photos(*values: int) -> Hostile:
    made = harmless()
    flat = tuple(np.full_like(made.photos[0], value) for value in values)
    return replace(made, photos=flat)


def _few(count: int) -> Hostile:
    made = harmless()
    views = made.scene.views[:count]
    scene = replace(made.scene, views=views)
    return replace(made, scene=scene, photos=made.photos[:count])


def _twins() -> Hostile:
    """Photographs that are one, by cameras that are one."""
    made = harmless()
    pose = made.scene.views[1].viewmat
    views = tuple(replace(view, viewmat=pose) for view in made.scene.views)
    scene = replace(made.scene, views=views)
    return replace(made, scene=scene, photos=made.photos[:1] * PHOTOS)


def _turned_anyhow() -> Hostile:
    """Where the cameras stood, but looking anywhere."""
    rng = np.random.default_rng(5)

    def turn(_, view):
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        rotation *= np.sign(np.linalg.det(rotation))
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = -rotation @ view.centre
        return replace(view, viewmat=viewmat)

    return _with_views(turn)


def _far() -> Hostile:
    """Ten thousand kilometres from the origin."""
    made = harmless()
    views = []
    for view in made.scene.views:
        viewmat = view.viewmat.copy()
        viewmat[:3, 3] -= viewmat[:3, :3] @ FAR
        views.append(replace(view, viewmat=viewmat))
    points = made.scene.points + FAR
    return replace(made, scene=replace(made.scene, views=tuple(views), points=points))


def _behind() -> Hostile:
    """5000 points, each behind every camera."""
    rng = np.random.default_rng(7)
    return _with_points(rng.uniform(-1, 1, (5000, 3)) - (0, 60, 0))


def _inside() -> Hostile:
    """Points around every camera, at the camera itself as well."""
    made = harmless()
    rng = np.random.default_rng(9)
    centres = np.stack([view.centre for view in made.scene.views])
    around = centres[np.arange(POINTS) % PHOTOS]
    return _with_points(around + 0.02 * (rng.normal(size=(POINTS, 3)).round(1)))


def _lenses() -> Hostile:
    """From a fisheye's focal length to that of a telescope."""
    focal = (30.0, 0.02, 3e6)

    def lens(index, view):
        K = view.K.copy()
        K[0, 0] = K[1, 1] = focal[index]
        return replace(view, K=K)

    return _with_views(lens)


def _slivers() -> Hostile:
    """A photograph, one row of pixels, and one column."""
    made = harmless()
    sizes = ((SIZE, SIZE), (SIZE, 1), (1, SIZE))
    views, photos = [], []
    for view, (width, height), photo in zip(made.scene.views, sizes, made.photos):
        K = view.K.copy()
        K[0, 2], K[1, 2] = width / 2, height / 2
        views.append(replace(view, K=K, width=width, height=height))
        photos.append(photo[:height, :width])
    scene = replace(made.scene, views=tuple(views))
    return replace(made, scene=scene, photos=tuple(photos))


HOSTILE: dict[str, Callable[[], Hostile]] = {
    "harmless": harmless,
    "one photograph": lambda: _few(1),
    "two that are one": _twins,
    "black": lambda: _with_photos(0, 0, 0),
    "white": lambda: _with_photos(255, 255, 255),
    "black and white": lambda: _with_photos(0, 255, 0),
    "cameras turned anyhow": _turned_anyhow,
    "one point": lambda: _with_points(np.zeros((1, 3))),
    "points in one place": lambda: _with_points(np.zeros((POINTS, 3))),
    "points in a line": lambda: _with_points(np.eye(3)[0] * np.c_[-20:20] / 20),
    "ten thousand km away": _far,
    "all behind the cameras": _behind,
    "cameras in the cloud": _inside,
    "a photograph masked": lambda: replace(harmless(), masked=(1,)),
    "all masked": lambda: replace(harmless(), masked=(0, 1, 2)),
    "focal lengths": _lenses,
    "one pixel wide": _slivers,
    "no points": lambda: _with_points(np.zeros((0, 3))),
}


def write_hostile(folder: Path, made: Hostile) -> Path:
    """The dataset in ``folder``."""
    write_colmap(folder / "sparse" / "0", made.scene)
    for view, photo in zip(made.scene.views, made.photos):
        save_photo(folder / "images" / view.name, photo)
    for index, view in enumerate(made.scene.views):
        mask = np.full((view.height, view.width), 255, np.uint8)
        mask[0, 0] = 255 * (index < PHOTOS - 1)
        mask[:] *= index not in made.masked
        save_photo(folder / "masks" / f"{view.name}.png", mask)
    return folder
