"""Selection of the sharpest video frame in each of several time windows."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.data.image_files import SUFFIXES
from gsjax.data.types import unexpected
from gsjax.errors import InputError
from gsjax.io.common import warn
from gsjax.io.images import captured_stderr, opencv, shrink

_COMPLETE = 0.9  # share of the frames: declared numbers are often slightly off
_JUDGED_AT = 640  # px: keeps the noise of single pixels out of the sharpness


class Frame(NamedTuple):
    """A frame of a video.

    Attributes:
      number: its index, from 0.
      pixels: [H, W, 3] BGR uint8.
      seconds: its time in the video.
    """

    number: int
    pixels: np.ndarray
    seconds: float


def sharpness(pixels: np.ndarray) -> float:
    """Return the variance of the Laplacian, to compare images of the same content.

    Pech-Pacheco et al., "Diatom autofocusing in brightfield microscopy", ICPR 2000.
    """
    cv2 = opencv()
    grey = cv2.cvtColor(shrink(pixels, _JUDGED_AT), cv2.COLOR_BGR2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def sharpest_frames(path: Path, windows: int, max_size: int = 0) -> Iterator[Frame]:
    """Yield the sharpest frame in each of several time windows of equal length.

    Warns if the video ends early.

    Args:
      path: the video.
      windows: number of windows; of a shorter video all frames are taken.
      max_size: longest side in px; 0 for any size.

    Raises:
      InputError: if it is not a video, or ends before the second frame.
    """
    total = _count(path)
    if total < 2:
        expected = "a video of at least 2 frames"
        raise unexpected(path, expected, total, "pass a longer one")
    return _sharpest(path, min(windows, total), total, max_size)


def _sharpest(path: Path, windows: int, total: int, max_size: int) -> Iterator[Frame]:
    best, best_score, window, index = None, -1.0, 0, -1
    for index, (pixels, seconds) in enumerate(_frames(path)):
        here = min(index * windows // total, windows - 1)
        if here != window and best is not None:
            yield best
            best, best_score, window = None, -1.0, here
        score = sharpness(pixels)
        if score > best_score:
            best_score = score
            best = Frame(index, shrink(pixels, max_size), seconds)
    if best is not None:
        yield best
    if index + 1 < _COMPLETE * total:
        what = f"ends after {index + 1} of {total} frames"
        warn(f"{path}: {what}; copy it again if it is truncated")


def _frames(path: Path) -> Iterator[tuple[np.ndarray, float]]:
    """Yield all frames, rotated as the file says, and their times in seconds."""
    cv2 = opencv()
    with _opened(path) as capture:
        while True:
            with captured_stderr():
                good, pixels = capture.read()
            if not good:
                return
            yield pixels, capture.get(cv2.CAP_PROP_POS_MSEC) / 1000


def _count(path: Path) -> int:
    """Return the number of frames, counting them if the file does not declare it."""
    with _opened(path) as capture, captured_stderr():
        declared = int(capture.get(opencv().CAP_PROP_FRAME_COUNT))
        return declared if declared > 0 else sum(iter(capture.grab, False))


@contextmanager
def _opened(path: Path):
    if path.suffix.lower() in SUFFIXES:
        raise InputError(f"{path}: is a single image; pass its folder, or a video")
    cv2 = opencv()
    with captured_stderr():  # FFmpeg takes a relative "10:30.mp4" for a URL
        capture = cv2.VideoCapture(os.path.abspath(path))
    if not capture.isOpened():
        what = "is neither a folder of photos nor a video that OpenCV reads"
        raise InputError(f"{path}: {what}; convert it to MP4")
    try:
        yield capture
    finally:
        capture.release()
