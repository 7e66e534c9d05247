"""Pictures and movies that a notebook displays."""

import base64
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from gsjax.errors import InputError
from gsjax.io import images
from gsjax.runtime.files import write_file

MIN_SIZE = 240  # px: smaller pictures are displayed enlarged
MIME_TYPES = {
    "webp": "image/webp",
    "gif": "image/gif",
    "mp4": "video/mp4",
    "webm": "video/webm",
}


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture that a notebook displays, enlarged if it is small.

    Attributes:
      pixels: [H, W, 3] uint8.
    """

    pixels: np.ndarray

    @property
    def png(self) -> bytes:
        """Contents of a PNG file."""
        return images.encode_png(self.pixels)

    def save(self, path: str | PathLike[str]) -> None:
        """Write a PNG file, in place of an existing one.

        Raises:
          InputError: if the suffix is not .png, or the file cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() != ".png":
            expected = f"expected the suffix .png, got {path.suffix!r}"
            raise InputError(f"{path}: {expected}; rename it")
        write_file(path, self.png)

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        height, width = self.pixels.shape[:2]
        zoom = max(1, MIN_SIZE // max(height, width))
        return self.png, {"width": zoom * width, "height": zoom * height}

    def __repr__(self) -> str:
        height, width = self.pixels.shape[:2]
        return f"Picture({width} × {height} px)"


@dataclass(frozen=True)
class Movie:
    """A movie that a notebook plays in a loop.

    Attributes:
      data, kind: contents of the file, and a key of `MIME_TYPES`.
      frames: number of frames.
      size: (width, height) in px at which it is shown.
    """

    data: bytes
    kind: str
    frames: int
    size: tuple[int, int]

    def _repr_html_(self) -> str:
        source = base64.b64encode(self.data).decode()
        width, height = self.size
        shape = f'width="{width}" height="{height}"'
        url = f'src="data:{MIME_TYPES[self.kind]};base64,{source}"'
        if MIME_TYPES[self.kind].startswith("video/"):
            switches = "autoplay loop muted playsinline controls"
            return f"<video {shape} {switches} {url}></video>"
        return f"<img {shape} {url}>"

    def __repr__(self) -> str:
        kilobytes = len(self.data) / 1000
        return f"Movie({self.frames} frames, {self.kind}, {kilobytes:.0f} kB)"
