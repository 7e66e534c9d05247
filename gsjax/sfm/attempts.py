"""Mapping that tries again: other first pairs, matches and lenses, until most is found.

COLMAP begins with a pair of photographs that moved sideways and saw much of the same.
Captures without such a pair, as of a walk straight ahead, need other limits. Attempts
run from the usual to the unusual, and end when nearly all photographs that match have a
camera, or when they have taken as long as all the work before. The best is kept.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from gsjax.sfm.engine import Progress, count_rows
from gsjax.sfm.mapping import (
    MapperLimits,
    map_incrementally,
    match_features,
    match_groups,
    set_camera_model,
)

_ENOUGH = 0.9  # share of the photographs that match, to be content with
_LEAST_SECONDS = 30.0  # that attempts may take in any case
_EXHAUSTIVE_UP_TO = 200  # photographs that are matched in all pairs as an attempt


class Attempt(NamedTuple):
    """A way of mapping.

    Attributes:
      name: what is tried, for the report.
      limits: of the mapper.
      matcher: to match again with before; None keeps the matches.
      camera_model: to begin with; None keeps that of the settings.
    """

    name: str
    limits: MapperLimits
    matcher: str | None = None
    camera_model: str | None = None


FORWARD = MapperLimits(forward=1.0, angle=4.0)
LOW = MapperLimits(forward=1.0, angle=1.5, first_inliers=50, inliers=15)


class Mapped(NamedTuple):
    """Result of the attempts.

    Attributes:
      models: COLMAP's reconstructions, most images first; may be none.
      tried: a line for each attempt.
    """

    models: list[Any]
    tried: list[str]


def attempts_of(count: int, matcher: str, camera_model: str) -> list[Attempt]:
    """Return the attempts for ``count`` photographs, the usual one first."""
    found = [
        Attempt("a first pair that moved sideways", MapperLimits()),
        Attempt("a first pair that may move forward", FORWARD),
        Attempt("a first pair of small angle and few matches", LOW),
    ]
    if matcher != "exhaustive" and count <= _EXHAUSTIVE_UP_TO:
        found.append(Attempt("matching all pairs", FORWARD, matcher="exhaustive"))
    for other in ("SIMPLE_RADIAL_FISHEYE", "SIMPLE_PINHOLE"):
        if camera_model != other:
            what = f"the camera model {other}"
            found.append(Attempt(what, FORWARD, camera_model=other))
    return found


def map_with_attempts(
    attempts: Sequence[Attempt],
    database: Path,
    folders: tuple[Path, Path],
    seed: int,
    progress: Progress,
    *,
    clock: Callable[[], float] = time.monotonic,
    spent: float = 0.0,
) -> Mapped:
    """Return the best models of several attempts.

    Args:
      attempts: in order.
      database: COLMAP's, with features and matches.
      folders: of the photographs, and for COLMAP's outputs; the latter is created.
      seed: of COLMAP's random numbers.
      progress: called with lines of progress.
      clock: returns seconds.
      spent: seconds of the work before; attempts after the first may take as long.
    """
    photos, work = folders
    work.mkdir()
    begun, best, tried = clock(), [], []
    groups = match_groups(database)
    for number, attempt in enumerate(attempts):
        first = number == 0
        if not first and clock() - begun > max(_LEAST_SECONDS, spent):
            tried.append("stopped: attempts took as long as the work before")
            break
        if attempt.camera_model is not None:
            if best:  # another lens is for captures that no model was found for
                continue
            set_camera_model(database, attempt.camera_model)
        if not first:
            progress(f"trying {attempt.name}")
        if attempt.matcher is not None:
            total = count_rows(database, "images")
            match_features(database, total, attempt.matcher, seed, progress)
            groups = match_groups(database)
        models = map_incrementally(
            database,
            photos,
            work / str(number),
            seed,
            progress,
            limits=attempt.limits,
        )
        tried.append(f"{attempt.name}: {_told(models)}")
        if _score(models) > _score(best):
            best = models
        if best and found_in_groups(best, groups) >= _ENOUGH * sum(map(len, groups)):
            break
    return Mapped(best, tried)


def found_in_groups(models: Sequence[Any], groups: Sequence[set[str]]) -> int:
    """Return the images of the largest model of each group of matching images."""
    names = [{image.name for image in model.images.values()} for model in models]
    return sum(max((len(n & group) for n in names), default=0) for group in groups)


def _score(models: Sequence[Any]) -> tuple[int, int, int]:
    if not models:
        return 0, 0, 0
    covered = {image.name for model in models for image in model.images.values()}
    return models[0].num_reg_images(), len(covered), models[0].num_points3D()


def _told(models: Sequence[Any]) -> str:
    if not models:
        return "no camera"
    counts = " and ".join(str(model.num_reg_images()) for model in models)
    return f"{counts} cameras"
