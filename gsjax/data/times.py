"""Times of views: from 0 at the first to 1 at the last photograph of a moving scene."""

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from gsjax.data.types import Dataset, View, unexpected
from gsjax.errors import InputError
from gsjax.runtime.files import read_json, shown, write_json

_NUMBER = re.compile(r"([0-9]+)\D*$")
TIMES_FILE = "times.json"
_MOST_SECONDS = 1e12
_MODEL_FOLDERS = ("0", "sparse", "colmap")  # of a COLMAP model in its dataset
_REMEDY = (
    "give each frame of the transforms.json a 'time', or put the frames of each camera "
    "into a folder of its own, numbered alike (camera_1/0001.png …)"
)


def with_unit_times(dataset: Dataset) -> Dataset:
    """Return the dataset with times from 0 to 1, or with none.

    A ``times.json`` in its folder has precedence over the times of the views. Times
    that lie in [0, 1] are kept; others are mapped to it by their range.

    Raises:
      InputError: if some views have a time and others have none, or `read_times` does.
    """
    folder = dataset.source if dataset.source.is_dir() else dataset.source.parent
    while folder.name in _MODEL_FOLDERS:
        folder = folder.parent
    path = folder / TIMES_FILE
    if path.is_file():
        dataset = _stamped(dataset, path, read_times(path))
    times = [view.time for view in dataset.views]
    known = [time for time in times if time is not None]
    if not known:
        return dataset
    if len(known) < len(times):
        first = next(view.name for view in dataset.views if view.time is None)
        raise InputError(
            f"{dataset.source}: {len(times) - len(known)} of {len(times)} views have "
            f"no time, the first: {first}; give all of them one, or none"
        )
    first, last = min(known), max(known)
    if first >= 0 and last <= 1:
        return dataset
    span = last - first or 1.0
    views = [replace(v, time=(t - first) / span) for v, t in zip(dataset.views, known)]
    return replace(dataset, views=tuple(views))


class FrameTimes(NamedTuple):
    """Times of the frames of videos, as `gsjax sfm --moving` writes them.

    Attributes:
      seconds: time of each photograph in seconds, by its name in the dataset.
    """

    seconds: dict[str, float]


def read_times(path: Path) -> FrameTimes:
    """Read a file such as ``{"seconds": {"frame_0001.png": 0.0}}``.

    Raises:
      InputError: if the file is damaged, or the times of the numbered frames in a
        folder do not increase.
    """
    data = read_json(path, f"a {TIMES_FILE}")
    times = data.get("seconds")
    if not isinstance(times, dict) or not times:
        remedy = "write it again with `gsjax sfm VIDEO --moving`"
        raise unexpected(f"{path}: seconds", "times by name", shown(times), remedy)
    for name, time in times.items():
        number = isinstance(time, int | float) and not isinstance(time, bool)
        if not number or not abs(time) < _MOST_SECONDS:
            raise unexpected(f"{path}: {name[:80]}", "a time in seconds", shown(time))
    _check_order(path, times)
    return FrameTimes({name: float(time) for name, time in times.items()})


def write_times(path: Path, times: FrameTimes) -> None:
    """Write the file of `read_times`."""
    write_json(path, times._asdict())


def _check_order(path: Path, times: dict[str, float]) -> None:
    """Raise if a later frame of a folder is not later in time."""
    by_folder: dict[str, list[tuple[int, str]]] = defaultdict(list)
    for name in times:
        place = PurePosixPath(name)
        match = _NUMBER.search(place.stem)
        if match is not None:
            stem = place.stem[: match.start()]
            by_folder[f"{place.parent}/{stem}"].append((int(match[1]), name))
    for frames in by_folder.values():
        for (_, before), (_, after) in pairwise(sorted(frames)):
            if not times[before] < times[after]:
                raise InputError(
                    f"{path}: times must increase with the number of the frame, but "
                    f"{after} has {times[after]:g} s after {before} with "
                    f"{times[before]:g} s; correct them, or rename the frames"
                )


def _stamped(dataset: Dataset, path: Path, times: FrameTimes) -> Dataset:
    """Return the dataset with the times of a file, which must know all views."""
    seconds, views = times.seconds, []
    for view in dataset.views:
        ends = (view.name, view.name.removeprefix("images/"))
        name = next((end for end in ends if end in seconds), None)
        if name is None:
            raise InputError(
                f"{path}: has no time for the photograph {view.name}; add it, or "
                "remove the file"
            )
        views.append(replace(view, time=seconds[name]))
    first, last = time_range(views)
    duration = last - first
    unit = [replace(v, time=(v.time - first) / (duration or 1.0)) for v in views]
    return replace(dataset, views=tuple(unit), duration=duration or None)


def require_times(dataset: Dataset) -> Dataset:
    """Return a dataset whose views all have a time, at least two of them different.

    Where the files state none, the views are taken for the frames of synchronised
    cameras: each folder holds those of one camera, numbered alike.

    Raises:
      InputError: if the times are unknown, or all equal; or if the folders hold
        different numbers of frames.
    """
    where = str(dataset.source)
    if any(view.time is None for view in dataset.views):
        times = _times_of_frames(where, dataset.views)
        views = tuple(replace(v, time=t) for v, t in zip(dataset.views, times))
        dataset = replace(dataset, views=views)
    times = {view.time for view in dataset.views}
    if len(times) < 2:
        raise InputError(
            f"{where}: all {len(dataset.views)} views are of one time, so nothing can "
            "move; leave out --motion, or correct their times"
        )
    return dataset


def _times_of_frames(where: str, views: Sequence[View]) -> list[float]:
    """Return times by the order of the frame numbers in the folders of cameras."""
    numbers: dict[str, list[int]] = defaultdict(list)
    found = []
    for view in views:
        path = PurePosixPath(view.name)
        match = _NUMBER.search(path.stem)
        if match is None or str(path.parent) == ".":
            fault = f"its views have no times, the first: {view.name}"
            raise InputError(f"{where}: {fault}; {_REMEDY}")
        found.append((str(path.parent), int(match[1])))
        numbers[found[-1][0]].append(found[-1][1])
    if len(numbers) < 2:
        fault = f"its views have no times, the first: {views[0].name}"
        raise InputError(f"{where}: {fault}; {_REMEDY}")
    _check_counts(where, numbers)
    place = {folder: sorted(listed) for folder, listed in numbers.items()}
    most = max(1, len(next(iter(place.values()))) - 1)
    return [place[folder].index(number) / most for folder, number in found]


def _check_counts(where: str, numbers: dict[str, list[int]]) -> None:
    """Raise unless the folders hold as many frames, each number once."""
    for folder, listed in numbers.items():
        if len(set(listed)) < len(listed):
            double = next(n for n in listed if listed.count(n) > 1)
            raise InputError(
                f"{where}: {folder} holds two frames of number {double}, so times do "
                "not increase; rename one"
            )
    counts = {folder: len(listed) for folder, listed in numbers.items()}
    least, most = min(counts, key=counts.__getitem__), max(counts, key=counts.get)  # pyright: ignore
    if counts[least] < counts[most]:
        raise InputError(
            f"{where}: synchronised cameras need as many frames each, but {least} has "
            f"{counts[least]} and {most} has {counts[most]}; remove frames, or give "
            "each frame a time in a transforms.json"
        )


def time_range(views: Sequence[View]) -> tuple[float, float]:
    """Return the first and the last time of views; (0, 0) if none has one."""
    times = [view.time for view in views if view.time is not None]
    return (float(np.min(times)), float(np.max(times))) if times else (0.0, 0.0)
