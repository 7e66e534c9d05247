"""COLMAP's binary files, read strictly: cameras.bin, images.bin, points3D.bin.

Little-endian, without padding. What a file declares is held against its size before
anything is allocated, and a file is used whole or not at all.
"""

import struct
from pathlib import Path

import numpy as np

from gsjax.data.colmap_model import (
    MAX_NAME_BYTES,
    ColmapCamera,
    ColmapImage,
    ColmapPoints,
    kind_of,
    make_colmap_camera,
    make_colmap_image,
    sorted_points,
    twice,
)
from gsjax.errors import InputError
from gsjax.runtime.files import read_bytes

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters
_IMAGE = struct.Struct("<I7dI")  # id, quaternion, translation, camera; then the name
_POINT_2D_BYTES = 24  # x, y as float64, id of the point as int64
_FIELDS = (
    *(("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3)),
    *(("error", "<f8"), ("n", "<u8")),
)
_POINT = np.dtype([*_FIELDS])
_PIECE = 1 << 12  # records gathered at a time
_TRACK_BYTES = 8  # image and index of the observation, uint32 each


class _Data:
    """The bytes of a file and how far they are read."""

    def __init__(self, path: Path, least: int, records: str):
        self.bytes = read_bytes(path, "a file of COLMAP")
        self.path, self.offset = path, 0
        self.size = len(self.bytes)
        (self.count,) = self.take(_COUNT, "the count")
        if self.count * least > self.size - self.offset:
            raise InputError(
                f"{path}: byte 0: the count says {self.count} {records} of at least "
                f"{least} bytes each, {self.size - self.offset} bytes follow; the file "
                "is truncated or damaged: export or copy it again"
            )

    def take(self, form: struct.Struct, what: str) -> tuple:
        start = self.offset
        self.skip(form.size, what)
        return form.unpack_from(self.bytes, start)

    def skip(self, size: int, what: str) -> None:
        if size > self.size - self.offset:
            raise self.truncated(size, what)
        self.offset += size

    def truncated(self, size: int, what: str) -> InputError:
        return InputError(
            f"{self.path}: byte {self.offset}: {what} takes {size} bytes, "
            f"{self.size - self.offset} are left of {self.size}; the file is truncated "
            "or damaged: export or copy it again"
        )

    def finish(self, records: str) -> None:
        if self.offset != self.size:
            raise InputError(
                f"{self.path}: {self.size - self.offset} bytes follow the last of "
                f"{self.count} {records} (from byte {self.offset}); the count or the "
                "file is damaged: export or copy it again"
            )


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """Cameras of a cameras.bin, by id."""
    data = _Data(path, _CAMERA.size, "cameras")
    cameras: dict[int, ColmapCamera] = {}
    for index in range(data.count):
        where = f"{path}: camera {index} (byte {data.offset})"
        identity, number, *size = data.take(_CAMERA, f"camera {index}")
        kind = kind_of(where, number)
        form = struct.Struct(f"<{kind.size}d")
        params = data.take(form, f"{kind.name} camera {index}")
        if identity in cameras:
            raise twice(where, identity, "camera")
        cameras[identity] = make_colmap_camera(where, kind, (size[0], size[1]), params)
    data.finish("cameras")
    return cameras


def read_images(path: Path) -> list[ColmapImage]:
    """Images of an images.bin, in its order; their 2D points are skipped."""
    data = _Data(path, _IMAGE.size + 1 + _COUNT.size, "images")
    images: list[ColmapImage] = []
    identities: set[int] = set()
    for index in range(data.count):
        where = f"{path}: image {index} (byte {data.offset})"
        identity, *pose, camera = data.take(_IMAGE, f"image {index}")
        name = _name(data, where)
        (points,) = data.take(_COUNT, f"the number of 2D points of image {index}")
        data.skip(points * _POINT_2D_BYTES, f"the {points} 2D points of image {index}")
        if identity in identities:
            raise twice(where, identity, "image")
        identities.add(identity)
        images.append(make_colmap_image(where, name, camera, tuple(pose)))
    data.finish("images")
    return images


def _name(data: _Data, where: str) -> str:
    limit = data.offset + MAX_NAME_BYTES + 1
    end = data.bytes.find(b"\0", data.offset, limit)
    if end < 0:
        raise InputError(
            f"{where}: its name (byte {data.offset}) has no end within "
            f"{MAX_NAME_BYTES} bytes; the file is truncated or damaged: export or copy "
            "it again"
        )
    raw = data.bytes[data.offset : end]
    data.offset = end + 1
    try:
        return raw.decode()
    except UnicodeDecodeError as error:
        raise InputError(
            f"{where}: its name {raw[:80]!r} is not UTF-8; the file is damaged, or the "
            "photograph is to be renamed"
        ) from error


def read_points(path: Path) -> ColmapPoints:
    """Points of a points3D.bin, sorted by id; of the tracks only the length."""
    data = _Data(path, _POINT.itemsize, "points")
    raw = np.frombuffer(data.bytes, np.uint8)
    fields = {name: np.empty((data.count, *s), kind) for name, kind, *s in _FIELDS}
    for first in range(0, data.count, _PIECE):
        piece = range(first, min(first + _PIECE, data.count))
        starts = _point_starts(data, piece)
        # A gather of the fixed part of records: [·, 51] bytes.
        rows = raw[starts[:, None] + np.arange(_POINT.itemsize)].view(_POINT)[:, 0]
        for name, field in fields.items():
            field[piece.start : piece.stop] = rows[name]
    data.finish("points")
    # Sorting copies: what was read must not be held as well.
    del data, raw
    identities, xyz, rgb, errors, lengths = fields.values()
    lengths = lengths.view(np.int64)
    return sorted_points(str(path), ColmapPoints(identities, xyz, rgb, errors, lengths))


def _point_starts(data: _Data, piece: range) -> np.ndarray:
    """Where each record of a piece starts, which follows those read before: a chain of
    lengths, walked in plain Python.
    """
    content, size = data.bytes, data.size
    unpack, fixed, length_at = _COUNT.unpack_from, _POINT.itemsize, _POINT.itemsize - 8
    starts = []
    at = data.offset
    for index in piece:
        starts.append(at)
        end = at + fixed
        if end <= size:
            end += _TRACK_BYTES * unpack(content, at + length_at)[0]
        if end > size:
            data.offset = at
            raise data.truncated(end - at, f"point {index}")
        at = end
    data.offset = at
    return np.asarray(starts, np.int64)
