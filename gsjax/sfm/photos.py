"""Prepare photographs and masks for structure from motion: upright and scaled down.

OpenCV decodes them and applies the EXIF orientation; they are written as PNG without
EXIF, so every reader sees the same pixels. Transparent parts go into the mask.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.data import heif
from gsjax.data.decode import decode, warn_of_damage
from gsjax.data.image_files import (
    SUFFIXES,
    check_name,
    files_by_lowered_suffix,
    find_mask,
    natural_order,
)
from gsjax.errors import InputError
from gsjax.io.images import captured_stderr, encode_png, opencv, shrink
from gsjax.runtime.files import opened, write_file
from gsjax.sfm.mapping import ImageRecord, exif_camera

_KEPT = (".jpg", ".jpeg", ".png")  # formats that the dataset keeps
_RAW = (
    *(".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf"),
    *(".orf", ".rw2", ".pef", ".srw", ".nrw"),
)
_UNSUPPORTED = (
    *_RAW,
    *(".gif", ".jxl", ".jp2", ".psd", ".jfif", ".jpe", ".mpo", ".ppm"),
)
_JPEG = b"\xff\xd8"  # first bytes of a JPEG, which has no alpha
_CUBIC_REACH = 2  # px, of the interpolation that undistorts


class PreparedPhoto(NamedTuple):
    """A photograph in the working folder.

    Attributes:
      name: name in the dataset; the working file is named by number.
      record: the image as COLMAP sees it.
      mask: whether it has a mask, drawn or from transparency.
      seconds: its time, of the frame of a video; None for a photograph.
    """

    name: str
    record: ImageRecord
    mask: bool = False
    seconds: float | None = None


class WorkFolder(NamedTuple):
    """The working folder: ``photos/``, ``masks/`` and COLMAP's files."""

    folder: Path

    @property
    def photos(self) -> Path:
        """Folder of the photographs."""
        return self.folder / "photos"

    @property
    def masks(self) -> Path:
        """Folder of the masks."""
        return self.folder / "masks"

    @property
    def database(self) -> Path:
        """COLMAP's database."""
        return (self.folder / "database.db").resolve()

    def mask(self, file: str) -> Path:
        """Return the mask of a working file; COLMAP expects a second suffix."""
        return self.masks / f"{file}.png"

    def add(
        self, number: int, name: str, pixels: np.ndarray, focal: float | None, key: str
    ) -> PreparedPhoto:
        """Write a photograph [H, W, 3] BGR; ``focal`` is in its pixels."""
        file = f"{number:06d}.png"
        write_file(self.photos / file, encode_png(pixels[..., ::-1]))
        height, width = pixels.shape[:2]
        return PreparedPhoto(name, ImageRecord(file, width, height, focal, key))


def find_photos(folder: Path, skipped: Sequence[Path] = ()) -> list[Path]:
    """Return the photographs in a folder and those below, in natural order (2, 10).

    Hidden folders, masks, and datasets that `gsjax.sfm` has written are left out.

    Args:
      folder: to search.
      skipped: further folders to leave out.

    Raises:
      InputError: if there are fewer than two, if a format is not supported, or if two
        would have the same name in the dataset.
    """
    files = sorted(
        _files_below(folder, {path.resolve() for path in skipped}),
        key=lambda path: [
            natural_order(part) for part in path.relative_to(folder).parts
        ],
    )
    unsupported = [p for p in files if p.suffix.lower() in _UNSUPPORTED]
    if unsupported:
        suffix = unsupported[0].suffix
        what = f"{suffix} is not supported; convert the photos to JPEG (keeping EXIF)"
        if suffix.lower() in _RAW:
            what = f"{suffix} is a raw format; develop the photos to JPEG, all alike"
        raise InputError(f"{_some(unsupported)}: {what}, or move them away")
    found = [p for p in files if p.suffix.lower() in SUFFIXES]
    if len(found) < 2:
        raise InputError(
            f"{folder}: expected at least 2 photos ({', '.join(SUFFIXES)}), got "
            f"{len(found)}; add photos (20 or more are better), or pass the file of a "
            "video"
        )
    names = [dataset_name(path, folder) for path in found]
    counts = Counter(names)
    duplicates = [p for p, name in zip(found, names) if counts[name] > 1]
    if duplicates:
        raise InputError(
            f"{_some(duplicates)}: would have the same name in the dataset; rename one"
        )
    return found


def _files_below(folder: Path, skipped: set[Path]) -> Iterator[Path]:
    """Yield the visible files of a folder and of those below."""
    for path in folder.iterdir():
        if path.name.startswith("."):
            continue
        if not path.is_dir():
            yield path
        elif not (
            path.name == "masks"
            or (path / "sfm.json").exists()
            or path.resolve() in skipped
        ):
            yield from _files_below(path, skipped)


def dataset_name(path: Path, folder: Path) -> str:
    """Return the name of a photograph in the dataset, relative to the source folder.

    HEIC and AVIF become .jpg, other formats that the dataset does not keep .png.

    Raises:
      InputError: if the name is not UTF-8.
    """
    suffix = path.suffix.lower()
    for part in (path, *path.parents):
        if part == folder:
            break
        check_name(part)
    inside = path.relative_to(folder)
    if suffix not in _KEPT:
        inside = inside.with_suffix(".jpg" if suffix in heif.SUFFIXES else ".png")
    return inside.as_posix()


def read_upright(path: Path, grey: bool = False) -> np.ndarray:
    """Decode an image and apply its EXIF orientation.

    Returns:
      [H, W, 3] BGR uint8; with ``grey`` [H, W] in the file's bit depth, since 16-bit
      values below 256 would become 0 in 8 bits.

    Raises:
      InputError: if the file is no image, is truncated or corrupt, or declares more
        pixels than a camera makes; the latter before any allocation.
    """
    cv2 = opencv()
    with warn_of_damage([path]):
        deep_grey = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
        return decode(path, deep_grey if grey else cv2.IMREAD_COLOR)


def _read_photo(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Return a photograph and where it is less than half opaque, both upright.

    Returns:
      [H, W, 3] BGR uint8; [H, W] bool, or None if all of it is opaque.
    """
    upright = read_upright(path)
    with opened(path, "a photograph") as file:
        if file.read(2) == _JPEG:
            return upright, None
    cv2 = opencv()
    with captured_stderr():  # damage has been reported by `read_upright`
        stored = decode(path, cv2.IMREAD_UNCHANGED)  # the only mode with alpha
        if stored.ndim < 3 or stored.shape[2] not in (2, 4):
            return upright, None
        alpha = stored[..., -1]
        opaque = np.iinfo(alpha.dtype).max if alpha.dtype.kind == "u" else 1
        hidden = alpha < opaque / 2
        if not hidden.any():
            return upright, None
        colors = decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    # How OpenCV orients depends on format and version, so compare the pixels.
    both = zip(_orientations(colors), _orientations(hidden))
    return upright, next(h for c, h in both if np.array_equal(c, upright))


def _orientations(pixels: np.ndarray) -> Iterator[np.ndarray]:
    """Yield an image in the eight EXIF orientations, as stored first."""
    for image in (pixels, pixels[:, ::-1]):
        for quarters in range(4):
            yield np.rot90(image, quarters)


def prepare_photos(
    paths: Sequence[Path],
    masks: Path | None,
    work: WorkFolder,
    max_size: int,
    folder: Path | None = None,
) -> list[PreparedPhoto]:
    """Write photographs and masks into the working folder.

    A pixel is excluded where the mask is black or the photograph is less than half
    opaque. If one photograph has a mask, one is written for each, as COLMAP expects.

    Args:
      masks: folder of masks, or None.
      max_size: upper limit of the longer side in px; 0 for none.
      folder: that names in the dataset are relative to; None if all lie in one.

    Raises:
      InputError: if photographs cannot be read (all are named) or a mask does not fit.
    """
    root = paths[0].parent if folder is None else folder
    drawn = {} if masks is None else find_masks(masks, paths, root)
    made, bad = [], []
    for number, path in enumerate(paths):
        try:
            pixels, hidden = _read_photo(path)
        except InputError as error:
            bad.append(str(error))
            continue
        height, width = pixels.shape[:2]
        camera, focal = exif_camera(path)
        small = shrink(pixels, max_size)
        if focal is not None:
            focal *= max(small.shape) / max(height, width)
        key = f"{camera} {width}x{height} {focal}"
        photo = work.add(number, dataset_name(path, root), small, focal, key)
        mask = None
        if path in drawn:
            mask = _read_mask(drawn[path], path.name, small.shape[:2], (height, width))
        if hidden is not None:
            clear = _opaque_mask(hidden, small.shape[:2])
            mask = clear if mask is None else np.minimum(clear, mask)
        if mask is not None:
            write_file(work.mask(photo.record.file), encode_png(mask))
        made.append(photo._replace(mask=mask is not None))
    if bad:
        raise InputError(
            f"{len(bad)} of {len(paths)} photos cannot be read; repair or remove them: "
            + "; ".join([*bad[:5], *["…"] * (len(bad) > 5)])
        )
    _complete_masks(made, work)
    return made


def add_masks(
    frames: Sequence[PreparedPhoto], masks: Path, work: WorkFolder
) -> list[PreparedPhoto]:
    """Write the masks of frames of a video, by the names of these in the dataset.

    Raises:
      InputError: if there is no mask for any frame, or one does not fit.
    """
    drawn = find_masks(masks, [Path(frame.name) for frame in frames], Path())
    made = []
    for frame in frames:
        path, record = drawn.get(Path(frame.name)), frame.record
        if path is not None:
            size = record.height, record.width
            mask = _read_mask(path, frame.name, size, size)
            write_file(work.mask(record.file), encode_png(mask))
        made.append(frame._replace(mask=path is not None))
    _complete_masks(made, work)
    return made


def _complete_masks(made: Sequence[PreparedPhoto], work: WorkFolder) -> None:
    """Write a mask for all photographs if there is one for any."""
    whole = [photo.record for photo in made if not photo.mask]
    for record in whole if len(whole) < len(made) else ():
        mask = np.full((record.height, record.width), 255, np.uint8)
        write_file(work.mask(record.file), encode_png(mask))


def find_masks(folder: Path, photos: Sequence[Path], root: Path) -> dict[Path, Path]:
    """Return the mask of each photograph that has one, named as `find_mask` expects.

    Args:
      folder: of the masks.
      photos: files, which need not exist.
      root: folder that the names of photographs are relative to.

    Raises:
      InputError: if the folder does not exist or holds no mask for any photograph.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of masks; check --masks")
    found, listing = {}, cache(files_by_lowered_suffix)
    for photo in photos:
        mask = find_mask(folder, photo.relative_to(root).as_posix(), listing)
        if mask is not None and not (photo.exists() and mask.samefile(photo)):
            found[photo] = mask
    if not found:
        raise InputError(
            f"{folder}: no mask for any photo; name the mask of {photos[0].name} "
            f"{photos[0].stem}.png or {photos[0].name}.png"
        )
    return found


def _opaque_mask(hidden: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Return a mask [h, w], 0 wherever a resampled pixel mixes with hidden ones.

    Args:
      hidden: [H, W] bool, where the photograph is transparent.
      size: h, w of the result.
    """
    cv2 = opencv()
    share = cv2.resize(
        hidden.astype(np.float32), size[::-1], interpolation=cv2.INTER_AREA
    )
    clear = np.where(share > 0, 0, 255).astype(np.uint8)
    return cv2.erode(clear, np.ones((2 * _CUBIC_REACH + 1,) * 2, np.uint8))


def _read_mask(
    path: Path, photo: str, size: tuple[int, ...], full: tuple[int, int]
) -> np.ndarray:
    """Return a drawn mask [h, w]: 0 where the file is black, else 255.

    Args:
      photo: name of the photograph, for messages.
      size: h, w of the result.
      full: H, W of the photograph.
    """
    mask = read_upright(path, grey=True)
    if mask.shape != full and mask.shape != size:
        raise InputError(
            f"{path}: expected {full[1]}x{full[0]} px, the upright size of {photo}, "
            f"got {mask.shape[1]}x{mask.shape[0]}; draw the mask in that size"
        )
    cv2 = opencv()
    mask = cv2.resize(mask, (size[1], size[0]), interpolation=cv2.INTER_NEAREST)
    return np.where(mask > 0, 255, 0).astype(np.uint8)


def _some(paths: Sequence[Path]) -> str:
    """Return the first path and the names of up to five others."""
    others = [path.name for path in paths[1:6]]
    dots = ["…"] if len(paths) > 6 else []
    return ", ".join([str(paths[0]), *others, *dots])
