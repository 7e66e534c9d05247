"""COLMAP models as datasets: cameras, poses and points of structure from motion.

The files are parsed here, not by pycolmap, which hangs on or silently accepts truncated
files.
"""

from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from gsjax.data import colmap_binary, colmap_text, image_files
from gsjax.data.colmap_model import (
    NO_POINTS,
    ColmapCamera,
    ColmapImage,
    ColmapPoints,
    viewmat_of,
)
from gsjax.data.types import Dataset, Reader, ReadOptions, View, unexpected
from gsjax.errors import InputError
from gsjax.io.common import warn

_PLACES = ("sparse/0", "sparse", ".")
_NERFSTUDIO = "colmap/sparse/0"
_ALL_PLACES = (*_PLACES, _NERFSTUDIO)


class ColmapModel(NamedTuple):
    """The content of a model's files; rigs.bin and frames.bin are not needed."""

    cameras: dict[int, ColmapCamera]
    images: list[ColmapImage]
    points: ColmapPoints


def find_colmap(folder: Path) -> Path | None:
    """Return the folder of a dataset's model, if it has one.

    It is sparse/0, sparse, the folder itself, or nerfstudio's colmap/sparse/0.
    """
    return next((folder / p for p in _ALL_PLACES if _has_model(folder / p)), None)


def _has_model(path: Path) -> bool:
    return any((path / f"cameras.{suffix}").exists() for suffix in ("bin", "txt"))


def read_colmap(folder: Path) -> ColmapModel:
    """Read the cameras, images and points3D files of a folder; .bin precedes .txt.

    Raises:
      InputError: if a file is missing, truncated or damaged, a value is impossible, or
        an image refers to a missing camera. A missing points3D gives a warning.
    """
    path, parser = _file(folder, "cameras")
    cameras = parser.read_cameras(path)
    path, parser = _file(folder, "images")
    images = parser.read_images(path)
    if not images:
        raise InputError(f"{path}: the model has no image; choose another one")
    for image in images:
        if image.camera not in cameras:
            raise InputError(
                f"{path}: image {image.name!r} refers to camera {image.camera}, which "
                f"is not among the {len(cameras)} cameras; use files of one model"
            )
    try:
        path, parser = _file(folder, "points3D")
    except InputError as error:
        warn(f"{error}; the dataset has no points")
        return ColmapModel(cameras, images, NO_POINTS)
    return ColmapModel(cameras, images, parser.read_points(path))


def _file(folder: Path, name: str) -> tuple[Path, ModuleType]:
    for suffix, parser in ((".bin", colmap_binary), (".txt", colmap_text)):
        path = folder / (name + suffix)
        if path.exists():
            return path, parser
    remedy = "a COLMAP model has cameras, images and points3D"
    raise unexpected(folder, f"{name}.bin or {name}.txt", "neither", remedy)


def _warn_of_larger(place: Path, count: int) -> None:
    """Warn if another of several models, which COLMAP did not join, has more images."""
    if place.name != "0":
        return
    counts = {path: _declared(path) for path in place.parent.glob("*/images.bin")}
    path = max(counts, key=lambda path: counts[path], default=place)
    if counts.get(path, 0) > count:
        warn(
            f"{place}: this model has {count} images, that of {path.parent} "
            f"{counts[path]}; to use the larger one, exchange the two folders"
        )


def _declared(path: Path) -> int:
    """Return the number of images that an images.bin declares; 0 if they cannot fit."""
    try:
        with path.open("rb") as file:
            count = int.from_bytes(file.read(8), "little")
        return count if 64 * count <= path.stat().st_size else 0
    except OSError:
        return 0


def _path(place: Path, listed: str, root: Path, moved: bool) -> str:
    """Return the path of a photograph relative to ``root``, from its name in the model.

    Names of some models are relative to the folder above and start with ``images``.
    """
    path = image_files.listed_path(str(place), listed, moved)
    if len(path.parts) > 1 and path.parts[0] == "images" and not (root / path).exists():
        return path.relative_to("images").as_posix()
    return path.as_posix() if moved else listed


def _name(root: Path, path: str, file: Path | None) -> str | None:
    """Return the searched path, or that of the file if found elsewhere, else None."""
    if file is None or file.parent == (root / path).parent:
        return None if file is None else path
    return file.relative_to(root).as_posix()


def load_colmap(folder: Path, options: ReadOptions | None = None) -> Dataset:
    """Read the dataset of a folder that contains a COLMAP model; see `load_dataset`."""
    options = options or ReadOptions()
    place = find_colmap(folder)
    if place is None:
        raise InputError(
            f"{folder}: expected cameras.bin or cameras.txt in one of "
            f"{', '.join(_ALL_PLACES)}; pass the folder of a dataset"
        )
    model = read_colmap(place)
    _warn_of_larger(place, len(model.images))
    root = image_files.image_folder(folder, options)
    moved = options.images is not None or options.poses_only
    paths = {i.name: _path(place, i.name, root, moved) for i in model.images}
    found = image_files.find_files(
        place, root, paths.values(), options, elsewhere=options.images is not None
    )
    names = {listed: _name(root, p, found.get(p)) for listed, p in paths.items()}
    masks, called = {}, list(filter(None, names.values()))
    if not options.poses_only:
        masks = image_files.find_masks(folder / "masks", called)
    views = []
    for image in model.images:
        name, camera = names[image.name], model.cameras[image.camera]
        if name is not None:
            file, mask = found[paths[image.name]], masks.get(name)
            viewmat = viewmat_of(image.quat, image.translation)
            size = camera.width, camera.height
            views.append(View(name, file, viewmat, camera.K, *size, camera.lens, mask))
    points = model.points
    return Dataset(place, "colmap", tuple(views), points.xyz, points.colors)


def _detects(*places: str):
    return lambda path: any(_has_model(path / place) for place in places)


COLMAP = Reader("COLMAP", _detects(*_PLACES), load_colmap)
NERFSTUDIO_COLMAP = Reader("COLMAP of nerfstudio", _detects(_NERFSTUDIO), load_colmap)
