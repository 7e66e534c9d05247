"""Images as bytes of files: PNG and .npy. OpenCV encodes, and is loaded when needed."""

import io
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from gsjax.errors import InputError, MissingExtraError

_MAX_16 = 65535
_MAX_STDERR = 2**20
_stderr_lock = threading.RLock()  # stderr belongs to the whole process


class DepthPicture(NamedTuple):
    """A depth map as a 16-bit image.

    Attributes:
      pixels: [H, W] uint16; 0 for no depth, else 1 at ``near`` to 65535 at ``far``.
      near, far: least and greatest depth of the view; both 0 if there is none.
    """

    pixels: np.ndarray
    near: float
    far: float


def opencv():
    """Return the module cv2, or raise `MissingExtraError` if it does not load."""
    try:
        import cv2
    except ImportError as error:
        what = f"OpenCV, which reads and writes images, does not load ({error})"
        remedy = "pip install opencv-contrib-python-headless"
        raise MissingExtraError(f"{what}; install it: {remedy}") from error
    return cv2


def shrink(pixels: np.ndarray, max_size: int) -> np.ndarray:
    """Scale an image down to ``max_size`` px of its longer side; 0 changes nothing."""
    height, width = pixels.shape[:2]
    scale = max_size / max(height, width) if max_size else 1.0
    if scale >= 1:
        return pixels
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return opencv().resize(pixels, size, interpolation=opencv().INTER_AREA)


def to_8_bit(image: np.ndarray) -> np.ndarray:
    """Clip values to [0, 1] and round them to uint8; no gamma."""
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)


def depth_picture(depth: np.ndarray) -> DepthPicture:
    """Convert a depth map [H, W], in which 0 means no depth."""
    found = np.isfinite(depth) & (depth > 0)
    pixels = np.zeros(depth.shape, np.uint16)
    if not found.any():
        return DepthPicture(pixels, 0.0, 0.0)
    values = depth[found].astype(np.float64)
    near, far = float(values.min()), float(values.max())
    relative = (values - near) / (far - near) if far > near else 0 * values
    pixels[found] = np.rint(1 + (_MAX_16 - 1) * relative)
    return DepthPicture(pixels, near, far)


def encode_png(pixels: np.ndarray) -> bytes:
    """Encode [H, W] grey or [H, W, 3] RGB, uint8 or uint16, as PNG."""
    cv2 = opencv()
    stored = pixels[..., ::-1] if pixels.ndim == 3 else pixels  # OpenCV has BGR
    done, data = cv2.imencode(".png", np.ascontiguousarray(stored))
    if not done:
        what = f"pixels: OpenCV cannot encode {pixels.dtype} {pixels.shape} as PNG"
        raise InputError(f"{what}; pass uint8 or uint16 of [H, W] or [H, W, 3]")
    return data.tobytes()


def encode_npy(image: np.ndarray) -> bytes:
    """Encode an array as a .npy file of float32."""
    buffer = io.BytesIO()
    np.save(buffer, np.asarray(image, np.float32), allow_pickle=False)
    return buffer.getvalue()


@contextmanager
def captured_stderr() -> Iterator[list[str]]:
    """Context in which nothing reaches stderr; afterwards the list holds its lines.

    C libraries write to the file descriptor, past Python. Other threads wait for it.
    """
    captured: list[str] = []
    with _stderr_lock, _scratch() as scratch:
        if sys.stderr is not None:
            sys.stderr.flush()
        kept = os.dup(2)
        try:
            os.dup2(scratch.fileno(), 2)
            yield captured
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            scratch.seek(0)
            text = scratch.read(_MAX_STDERR).decode(errors="replace")
            captured += [line for line in text.splitlines() if line.strip()]


def _scratch():
    """Return an anonymous file, in memory if the system has such files."""
    if hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create("stderr"), "w+b")
    return tempfile.TemporaryFile()
