"""Strict parser of COLMAP's binary files: cameras.bin, images.bin, points3D.bin.

They are little-endian without padding. Declared sizes are checked against the file size
before any allocation, and a file must be consumed completely.
"""

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gsjax.data import colmap_model as model
from gsjax.errors import InputError
from gsjax.runtime.files import read_bytes

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters
_IMAGE = struct.Struct("<I7dI")  # id, quaternion, translation, camera; then the name
_POINT_2D_BYTES = 24  # x, y as float64, id of the point as int64
_FIELDS = [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8")]
_FIELDS += [("n", "<u8")]
POINT = np.dtype(_FIELDS)
_CHUNK = 1 << 12  # records gathered at a time
_TRACK_BYTES = 8  # image and index of the observation, uint32 each
_REMEDY = "the file is truncated or damaged: export or copy it again"


class _Data:
    """The bytes of a file and the read position."""

    def __init__(self, path: Path, least: int, records: str):
        self.bytes = read_bytes(path, "a file of COLMAP")
        self.path, self.offset = path, 0
        self.size = len(self.bytes)
        (self.count,) = self.take(_COUNT, "the count")
        if self.count * least > self.size - self.offset:
            raise InputError(
                f"{path}: byte 0: the count says {self.count} {records} of at least "
                f"{least} bytes each, got {self.size - self.offset} bytes; {_REMEDY}"
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
            f"{self.path}: byte {self.offset}: expected {size} bytes for {what}, got "
            f"{self.size - self.offset} of {self.size}; {_REMEDY}"
        )

    def finish(self, records: str) -> None:
        if self.offset != self.size:
            raise InputError(
                f"{self.path}: {self.size - self.offset} bytes follow the last of "
                f"{self.count} {records} (from byte {self.offset}); the count or the "
                "file is damaged: export or copy it again"
            )


def read_cameras(path: Path) -> dict[int, model.ColmapCamera]:
    """Return the cameras of a cameras.bin by id."""
    return model.by_id(_cameras(_Data(path, _CAMERA.size, "cameras")), "camera")


def _cameras(data: _Data) -> Iterator[tuple[str, int, model.ColmapCamera]]:
    for index in range(data.count):
        where = f"{data.path}: camera {index} (byte {data.offset})"
        identity, number, *size = data.take(_CAMERA, f"camera {index}")
        kind = model.kind_of(where, number)
        form = struct.Struct(f"<{kind.size}d")
        params = data.take(form, f"{kind.name} camera {index}")
        yield where, identity, model.make_colmap_camera(where, kind, size, params)
    data.finish("cameras")


def read_images(path: Path) -> list[model.ColmapImage]:
    """Return the images of an images.bin in file order; 2D points are skipped."""
    data = _Data(path, _IMAGE.size + 1 + _COUNT.size, "images")
    return [*model.by_id(_images(data), "image").values()]


def _images(data: _Data) -> Iterator[tuple[str, int, model.ColmapImage]]:
    for index in range(data.count):
        where = f"{data.path}: image {index} (byte {data.offset})"
        identity, *pose, camera = data.take(_IMAGE, f"image {index}")
        name = _name(data, where)
        (points,) = data.take(_COUNT, f"the number of 2D points of image {index}")
        data.skip(points * _POINT_2D_BYTES, f"the {points} 2D points of image {index}")
        yield where, identity, model.make_colmap_image(where, name, camera, pose)
    data.finish("images")


def _name(data: _Data, where: str) -> str:
    limit = data.offset + model.MAX_NAME_BYTES + 1
    end = data.bytes.find(b"\0", data.offset, limit)
    if end < 0:
        most = f"{model.MAX_NAME_BYTES} bytes; {_REMEDY}"
        raise InputError(
            f"{where}: the name (byte {data.offset}) has no end within {most}"
        )
    raw = data.bytes[data.offset : end]
    data.offset = end + 1
    try:
        return raw.decode()
    except UnicodeDecodeError as error:
        raise InputError(
            f"{where}: the name {raw[:80]!r} is not UTF-8; rename the photograph"
        ) from error


def read_points(path: Path) -> model.ColmapPoints:
    """Return the points of a points3D.bin sorted by id; of tracks only the length."""
    data = _Data(path, POINT.itemsize, "points")
    raw = np.frombuffer(data.bytes, np.uint8)
    fields = {name: np.empty((data.count, *s), kind) for name, kind, *s in _FIELDS}
    for first in range(0, data.count, _CHUNK):
        chunk = range(first, min(first + _CHUNK, data.count))
        starts = _point_starts(data, chunk)
        # A gather of the fixed part of records: [·, 51] bytes.
        rows = raw[starts[:, None] + np.arange(POINT.itemsize)].view(POINT)[:, 0]
        for name, field in fields.items():
            field[chunk.start : chunk.stop] = rows[name]
    data.finish("points")
    # Sorting copies; free the file's bytes first.
    del data, raw
    identities, xyz, rgb, errors, lengths = fields.values()
    lengths = lengths.view(np.int64)
    return model.sorted_points(
        str(path), model.ColmapPoints(identities, xyz, rgb, errors, lengths)
    )


def _point_starts(data: _Data, chunk: range) -> np.ndarray:
    """Return the byte offsets of a chunk's records; each depends on the one before."""
    content, size = data.bytes, data.size
    unpack, fixed, length_at = _COUNT.unpack_from, POINT.itemsize, POINT.itemsize - 8
    starts = []
    at = data.offset
    for index in chunk:
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
