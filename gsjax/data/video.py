"""Frames of a video: of each stretch of time the sharpest."""

import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.data.decode import libraries_heard
from gsjax.errors import InputError
from gsjax.io.images import opencv
from gsjax.sfm.photos import READ, shrink

_MOST = 0.9  # of the frames; what a file says of their number is often a little off
_JUDGED_AT = 640  # px: noise of single pixels is not sharpness


class Frame(NamedTuple):
    """A frame: which one of the video it is, from 0, and [H, W, 3] BGR uint8."""

    number: int
    pixels: np.ndarray


def sharpness(pixels: np.ndarray) -> float:
    """Variance of the Laplacian: a heuristic that compares like with like.

    Pech-Pacheco et al., "Diatom autofocusing in brightfield microscopy", ICPR 2000.
    """
    cv2 = opencv()
    grey = cv2.cvtColor(shrink(pixels, _JUDGED_AT), cv2.COLOR_BGR2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def sharpest_frames(path: Path, wanted: int, max_size: int = 0) -> Iterator[Frame]:
    """The video in ``wanted`` windows of equal length, and of each the sharpest frame.

    Args:
      wanted: how many; of a shorter video all frames are taken.
      max_size: the longer side in px is at most this; 0 for any size.

    Raises:
      InputError: if it is not a video, or breaks off before the second frame.

    Warns:
      if it breaks off later.
    """
    total = _count(path)
    if total < 2:
        raise InputError(f"{path}: a video of {total} frames; more are wanted")
    return _sharpest(path, min(wanted, total), total, max_size)


def _sharpest(path: Path, wanted: int, total: int, max_size: int) -> Iterator[Frame]:
    best, best_score, window, index = None, -1.0, 0, -1
    for index, pixels in enumerate(_frames(path)):
        here = min(index * wanted // total, wanted - 1)
        if here != window and best is not None:
            yield best
            best, best_score, window = None, -1.0, here
        score = sharpness(pixels)
        if score > best_score:
            best, best_score = Frame(index, shrink(pixels, max_size)), score
    if best is not None:
        yield best
    if index + 1 < _MOST * total:
        warnings.warn(
            f"{path}: breaks off after {index + 1} of {total} frames; copy it again if "
            "it is to be longer",
            UserWarning,
            stacklevel=2,
        )


def _frames(path: Path) -> Iterator[np.ndarray]:
    """All frames, turned as the file says."""
    capture = _opened(path)
    try:
        while True:
            with libraries_heard():
                good, pixels = capture.read()
            if not good:
                return
            yield pixels
    finally:
        capture.release()


def _count(path: Path) -> int:
    """How many frames there are; counted where the file does not say so."""
    capture = _opened(path)
    try:
        told = int(capture.get(opencv().CAP_PROP_FRAME_COUNT))
        if told > 0:
            return told
        counted = 0
        with libraries_heard():
            while capture.grab():
                counted += 1
        return counted
    finally:
        capture.release()


def _opened(path: Path):
    if path.suffix.lower() in READ:
        raise InputError(f"{path}: is a single image; a folder or a video is wanted")
    cv2 = opencv()
    with libraries_heard():  # FFmpeg takes a relative "10:30.mp4" for an address
        capture = cv2.VideoCapture(os.path.abspath(path))
    if not capture.isOpened():
        raise InputError(
            f"{path}: is neither a folder of photos nor a video that OpenCV reads"
        )
    return capture
