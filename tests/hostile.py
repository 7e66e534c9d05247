"""Datasets that no one should train on, and someone will: COLMAP folders by name.

All but one have three photographs of up to 32 × 32 px, one of them with a mask, and
cameras as far apart, so that one program trains on them all.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from captures import save_photo

from gsjax import look_at
from gsjax.data.colmap_writer import write_colmap
from gsjax.data.types import Dataset, View

SIZE, PHOTOS, POINTS = 32, 3, 40
# The extent of the last two is then 1, as it is of cameras in one place.
APART = 2 / 1.1
FAR = np.asarray([1e7, -1e7, 1e7])  # m: ten thousand kilometres each way


@dataclass(frozen=True)
class Hostile:
    """A dataset, its photographs [H, W, 3], and which of them are fully masked.

    A corner of the last one is always masked.
    """

    dataset: Dataset
    photos: tuple[np.ndarray, ...]
    masked: tuple[int, ...] = ()


def _matrix(focal: float, width=SIZE, height=SIZE) -> np.ndarray:
    return np.asarray([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def harmless() -> Hostile:
    """Return coloured points and photographs of noise, from which others are made."""
    rng = np.random.default_rng(3)
    views, photos = [], []
    for index in range(PHOTOS):
        pose = look_at((APART * (index - 2), -3, 0.5), (0, 0, 0))
        name, K = f"{index}.png", _matrix(30.0)
        views.append(View(name, Path(name), pose, K, SIZE, SIZE))
        photos.append(rng.integers(0, 256, (SIZE, SIZE, 3)).astype(np.uint8))
    points = rng.uniform(-0.8, 0.8, (POINTS, 3))
    colors = rng.integers(0, 256, (POINTS, 3)).astype(np.uint8)
    dataset = Dataset(Path("made"), "made", tuple(views), points, colors)
    return Hostile(dataset, tuple(photos))


def _with_views(change: Callable[[int, View], View]) -> Hostile:
    made = harmless()
    views = tuple(change(i, view) for i, view in enumerate(made.dataset.views))
    return replace(made, dataset=replace(made.dataset, views=views))


def _with_points(points: np.ndarray, made: Hostile | None = None) -> Hostile:
    made = made or harmless()
    colors = np.resize(made.dataset.colors, (len(points), 3))
    return replace(made, dataset=replace(made.dataset, points=points, colors=colors))


def _with_photos(*values: int) -> Hostile:
    flat = tuple(np.full((SIZE, SIZE, 3), value, np.uint8) for value in values)
    return replace(harmless(), photos=flat)


def _one() -> Hostile:
    made = harmless()
    dataset = replace(made.dataset, views=made.dataset.views[:1])
    return Hostile(dataset, made.photos[:1])


def _twins() -> Hostile:
    """Return one photograph three times, by cameras in one place."""
    pose = harmless().dataset.views[1].viewmat
    made = _with_views(lambda _, view: replace(view, viewmat=pose))
    return replace(made, photos=made.photos[:1] * PHOTOS)


def _turned() -> Hostile:
    """Return cameras that look anywhere."""
    rng = np.random.default_rng(5)

    def turn(_, view):
        ahead, up = rng.normal(size=(2, 3))
        return replace(view, viewmat=look_at(view.centre, view.centre + ahead, up))

    return _with_views(turn)


def _far() -> Hostile:
    move = np.eye(4)
    move[:3, 3] = -FAR
    made = _with_views(lambda _, view: replace(view, viewmat=view.viewmat @ move))
    return _with_points(harmless().dataset.points + FAR, made)


def _inside() -> Hostile:
    """Return points around every camera, also at the camera itself."""
    rng = np.random.default_rng(9)
    centres = np.stack([view.centre for view in harmless().dataset.views])
    around = centres[np.arange(POINTS) % PHOTOS]
    return _with_points(around + 0.02 * (rng.normal(size=(POINTS, 3)).round(1)))


def _lenses() -> Hostile:
    """Return focal lengths from that of a fisheye to that of a telescope."""
    lenses = [_matrix(focal) for focal in (30.0, 0.02, 3e6)]
    return _with_views(lambda index, view: replace(view, K=lenses[index]))


def _slivers() -> Hostile:
    """Return a photograph, one row of pixels, and one column."""
    sizes = ((SIZE, SIZE), (SIZE, 1), (1, SIZE))

    def cut(index, view):
        width, height = sizes[index]
        return replace(view, K=_matrix(30.0, *sizes[index]), width=width, height=height)

    made = _with_views(cut)
    photos = zip(made.photos, sizes)
    return replace(made, photos=tuple(photo[:h, :w] for photo, (w, h) in photos))


HOSTILE: dict[str, Callable[[], Hostile]] = {
    "harmless": harmless,
    "one photograph": _one,
    "two that are one": _twins,
    "black": lambda: _with_photos(0, 0, 0),
    "white": lambda: _with_photos(255, 255, 255),
    "black and white": lambda: _with_photos(0, 255, 0),
    "cameras turned anyhow": _turned,
    "one point": lambda: _with_points(np.zeros((1, 3))),
    "points in one place": lambda: _with_points(np.zeros((POINTS, 3))),
    "points in a line": lambda: _with_points(np.eye(3)[0] * np.c_[-20:20] / 20),
    "ten thousand km away": _far,
    "all behind the cameras": lambda: _with_points(np.full((5000, 3), (0, -60, 0.1))),
    "cameras in the cloud": _inside,
    "a photograph masked": lambda: replace(harmless(), masked=(0,)),
    "all masked": lambda: replace(harmless(), masked=(0, 1, 2)),
    "focal lengths": _lenses,
    "one pixel wide": _slivers,
    "no points": lambda: _with_points(np.zeros((0, 3))),
}


def write_hostile(folder: Path, made: Hostile) -> Path:
    """Write the dataset to ``folder``, and return it."""
    write_colmap(folder / "sparse" / "0", made.dataset)
    for index, (view, photo) in enumerate(zip(made.dataset.views, made.photos)):
        save_photo(folder / "images" / view.name, photo)
        mask = np.full(photo.shape[:2], 255, np.uint8)
        mask[0, 0] = 255 * (index < PHOTOS - 1)
        mask[:] *= index not in made.masked
        save_photo(folder / "masks" / f"{view.name}.png", mask)
    return folder
