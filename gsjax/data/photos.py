"""Photographs: files → undistorted, scaled pixels with the camera that goes with them.

OpenCV decodes and is loaded when first needed. EXIF orientation is ignored, as
COLMAP ignores it: the camera is that of the pixels as they are stored.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from gsjax.cameras.distortion import undistortion_maps
from gsjax.data.decode import decode, telling_of_damage
from gsjax.data.image_header import image_size
from gsjax.data.types import Distortion, Photo, View
from gsjax.errors import InputError
from gsjax.io.images import opencv
from gsjax.runtime.machine import all_of, usable_cores

# Sizes that differ from the camera's by rounding only: 1 px a side and this much.
_ASPECT_TOLERANCE = 0.01
# How much longer than its camera's a side may be. Cameras are found in photographs made
# smaller, by 8 or 16; a few bytes may declare a picture of any size.
_MOST_LARGER = 64
# Share of the pixels of a photograph that undoing its lens leaves; a heuristic.
_LEAST_SEEN = 0.01
_MAX_REMAP = 32766  # of cv2.remap
_BATCH = 8  # photographs a thread, before anything is told of them
Filter = Callable[[np.ndarray], np.ndarray]


def load_photo(view: View, max_size: int | None = None) -> Photo:
    """Read a photograph, undo its lens, leave out its mask, make it small enough.

    16 bits are rounded to 8, grey becomes RGB, and an alpha channel that is opaque
    everywhere is dropped. The ideal pinhole keeps focal lengths and principal point;
    pixels that the lens did not see are not valid, nor is any pixel to which one that
    is masked or was not seen contributes. Damage that the decoder could mend is warned
    of.

    Args:
      view: which photograph.
      max_size: longest side in px; larger ones are averaged down. None for as it is.

    Raises:
      InputError: if the file cannot be read, is no image, is truncated or too large,
        has not the aspect ratio of the camera, as its header says, or is more than
        64 times as wide; if its lens leaves nothing of it; or max_size is below 1.
    """
    with telling_of_damage(_files([view])):
        return _load(view, max_size)


def _files(views: Sequence[View]) -> list[Path]:
    both = [path for view in views for path in (view.image, view.mask)]
    return [path for path in both if path is not None]


def _load(view: View, max_size: int | None) -> Photo:
    if max_size is not None and max_size < 1:
        raise InputError(f"max_size {max_size}: at least 1 px is wanted")
    as_stored = opencv().IMREAD_UNCHANGED  # which does not rotate
    stored = decode(view.image, as_stored, partial(_ratio, view))
    pixels, alpha = _to_rgb(view.image, stored)
    height, width = pixels.shape[:2]
    K = scaled_intrinsics(view.K, *_ratio(view, width, height))
    invalid = None if view.mask is None else _masked(view.mask, width, height)
    if view.lens is not None:
        if max(width, height) > _MAX_REMAP:
            raise InputError(
                f"{view.image}: {width} × {height} px; at most {_MAX_REMAP} px a side "
                "are undistorted: make it smaller"
            )
        given = (pixels, alpha, invalid)
        pixels, alpha, invalid = _undistorted(view.image, view.lens, K, *given)
    if max_size is not None and max(width, height) > max_size:
        size = size_within(width, height, max_size)
        shrink = partial(opencv().resize, dsize=size, interpolation=opencv().INTER_AREA)
        pixels, alpha = _filtered(shrink, pixels, alpha)
        if invalid is not None:
            invalid = shrink(invalid.astype(np.float32)) > 0
        K = scaled_intrinsics(K, size[0] / width, size[1] / height)
    valid = None if invalid is None or not invalid.any() else ~invalid
    return Photo(pixels, alpha, valid, K)


def load_photos(
    views: Sequence[View],
    max_size: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Photo]:
    """`load_photo` of all views, on all cores, in their order.

    Args:
      views: which photographs.
      max_size: longest side in px, or None.
      progress: called with (how many are done, how many there are) for each.

    Raises:
      InputError: on the first photograph that `load_photo` refuses.
    """
    workers = min(32, usable_cores())
    photos: list[Photo] = []
    with ThreadPoolExecutor(workers) as pool:
        for start in range(0, len(views), _BATCH * workers):
            batch = views[start : start + _BATCH * workers]
            with telling_of_damage(_files(batch)):
                photos += all_of(pool, lambda view: _load(view, max_size), batch)
            if progress is not None:
                for done in range(start, len(photos)):
                    progress(done + 1, len(views))
    return photos


def _to_rgb(path: Path, stored: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """RGB and alpha, both uint8; None for an alpha that lets nothing through."""
    if stored.dtype == np.uint16:
        # Nearest of 255·v/65535 = v/257; 257 is odd, so that there are no ties.
        stored = ((stored.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if stored.dtype != np.uint8:
        raise InputError(
            f"{path}: pixels of {stored.dtype}; 8 or 16 bits are wanted: convert the "
            "photograph to PNG or JPEG"
        )
    channels = 1 if stored.ndim == 2 else stored.shape[2]
    if channels == 1:
        return np.repeat(stored.reshape(*stored.shape[:2], 1), 3, axis=2), None
    if channels == 2:
        pixels = np.repeat(stored[..., :1], 3, axis=2)
    else:
        pixels = np.ascontiguousarray(stored[..., 2::-1])
    # Of CMYK, too, OpenCV makes four channels, the last of them opaque.
    clear = channels in (2, 4) and (stored[..., -1] < 255).any()
    return pixels, stored[..., -1].copy() if clear else None


def _ratio(view: View, width: int, height: int) -> tuple[float, float]:
    """Size of the file over the size that the camera is for."""
    sx, sy = width / view.width, height / view.height
    # Rounding moves either side by up to 1 px.
    tolerance = _ASPECT_TOLERANCE + 1 / width + 1 / height
    if abs(np.log(sx / sy)) > tolerance:
        turned = abs(np.log(width / view.height * view.width / height)) <= tolerance
        remedy = (
            "it was rotated, or is to be by its EXIF, which is not heeded here: keep "
            "the photographs that the cameras are of, or save it as it is shown"
        )
        raise InputError(
            f"{view.image}: {width} × {height} px, but its camera is for {view.width} "
            f"× {view.height}; "
            + (remedy if turned else "one of the same aspect ratio is wanted")
        )
    if max(sx, sy) > _MOST_LARGER:
        raise InputError(
            f"{view.image}: {width} × {height} px, but its camera is for {view.width} "
            f"× {view.height}; at most {_MOST_LARGER} times as many a side are read: "
            "make it smaller"
        )
    return sx, sy


def stored_size(view: View) -> tuple[int, int]:
    """Width and height, px, of a photograph as its file has it, by the header; where
    that is not there, as the camera is for."""
    if view.image.exists():
        return image_size(view.image)
    return view.width, view.height


def size_within(width: int, height: int, longest: int | None) -> tuple[int, int]:
    """Width and height, px, of a photograph whose longest side is made that long, if
    it is longer; None for as it is."""
    ratio = 1.0 if longest is None else min(1.0, longest / max(width, height))
    return max(1, round(width * ratio)), max(1, round(height * ratio))


def scaled_intrinsics(K: np.ndarray, sx: float, sy: float) -> np.ndarray:
    """Intrinsics of an image whose sides are ``sx`` and ``sy`` times as long."""
    return np.asarray(K, np.float64) * np.asarray([[sx], [sy], [1.0]])


def _check_mask(path: Path, size: tuple[int, int], across: int, down: int) -> None:
    """See that a mask of so many px is one of a photograph of that size."""
    width, height = size
    rounding = 1 / across + 1 / down + 1 / width + 1 / height
    stretched = abs(np.log(across / width * height / down))
    if stretched > _ASPECT_TOLERANCE + rounding or across > _MOST_LARGER * width:
        raise InputError(
            f"{path}: a mask of {across} × {down} px for a photograph of {width} × "
            f"{height}; one of the same aspect ratio, at most {_MOST_LARGER} times as "
            "wide, is wanted"
        )


def _masked(path: Path, width: int, height: int) -> np.ndarray:
    """[H, W] bool: where the mask is 0."""
    cv2 = opencv()
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    flags |= cv2.IMREAD_ANYDEPTH  # of 16 bits, 1 is no black
    mask = decode(path, flags, partial(_check_mask, path, (width, height)))
    if mask.shape != (height, width):
        rows = (np.arange(height) + 0.5) * (mask.shape[0] / height)
        columns = (np.arange(width) + 0.5) * (mask.shape[1] / width)
        mask = mask[rows.astype(int)[:, None], columns.astype(int)]
    return mask == 0


def _filtered(
    filter_: Filter, pixels: np.ndarray, alpha: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Interpolate colours, weighted by their opacity where the image has one."""
    if alpha is None:
        return filter_(pixels), None
    weight = alpha.astype(np.float32)
    mean = filter_(weight)[..., None]
    colors = filter_(pixels * weight[..., None])
    mean_or_1 = np.where(mean > 0, mean, 1)
    colors = np.where(mean > 0, colors / mean_or_1, filter_(pixels))
    clipped = np.clip(np.rint(colors), 0, 255).astype(np.uint8)
    return clipped, np.clip(np.rint(mean[..., 0]), 0, 255).astype(np.uint8)


_KEPT = 2  # cameras whose maps are kept: those of a photograph take several of it
_maps_lock = threading.Lock()
_maps_of: OrderedDict[tuple, Future] = OrderedDict()


def _maps(lens: Distortion, K: np.ndarray, width: int, height: int):
    """`undistortion_maps`: made by one thread of those that want the same."""
    key = (lens, tuple(K.ravel().tolist()), width, height)
    with _maps_lock:
        found = _maps_of.get(key)
        made = found if found is not None else Future()
        _maps_of[key] = made
        _maps_of.move_to_end(key)
        while len(_maps_of) > _KEPT:
            _maps_of.popitem(last=False)
    if found is None:
        try:
            made.set_result(undistortion_maps(lens, K, width, height))
        except BaseException as error:
            made.set_exception(error)
            with _maps_lock:
                if _maps_of.get(key) is made:
                    del _maps_of[key]
    return made.result()


def _undistorted(
    path: Path,
    lens: Distortion,
    K: np.ndarray,
    pixels: np.ndarray,
    alpha: np.ndarray | None,
    invalid: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    height, width = pixels.shape[:2]
    map_x, map_y, seen = _maps(lens, K, width, height)
    if seen.mean() < _LEAST_SEEN:
        told = ", ".join(f"{value:g}" for value in lens.coefficients)
        raise InputError(
            f"{path}: of its {seen.size:,} pixels {int(seen.sum())} are left when the "
            f"lens of its camera ({lens.model}, {told}) is undone; estimate the camera "
            "again, or remove the photograph"
        )
    cv2 = opencv()
    remap = partial(
        cv2.remap,
        map1=map_x,
        map2=map_y,
        interpolation=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    pixels, alpha = _filtered(remap, pixels, alpha)
    if invalid is None:
        return pixels, alpha, ~seen
    touched = remap(invalid.astype(np.float32)) > 1 / 64
    return pixels, alpha, touched | ~seen


def undistorted_view(view: View, photo: Photo) -> View:
    """The view of a loaded photograph: its K and size, and no lens."""
    height, width = photo.pixels.shape[:2]
    return replace(view, K=photo.K, width=width, height=height, lens=None)
