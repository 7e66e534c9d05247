"""Textures of a SOG scene: lossless WebP images, one texel a Gaussian.

OpenCV encodes and decodes, and is imported on first use. Axis legend: H rows and W
columns of a texture, from its top left; 4 bytes a texel, RGBA.
"""

import math
import struct

import numpy as np

from gsjax.errors import InputError
from gsjax.io.images import captured_stderr, opencv
from gsjax.io.sog_files import REMEDY

_BLOCK = 4  # W and H are multiples of it
_OPAQUE = 255
# Texels by Gaussian, beyond a few: textures of other writers may have other shapes.
_MAX_SPARE, _FEW = 4, 4096


def texture_size(count: int) -> tuple[int, int]:
    """Return the W and H of the textures of ``count`` Gaussians, at least one."""
    width = _BLOCK * math.ceil(math.sqrt(count) / _BLOCK)
    return width, _BLOCK * math.ceil(count / width / _BLOCK)


def decode_texture(where: str, data: bytes, *, most: int) -> np.ndarray:
    """Return the texels [H, W, 4] uint8 of a lossless WebP.

    Args:
      where: its name, for messages.
      data: the file.
      most: maximum number of texels; a larger size is rejected before decoding.

    Raises:
      InputError: if it is not a lossless WebP, is truncated, damaged or too large.
    """
    width, height = webp_size(where, data)
    if width * height > most:
        got = f"got {width} × {height}"
        raise InputError(
            f"{where}: expected a texture of up to {most:,} texels, {got}; {REMEDY}"
        )
    cv2 = opencv()
    with captured_stderr():  # the decoder may report damage there
        try:
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            pixels = None
    if pixels is None or pixels.shape[:2] != (height, width) or pixels.ndim != 3:
        raise InputError(
            f"{where}: the image cannot be decoded: truncated or damaged; {REMEDY}"
        )
    if pixels.shape[2] == 3:  # written without alpha
        return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGBA)
    return cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA)


def webp_size(where: str, data: bytes) -> tuple[int, int]:
    """Return the W and H that the header of a lossless WebP declares.

    Raises:
      InputError: if it is not a lossless WebP, or is truncated.
    """
    # RIFF, size of the rest, WEBP; then chunks of name, size and content.
    if data[:4] != b"RIFF" or data[8:12] != b"WEBP" or len(data) < 25:
        got = f"got {len(data):,} bytes that start with {data[:12]!r}"
        raise InputError(f"{where}: expected a WebP image, {got}; {REMEDY}")
    (declared,) = struct.unpack_from("<I", data, 4)
    if declared + 8 > len(data):
        got = f"got {len(data):,}; the file is truncated"
        raise InputError(f"{where}: expected {declared + 8:,} bytes, {got}: {REMEDY}")
    at = 12
    while at + 13 <= len(data):
        kind, length = struct.unpack_from("<4sI", data, at)
        if kind == b"VP8L":
            (bits,) = struct.unpack_from("<I", data, at + 9)
            return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
        if kind == b"VP8 ":
            break
        at += 8 + length + length % 2
    raise InputError(f"{where}: expected a lossless WebP, got another; {REMEDY}")


def decode_rows(where: str, data: bytes, count: int) -> np.ndarray:
    """Return the texels [count, 4] uint8 of a texture of ``count`` Gaussians.

    Raises:
      InputError: as `decode_texture`, and if the texture has fewer texels.
    """
    texels = decode_texture(where, data, most=_MAX_SPARE * count + _FEW)
    height, width, _ = texels.shape
    if width * height < count:
        expected = f"expected {count:,} texels or more, got {width} × {height}"
        raise InputError(f"{where}: {expected}; {REMEDY}")
    return texels.reshape(-1, 4)[:count]


def encode_rows(rows: np.ndarray) -> bytes:
    """Return the WebP of a texture of rows [N, 3] or [N, 4] uint8, padded with 0."""
    width, height = texture_size(len(rows))
    texels = np.zeros((width * height, rows.shape[1]), np.uint8)
    texels[: len(rows)] = rows
    return encode_texture(texels.reshape(height, width, -1))


def encode_texture(texels: np.ndarray) -> bytes:
    """Return texels [H, W, 3] or [H, W, 4] uint8 as a WebP that keeps each byte.

    Without alpha, texels are opaque.
    """
    cv2 = opencv()
    swap = cv2.COLOR_RGBA2BGRA if texels.shape[2] == 4 else cv2.COLOR_RGB2BGR
    # Other lossless modes change the colours of transparent texels.
    mode = [cv2.IMWRITE_WEBP_LOSSLESS_MODE, cv2.IMWRITE_WEBP_LOSSLESS_PRESERVE_COLOR]
    done, data = cv2.imencode(".webp", cv2.cvtColor(texels, swap), mode)
    assert done, texels.shape
    return data.tobytes()
