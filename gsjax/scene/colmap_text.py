"""COLMAP's text files, read strictly: cameras.txt, images.txt, points3D.txt."""

import re
import warnings
from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gsjax.errors import InputError
from gsjax.files import reading
from gsjax.scene.colmap_model import (
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

_UINT32, _UINT64 = (1 << 32) - 1, (1 << 64) - 1


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """(number, line) of all lines, comments and blank ones too, without their ends."""
    number, line = 0, "\n"
    try:
        with (
            reading(path, "a file of COLMAP"),
            path.open(encoding="utf-8") as file,
        ):
            for number, line in enumerate(file, 1):
                yield number, line.strip()
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: after line {number}: not UTF-8 text; the file is damaged, or a "
            "binary one with the wrong suffix: export or copy it again"
        ) from error
    if not line.endswith("\n"):
        warnings.warn(
            f"{path}: line {number}, the last one, has no end; the file may be "
            "truncated: export or copy it again",
            UserWarning,
            stacklevel=3,
        )


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
        if any("_" in text for text in texts):  # which Python takes
            raise ValueError(f"an underscore in {' '.join(texts)}")
        return tuple(float(text) for text in texts)
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
    for number, line in _lines(path):
        if not _is_record(line):
            declared = _declared(line, "cameras", declared)
            continue
        where = f"{path}: line {number}"
        words = _words(where, line, 4, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
        identity = _whole(where, "the camera id", words[0], _UINT32)
        kind = kind_of(where, words[1])
        size = (
            _whole(where, "the width", words[2], _UINT64),
            _whole(where, "the height", words[3], _UINT64),
        )
        params = _floats(where, words[4:])
        if len(params) != kind.size:
            raise InputError(
                f"{where}: found {len(params)} parameters, {kind.name} has "
                f"{kind.size}; the file is truncated or damaged: export it again"
            )
        if identity in cameras:
            raise twice(where, identity, "camera")
        cameras[identity] = make_colmap_camera(where, kind, size, params)
    _compare(path, "cameras", len(cameras), declared)
    return cameras


def _check_observations(where: str, line: str) -> None:
    """See that a line may be the 2D points of an image; they are not read.

    Raises:
      InputError: if not; as where it was left out, and the next image stands there.
    """
    values = line.split()
    last = values[-1].removeprefix("-") if values else "0"
    if len(values) % 3 or not (last.isascii() and last.isdecimal()):
        raise InputError(
            f"{where}: {len(values)} values, the last {values[-1][:40]!r}; X Y "
            "POINT3D_ID of each 2D point, or an empty line, is wanted after an image"
        )


def read_images(path: Path) -> list[ColmapImage]:
    """Images of an images.txt, in its order; their 2D points are skipped."""
    images: list[ColmapImage] = []
    identities: set[int] = set()
    wanted = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
    declared, observations = None, False
    for number, line in _lines(path):
        where = f"{path}: line {number}"
        if observations:  # a line of its own after each image, which may be empty
            observations = False
            _check_observations(where, line)
            continue
        if not _is_record(line):
            declared = _declared(line, "images", declared)
            continue
        words = _words(where, line, 10, wanted, 9)
        identity = _whole(where, "the image id", words[0], _UINT32)
        camera = _whole(where, "the camera id", words[8], _UINT32)
        if identity in identities:
            raise twice(where, identity, "image")
        if len(words[9].encode()) > MAX_NAME_BYTES:
            raise InputError(
                f"{where}: a name of more than {MAX_NAME_BYTES} bytes; rename it"
            )
        identities.add(identity)
        pose = _floats(where, words[1:8])
        images.append(make_colmap_image(where, words[9], camera, pose))
        observations = True
    _compare(path, "images", len(images), declared)
    if observations:
        warnings.warn(
            f"{path}: the line of 2D points (which may be empty) of the last image is "
            "missing; the file may be truncated: export or copy it again",
            UserWarning,
            stacklevel=2,
        )
    return images


def read_points(path: Path) -> ColmapPoints:
    """Points of a points3D.txt, sorted by id; of the tracks only the length."""
    # Arrays, as lists of Python's numbers take five times the file.
    identities, values = array("Q"), array("d")
    lengths, numbers = array("q"), array("q")
    declared = None
    for number, line in _lines(path):
        if not _is_record(line):
            declared = _declared(line, "points", declared)
            continue
        words = line.split()
        try:  # quick, as there may be millions; what is wrong is found out below
            row = [float(word) for word in words[1:8]]
            identity = int(words[0])
        except ValueError:
            row, identity = [], -1
        odd = len(row) < 7 or len(words) % 2 or "_" in line
        if odd or not 0 <= identity <= _UINT64:
            raise _bad_point(f"{path}: line {number}", words)
        identities.append(identity)
        values.extend(row)
        lengths.append((len(words) - 8) // 2)
        numbers.append(number)
    _compare(path, "points", len(identities), declared)
    if not identities:
        warnings.warn(
            f"{path}: no points are in it; the scene has none to start from",
            UserWarning,
            stacklevel=2,
        )
    table = np.frombuffer(values, np.float64).reshape(-1, 7)
    colors = table[:, 3:6]
    bad = ~((colors >= 0) & (colors <= 255) & (colors == np.rint(colors))).all(axis=1)
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        raise InputError(
            f"{path}: line {numbers[first]}: colour {colors[first].tolist()}; whole "
            "numbers from 0 to 255 are wanted"
        )
    points = ColmapPoints(
        ids=np.frombuffer(identities, np.uint64),
        xyz=np.ascontiguousarray(table[:, :3]),
        colors=colors.astype(np.uint8),
        errors=table[:, 6].copy(),
        track_lengths=np.frombuffer(lengths, np.int64),
    )
    return sorted_points(str(path), points)


def _bad_point(where: str, words: list[str]) -> InputError:
    """What is wrong with a line of points3D.txt."""
    try:
        if len(words) < 8:
            wanted = "POINT3D_ID X Y Z R G B ERROR TRACK is wanted; export it again"
            return InputError(f"{where}: found {len(words)} values, {wanted}")
        _whole(where, "the point id", words[0], _UINT64)
        _floats(where, words[1:])
    except InputError as error:
        return error
    return InputError(
        f"{where}: the track has {len(words) - 8} values; pairs of IMAGE_ID "
        "POINT2D_IDX are wanted; the file is truncated or damaged: export or copy it "
        "again"
    )


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
