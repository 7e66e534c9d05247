"""Movies to files: .mp4, .webm, .gif, .webp, or a folder of PNGs.

A movie is written under a temporary name and then renamed: it appears complete or not
at all. `gsjax.io.video` encodes .mp4 and .webm, OpenCV the others.
"""

import os
import re
import shutil
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from gsjax.errors import InputError
from gsjax.io import images, video
from gsjax.runtime.files import make_folder, reject_existing, write_file, writing

VIDEO_KINDS = (".mp4", ".webm")  # frames are encoded one by one
MOVIE_KINDS = (*VIDEO_KINDS, ".webp", ".gif")


def check_movie(path: Path, *, overwrite: bool = False) -> None:
    """Check that `write_movie` accepts the name, before frames are rendered.

    Raises:
      InputError: if the suffix is unknown, or the movie exists.
      MissingExtraError: if the package that encodes it is absent.
    """
    suffix = path.suffix.lower()
    if suffix not in (*MOVIE_KINDS, ".png", ""):
        raise InputError(
            f"{path}: expected a suffix of {', '.join(MOVIE_KINDS)}, or .png (or none) "
            f"for a folder of PNGs, got {path.suffix}; pass another name"
        )
    if suffix == ".mp4":
        video.pyav()
    else:
        images.opencv()
    folder = _png_folder(path)
    if folder is None:
        reject_existing([path], overwrite, "another name with -o")
    elif folder.exists():
        _refuse_folder(folder, overwrite)


def write_movie(
    path: Path,
    frames: Iterable[np.ndarray],
    *,
    fps: float = 24.0,
    overwrite: bool = False,
) -> int:
    """Write frames in the format of the suffix.

    Args:
      path: .mp4 (H.264), .webm (VP9), .webp or .gif; ``name.png``, or a name without
        suffix, is the folder ``name`` with frame_0001.png and so on. Missing folders
        are created.
      frames: [H, W, 3] RGB uint8, all of one size, read one by one. For .mp4 and .webm,
        whose sizes are even, an odd last column or row is repeated.
      fps: frames per second; ignored for folders. A GIF has times in 1/100 s, and at
        most 50 frames per second, which is what browsers show. An .mp4 stores the
        nearest fraction whose denominator is at most 1001, as 24000/1001.
      overwrite: replace an existing movie; a folder only if it holds nothing but
        frames.

    Returns:
      The number of frames.

    Raises:
      InputError: if the suffix is unknown, the movie exists, there are no frames or
        frames of different sizes, or the file cannot be written.
      MissingExtraError: if OpenCV is absent, or PyAV for .mp4.
    """
    check_movie(path, overwrite=overwrite)
    if not 0.1 <= fps <= 1000:
        raise InputError(f"fps: expected 0.1 to 1000 frames per second, got {fps:g}")
    checked = _checked(frames)
    first = next(checked, None)
    if first is None:
        raise InputError(f"{path}: expected at least one frame, got none")
    checked = chain([first], checked)
    folder, suffix = _png_folder(path), path.suffix.lower()
    make_folder((folder or path).parent)
    if folder is not None:
        return _write_folder(folder, checked)
    if suffix in VIDEO_KINDS:
        encode = video.write_h264 if suffix == ".mp4" else video.write_vp9
        return encode(path, checked, fps)
    pictures = list(checked)
    write_file(path, encode_animation(suffix, pictures, fps))
    return len(pictures)


def played_rate(suffix: str, fps: float) -> float:
    """Return the frames per second of a movie: a GIF has at most 50."""
    return min(fps, 50.0) if suffix == ".gif" else fps


def encode_animation(suffix: str, frames: Iterable[np.ndarray], fps: float) -> bytes:
    """Encode a ".gif" or ".webp" that loops, of frames [H, W, 3] RGB uint8 of one size.

    Raises:
      InputError: if OpenCV cannot encode it.
    """
    cv2 = images.opencv()
    animation = cv2.Animation()
    animation.frames = [np.ascontiguousarray(frame[..., ::-1]) for frame in frames]
    # Times of the frame ends are rounded, so the total duration is right.
    unit, rate = 10 if suffix == ".gif" else 1, played_rate(suffix, fps)
    ends = np.rint(np.arange(len(animation.frames) + 1) * 1000 / (rate * unit)) * unit
    animation.durations = np.diff(ends).astype(int).tolist()
    if suffix == ".gif":
        settings = [cv2.IMWRITE_GIF_QUALITY, 8, cv2.IMWRITE_GIF_DITHER, 2]
    else:
        settings = [cv2.IMWRITE_WEBP_QUALITY, 90]
    done, data = cv2.imencodeanimation(suffix, animation, settings)
    if not done:
        raise InputError(f"frames: OpenCV cannot encode them as {suffix}; use .webp")
    return data.tobytes()


def _png_folder(path: Path) -> Path | None:
    return path.with_suffix("") if path.suffix.lower() in ("", ".png") else None


def _checked(frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    shape = None
    for index, frame in enumerate(frames):
        shape = frame.shape if shape is None else shape
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            got = f"{frame.dtype} {frame.shape}; convert it by gsjax.io.images.to_8_bit"
            raise InputError(f"frame {index}: expected uint8 [H, W, 3], got {got}")
        if frame.shape != shape or 0 in shape:
            got = f"{frame.shape}; render all frames at one size"
            raise InputError(f"frame {index}: expected the shape {shape}, got {got}")
        yield frame


def _refuse_folder(folder: Path, overwrite: bool) -> None:
    if not folder.is_dir():
        raise InputError(f"{folder}: expected a folder, got a file; pass another name")
    names = [entry.name for entry in folder.iterdir()]
    other = [name for name in names if not re.fullmatch(r"frame_\d+\.png", name)]
    if other:
        what = f"holds files other than frames ({other[0]})"
        raise InputError(f"{folder}: {what}; pass a new folder")
    if names and not overwrite:
        remedy = "pass --overwrite, or another name"
        raise InputError(f"{folder}: holds {len(names)} frames; {remedy}")


def _write_folder(folder: Path, frames: Iterable[np.ndarray]) -> int:
    """Write into a temporary folder beside it, and rename that."""
    temporary, count = video.temporary_name(folder), 0
    try:
        make_folder(temporary)
        for count, frame in enumerate(frames, start=1):
            write_file(temporary / f"frame_{count:04d}.png", images.encode_png(frame))
        with writing(folder):
            if folder.exists():  # `check_movie`: it holds nothing but frames
                shutil.rmtree(folder)
            os.replace(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return count
