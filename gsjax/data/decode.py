"""Image files → pixels as they are stored; what is damaged is refused, or told of.

OpenCV decodes and is loaded when first needed. Its decoders return what they could
make of a damaged JPEG or TIFF and tell of it on stderr only, without the file's name.
"""

import os
import re
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from gsjax.data.image_header import (
    check_image,
    clear_grey,
    has_tiff_alpha,
    has_two_samples,
    tiff_as_stored,
)
from gsjax.errors import InputError
from gsjax.io.images import opencv
from gsjax.runtime.files import read_bytes

# What libjpeg, libpng and, through OpenCV, libtiff say of pixels that are not as they
# were; the rest of libpng's warnings are of colour profiles and the like.
_DAMAGE = re.compile(
    "(?:Corrupt JPEG data|Premature end of JPEG file|libpng warning: IDAT).*"
    "|(?<=TIFF_Error ).*"
)
_HARMLESS = "libpng warning: "
_SHOWN = 3
_MOST_HEARD = 2**20
_stderr_lock = threading.RLock()  # that of the process, which others must not swap too


def decode(
    path: Path, flags: int, check: Callable[[int, int], object] | None = None
) -> np.ndarray:
    """Pixels of an image file, in OpenCV's order of channels.

    Args:
      path: the file; its own bytes are checked before anything is decoded.
      flags: of cv2.imdecode.
      check: given the width and height in px that its header declares, before memory
        is taken for them; raises if they are not what is wanted.

    Raises:
      InputError: as ``check``; if the file cannot be read, is no image, is truncated,
        declares more pixels than any camera makes, or is a TIFF of half-transparent
        pixels, or of grey and another sample.
    """
    data = read_bytes(path, "a photograph")
    size = check_image(path, data)
    if check is not None:
        check(*size)
    if has_two_samples(data):  # of which OpenCV drops one, or reads 16 bits as zeros
        raise InputError(
            f"{path}: a TIFF of two samples a pixel, grey and transparency, which "
            "cannot be read; convert it to PNG"
        )
    cv2 = opencv()
    if flags & cv2.IMREAD_IGNORE_ORIENTATION:  # IMREAD_UNCHANGED is among them
        data = tiff_as_stored(data)  # of which OpenCV takes no notice in a TIFF
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise InputError(f"{path}: cannot be decoded: {str(error)[:120]}") from error
    if pixels is None:
        raise InputError(
            f"{path}: cannot be decoded: the image is truncated, damaged or of a kind "
            "that OpenCV does not read; convert it to PNG or JPEG"
        )
    most = 65535 if pixels.dtype == np.uint16 else 255
    # OpenCV 5.0 multiplies colours of 8 bits that were not, leaves what was as it is,
    # and does not say so.
    if pixels.ndim == 3 and pixels.shape[2] == 4 and has_tiff_alpha(data):
        alpha = pixels[..., 3]
        if ((alpha > 0) & (alpha < most)).any():
            raise InputError(
                f"{path}: a TIFF with pixels that are transparent in part, whose "
                "colours cannot be told from black mixed into them; convert it to PNG"
            )
    grey = clear_grey(data) if flags == cv2.IMREAD_UNCHANGED else None
    if grey is not None and pixels.ndim == 2:  # OpenCV heeds it in colours alone
        alpha = np.where(pixels == round(grey * most), 0, most).astype(pixels.dtype)
        pixels = np.stack([pixels, alpha], -1)
    return pixels


@contextmanager
def telling_of_damage(files: Sequence[Path]) -> Iterator[None]:
    """Within, ``files`` are decoded; those that OpenCV's decoders mend are warned of.

    Threads decode at once and share one stderr. So if damage is heard of, which files
    it is of is found by decoding them again, in turn.
    """
    with libraries_heard() as heard:
        yield
    if any(map(_DAMAGE.search, heard)):
        _warn_of_damage(files)
    for line in heard:
        if not (_DAMAGE.search(line) or line.startswith(_HARMLESS)):
            os.write(2, f"{line}\n".encode())


def _warn_of_damage(files: Sequence[Path]) -> None:
    told = {}
    for path in files:
        with libraries_heard() as heard:
            decode(path, opencv().IMREAD_GRAYSCALE)
        found = [match for match in map(_DAMAGE.search, heard) if match]
        if found:
            told[path] = found[0][0]
    if told:
        some = "; ".join(f"{path}: {why}" for path, why in [*told.items()][:_SHOWN])
        more = f"; and {len(told) - _SHOWN} more" if len(told) > _SHOWN else ""
        warnings.warn(
            f"photographs that are damaged are read as far as they could be: {some}"
            f"{more}; copy or export them again, or remove them",
            UserWarning,
            stacklevel=4,
        )


@contextmanager
def libraries_heard() -> Iterator[list[str]]:
    """Within, nothing reaches stderr; afterwards the list holds its lines.

    C libraries write there, past Python. Another thread's use of this waits.
    """
    heard: list[str] = []
    with _stderr_lock, _scratch() as scratch:
        if sys.stderr is not None:
            sys.stderr.flush()
        kept = os.dup(2)
        try:
            os.dup2(scratch.fileno(), 2)
            yield heard
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            scratch.seek(0)
            text = scratch.read(_MOST_HEARD).decode(errors="replace")
            heard += [line for line in text.splitlines() if line.strip()]


def _scratch():
    """A file without a name; in memory where there is such a thing."""
    if hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create("stderr"), "w+b")
    return tempfile.TemporaryFile()
