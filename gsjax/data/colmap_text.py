"""Strict parser of COLMAP's text files: cameras.txt, images.txt, points3D.txt."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import numpy as np

from gsjax.data import colmap_model as model
from gsjax.data.text_file import blocks, lines, read_text, too_long
from gsjax.data.types import unexpected
from gsjax.io import numerals
from gsjax.io.common import warn

_UINT32, _UINT64 = (1 << 32) - 1, (1 << 64) - 1
# Bytes of a line: of a camera or an image; and of a point, which leaves space for
# a track of some 70 000 photographs.
_LONGEST, _LONGEST_POINT = 1 << 14, 1 << 20
_EXPECTED = "a file of COLMAP"
_LEAST_POINT = 16  # bytes without a track: "1 0 0 0 0 0 0 0" and the line end
_SPACE = np.uint8(32)
_COMMENT = re.compile(rb"(?m)^[ \t]*(#.*)$")
_FIELDS = {"ids": ("<u8",), "xyz": ("<f8", 3), "colors": ("u1", 3)}
_FIELDS |= {"errors": ("<f8",), "track_lengths": ("<i8",)}


def _records(
    text: Iterator[tuple[str, bytes]], declared: list[int], name: str
) -> Iterator[tuple[str, str]]:
    """Yield the records; append the number that a comment states to ``declared``."""
    for where, line in text:
        if len(line) > _LONGEST:
            raise too_long(where, _LONGEST)
        record = line.decode().strip()
        if record and not record.startswith("#"):
            yield where, record
        else:
            declared += _declared(record, name)


def _whole(where: str, what: str, text: str, most: int) -> int:
    if re.fullmatch("[0-9]{1,20}", text) and int(text) <= most:
        return int(text)
    raise unexpected(
        where, f"a whole number from 0 to {most} as {what}", f"{text[:40]!r}"
    )


def _floats(where: str, texts: list[str]) -> tuple[float, ...]:
    try:
        return tuple(numerals.parse_number(text) for text in texts)
    except ValueError as error:
        raise unexpected(where, "numbers", str(error)[:80]) from error


def _words(where: str, line: str, least: int, expected: str, split: int = -1):
    words = line.split(maxsplit=split)
    if len(words) < least:
        raise unexpected(where, expected, f"{len(words)} values")
    return words


def read_cameras(path: Path) -> dict[int, model.ColmapCamera]:
    """Return the cameras of a cameras.txt by id."""
    declared: list[int] = []
    text = lines(path, read_text(path, _EXPECTED))
    records = _records(text, declared, "cameras")
    cameras = model.by_id((_camera(*record) for record in records), "camera")
    _compare(path, "cameras", len(cameras), declared)
    return cameras


def _camera(where: str, line: str) -> tuple[str, int, model.ColmapCamera]:
    words = _words(where, line, 4, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
    identity = _whole(where, "the camera id", words[0], _UINT32)
    kind = model.kind_of(where, words[1][:40])
    size = (
        _whole(where, "the width", words[2], _UINT64),
        _whole(where, "the height", words[3], _UINT64),
    )
    params = _floats(where, words[4:])
    if len(params) != kind.size:
        raise unexpected(where, f"{kind.size} parameters of {kind.name}", len(params))
    return where, identity, model.make_colmap_camera(where, kind, size, params)


def read_images(path: Path) -> list[model.ColmapImage]:
    """Return the images of an images.txt in file order; 2D points are skipped."""
    declared: list[int] = []
    text = lines(path, read_text(path, _EXPECTED))
    images = model.by_id(_images(path, text, declared), "image")
    _compare(path, "images", len(images), declared)
    return [*images.values()]


def _images(path: Path, text: Iterator[tuple[str, bytes]], declared: list[int]):
    observations = ("", b"")
    for where, record in _records(text, declared, "images"):
        yield _image(where, record)
        # Each image is followed by a line of 2D points, which may be empty.
        observations = next(text, None)
        if observations is not None:
            _check_observations(*observations)
    if observations is None:
        warn(
            f"{path}: the last image has no line of 2D points (it may be empty); the "
            "file may be truncated: export or copy it again"
        )


def _check_observations(where: str, line: bytes) -> None:
    """Raise unless a line may be the 2D points of an image, and not the next image."""
    ink = np.frombuffer(b" " + line, np.uint8) > _SPACE
    count = np.count_nonzero(ink[1:] & ~ink[:-1])  # words
    last = (line[-80:].decode(errors="replace").split() or ["0"])[-1][-40:]
    number = last.removeprefix("-")
    if count % 3 or not (number.isascii() and number.isdecimal()):
        expected = "X Y POINT3D_ID of each 2D point or an empty line after an image"
        raise unexpected(where, expected, f"{count} values, the last {last!r}")


def _image(where: str, line: str) -> tuple[str, int, model.ColmapImage]:
    expected = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
    words = _words(where, line, 10, expected, 9)
    identity = _whole(where, "the image id", words[0], _UINT32)
    camera = _whole(where, "the camera id", words[8], _UINT32)
    if len(words[9].encode()) > model.MAX_NAME_BYTES:
        expected = f"a name of at most {model.MAX_NAME_BYTES} bytes"
        raise unexpected(where, expected, "more", "rename the photograph")
    pose = _floats(where, words[1:8])
    return where, identity, model.make_colmap_image(where, words[9], camera, pose)


def read_points(path: Path) -> model.ColmapPoints:
    """Return the points of a points3D.txt sorted by id; of tracks only the length."""
    count = 0
    declared: list[int] = []
    text = read_text(path, _EXPECTED)
    most = min(text.count(b"\n"), len(text) // _LEAST_POINT) + 1
    fields = {key: np.empty((most, *s), kind) for key, (kind, *s) in _FIELDS.items()}
    for number, block in blocks(path, text, _LONGEST_POINT):
        if b"#" in block:
            for comment in _COMMENT.findall(block):
                declared += _declared(comment.decode(), "points")
            block = _COMMENT.sub(b"", block)
        rows = _points(block)
        if rows is None:
            _raise_bad_block(path, number, block)
        size = len(rows["ids"])
        for name, field in fields.items():
            field[count : count + size] = rows[name]
        count += size
    del text
    _compare(path, "points", count, declared)
    if not count:
        warn(f"{path}: the file has no points to start from")
    points = model.ColmapPoints(
        **{name: field[:count] for name, field in fields.items()}
    )
    return model.sorted_points(str(path), points)


def _points(block: bytes) -> dict[str, np.ndarray] | None:
    """Return the fields of the points in whole lines; None if a line is malformed."""
    raw = np.frombuffer(block, np.uint8)
    starts, first, counts, ends = numerals.find_words(raw)
    first, counts, ends = (values[counts > 0] for values in (first, counts, ends))
    if not len(counts):
        return {name: np.empty((0, *s), kind) for name, (kind, *s) in _FIELDS.items()}
    if (counts < 8).any() or (counts % 2).any():
        return None
    # Ends of the ids and starts of the tracks: both consist of digits only.
    second = starts[first + 1]
    tracks = np.where(counts > 8, np.append(starts, len(raw))[first + 8], ends)
    other = numerals.other_than_digits(raw)
    if (other[second] > other[starts[first]]).any() or (
        other[ends] > other[tracks]
    ).any():
        return None
    marks = np.zeros(len(raw) + 1, np.int8)
    marks[tracks] += 1
    marks[ends] -= 1
    in_track = np.cumsum(marks[:-1], dtype=np.int8) > 0
    values = numerals.parse_numbers(np.where(in_track, _SPACE, raw), 8 * len(counts))
    if values is None:
        return None
    values = values.reshape(-1, 8)
    colors = values[:, 4:7]
    if not ((colors >= 0) & (colors <= 255) & (colors == np.rint(colors))).all():
        return None
    ids = _identities(block, values[:, 0], starts[first], second)
    if ids is None:
        return None
    return {
        "ids": ids,
        "xyz": values[:, 1:4],
        "colors": colors,
        "errors": values[:, 7],
        "track_lengths": (counts - 8) // 2,
    }


def _identities(
    block: bytes, values: np.ndarray, starts: np.ndarray, ends: np.ndarray
) -> np.ndarray | None:
    """Return ids as uint64, re-reading those that float64 rounds; None if too large."""
    long = ends - starts > 15  # digits that float64 represents exactly
    ids = np.where(long, 0, values).astype(np.uint64)
    for row in np.flatnonzero(long):
        value = int(block[starts[row] : ends[row]])
        if value > _UINT64:
            return None
        ids[row] = value
    return ids


def _raise_bad_block(path: Path, number: int, block: bytes) -> NoReturn:
    """Raise the error of the first malformed line after ``number``."""
    for row, line in enumerate(block.decode().split("\n"), number + 1):
        if words := line.split():
            _check_point(f"{path}: line {row}", words)
    raise unexpected(f"{path}: after line {number}", "numbers", "other characters")


def _check_point(where: str, words: list[str]) -> None:
    """Raise if a line of points3D.txt is malformed."""
    count = f"{len(words)} values"
    if len(words) < 8:
        raise unexpected(where, "POINT3D_ID X Y Z R G B ERROR TRACK", count)
    _whole(where, "the point id", words[0], _UINT64)
    colors = _floats(where, words[1:8])[3:6]
    for word in words[8:]:
        _whole(where, "a value of the track", word, 10**20)
    if len(words) % 2:
        raise unexpected(where, "a track of pairs IMAGE_ID POINT2D_IDX", count)
    if not all(0 <= color <= 255 and color % 1 == 0 for color in colors):
        raise unexpected(where, "a colour of whole numbers from 0 to 255", [*colors])


def _declared(line: str, records: str) -> list[int]:
    """Return the number of records that a comment of COLMAP states, if it does."""
    found = re.match(rf"# *Number of {records}: *([0-9]{{1,18}})", line)
    return [int(found[1])] if found else []


def _compare(path: Path, records: str, found: int, declared: list[int]) -> None:
    # Only a warning: files edited by hand keep their first comment.
    if declared and declared[-1] != found:
        got = f"a comment says {declared[-1]} {records}, got {found}"
        warn(f"{path}: {got}; the file may be truncated")
