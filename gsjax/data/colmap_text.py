"""COLMAP's text files, read strictly: cameras.txt, images.txt, points3D.txt."""

import re
import warnings
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
from gsjax.data.text_file import TextFile, open_text
from gsjax.errors import InputError
from gsjax.io.numerals import (
    find_words,
    other_than_digits,
    parse_number,
    parse_numbers,
)

_UINT32, _UINT64 = (1 << 32) - 1, (1 << 64) - 1
# Characters of a line: of a camera or an image; and of a point, whose track then has
# room for some 70 000 photographs.
_LONGEST, _LONGEST_POINT = 1 << 14, 1 << 20
_WANTED = "a file of COLMAP"
# Of a point without a track: "1 0 0 0 0 0 0 0" and its end.
_LEAST_POINT = 16
_SPACE = np.uint8(32)
_FIELDS = {"ids": ("<u8",), "xyz": ("<f8", 3), "colors": ("u1", 3)}
_FIELDS |= {"errors": ("<f8",), "track_lengths": ("<i8",)}


def _is_record(line: str) -> bool:
    return bool(line) and not line.startswith("#")


def _whole(where: str, what: str, text: str, most: int) -> int:
    if re.fullmatch("[0-9]{1,20}", text) and int(text) <= most:
        return int(text)
    raise InputError(
        f"{where}: {what} is {text[:40]!r}; a whole number from 0 to {most} is wanted"
    )


def _floats(where: str, texts: list[str]) -> tuple[float, ...]:
    try:
        return tuple(parse_number(text) for text in texts)
    except ValueError as error:
        raise InputError(f"{where}: {str(error)[:80]}; pass numbers") from error


def _words(where: str, line: str, least: int, wanted: str, split: int = -1):
    words = line.split(maxsplit=split)
    if len(words) < least:
        raise InputError(
            f"{where}: found {len(words)} values, {wanted} is wanted; the file is "
            "truncated or damaged: export or copy it again"
        )
    return words


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """Cameras of a cameras.txt, by id."""
    cameras: dict[int, ColmapCamera] = {}
    declared = None
    with open_text(path, _WANTED) as text:
        for line in text.lines(_LONGEST):
            if not _is_record(line):
                declared = _declared(line, "cameras", declared)
                continue
            identity, camera = _camera(text.where(), line)
            if identity in cameras:
                raise twice(text.where(), identity, "camera")
            cameras[identity] = camera
    _compare(path, "cameras", len(cameras), declared)
    return cameras


def _camera(where: str, line: str) -> tuple[int, ColmapCamera]:
    words = _words(where, line, 4, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
    identity = _whole(where, "the camera id", words[0], _UINT32)
    kind = kind_of(where, words[1][:40])
    size = (
        _whole(where, "the width", words[2], _UINT64),
        _whole(where, "the height", words[3], _UINT64),
    )
    params = _floats(where, words[4:])
    if len(params) != kind.size:
        raise InputError(
            f"{where}: found {len(params)} parameters, {kind.name} has {kind.size}; "
            "the file is truncated or damaged: export it again"
        )
    return identity, make_colmap_camera(where, kind, size, params)


def read_images(path: Path) -> list[ColmapImage]:
    """Images of an images.txt, in its order; their 2D points are skipped."""
    images: list[ColmapImage] = []
    identities: set[int] = set()
    declared, whole = None, True
    with open_text(path, _WANTED) as text:
        for line in text.lines(_LONGEST):
            if not _is_record(line):
                declared = _declared(line, "images", declared)
                continue
            identity, image = _image(text.where(), line)
            if identity in identities:
                raise twice(text.where(), identity, "image")
            identities.add(identity)
            images.append(image)
            # A line of its own after each image, which may be empty.
            whole = _pass_observations(text)
    _compare(path, "images", len(images), declared)
    if not whole:
        warnings.warn(
            f"{path}: the line of 2D points (which may be empty) of the last image is "
            "missing; the file may be truncated: export or copy it again",
            UserWarning,
            stacklevel=2,
        )
    return images


def _pass_observations(text: TextFile) -> bool:
    """Pass a line that may be the 2D points of an image; False if there is no line.

    Raises:
      InputError: if it is something else; as where it was left out, and the next image
        stands there.
    """
    found = text.pass_line()
    if found is None:
        return False
    count, last = found
    number = last.removeprefix("-") or "0"
    if count % 3 or not (number.isascii() and number.isdecimal()):
        raise InputError(
            f"{text.where()}: {count} values, the last {last!r}; X Y POINT3D_ID of "
            "each 2D point, or an empty line, is wanted after an image"
        )
    return True


def _image(where: str, line: str) -> tuple[int, ColmapImage]:
    wanted = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
    words = _words(where, line, 10, wanted, 9)
    identity = _whole(where, "the image id", words[0], _UINT32)
    camera = _whole(where, "the camera id", words[8], _UINT32)
    if len(words[9].encode()) > MAX_NAME_BYTES:
        raise InputError(
            f"{where}: a name of more than {MAX_NAME_BYTES} bytes; rename it"
        )
    pose = _floats(where, words[1:8])
    return identity, make_colmap_image(where, words[9], camera, pose)


def read_points(path: Path) -> ColmapPoints:
    """Points of a points3D.txt, sorted by id; of the tracks only the length.

    Whether the images of a track are there is not looked at: the points of a model
    from which images were taken off are still good to start from.
    """
    count, declared = 0, None
    with open_text(path, _WANTED) as text:
        most = text.most_lines(_LEAST_POINT)
        fields = {
            key: np.empty((most, *s), kind) for key, (kind, *s) in _FIELDS.items()
        }
        for block in text.blocks(_LONGEST_POINT):
            if "#" in block:
                for comment in re.findall("(?m)^[ \t]*(#.*)$", block):
                    declared = _declared(comment, "points", declared)
                block = re.sub("(?m)^[ \t]*#.*$", "", block)
            rows = _points(block)
            if rows is None:
                raise _bad_block(path, text.number, block)
            size = len(rows["ids"])
            if count + size > most:
                raise InputError(f"{path}: grew while it was read; wait for its end")
            for name, field in fields.items():
                field[count : count + size] = rows[name]
            count += size
    _compare(path, "points", count, declared)
    if not count:
        warnings.warn(
            f"{path}: no points are in it; the scene has none to start from",
            UserWarning,
            stacklevel=2,
        )
    points = ColmapPoints(**{name: field[:count] for name, field in fields.items()})
    return sorted_points(str(path), points)


def _points(block: str) -> dict[str, np.ndarray] | None:
    """The fields of the points of whole lines; None if a line is none, nor blank."""
    raw = np.frombuffer(block.encode(), np.uint8)
    starts, first, counts, ends = find_words(raw)
    first, counts, ends = (values[counts > 0] for values in (first, counts, ends))
    if not len(counts):
        return {name: np.empty((0, *s), kind) for name, (kind, *s) in _FIELDS.items()}
    if (counts < 8).any() or (counts % 2).any():
        return None
    # Where the ids end, and the tracks begin: both are of digits alone.
    second = starts[first + 1]
    tracks = np.where(counts > 8, np.append(starts, len(raw))[first + 8], ends)
    other = other_than_digits(raw)
    if (other[second] > other[starts[first]]).any() or (
        other[ends] > other[tracks]
    ).any():
        return None
    marks = np.zeros(len(raw) + 1, np.int8)
    marks[tracks] += 1
    marks[ends] -= 1
    in_track = np.cumsum(marks[:-1], dtype=np.int8) > 0
    values = parse_numbers(np.where(in_track, _SPACE, raw), 8 * len(counts))
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
    block: str, values: np.ndarray, starts: np.ndarray, ends: np.ndarray
) -> np.ndarray | None:
    """Whole numbers, of which ``values`` hold what float64 can; None if too large."""
    long = ends - starts > 15  # digits, all of which float64 still has
    ids = np.where(long, 0, values).astype(np.uint64)
    for row in np.flatnonzero(long):  # of plain ASCII: bytes are characters
        value = int(block[starts[row] : ends[row]])
        if value > _UINT64:
            return None
        ids[row] = value
    return ids


def _bad_block(path: Path, number: int, block: str) -> InputError:
    """What is wrong with the first bad one of the lines after ``number``."""
    for row, line in enumerate(block.split("\n"), number + 1):
        words = line.split()
        error = _bad_point(f"{path}: line {row}", words) if words else None
        if error is not None:
            return error
    return InputError(
        f"{path}: after line {number}: characters that are of no text of numbers; the "
        "file is damaged: export or copy it again"
    )


def _bad_point(where: str, words: list[str]) -> InputError | None:
    """What is wrong with a line of points3D.txt, if anything is."""
    try:
        if len(words) < 8:
            wanted = "POINT3D_ID X Y Z R G B ERROR TRACK is wanted; export it again"
            return InputError(f"{where}: found {len(words)} values, {wanted}")
        _whole(where, "the point id", words[0], _UINT64)
        values = _floats(where, words[1:8])
        for word in words[8:]:
            _whole(where, "a value of the track", word, 10**20)
    except InputError as error:
        return error
    if len(words) % 2:
        return InputError(
            f"{where}: the track has {len(words) - 8} values; pairs of IMAGE_ID "
            "POINT2D_IDX are wanted; the file is truncated or damaged: export or copy "
            "it again"
        )
    colors = values[3:6]
    if not all(0 <= color <= 255 and color % 1 == 0 for color in colors):
        return InputError(
            f"{where}: colour {[*colors]}; whole numbers from 0 to 255 are wanted"
        )
    return None


def _declared(line: str, records: str, before: int | None) -> int | None:
    """The number of records that a comment of COLMAP states."""
    found = re.match(rf"# *Number of {records}: *([0-9]{{1,18}})", line)
    return int(found[1]) if found else before


def _compare(path: Path, records: str, found: int, declared: int | None) -> None:
    # A warning only: files edited by hand keep their first comment.
    if declared is not None and declared != found:
        warnings.warn(
            f"{path}: a comment says {declared} {records}, {found} are there; the file "
            "may be truncated",
            UserWarning,
            stacklevel=3,
        )
