"""Loading of photographs: scaled pixels and the camera that fits them.

OpenCV decodes and is imported on first use. EXIF orientation is ignored, as in COLMAP:
a camera refers to the pixels as stored.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from gsjax.cameras.distortion import (
    Distortion,
    imaged_pixels,
    undistortion_maps,
)
from gsjax.data.decode import decode, warn_of_damage
from gsjax.data.image_header import image_size
from gsjax.data.types import Photo, View, unexpected
from gsjax.errors import InputError
from gsjax.io.common import to_bytes
from gsjax.io.images import opencv
from gsjax.runtime.machine import map_concurrently, usable_cores

# Relative deviation of an aspect ratio, besides rounding by 1 px a side.
_ASPECT_TOLERANCE = 0.01
# Bound of file size over camera size, a side. Cameras are often estimated from copies
# smaller by 8 or 16; a few bytes may declare an image of any size.
_MAX_RATIO = 64
# Minimum share of the pixels that are valid after undistortion (a heuristic).
_MIN_VALID = 0.01
_MAX_REMAP = 32766  # px a side, limit of cv2.remap
_BATCH = 8  # photographs per thread between reports
Filter = Callable[[np.ndarray], np.ndarray]


def load_photo(
    view: View, max_size: int | None = None, undistort: bool = False
) -> Photo:
    """Read and scale a photograph, and apply its mask.

    Samples of 16 bits are rounded to 8, grey becomes RGB, and an opaque alpha channel
    is dropped. A pixel is invalid if any masked pixel contributes to it, or if it is
    beyond the image of the lens. Warns of damage that the decoder could repair.

    Args:
      view: the view to load.
      max_size: longest side in px; larger photographs are averaged down. None keeps the
        size.
      undistort: resample to an ideal pinhole of the same focal lengths and principal
        point. Pixels that come from outside of the photograph are invalid.

    Raises:
      InputError: if the file cannot be read, is not an image, is truncated or too
        large, does not have the camera's aspect ratio or is over 64 times as wide, if
        its lens folds within the image or leaves nothing of it, or if max_size is below
        1.
    """
    with warn_of_damage(_files([view])):
        return _load(view, max_size, undistort)


def _files(views: Sequence[View]) -> list[Path]:
    both = [path for view in views for path in (view.image, view.mask)]
    return [path for path in both if path is not None]


def _load(view: View, max_size: int | None, undistort: bool) -> Photo:
    if max_size is not None and max_size < 1:
        remedy = "pass None to keep the size"
        raise unexpected("max_size", "at least 1 px", max_size, remedy)
    as_stored = opencv().IMREAD_UNCHANGED  # does not rotate
    stored = decode(view.image, as_stored, partial(_ratio, view))
    pixels, alpha = _to_rgb(view.image, stored)
    height, width = pixels.shape[:2]
    K = scaled_intrinsics(view.K, *_ratio(view, width, height))
    invalid = None if view.mask is None else _masked(view.mask, width, height)
    lens = view.lens
    if lens is not None and not undistort:
        beyond = _beyond(view.image, lens, K, width, height)
        invalid = beyond if invalid is None else invalid | beyond
    elif lens is not None:
        loaded = (pixels, alpha, invalid)
        pixels, alpha, invalid = _undistorted(view.image, lens, K, *loaded)
        lens = None
    if max_size is not None and max(width, height) > max_size:
        size = size_within(width, height, max_size)
        shrink = partial(opencv().resize, dsize=size, interpolation=opencv().INTER_AREA)
        pixels, alpha = _filtered(shrink, pixels, alpha)
        if invalid is not None:
            invalid = shrink(invalid.astype(np.float32)) > 0
        K = scaled_intrinsics(K, size[0] / width, size[1] / height)
    valid = None if invalid is None or not invalid.any() else ~invalid
    return Photo(pixels, alpha, valid, K, lens)


def load_photos(
    views: Sequence[View],
    max_size: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    *,
    undistort: bool = False,
) -> list[Photo]:
    """Return `load_photo` of each view, in order, using all cores.

    Args:
      views: the views to load.
      max_size: longest side in px, or None.
      progress: called with (number done, total) for each photograph.
      undistort: as in `load_photo`.

    Raises:
      InputError: as `load_photo`, for the first photograph that fails.
    """
    workers = min(32, usable_cores())
    photos: list[Photo] = []
    with ThreadPoolExecutor(workers) as pool:
        for start in range(0, len(views), _BATCH * workers):
            batch = views[start : start + _BATCH * workers]
            with warn_of_damage(_files(batch)):
                load = partial(_load, max_size=max_size, undistort=undistort)
                photos += map_concurrently(pool, load, batch)
            if progress is not None:
                for done in range(start, len(photos)):
                    progress(done + 1, len(views))
    return photos


def _to_rgb(path: Path, stored: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return RGB and alpha, both uint8; alpha is None if opaque."""
    if stored.dtype == np.uint16:
        # Rounds 255·v/65535 = v/257; 257 is odd, so there are no ties.
        stored = ((stored.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if stored.dtype != np.uint8:
        remedy = "convert the photograph to PNG or JPEG"
        raise unexpected(path, "samples of 8 or 16 bits", stored.dtype, remedy)
    channels = 1 if stored.ndim == 2 else stored.shape[2]
    if channels == 1:
        return np.repeat(stored.reshape(*stored.shape[:2], 1), 3, axis=2), None
    if channels == 2:
        pixels = np.repeat(stored[..., :1], 3, axis=2)
    else:
        pixels = np.ascontiguousarray(stored[..., 2::-1])
    clear = channels in (2, 4) and (stored[..., -1] < 255).any()
    return pixels, stored[..., -1].copy() if clear else None


def _ratio(view: View, width: int, height: int) -> tuple[float, float]:
    """Return the size of the file over the size that the camera refers to."""
    sx, sy = width / view.width, height / view.height
    camera, got = f"{view.width} × {view.height}", f"{width} × {height} px"
    # Rounding moves either side by up to 1 px.
    tolerance = _ASPECT_TOLERANCE + 1 / width + 1 / height
    if abs(np.log(sx / sy)) > tolerance:
        turned = abs(np.log(width / view.height * view.width / height)) <= tolerance
        remedy = "use the photographs that the cameras were estimated from"
        if turned:
            remedy = f"it was rotated, or its EXIF (ignored here) rotates it: {remedy}"
        expected = f"the aspect ratio of its camera, {camera}"
        raise unexpected(view.image, expected, got, remedy)
    if max(sx, sy) > _MAX_RATIO:
        expected = f"at most {_MAX_RATIO} times the size of its camera, {camera}"
        raise unexpected(view.image, expected, got, "make it smaller")
    return sx, sy


def stored_size(view: View) -> tuple[int, int]:
    """Return the size in px of a photograph's file; without a file, of its camera."""
    return image_size(view.image) if view.image.exists() else (view.width, view.height)


def size_within(width: int, height: int, longest: int | None) -> tuple[int, int]:
    """Return the size in px of an image whose longest side is reduced to ``longest``.

    The size is kept if it is smaller, or ``longest`` is None.
    """
    ratio = 1.0 if longest is None else min(1.0, longest / max(width, height))
    return max(1, round(width * ratio)), max(1, round(height * ratio))


def scaled_intrinsics(K: np.ndarray, sx: float, sy: float) -> np.ndarray:
    """Return the intrinsics of an image scaled by ``sx`` and ``sy``."""
    return np.asarray(K, np.float64) * np.asarray([[sx], [sy], [1.0]])


def _check_mask(path: Path, size: tuple[int, int], across: int, down: int) -> None:
    """Check the size of a mask, across × down px, against that of its photograph."""
    width, height = size
    rounding = 1 / across + 1 / down + 1 / width + 1 / height
    stretched = abs(np.log(across / width * height / down))
    if stretched > _ASPECT_TOLERANCE + rounding or across > _MAX_RATIO * width:
        expected = (
            f"a mask of the aspect ratio of its photograph, {width} × {height} px"
        )
        expected += f", and at most {_MAX_RATIO} times as wide"
        remedy = "make one of the photograph's size"
        raise unexpected(path, expected, f"{across} × {down} px", remedy)


def _masked(path: Path, width: int, height: int) -> np.ndarray:
    """Return [H, W] bool: where the mask is 0."""
    cv2 = opencv()
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    flags |= cv2.IMREAD_ANYDEPTH  # a 1 of 16 bits is not black
    mask = decode(path, flags, partial(_check_mask, path, (width, height)))
    if mask.shape != (height, width):
        rows = (np.arange(height) + 0.5) * (mask.shape[0] / height)
        columns = (np.arange(width) + 0.5) * (mask.shape[1] / width)
        mask = mask[rows.astype(int)[:, None], columns.astype(int)]
    return mask == 0


def _filtered(
    filter_: Filter, pixels: np.ndarray, alpha: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Filter the colours of an image, weighted by its opacity if it has one."""
    if alpha is None:
        return filter_(pixels), None
    weight = alpha.astype(np.float32)
    mean = filter_(weight)[..., None]
    colors = filter_(pixels * weight[..., None])
    colors = np.where(mean > 0, colors / np.where(mean > 0, mean, 1), filter_(pixels))
    return to_bytes(colors), to_bytes(mean[..., 0])


_KEPT = 2  # maps are several times as large as a photograph
_maps_lock = threading.Lock()
_maps_of: OrderedDict[tuple, Future] = OrderedDict()


def _maps(compute: Callable, lens: Distortion, K: np.ndarray, width: int, height: int):
    """Return what a function computes, once for all threads that need it."""
    key = (compute, lens, tuple(K.ravel().tolist()), width, height)
    with _maps_lock:
        found = _maps_of.get(key)
        made = found if found is not None else Future()
        _maps_of[key] = made
        _maps_of.move_to_end(key)
        while len(_maps_of) > _KEPT:
            _maps_of.popitem(last=False)
    if found is None:
        try:
            made.set_result(compute(lens, K, width, height))
        except BaseException as error:
            made.set_exception(error)
            with _maps_lock:
                if _maps_of.get(key) is made:
                    del _maps_of[key]
    return made.result()


def _beyond(
    path: Path, lens: Distortion, K: np.ndarray, width: int, height: int
) -> np.ndarray:
    """Return [H, W] bool, True for pixels that no direction is imaged to."""
    beyond = ~_maps(imaged_pixels, lens, K, width, height)
    middle = beyond[height // 2], beyond[:, width // 2]
    if all(line[0] | line[-1] for line in middle) or beyond.mean() > 1 - _MIN_VALID:
        values = ", ".join(f"{value:g}" for value in lens.coefficients)
        raise InputError(
            f"{path}: the lens ({lens.model}, {values}) folds within the image: "
            f"{int(beyond.sum()):,} of {beyond.size:,} pixels show no direction; "
            "estimate the camera again"
        )
    return beyond


def _undistorted(
    path: Path,
    lens: Distortion,
    K: np.ndarray,
    pixels: np.ndarray,
    alpha: np.ndarray | None,
    invalid: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    height, width = pixels.shape[:2]
    if max(width, height) > _MAX_REMAP:
        expected = f"at most {_MAX_REMAP} px a side to undistort"
        raise unexpected(path, expected, f"{width} × {height}", "make it smaller")
    map_x, map_y, seen = _maps(undistortion_maps, lens, K, width, height)
    if seen.mean() < _MIN_VALID:
        values = ", ".join(f"{value:g}" for value in lens.coefficients)
        raise InputError(
            f"{path}: {int(seen.sum())} of {seen.size:,} pixels are left after "
            f"undistortion ({lens.model}, {values}); estimate the camera again"
        )
    cv2 = opencv()
    options = {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_REPLICATE}
    remap = partial(cv2.remap, map1=map_x, map2=map_y, **options)
    pixels, alpha = _filtered(remap, pixels, alpha)
    if invalid is None:
        return pixels, alpha, ~seen
    touched = remap(invalid.astype(np.float32)) > 1 / 64
    return pixels, alpha, touched | ~seen


def undistort_photo(name: str, photo: Photo) -> Photo:
    """Return a loaded photograph of the view ``name`` as an ideal pinhole shows it."""
    if photo.lens is None:
        return photo
    invalid = None if photo.valid is None else ~photo.valid
    loaded = (photo.pixels, photo.alpha, invalid)
    pixels, alpha, invalid = _undistorted(Path(name), photo.lens, photo.K, *loaded)
    return Photo(pixels, alpha, ~invalid if invalid.any() else None, photo.K)


def loaded_view(view: View, photo: Photo) -> View:
    """Return the view of a loaded photograph: its K, size and lens."""
    height, width = photo.pixels.shape[:2]
    return replace(view, K=photo.K, width=width, height=height, lens=photo.lens)
