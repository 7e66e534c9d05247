"""Write a reconstruction as a dataset: photographs, masks, COLMAP model.

Photographs keep their pixels and lenses, and are encoded once. If they are undistorted,
they and their masks are resampled once, from the working files through one map (cubic;
masks: nearest pixel).
"""

import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsjax.data.times import TIMES_FILE, FrameTimes, write_times
from gsjax.errors import InputError
from gsjax.io.images import encode_png, opencv
from gsjax.runtime.files import make_folder, temporary_in, write_file, writing
from gsjax.sfm.engine import colmap
from gsjax.sfm.photos import PreparedPhoto, WorkFolder, read_upright

# The last marks a dataset as written by this module.
SCENES = "scenes"  # folder of further datasets
ENTRIES = ("images", "masks", "sparse", TIMES_FILE, SCENES, "sfm.json")
JPEG_QUALITY = 95
_ROWS_PER_STEP = 256


class _UndistortionMap(NamedTuple):
    """A pinhole camera and, for each of its pixels, where the photograph shows it."""

    pinhole: Any
    x: np.ndarray
    y: np.ndarray


def write_dataset(
    model: Any,
    photos: list[PreparedPhoto],
    work: WorkFolder,
    dataset: Path,
    undistort: bool = False,
    moving: bool = False,
) -> None:
    """Write ``images/``, ``masks/`` and ``sparse/0/`` of the registered images.

    Args:
      model: pycolmap's reconstruction of the working files; changed in place to that of
        the images of the dataset.
      dataset: the folder.
      undistort: resample the photographs to ideal pinholes.
      moving: write the times of the frames, and no masks, which hide what moves.
    """
    by_file = {photo.record.file: photo for photo in photos}
    for folder in ("images", "sparse/0"):
        make_folder(dataset / folder)
    images = sorted(model.images.values(), key=lambda image: image.camera_id)
    # Camera by camera: the map of one takes as much memory as a few photographs.
    for key, of_camera in groupby(images, key=lambda image: image.camera_id):
        camera = model.cameras[key]
        undistortion = _undistortion_map(camera) if undistort else None
        for image in of_camera:
            photo = by_file[image.name]
            if moving:
                photo = photo._replace(mask=False)
            _write_pixels(photo, undistortion, work, dataset)
            if undistortion is not None:
                _undistort_features(image, camera, undistortion.pinhole)
            image.name = photo.name
        if undistortion is None:
            continue
        pinhole = undistortion.pinhole
        camera.model = pinhole.model
        camera.width, camera.height = pinhole.width, pinhole.height
        camera.params = pinhole.params
    model.write_binary(dataset / "sparse" / "0")
    if moving:
        kept = {image.name for image in images}
        seconds = {p.name: p.seconds for p in photos if p.name in kept}
        known = {name: s for name, s in seconds.items() if s is not None}
        write_times(dataset / TIMES_FILE, FrameTimes(known))


def _undistortion_map(camera: Any) -> _UndistortionMap:
    """Return the map to the pinhole whose view lies within that of the camera."""
    pycolmap = colmap()
    options = pycolmap.UndistortCameraOptions()
    options.max_image_size = max(camera.width, camera.height)
    pinhole = pycolmap.undistort_camera(options, camera)
    maps = np.empty((2, pinhole.height, pinhole.width), np.float32)
    for top in range(0, pinhole.height, _ROWS_PER_STEP):
        rows = np.arange(top, min(top + _ROWS_PER_STEP, pinhole.height))
        y, x = np.meshgrid(rows + 0.5, np.arange(pinhole.width) + 0.5, indexing="ij")
        rays = pinhole.cam_from_img(np.stack([x.ravel(), y.ravel()], -1))
        seen = camera.img_from_cam(np.concatenate([rays, np.ones((len(rays), 1))], 1))
        maps[:, rows] = (seen - 0.5).T.reshape(2, *x.shape)
    return _UndistortionMap(pinhole, *maps)


def _write_pixels(
    photo: PreparedPhoto,
    undistortion: _UndistortionMap | None,
    work: WorkFolder,
    dataset: Path,
) -> None:
    cv2 = opencv()

    def resampled(pixels: np.ndarray, kind: int) -> np.ndarray:
        if undistortion is None:
            return pixels
        maps, border = (undistortion.x, undistortion.y), cv2.BORDER_REPLICATE
        return cv2.remap(pixels, *maps, kind, borderMode=border)

    pixels = _read_working_file(work.photos / photo.record.file)
    pixels = resampled(pixels, cv2.INTER_CUBIC)
    image = dataset / "images" / photo.name
    make_folder(image.parent)
    write_file(image, _encode(pixels, photo.name))
    if photo.mask:
        drawn = dataset / "masks" / f"{photo.name}.png"
        make_folder(drawn.parent)
        mask = _read_working_file(work.mask(photo.record.file), grey=True)
        mask = resampled(mask, cv2.INTER_NEAREST)
        write_file(drawn, encode_png(mask))


def _read_working_file(path: Path, grey: bool = False) -> np.ndarray:
    try:
        return read_upright(path, grey)
    except InputError as error:
        raise InputError(
            f"{error}; the working file changed while in use; check the disk"
        ) from error


def _encode(pixels: np.ndarray, name: str) -> bytes:
    if name.lower().endswith(".png"):
        return encode_png(pixels[..., ::-1])
    cv2 = opencv()
    done, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise InputError(f"{name}: OpenCV cannot encode {pixels.shape} as JPEG")
    return data.tobytes()


def _undistort_features(image: Any, camera: Any, pinhole: Any) -> None:
    """Move the features of an image to their places in the undistorted image."""
    if not image.num_points2D():
        return
    before = np.array([point.xy for point in image.points2D])
    rays = camera.cam_from_img(before)
    after = pinhole.img_from_cam(np.concatenate([rays, np.ones((len(rays), 1))], 1))
    for point, xy in zip(image.points2D, after):
        point.xy = xy


def check_output(output: Path, sources: Iterable[Path | None], overwrite: bool) -> None:
    """Check the folder of a dataset before the work that fills it.

    Raises:
      InputError: if it is a file, if it would replace a source, if entries exist and
        ``overwrite`` is not set, or if they were not written by `write_dataset`.
    """
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: expected a folder, got a file; pass another to -o")
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
def staging_folder(output: Path) -> Iterator[Path]:
    """Yield a temporary folder on the disk of ``output``, removed on exit.

    It lies in ``output`` if that exists, else beside it: files are moved, not copied.
    """
    base = output if output.is_dir() else output.parent
    make_folder(base)
    folder = temporary_in(base)
    make_folder(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def install_dataset(dataset: Path, output: Path, stage: Path) -> None:
    """Move a finished dataset into place; other files in ``output`` are kept.

    Replaced entries move to ``stage``. sfm.json is moved away first and put in place
    last, so its presence means that the dataset is complete.

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
