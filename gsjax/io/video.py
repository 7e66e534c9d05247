"""Video files, encoded frame by frame: H.264 by PyAV and VP9 by OpenCV."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from gsjax.errors import InputError, MissingExtraError
from gsjax.io import images
from gsjax.runtime.files import writing

_BT709, _LIMITED = 1, 1  # of ITU-T H.273, and of FFmpeg's AVColorRange
_MAX_DENOMINATOR = 1001  # 24000/1001 and 30000/1001 frames per second are exact
_CRF = 17  # constant rate factor of x264; up to about 18, no loss is visible


def pyav() -> Any:
    """Return the module av, or raise `MissingExtraError` if it does not load."""
    try:
        import av
    except ImportError as error:
        what = f"PyAV, which writes .mp4 movies, does not load ({error})"
        remedy = "pip install 'gsjax[movies]', or use the suffix .webm"
        raise MissingExtraError(f"{what}; {remedy}") from error
    return av


def write_h264(path: Path, frames: Iterator[np.ndarray], fps: float) -> int:
    """Write an .mp4 that plays while it loads.

    Colours are converted to BT.709 of limited range. Chroma is the mean of 2 × 2 px
    (yuv420p), the only kind that all phones and browsers decode.

    Args:
      path: the file, replaced if it exists.
      frames: at least one frame [H, W, 3] RGB uint8, all of one size; an odd last
        column or row is repeated.
      fps: frames per second.

    Returns:
      The number of frames.

    Raises:
      InputError: if H.264 does not allow the size, or the file cannot be written.
      MissingExtraError: if PyAV is absent.
    """
    av, temporary = pyav(), temporary_name(path)
    rate = Fraction(fps).limit_denominator(_MAX_DENOMINATOR)
    first, count = next(frames), 0
    options = {"movflags": "faststart"}  # puts the index before the frames
    try:
        with _encoding(av, path, first):
            container = av.open(str(temporary), "w", format="mp4", options=options)
        try:
            stream = _h264_stream(container, _even(first), rate)
            for frame in chain([first], frames):
                with _encoding(av, path, first):
                    container.mux(stream.encode(_yuv(av, _even(frame), count, rate)))
                count += 1
            with _encoding(av, path, first):
                container.mux(stream.encode())
                container.close()
        finally:
            with suppress(av.FFmpegError):  # reported already
                container.close()
        with writing(path):
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return count


@contextmanager
def _encoding(av: Any, path: Path, frame: np.ndarray) -> Iterator[None]:
    """Turn errors of PyAV within the context into an `InputError`."""
    try:
        with writing(path):
            yield
    except av.FFmpegError as error:  # of the encoder, not of the system
        size = f"{frame.shape[1]} × {frame.shape[0]} px"
        what = f"{path}: H.264 cannot encode frames of {size} ({error})"
        raise InputError(f"{what}; render a smaller size, or use .webm") from error


def _h264_stream(container: Any, frame: np.ndarray, rate: Fraction) -> Any:
    """Add a video stream for frames of this size to a container."""
    stream = container.add_stream("libx264", rate=rate, options={"crf": str(_CRF)})
    stream.width, stream.height = frame.shape[1], frame.shape[0]
    stream.pix_fmt = "yuv420p"
    codec = stream.codec_context
    codec.colorspace = codec.color_primaries = codec.color_trc = _BT709
    codec.color_range = _LIMITED
    return stream


def _yuv(av: Any, frame: np.ndarray, index: int, rate: Fraction) -> Any:
    """Convert an RGB frame of even size, and give it its time."""
    converted = av.VideoFrame.from_ndarray(frame, "rgb24").reformat(
        format="yuv420p",
        src_colorspace="ITU709",
        dst_colorspace="ITU709",  # the default is BT.601
        src_color_range="JPEG",
        dst_color_range="MPEG",
        interpolation="AREA",  # others blur chroma beyond 2 × 2 px
    )
    converted.pts, converted.time_base = index, 1 / rate
    return converted


def write_vp9(path: Path, frames: Iterator[np.ndarray], fps: float) -> int:
    """Write a .webm; arguments, result and `InputError` as `write_h264`.

    Raises:
      InputError: if OpenCV cannot write it.
      MissingExtraError: if OpenCV is absent.
    """
    cv2, temporary = images.opencv(), temporary_name(path)
    writer, count = None, 0
    try:
        for frame in frames:
            even = _even(frame)
            writer = writer or _vp9_writer(temporary, even, fps)
            writer.write(np.ascontiguousarray(even[..., ::-1]))
            count += 1
        if writer is not None:
            writer.release()
        # The encoder does not report a full disk; a truncated file has no duration.
        written = cv2.VideoCapture(str(temporary)).get(cv2.CAP_PROP_FRAME_COUNT)
        if abs(written - count) > 1:
            some = f"only {written:g} of {count} frames could be written"
            raise InputError(f"{path}: {some}; free some disk space")
        with writing(path):
            os.replace(temporary, path)
    finally:
        if writer is not None:
            writer.release()
        temporary.unlink(missing_ok=True)
    return count


def _vp9_writer(path: Path, frame: np.ndarray, fps: float):
    cv2 = images.opencv()
    size, code = (frame.shape[1], frame.shape[0]), cv2.VideoWriter.fourcc(*"VP90")
    with images.captured_stderr():  # FFmpeg warns about a code that WebM does not use
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, fps, size)
    if not writer.isOpened():
        where = f"{path.parent}: OpenCV cannot write VP9 there"
        raise InputError(f"{where}; check permissions, or use the suffix .webp")
    return writer


def _even(frame: np.ndarray) -> np.ndarray:
    """Repeat an odd last row or column of a frame [H, W, 3]."""
    height, width = frame.shape[:2]
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), "edge")


def temporary_name(path: Path) -> Path:
    """Return a name beside ``path``, absolute: FFmpeg takes "10:30.webm" for a URL."""
    name = f".gsjax-{secrets.token_hex(6)}{path.suffix.lower()}"
    return path.absolute().with_name(name)
