"""Photographs and masks as structure from motion wants them: upright, and not large.

They are decoded by OpenCV, which turns them as EXIF says, scaled down, and written as
PNG without EXIF: whatever reads those files sees the same pixels the same way up.
Where a photograph is transparent is in its mask.
"""

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.data.decode import decode, libraries_heard, telling_of_damage
from gsjax.data.image_files import (
    by_suffix_of_either_case,
    check_name,
    find_mask,
    natural_order,
)
from gsjax.errors import InputError
from gsjax.io.images import encode_png, opencv
from gsjax.runtime.files import opened, write_file
from gsjax.sfm.mapping import Shot, exif_camera

READ = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
_KEPT = (".jpg", ".jpeg", ".png")  # formats in which the dataset is written
_UNREAD = (
    *(".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf"),
    *(".orf", ".rw2", ".pef", ".srw", ".nrw", ".gif", ".jxl", ".jp2", ".psd"),
    *(".jfif", ".jpe", ".mpo", ".ppm"),
)
_JPEG = b"\xff\xd8"  # how such files, which have no alpha, begin
_REACH = 2  # px, of the cubic interpolation that undoes the lens


class Photograph(NamedTuple):
    """A photograph in the working folder.

    Attributes:
      name: what the dataset calls it; the working file has a number for a name.
      shot: what COLMAP is told of it.
      mask: whether it came with one, or is transparent somewhere.
    """

    name: str
    shot: Shot
    mask: bool = False


class Workshop(NamedTuple):
    """The working folder: ``photos/`` and, if there are any, ``masks/``."""

    folder: Path

    @property
    def photos(self) -> Path:
        return self.folder / "photos"

    @property
    def masks(self) -> Path:
        return self.folder / "masks"

    def mask(self, file: str) -> Path:
        return self.masks / f"{file}.png"  # COLMAP's rule: a second suffix

    def add(
        self, number: int, name: str, pixels: np.ndarray, focal: float | None, key: str
    ) -> Photograph:
        """Write a photograph [H, W, 3] BGR, whose focal length is in its own px."""
        file = f"{number:06d}.png"
        write_file(self.photos / file, encode_png(pixels[..., ::-1]))
        height, width = pixels.shape[:2]
        return Photograph(name, Shot(file, width, height, focal, key))


def find_photos(folder: Path) -> list[Path]:
    """The photographs in a folder (not in folders within), by name: 2 before 10.

    Raises:
      InputError: if there are fewer than two, or any that cannot be read.
    """
    files = [p for p in folder.iterdir() if p.is_file() and p.name[0] != "."]
    files.sort(key=lambda path: natural_order(path.name))
    unread = [p for p in files if p.suffix.lower() in _UNREAD]
    if unread:
        raise InputError(
            f"{_some(unread)}: {unread[0].suffix} photos are not read here; convert "
            "them to JPEG (keeping EXIF), or move them away"
        )
    found = [p for p in files if p.suffix.lower() in READ]
    if len(found) < 2:
        raise InputError(
            f"{folder}: {len(found)} photo{'s' * (len(found) != 1)} "
            f"({', '.join(READ)}) in it; at least two are wanted, rather twenty (a "
            "video is given by its own name)" + _told_of_subfolders(folder)
        )
    names = [dataset_name(path) for path in found]
    double = [p for p, name in zip(found, names) if names.count(name) > 1]
    if double:
        raise InputError(
            f"{_some(double)}: would have the same name in the dataset; rename one"
        )
    return found


def _told_of_subfolders(folder: Path) -> str:
    below = [p for p in folder.rglob("*") if p.parent != folder and p.name[0] != "."]
    count = sum(path.suffix.lower() in READ for path in below)
    told = f"; subfolders are not searched, {count} photos lie there: move them up"
    return told if count else ""


def dataset_name(path: Path) -> str:
    """What a photograph is called in the dataset: as it was, if JPEG or PNG.

    Raises:
      InputError: if that is not UTF-8.
    """
    kept = path.suffix.lower() in _KEPT
    check_name(path)
    return path.name if kept else path.with_suffix(".png").name


def read_upright(path: Path, grey: bool = False) -> np.ndarray:
    """[H, W, 3] BGR uint8, turned as EXIF says; or [H, W] grey, of as many bits as it
    has: of 16, the darkest that is not black would be black in 8.

    Raises:
      InputError: if the file is no image, truncated, damaged, or declares more pixels
        than any camera makes, which is found before they are taken.
    """
    cv2 = opencv()
    with telling_of_damage([path]):
        deep_grey = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
        return decode(path, deep_grey if grey else cv2.IMREAD_COLOR)


def _read_photo(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """What `read_upright` reads, and where that is less than half opaque.

    Returns:
      [H, W, 3] BGR uint8, and [H, W] bool, or None if that is nowhere.
    """
    upright = read_upright(path)
    with opened(path, "a photograph") as file:
        if file.read(2) == _JPEG:
            return upright, None
    cv2 = opencv()
    with libraries_heard():  # all of which has been told
        stored = decode(path, cv2.IMREAD_UNCHANGED)  # the only way to alpha
        if stored.ndim < 3 or stored.shape[2] not in (2, 4):
            return upright, None
        alpha = stored[..., -1]
        opaque = np.iinfo(alpha.dtype).max if alpha.dtype.kind == "u" else 1
        hidden = alpha < opaque / 2
        if not hidden.any():
            return upright, None
        colors = decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    # How OpenCV turned the colours depends on format and version, and it does not say.
    both = zip(_turned(colors), _turned(hidden))
    return upright, next(h for c, h in both if np.array_equal(c, upright))


def _turned(pixels: np.ndarray) -> Iterator[np.ndarray]:
    """In the eight ways of EXIF, as it is first."""
    for picture in (pixels, pixels[:, ::-1]):
        for quarters in range(4):
            yield np.rot90(picture, quarters)


def prepare_photos(
    paths: Sequence[Path], masks: Path | None, work: Workshop, max_size: int
) -> list[Photograph]:
    """Write the photographs, and their masks, into the working folder.

    Left out is what a mask says and what is less than half opaque. Once any has a mask,
    there is one of each photograph, as COLMAP wants it.

    Args:
      masks: folder of masks, or None.
      max_size: the longer side in px is at most this; 0 for any size.

    Raises:
      InputError: naming all that are unreadable, or a mask that does not fit.
    """
    pairs = {} if masks is None else find_masks(masks, paths)
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
        photo = work.add(number, dataset_name(path), small, focal, key)
        mask = _mask(pairs.get(path), hidden, path, small.shape[:2], (height, width))
        if mask is not None:
            write_file(work.mask(photo.shot.file), encode_png(mask))
        made.append(photo._replace(mask=mask is not None))
    if bad:
        raise InputError(
            f"{len(bad)} of {len(paths)} photos cannot be read; mend or remove: "
            + "; ".join([*bad[:5], *["…"] * (len(bad) > 5)])
        )
    whole = [photo.shot for photo in made if not photo.mask]
    for shot in whole if len(whole) < len(made) else ():
        mask = np.full((shot.height, shot.width), 255, np.uint8)
        write_file(work.mask(shot.file), encode_png(mask))
    return made


def shrink(pixels: np.ndarray, max_size: int) -> np.ndarray:
    """The image with its longer side at most ``max_size`` (0: as it is)."""
    height, width = pixels.shape[:2]
    scale = max_size / max(height, width) if max_size else 1.0
    if scale >= 1:
        return pixels
    size = max(1, round(width * scale)), max(1, round(height * scale))
    cv2 = opencv()
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def find_masks(folder: Path, photos: Sequence[Path]) -> dict[Path, Path]:
    """The mask of each photograph that has one, named as `find_mask` knows them.

    Raises:
      InputError: if the folder is missing or has no mask for any.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of masks")
    found, listing = {}, cache(by_suffix_of_either_case)
    for photo in photos:
        mask = find_mask(folder, photo.name, listing)
        if mask is not None and not mask.samefile(photo):
            found[photo] = mask
    if not found:
        raise InputError(
            f"{folder}: no mask for any photo; for {photos[0].name} one would be "
            f"{photos[0].stem}.png or {photos[0].name}.png"
        )
    return found


def _mask(
    path: Path | None,
    hidden: np.ndarray | None,
    photo: Path,
    size: tuple[int, ...],
    full: tuple[int, int],
) -> np.ndarray | None:
    """[h, w] of 0, to be left out, and 255; None where there is nothing to say so.

    Args:
      path: a drawn mask, or None.
      hidden: [H, W] bool, where the photograph is transparent; or None.
      photo: the photograph, for messages.
      size: h, w of the result.
      full: H, W of the photograph.
    """
    drawn = None if path is None else _drawn(path, photo, size, full)
    if hidden is None:
        return drawn
    cv2 = opencv()
    # Colours that are not seen count as none, so neither do pixels that they mix into.
    share = cv2.resize(
        hidden.astype(np.float32), size[::-1], interpolation=cv2.INTER_AREA
    )
    clear = np.where(share > 0, 0, 255).astype(np.uint8)
    clear = cv2.erode(clear, np.ones((2 * _REACH + 1,) * 2, np.uint8))
    return clear if drawn is None else np.minimum(clear, drawn)


def _drawn(
    path: Path, photo: Path, size: tuple[int, ...], full: tuple[int, int]
) -> np.ndarray:
    """[h, w] of 0, to be left out, and 255: whatever is not black in the file."""
    mask = read_upright(path, grey=True)
    if mask.shape != full and mask.shape != size:
        raise InputError(
            f"{path}: the mask is {mask.shape[1]}x{mask.shape[0]}, {photo.name} seen "
            f"upright is {full[1]}x{full[0]}; draw it in that size"
        )
    cv2 = opencv()
    wanted = (size[1], size[0])
    mask = cv2.resize(mask, wanted, interpolation=cv2.INTER_NEAREST)
    return np.where(mask > 0, 255, 0).astype(np.uint8)


def _some(paths: Sequence[Path]) -> str:
    """The first, and the names of some others."""
    others = [path.name for path in paths[1:6]]
    dots = ["…"] if len(paths) > 6 else []
    return ", ".join([str(paths[0]), *others, *dots])
