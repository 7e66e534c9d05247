"""Size and completeness of an image file, from its bytes, before it is decoded.

A decoder allocates what a header declares, so a few hundred bytes may request
gigabytes: sizes are bounded here first. Truncated files are rejected, because some
decoders return their upper part without an error. OpenCV has no call for either.
"""

import mmap
import struct
from pathlib import Path

from gsjax.data import heif
from gsjax.errors import InputError
from gsjax.runtime.files import opened

Buffer = bytes | mmap.mmap

# 268 MP: above any camera; 0.8 GB as RGB.
MAX_PIXELS = 1 << 28
# Maximum compression ratios; a smaller file cannot be complete. A code of LZW has 12
# bits for at most 4096 bytes.
_MAX_DEFLATE, _MAX_LZW = 1032, 1400
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
_REMEDY = "copy or export it again"
# Tags of TIFF: width, height, bits per sample, compression, kind of colours,
# orientation, samples per pixel, extra samples.
_ORIENTATION = 274
_TIFF_TAGS = (256, 257, 258, 259, 262, _ORIENTATION, 277, 338)
# Markers of JPEG without a length, and those with the size of the image.
_JPEG_BARE = {0x01, *range(0xD0, 0xD9)}
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}


def image_size(path: Path) -> tuple[int, int]:
    """Return the width and height in px of an image file, without decoding it.

    Raises:
      InputError: as `check_image`, or if the file cannot be read.
    """
    with opened(path, "a photograph") as file:
        if not file.read(1):
            return check_image(path, b"")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return check_image(path, data)


def check_image(path: Path, data: Buffer) -> tuple[int, int]:
    """Return the width and height in px that the bytes of an image file declare.

    EXIF orientation is ignored; the turn of a HEIC or AVIF is applied.

    Raises:
      InputError: if the file is empty, of an unknown format, truncated, in CMYK, or
        larger than `MAX_PIXELS`.
    """
    if not len(data):
        raise InputError(f"{path}: the file is empty; {_REMEDY}")
    reader = _reader(data[:64])
    if reader is None:
        got = f"a file that starts with {data[:8]!r}; convert it to PNG or JPEG"
        kinds = "PNG, JPEG, WebP, TIFF, BMP, HEIC or AVIF"
        raise InputError(f"{path}: expected a {kinds}, got {got}")
    try:
        width, height = reader(data)
    except _ForPrint as error:
        what = "expected grey or RGB, got CMYK, the inks of a printer"
        raise InputError(f"{path}: {what}; convert it to sRGB") from error
    except (struct.error, IndexError, _Truncated, heif.BoxError) as error:
        told = isinstance(error, _Truncated | heif.BoxError)
        detail = f" ({error})" if told else ""
        what = f"the image is truncated or damaged{detail}, got {len(data)} bytes"
        raise InputError(f"{path}: {what}; {_REMEDY}") from error
    if width < 1 or height < 1:
        raise InputError(f"{path}: got an image of {width} × {height} px; {_REMEDY}")
    if width * height > MAX_PIXELS:
        got = f"{width} × {height} px; make it smaller"
        raise InputError(f"{path}: expected at most {MAX_PIXELS} pixels, got {got}")
    return width, height


class _Truncated(Exception):
    """Names the missing part of a file."""


class _ForPrint(Exception):
    """Says that an image has the colours of inks."""


def _reader(head: bytes):
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        return _png
    if head.startswith(b"\xff\xd8\xff"):
        return _jpeg
    if head.startswith(b"RIFF") and head[8:12] == b"WEBP":
        return _webp
    if head.startswith((b"II*\0", b"MM\0*")):
        return _tiff
    if heif.kind_of(head):
        return _heif
    return _bmp if head.startswith(b"BM") else None


def _png(data: Buffer) -> tuple[int, int]:
    length, kind, width, height, depth, color = struct.unpack_from(">I4sIIBB", data, 8)
    if kind != b"IHDR" or length != 13:
        raise _Truncated("no IHDR chunk")
    row = (width * depth * _PNG_CHANNELS.get(color, 1) + 7) // 8
    if width * height > MAX_PIXELS:
        return width, height
    if (1 + row) * height > _MAX_DEFLATE * len(data):
        raise _Truncated(f"{width} × {height} px cannot fit in it")
    at = 8
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, at)
        at += 12 + length
        if at > len(data):
            raise _Truncated("no IEND chunk")
    return width, height


def _jpeg(data: Buffer) -> tuple[int, int]:
    at, size, arithmetic = 2, None, False
    while True:
        marker, code = data[at], data[at + 1]
        if marker != 0xFF:
            raise _Truncated(f"no marker at byte {at}")
        if code == 0xFF:  # fill byte
            at += 1
            continue
        if code in _JPEG_BARE:
            at += 2
            continue
        if code == 0xDA and size is not None:
            break
        if code in _JPEG_FRAMES:
            height, width, channels = struct.unpack_from(">HHB", data, at + 5)
            if channels == 4:
                raise _ForPrint
            size, arithmetic = (width, height), code > 0xC8
        at += 2 + struct.unpack_from(">H", data, at + 2)[0]
    # Huffman codes take at least a bit for each block of 8 × 8.
    if not arithmetic and -(-size[0] // 8) * -(-size[1] // 8) > 8 * len(data):
        raise _Truncated(f"{size[0]} × {size[1]} px cannot fit in it")
    # In compressed data FF is followed by 00 or a restart, so this is the end.
    if data.find(b"\xff\xd9", at) < 0:
        raise _Truncated("no end-of-image marker")
    return size


def _webp(data: Buffer) -> tuple[int, int]:
    (length,) = struct.unpack_from("<I", data, 4)
    kind = data[12:16]
    if length + 8 > len(data):
        raise _Truncated(f"{length + 8} bytes are declared")
    if kind == b"VP8X":
        width, more, height, rest = struct.unpack_from("<HBHB", data, 24)
        return width + (more << 16) + 1, height + (rest << 16) + 1
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    width, height = struct.unpack_from("<HH", data, 26)
    return width & 0x3FFF, height & 0x3FFF


def has_tiff_alpha(data: Buffer) -> bool:
    """Return whether a checked image is a TIFF whose extra sample is opacity.

    Colours may have been multiplied by it (1) or not (2).
    """
    return _reader(data[:12]) is _tiff and _tiff_tags(data).get(338) in (1, 2)


def has_two_samples(data: Buffer) -> bool:
    """Return whether a checked image is a TIFF of grey and alpha."""
    return _reader(data[:12]) is _tiff and _tiff_tags(data).get(277) == 2


def clear_grey(data: Buffer) -> float | None:
    """Return the grey, in [0, 1], that a checked PNG declares transparent, else None.

    It is in the tRNS chunk of a PNG without other transparency.
    """
    if _reader(data[:12]) is not _png or data[25] != 0:
        return None
    depth, at = data[24], 8
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        if kind == b"tRNS" and length == 2:
            return struct.unpack_from(">H", data, at + 8)[0] / (2**depth - 1)
        at += 12 + length
    return None


def tiff_as_stored(data: bytes) -> bytes:
    """Return the bytes of a checked image, without the orientation of a TIFF."""
    places = _tiff_places(data) if _reader(data[:12]) is _tiff else {}
    if _ORIENTATION not in places:
        return data
    form, at = places[_ORIENTATION]
    upright = bytearray(data)
    struct.pack_into(form, upright, at, 1)
    return bytes(upright)


def _tiff_tags(data: Buffer) -> dict[int, int]:
    places = _tiff_places(data).items()
    return {tag: struct.unpack_from(form, data, at)[0] for tag, (form, at) in places}


def _tiff_places(data: Buffer) -> dict[int, tuple[str, int]]:
    """Return the format and offset of the first value of each of `_TIFF_TAGS`."""
    order = "<" if data[:2] == b"II" else ">"
    (at,) = struct.unpack_from(f"{order}I", data, 4)
    (count,) = struct.unpack_from(f"{order}H", data, at)
    found = {}
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind, values = struct.unpack_from(f"{order}HHI", data, entry)
        form = {1: "B", 3: "H", 4: "I"}.get(kind)
        if tag in _TIFF_TAGS and form:
            at = entry + 8
            if values * struct.calcsize(form) > 4:  # stored elsewhere
                (at,) = struct.unpack_from(f"{order}I", data, at)
            found[tag] = order + form, at
    return found


def _tiff(data: Buffer) -> tuple[int, int]:
    found = _tiff_tags(data)
    if not {256, 257} <= set(found):
        raise _Truncated("no image size")
    if found.get(262) == 5:
        raise _ForPrint
    width, height = found[256], found[257]
    # One sample: others may be subsampled, as in YCbCr.
    bits = width * height * found.get(258, 1)
    ratio = {1: 1, 5: _MAX_LZW, 8: _MAX_DEFLATE, 32946: _MAX_DEFLATE}
    shrunk = ratio.get(found.get(259, 1))  # other compressions have no such bound
    if width * height <= MAX_PIXELS and shrunk and bits > 8 * shrunk * len(data):
        raise _Truncated(f"{width} × {height} px cannot fit in it")
    return width, height


def _heif(data: Buffer) -> tuple[int, int]:
    return heif.turns_of(data).upright


def _bmp(data: Buffer) -> tuple[int, int]:
    width, height = struct.unpack_from("<ii", data, 18)
    return width, abs(height)
