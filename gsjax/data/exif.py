"""EXIF blocks of photographs."""

import io
from pathlib import Path

from PIL import Image

from gsjax.data import heif


def exif_of(path: Path) -> bytes:
    """Return the EXIF block of a JPEG, HEIC or AVIF; empty if there is none.

    Raises:
      MissingExtraError: if the file is a HEIC and pillow-heif is absent.
    """
    with path.open("rb") as file:
        if heif.kind_of(file.read(64)) == "heic":
            return heif.opener().open_heif(path).info.get("exif") or b""
    try:
        with Image.open(path) as image:
            return image.info.get("exif") or b""
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return b""


def blank_jpeg(size: tuple[int, int], exif: bytes) -> bytes:
    """Return a grey JPEG of width and height ``size`` with an EXIF block."""
    stream = io.BytesIO()
    Image.new("L", size).save(stream, "JPEG", exif=exif)
    return stream.getvalue()
