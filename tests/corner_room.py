"""Photographs for structure from motion: the corner of a room, by ray casting.

Three planes of random texture; the cameras' poses and focal length are known exactly.
"""

import struct
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsjax import look_at

WIDTH, HEIGHT, FOCAL, COUNT = 320, 240, 297.0, 5
NAMES = [f"photo {i}.jpg" for i in range(COUNT)]  # with a space
ROTATED = 2  # index of the photograph stored rotated, with an EXIF orientation


def viewmat_at(turn: float) -> np.ndarray:
    """Return a camera in the corner x, y, z > 0, on an arc; ``turn`` in [0, 1]."""
    angle = 0.45 + 0.6 * turn
    eye = np.array([3.2 * np.cos(angle), 1.5 + 0.5 * turn, 3.2 * np.sin(angle)])
    return np.asarray(look_at(eye, (0.5, 0.6, 0.5)), np.float64)


def corner_view(index: float = 0, scale: float = 1.0) -> np.ndarray:
    """Return the photograph [H, W, 3] uint8 of camera ``index`` of `COUNT`."""
    viewmat = viewmat_at(index / (COUNT - 1))
    width, height, focal = round(WIDTH * scale), round(HEIGHT * scale), FOCAL * scale
    y, x = np.mgrid[:height, :width] + 0.5
    rays = np.stack([(x - width / 2) / focal, (y - height / 2) / focal, x * 0 + 1], -1)
    rays = rays @ viewmat[:3, :3]
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    with np.errstate(divide="ignore"):
        depths = np.where(rays < -1e-9, -eye / rays, np.inf)
    plane = depths.argmin(-1)
    points = eye + rays * depths.min(-1)[..., None]
    image = np.zeros((height, width, 3), np.uint8)
    for axis in range(3):
        a, b = (points[..., k].astype(np.float32) * 120 for k in range(3) if k != axis)
        wrap = cv2.BORDER_WRAP
        seen = cv2.remap(texture(axis), a, b, cv2.INTER_LINEAR, borderMode=wrap)
        image[plane == axis] = seen[plane == axis]
    return image


@cache
def texture(seed: int) -> np.ndarray:
    """Return blobs of several sizes, which SIFT detects."""
    rng = np.random.default_rng(seed)
    total = np.zeros((512, 512, 3))
    for size in (64, 128, 256):
        noise = rng.normal(0, 1, (size, size, 3)).astype(np.float32)
        total += cv2.resize(noise, (512, 512), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 45 * total, 0, 255).astype(np.uint8)


def exif(
    orientation: int,
    focal_35mm: int,
    focal_mm: tuple[int, int] = (60, 10),
    camera: tuple[bytes, bytes] = (b"Maker", b"Model"),
) -> bytes:
    """Return an EXIF segment.

    Args:
      focal_35mm: focal length for 35 mm film, which takes precedence unless it is 0.
      focal_mm: focal length of the lens as a fraction.
      camera: maker and model.
    """

    def ifd(entries, at):
        head, tail = struct.pack("<H", len(entries)), b""
        after = at + 2 + 12 * len(entries) + 4
        for tag, kind, count, value in entries:
            if len(value) > 4:
                where = struct.pack("<I", after + len(tail))
                tail += value + b"\0" * (len(value) % 2)
                value = where
            head += struct.pack("<HHI", tag, kind, count) + value.ljust(4, b"\0")
        return head + b"\0" * 4 + tail

    short = struct.Struct("<H").pack
    names = zip((0x010F, 0x0110), camera)
    main = [
        *((tag, 2, len(name) + 1, name + b"\0") for tag, name in names),
        (0x0112, 3, 1, short(orientation)),
        (0x8769, 4, 1, struct.pack("<I", 8)),
    ]
    start = 8 + len(ifd(main, 8))
    main[-1] = (0x8769, 4, 1, struct.pack("<I", start))
    lens = [
        (0x920A, 5, 1, struct.pack("<II", *focal_mm)),
        (0xA405, 3, 1, short(focal_35mm)),
    ]
    body = b"Exif\0\0II*\0" + struct.pack("<I", 8) + ifd(main, 8) + ifd(lens, start)
    return b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body


def write_photo(
    path: Path, upright: np.ndarray, orientation=1, focal_35mm=0, **lens
) -> None:
    """Write RGB pixels as JPEG; with orientation 6 they are stored rotated left."""
    stored = np.rot90(upright, 1) if orientation == 6 else upright
    quality = [cv2.IMWRITE_JPEG_QUALITY, 97]
    data = cv2.imencode(".jpg", np.ascontiguousarray(stored[..., ::-1]), quality)[1]
    data = data.tobytes()
    if focal_35mm or lens or orientation != 1:
        data = data[:2] + exif(orientation, focal_35mm, **lens) + data[2:]
    path.write_bytes(data)


def write_blank(path: Path, seed: int | None = None) -> None:
    """Write a grey photograph, or one of noise that matches no other."""
    pixels = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    if seed is not None:
        pixels = texture(100 + seed)[:HEIGHT, :WIDTH]
    write_photo(path, pixels)


def read(path: Path) -> np.ndarray:
    """Decode an image as stored: RGB or grey."""
    pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    return pixels[..., ::-1] if pixels.ndim == 3 else pixels


def make_room(folder: Path) -> Path:
    """Fill a folder: photographs with EXIF, one stored rotated, and other files."""
    for i, name in enumerate(NAMES):
        write_photo(folder / name, corner_view(i), 6 if i == ROTATED else 1, 32)
    (folder / "notes.txt").write_text("not a photo")
    (folder / "._photo 0.jpg").write_text("of another system")
    return folder


def make_video(path: Path) -> None:
    """Write an .avi of thirty frames on the arc; all but every fifth are blurred."""
    code = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), code, 10, (WIDTH, HEIGHT))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no MJPG")
    for i in range(30):
        pixels = corner_view(i * (COUNT - 1) / 29)[..., ::-1]
        writer.write(pixels if i % 5 == 3 else cv2.GaussianBlur(pixels, (0, 0), 3))
    writer.release()
