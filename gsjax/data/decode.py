"""Decoding of image files with OpenCV, with errors and warnings for damaged ones.

OpenCV is imported on first use. For a damaged JPEG or TIFF its decoders return what
they could read and report that on stderr only, without the file's name.
"""

import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from gsjax.data import heif, image_header
from gsjax.errors import InputError
from gsjax.io.common import warn
from gsjax.io.images import captured_stderr, opencv
from gsjax.runtime.files import read_bytes

# Messages of libjpeg, libpng and (through OpenCV) libtiff about damaged pixels. The
# other warnings of libpng concern colour profiles and the like.
_DAMAGE = re.compile(
    "(?:Corrupt JPEG data|Premature end of JPEG file|libpng warning: IDAT).*"
    "|(?<=TIFF_Error ).*"
)
_HARMLESS = "libpng warning: "
_SHOWN = 3


def decode(
    path: Path, flags: int, check: Callable[[int, int], object] | None = None
) -> np.ndarray:
    """Return the pixels of an image file, in OpenCV's order of channels.

    Args:
      path: the file; its header is checked before anything is decoded.
      flags: flags of cv2.imdecode.
      check: called with the declared width and height in px, which it may reject.

    Raises:
      InputError: as ``check``; if the file cannot be read, is not an image, is
        truncated or declares more than `MAX_PIXELS`; or if it is a TIFF of partly
        transparent pixels, or of grey and another sample.
    """
    data = read_bytes(path, "a photograph")
    size = image_header.check_image(path, data)
    if check is not None:
        check(*size)
    if image_header.has_two_samples(data):  # OpenCV drops one, or reads zeros
        what = "a TIFF of two samples a pixel, grey and transparency"
        raise InputError(f"{path}: {what}, cannot be read; convert it to PNG")
    kind, cv2 = heif.kind_of(data[:64]), opencv()
    if kind == "heic":
        return _as_asked(heif.decode_heic(path, data), flags)
    if flags & cv2.IMREAD_IGNORE_ORIENTATION:  # IMREAD_UNCHANGED includes it
        data = image_header.tiff_as_stored(data)  # OpenCV ignores the flag in a TIFF
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise InputError(f"{path}: cannot be decoded: {str(error)[:120]}") from error
    if pixels is None:
        what = "the image is truncated, damaged or not supported by OpenCV"
        raise InputError(
            f"{path}: cannot be decoded: {what}; convert it to PNG or JPEG"
        )
    if kind == "avif":  # OpenCV stores it as it lies on the sensor
        return heif.turns_of(data).apply(pixels)
    most = 65535 if pixels.dtype == np.uint16 else 255
    # OpenCV 5.0 multiplies straight colours of 8 bits by alpha and keeps premultiplied
    # ones, without telling which.
    if pixels.ndim == 3 and pixels.shape[2] == 4 and image_header.has_tiff_alpha(data):
        alpha = pixels[..., 3]
        if ((alpha > 0) & (alpha < most)).any():
            what = "a TIFF with partly transparent pixels, perhaps mixed with black"
            raise InputError(f"{path}: {what}, cannot be read; convert it to PNG")
    grey = image_header.clear_grey(data) if flags == cv2.IMREAD_UNCHANGED else None
    if grey is not None and pixels.ndim == 2:  # OpenCV only handles it in colour images
        alpha = np.where(pixels == round(grey * most), 0, most).astype(pixels.dtype)
        pixels = np.stack([pixels, alpha], -1)
    return pixels


def _as_asked(pixels: np.ndarray, flags: int) -> np.ndarray:
    """Return pixels of a colour image or a grey one as OpenCV would for these flags."""
    cv2 = opencv()
    if flags == cv2.IMREAD_UNCHANGED:
        return pixels
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    if flags & cv2.IMREAD_COLOR:
        if channels < 3:
            grey = pixels if channels == 1 else pixels[..., 0]
            return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
        return np.ascontiguousarray(pixels[..., :3])
    if channels < 3:
        return pixels if channels == 1 else np.ascontiguousarray(pixels[..., 0])
    return cv2.cvtColor(np.ascontiguousarray(pixels[..., :3]), cv2.COLOR_BGR2GRAY)


@contextmanager
def warn_of_damage(files: Sequence[Path]) -> Iterator[None]:
    """Context for decoding ``files`` that warns of those that OpenCV had to repair.

    Threads decode at the same time and share one stderr. If it reports damage, the
    files are decoded again one by one to find the damaged ones.
    """
    with captured_stderr() as lines:
        yield
    if any(map(_DAMAGE.search, lines)):
        _warn_of_each(files)
    for line in lines:
        if not (_DAMAGE.search(line) or line.startswith(_HARMLESS)):
            os.write(2, f"{line}\n".encode())


def _warn_of_each(files: Sequence[Path]) -> None:
    damage = {}
    for path in files:
        with captured_stderr() as lines:
            decode(path, opencv().IMREAD_GRAYSCALE)
        found = [match for match in map(_DAMAGE.search, lines) if match]
        if found:
            damage[path] = found[0][0]
    if damage:
        some = "; ".join(f"{path}: {why}" for path, why in [*damage.items()][:_SHOWN])
        more = f"; and {len(damage) - _SHOWN} more" if len(damage) > _SHOWN else ""
        warn(
            f"damaged photographs are read as far as possible: {some}{more}; copy or "
            "export them again, or remove them"
        )
