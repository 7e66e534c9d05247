"""COLMAP models as scenes: cameras, poses and points of a structure from motion.

The files are read by us, not by pycolmap: that hangs on, or silently accepts, files
that are truncated (measured with 4.2.1).
"""

import warnings
from os import PathLike
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np

from gsjax.data import colmap_binary, colmap_text
from gsjax.data.colmap_model import (
    ColmapCamera,
    ColmapImage,
    ColmapPoints,
    viewmat_of,
)
from gsjax.data.image_files import (
    find_files,
    find_masks,
    image_folder,
    inside,
    last_parts,
)
from gsjax.data.types import Dataset, View
from gsjax.errors import InputError

_PLACES = ("sparse/0", "sparse", ".", "colmap/sparse/0")  # the last is nerfstudio's


class ColmapModel(NamedTuple):
    """A model as it stands in its files; rigs.bin and frames.bin are not needed."""

    cameras: dict[int, ColmapCamera]
    images: list[ColmapImage]
    points: ColmapPoints


def find_colmap(folder: Path) -> Path | None:
    """Where the model of a dataset lies: sparse/0, sparse, the folder itself, or
    nerfstudio's colmap/sparse/0."""
    for place in _PLACES:
        if any(
            (folder / place / f"cameras.{form}").exists() for form in ("bin", "txt")
        ):
            return folder / place if place != "." else folder
    return None


def read_colmap(folder: Path) -> ColmapModel:
    """Read the cameras, images and points3D files of a folder, .bin before .txt.

    Raises:
      InputError: on a missing, truncated or damaged file, on values that cannot be,
        or on an image of a camera that is not there. A missing points3D is warned of.
    """
    path, reader = _file(folder, "cameras")
    cameras = reader.read_cameras(path)
    path, reader = _file(folder, "images")
    images = reader.read_images(path)
    if not images:
        raise InputError(f"{path}: the model has no image; choose another one")
    for image in images:
        if image.camera not in cameras:
            raise InputError(
                f"{path}: image {image.name!r} is of camera {image.camera}, which the "
                f"{len(cameras)} cameras of {folder} do not have; the files are not of "
                "one model"
            )
    try:
        path, reader = _file(folder, "points3D")
    except InputError as error:
        warnings.warn(f"{error}; the scene has no points", UserWarning, stacklevel=2)
        return ColmapModel(cameras, images, _no_points())
    return ColmapModel(cameras, images, reader.read_points(path))


def _file(folder: Path, name: str) -> tuple[Path, ModuleType]:
    for suffix, reader in ((".bin", colmap_binary), (".txt", colmap_text)):
        path = folder / (name + suffix)
        if path.exists():
            return path, reader
    raise InputError(
        f"{folder}: neither {name}.bin nor {name}.txt is there; a COLMAP model has "
        "cameras, images and points3D"
    )


def _no_points() -> ColmapPoints:
    return ColmapPoints(
        ids=np.zeros(0, np.uint64),
        xyz=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        errors=np.zeros(0),
        track_lengths=np.zeros(0, np.int64),
    )


def _warn_of_larger(place: Path, count: int) -> None:
    """Tell of another model beside the one that is read, if it has more images: COLMAP
    writes several where it could not join them."""
    if place.name != "0":
        return
    counts = {path: _declared(path) for path in place.parent.glob("*/images.bin")}
    path = max(counts, key=lambda path: counts[path], default=place)
    if counts.get(path, 0) > count:
        warnings.warn(
            f"{place}: {count} images are in this model, and {counts[path]} in "
            f"{path.parent}; to take that, put it in the place of the first",
            UserWarning,
            stacklevel=3,
        )


def _declared(path: Path) -> int:
    """How many images an images.bin says it has; 0 if there is no room for so many."""
    try:
        with path.open("rb") as file:
            count = int.from_bytes(file.read(8), "little")
        return count if 64 * count <= path.stat().st_size else 0
    except OSError:
        return 0


def _path(place: Path, listed: str, root: Path, moved: bool) -> str:
    """Where a photograph lies in ``root``, by its name in the model.

    Of one that was ``moved`` to another folder, the end of it that does not lead out;
    and some models are of the folder above, and name that of the photographs, too.
    """
    if moved:
        listed = last_parts(listed) or listed
    offer = ", or pass images=, the folder that it is in (--images)"
    path = inside(str(place), listed, offer)
    if len(path.parts) > 1 and path.parts[0] == "images" and not (root / path).exists():
        return path.relative_to("images").as_posix()
    return listed


def _name(root: Path, path: str, found: dict[str, Path]) -> str | None:
    """What a photograph is called: where it was looked for, or where it was found in
    another folder; None if it is missing."""
    file = found.get(path)
    if file is None or file.parent == (root / path).parent:
        return None if file is None else path
    return file.relative_to(root).as_posix()


def load_colmap(
    folder: Path,
    *,
    images: str | PathLike[str] | None = None,
    skip_missing: bool = False,
    factor: int | None = None,
    poses_only: bool = False,
) -> Dataset:
    """The scene of a dataset that has a COLMAP model; see `load_dataset`."""
    place = find_colmap(folder)
    if place is None:
        raise InputError(f"{folder}: no cameras.bin or cameras.txt in {_PLACES}")
    model = read_colmap(place)
    _warn_of_larger(place, len(model.images))
    root = image_folder(folder, images, factor, poses_only=poses_only)
    moved = images is not None or poses_only
    paths = {i.name: _path(place, i.name, root, moved) for i in model.images}
    found = find_files(
        *(place, root, paths.values()),
        skip_missing=skip_missing,
        elsewhere=images is not None,
        factor=factor,
        poses_only=poses_only,
    )
    names = {listed: _name(root, path, found) for listed, path in paths.items()}
    called = list(filter(None, names.values()))
    masks = {} if poses_only else find_masks(folder / "masks", called)
    views = []
    for image in model.images:
        name, camera = names[image.name], model.cameras[image.camera]
        if name is None:
            continue
        view = View(
            name=name,
            image=found[paths[image.name]],
            viewmat=viewmat_of(image.quat, image.translation),
            K=camera.K,
            width=camera.width,
            height=camera.height,
            lens=camera.lens,
            mask=masks.get(name),
        )
        views.append(view)
    points = model.points
    return Dataset(place, "colmap", tuple(views), points.xyz, points.colors)
