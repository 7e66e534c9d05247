"""HEIC, HEIF and AVIF: the size and turns in their boxes, and decoding of HEIC.

Phones store photographs as they lie on the sensor, and the turn as a property of the
image (ISO/IEC 23008-12, `irot` and `imir`). A decoder of HEIC applies it, OpenCV's of
AVIF does not.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsjax.errors import InputError, MissingExtraError

HEIC_SUFFIXES = (".heic", ".heif")
SUFFIXES = (*HEIC_SUFFIXES, ".avif")
_AVIF = {b"avif", b"avis"}
_HEIC = {b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"}


class BoxError(ValueError):
    """Names what is wrong with the boxes of a file."""


class Turns(NamedTuple):
    """Size and turns of the main image of a file.

    Attributes:
      width, height: px as stored, before it is turned.
      quarters: of a turn, anticlockwise.
      mirrored: after the turn: "" not, "vertical" top to bottom, "horizontal" left to
        right.
    """

    width: int
    height: int
    quarters: int = 0
    mirrored: str = ""

    @property
    def upright(self) -> tuple[int, int]:
        """Width and height in px after the turn."""
        if self.quarters % 2:
            return self.height, self.width
        return self.width, self.height

    def apply(self, pixels: np.ndarray) -> np.ndarray:
        """Return stored pixels [H, W, ...] upright."""
        pixels = np.rot90(pixels, self.quarters)
        if self.mirrored:
            pixels = pixels[::-1] if self.mirrored == "vertical" else pixels[:, ::-1]
        return np.ascontiguousarray(pixels)


def kind_of(head: bytes) -> str:
    """Return "heic", "avif" or "" by the first bytes of a file, at least 12."""
    if head[4:8] != b"ftyp":
        return ""
    (size,) = struct.unpack_from(">I", head)
    brands = {head[8:12], *(head[at : at + 4] for at in range(16, min(size, 64), 4))}
    if brands & _AVIF:
        return "avif"
    return "heic" if brands & _HEIC else ""


def turns_of(data: Any) -> Turns:
    """Return the size and turns of the main image of a file.

    Raises:
      BoxError: if a box is missing, or reaches beyond the file.
      struct.error, IndexError: if a box is too short.
    """
    top = dict(_boxes(data, 0, len(data)))
    if b"meta" not in top:
        raise BoxError("no meta box")
    start, end = top[b"meta"]
    meta = dict(_boxes(data, start + 4, end))
    for name in (b"pitm", b"iprp"):
        if name not in meta:
            raise BoxError(f"no {name.decode()} box")
    at = meta[b"pitm"][0]
    (main,) = struct.unpack_from(">I" if data[at] else ">H", data, at + 4)
    properties, chosen = [], []
    for name, (start, end) in _boxes(data, *meta[b"iprp"]):
        if name == b"ipco":
            properties = list(_boxes(data, start, end))
        elif name == b"ipma":
            chosen += _associations(data, start, main)
    size, quarters, mirrored = None, 0, ""
    for index in chosen:
        if not 0 < index <= len(properties):
            continue
        name, (start, _) = properties[index - 1]
        if name == b"ispe":
            size = struct.unpack_from(">II", data, start + 4)
        elif name == b"irot":
            quarters = data[start] & 3
        elif name == b"imir":
            mirrored = "horizontal" if data[start] & 1 else "vertical"
    if size is None:
        raise BoxError("no image size")
    return Turns(*size, quarters, mirrored)


def _boxes(data: Any, at: int, end: int) -> Iterator[tuple[bytes, tuple[int, int]]]:
    """Yield the name and the place (start, end) of the content of each box."""
    while at + 8 <= end:
        size, name = struct.unpack_from(">I4s", data, at)
        head = 8
        if size == 1:
            (size,) = struct.unpack_from(">Q", data, at + 8)
            head = 16
        elif size == 0:
            size = end - at
        if size < head or at + size > end:
            raise BoxError(f"box {name.decode('latin-1')} declares {size} bytes")
        yield name, (at + head, at + size)
        at += size


def _associations(data: Any, at: int, main: int) -> list[int]:
    """Return the numbers of the properties of an item, from 1, of an `ipma` box."""
    version, wide = data[at], data[at + 3] & 1
    (items,) = struct.unpack_from(">I", data, at + 4)
    at += 8
    for _ in range(items):
        form = ">H" if version < 1 else ">I"
        (item,) = struct.unpack_from(form, data, at)
        at += struct.calcsize(form)
        count = data[at]
        form = f">{count}{'H' if wide else 'B'}"
        numbers = struct.unpack_from(form, data, at + 1)
        at += 1 + struct.calcsize(form)
        if item == main:
            return [number & (0x7FFF if wide else 0x7F) for number in numbers]
    return []


def opener() -> Any:
    """Return the module pillow_heif.

    Raises:
      MissingExtraError: if it is absent.
    """
    try:
        import pillow_heif
    except ImportError as error:
        raise MissingExtraError(
            "HEIC photographs need pillow-heif; install it: pip install 'gsjax[heic]', "
            "or convert the photographs to JPEG (keeping EXIF)"
        ) from error
    return pillow_heif


def decode_heic(path: Path, data: bytes) -> np.ndarray:
    """Return an upright photograph: [H, W], or [H, W, C] BGR or BGRA, uint8.

    Raises:
      InputError: if the file cannot be decoded.
      MissingExtraError: if pillow-heif is absent.
    """
    try:
        pixels = np.asarray(opener().open_heif(data, convert_hdr_to_8bit=True))
    except (ValueError, RuntimeError, EOFError, OSError, SyntaxError) as error:
        what = f"cannot be decoded: {str(error)[:120]}"
        raise InputError(f"{path}: {what}; copy or export it again") from error
    if pixels.ndim == 3 and pixels.shape[2] >= 3:
        pixels = pixels[..., [2, 1, 0, *range(3, pixels.shape[2])]]
    return np.ascontiguousarray(pixels)
