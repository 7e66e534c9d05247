"""A reconstruction as a dataset: undistorted photographs, masks and a COLMAP model.

Photographs and masks go through the same map, one cubic interpolation (masks: nearest
pixel) from the working files, so that nothing is resampled or compressed twice.
"""

import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsjax.errors import InputError
from gsjax.io.images import encode_png, opencv
from gsjax.runtime.files import make_folder, temporary_in, write_file, writing
from gsjax.sfm.engine import colmap
from gsjax.sfm.photos import Photograph, Workshop, read_upright

ENTRIES = ("images", "masks", "sparse", "sfm.json")  # the last says: made by us
JPEG_QUALITY = 95
_BAND = 256  # rows of a map at a time


class _Lens(NamedTuple):
    """From a pinhole's image to the photograph: for each pixel, where to look."""

    pinhole: Any
    x: np.ndarray
    y: np.ndarray


def write_dataset(
    model: Any, photographs: list[Photograph], work: Workshop, dataset: Path
) -> None:
    """Write ``images/``, ``masks/`` and ``sparse/0/`` of what is registered.

    Args:
      model: pycolmap's reconstruction of the working files; is changed to that of the
        undistorted ones.
      dataset: the folder, which exists.
    """
    by_file = {photo.shot.file: photo for photo in photographs}
    for folder in ("images", "sparse/0"):
        make_folder(dataset / folder)
    images = sorted(model.images.values(), key=lambda image: image.camera_id)
    # Camera by camera: the maps of one take as much memory as a few photographs.
    for key, of_camera in groupby(images, key=lambda image: image.camera_id):
        camera = model.cameras[key]
        lens = _lens(camera)
        for image in of_camera:
            photo = by_file[image.name]
            _write_pixels(photo, lens, work, dataset)
            _move_points(image, camera, lens)
            image.name = photo.name
        camera.model = lens.pinhole.model
        camera.width, camera.height = lens.pinhole.width, lens.pinhole.height
        camera.params = lens.pinhole.params
    model.write_binary(dataset / "sparse" / "0")


def _lens(camera: Any) -> _Lens:
    """The pinhole that sees no further than the camera did, and the map to it."""
    pycolmap = colmap()
    options = pycolmap.UndistortCameraOptions()
    options.max_image_size = max(camera.width, camera.height)
    pinhole = pycolmap.undistort_camera(options, camera)
    maps = np.empty((2, pinhole.height, pinhole.width), np.float32)
    for top in range(0, pinhole.height, _BAND):
        rows = np.arange(top, min(top + _BAND, pinhole.height))
        y, x = np.meshgrid(rows + 0.5, np.arange(pinhole.width) + 0.5, indexing="ij")
        rays = pinhole.cam_from_img(np.stack([x.ravel(), y.ravel()], -1))
        seen = camera.img_from_cam(np.concatenate([rays, np.ones((len(rays), 1))], 1))
        maps[:, rows] = (seen - 0.5).T.reshape(2, *x.shape)
    return _Lens(pinhole, *maps)


def _write_pixels(photo: Photograph, lens: _Lens, work: Workshop, dataset: Path):
    cv2 = opencv()
    border = cv2.BORDER_REPLICATE
    pixels = _read(work.photos / photo.shot.file)
    pixels = cv2.remap(pixels, lens.x, lens.y, cv2.INTER_CUBIC, borderMode=border)
    write_file(dataset / "images" / photo.name, _encoded(pixels, photo.name))
    if photo.mask:
        make_folder(dataset / "masks")
        mask = _read(work.mask(photo.shot.file), grey=True)
        mask = cv2.remap(mask, lens.x, lens.y, cv2.INTER_NEAREST, borderMode=border)
        write_file(dataset / "masks" / f"{photo.name}.png", encode_png(mask))


def _read(path: Path, grey: bool = False) -> np.ndarray:
    try:
        return read_upright(path, grey)
    except InputError as error:
        raise InputError(f"{error}; this working file was whole before") from error


def _encoded(pixels: np.ndarray, name: str) -> bytes:
    if name.lower().endswith(".png"):
        return encode_png(pixels[..., ::-1])
    cv2 = opencv()
    done, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise InputError(f"{name}: OpenCV cannot encode {pixels.shape} as JPEG")
    return data.tobytes()


def _move_points(image: Any, camera: Any, lens: _Lens) -> None:
    """Where the features are in the undistorted image."""
    if not image.num_points2D():
        return
    before = np.array([point.xy for point in image.points2D])
    rays = camera.cam_from_img(before)
    after = lens.pinhole.img_from_cam(
        np.concatenate([rays, np.ones((len(rays), 1))], 1)
    )
    for point, xy in zip(image.points2D, after):
        point.xy = xy


def refuse_output(
    output: Path, sources: Iterable[Path | None], overwrite: bool
) -> None:
    """Check the folder of the dataset before the work that fills it.

    Raises:
      InputError: if it is a file, or has entries that would be replaced unasked, or
        that no dataset of ours put there; or if it would replace one of the sources.
    """
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: is a file; a folder is to be written there")
    for source in filter(None, sources):
        within = source.resolve()
        if any(within.is_relative_to((output / e).resolve()) for e in ENTRIES):
            raise InputError(
                f"{source}: lies where the dataset would be written; pass another "
                "folder with -o"
            )
    found = [output / entry for entry in ENTRIES if (output / entry).exists()]
    if found and not overwrite:
        raise InputError(
            f"{found[0]}: exists; pass --overwrite, or another folder with -o"
        )
    if found and not (output / ENTRIES[-1]).is_file():
        raise InputError(
            f"{found[0]}: was not made by gsjax sfm (no sfm.json beside it) and is not "
            "replaced; move it away, or pass another folder with -o"
        )


@contextmanager
def staging(output: Path) -> Iterator[Path]:
    """A folder from which all can be moved to ``output``, gone at the end whatever
    happens: within it, as it may be a disk of its own; beside it, if it is not there.
    """
    base = output if output.is_dir() else output.parent
    make_folder(base)
    folder = temporary_in(base)
    make_folder(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def install(dataset: Path, output: Path, stage: Path) -> None:
    """Move a finished dataset into place; other files in ``output`` stay.

    What is replaced goes to ``stage`` first. sfm.json leaves first and comes last:
    while it is there, the dataset is whole.

    Raises:
      InputError: if files cannot be moved.
    """
    with writing(output):
        if not output.exists():
            dataset.rename(output)
            return
        old = stage / "replaced"
        old.mkdir()
        for entry in reversed(ENTRIES):
            if (output / entry).exists():
                (output / entry).rename(old / entry)
        for entry in ENTRIES:
            if (dataset / entry).exists():
                (dataset / entry).rename(output / entry)
