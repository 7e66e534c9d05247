"""More points of a scene than structure from motion gives: those on which views agree.

Views are swept against their neighbours (`gsjax.init.plane_sweep`), and what one finds is a
point if others find it too. A training that starts from them need not grow a scene out
of a few hundred points, and knows from the start how far away things are.

Axis legend: V views, M points.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from gsjax.data.extent import finite_points, has_points, scene_extent
from gsjax.data.types import Dataset, Photo
from gsjax.errors import InputError
from gsjax.init.gaussians import points_in_ball
from gsjax.init.plane_sweep import (
    DepthMap,
    Pinhole,
    Shot,
    make_shot,
    pinhole,
    project,
    sweep,
    unproject,
)
from gsjax.runtime.machine import all_of, usable_cores

_LONGEST = 192  # px, of the photographs as they are swept
# Of more views some are swept, far from one another, and with each the two neighbours
# that are to agree with it.
_MOST_VIEWS, _SEEDS = 48, 16
_NEIGHBOURS = 4
# Between the directions from which two views see a point: narrow ones tell little of
# how far it is, and at wide ones windows do not look alike.
_LEAST_ANGLE, _BEST_ANGLE, _WIDEST_ANGLE = 0.5, 12.0, 60.0  # degrees
_LEAST_SHARED = 0.1  # of what one view shows, in the other
_SAMPLED = 2000  # points to choose neighbours by
_LEAST_SCORE = 0.6
_AGREEING = 2  # other views
_STEPS = 1.5  # of depths, that two may differ by and still agree
_ROOM = (0.8, 1.3)  # beyond the depths of the points that are known
# Extents, where no points are known. What is farther than is looked for is found where
# something happens to look alike; and evenly in 1 / z far costs next to nothing.
_FARTHEST = 60.0
_MOST_THREADS = 16  # with 20 MB each


class Found(NamedTuple):
    """Points [M, 3] float64 and their colours [M, 3] uint8."""

    points: np.ndarray
    colors: np.ndarray


def find_points(
    scene: Dataset, photos: Sequence[Photo], count: int, *, seed: int = 0
) -> Found:
    """Points that a view found, and two of its neighbours too (of one, that one).

    Of a scene of more than 48 views, 16 that lie far from one another are looked at,
    each with two neighbours. Depths are looked for where the scene's points are or, if
    it has none, from the ball around what its cameras look at to sixty extents away.

    Args:
      scene: its cameras and points.
      photos: one for each view; what is masked or transparent is left out.
      count: of more points than that, that many are drawn.
      seed: of what is drawn.

    Returns:
      As many as there are; none where the views do not overlap or nothing in them can
      be told from its surroundings.

    Raises:
      InputError: if there is not one photo for each view.
      MissingExtraError: if OpenCV is absent.
    """
    if len(photos) != len(scene.views):
        raise InputError(
            f"{len(photos)} photos for {len(scene.views)} views; one for each is wanted"
        )
    rng = np.random.default_rng(seed)
    around = _Surroundings(scene, photos, rng)
    pairing = _paired(around)
    needed = sorted({*pairing, *(view for some in pairing.values() for view in some)})
    shots = {view: _shot(around.cameras[view], photos[view]) for view in needed}

    def swept(view: int) -> DepthMap:
        others = [shots[other] for other in pairing[view]]
        return sweep(shots[view], others, *around.depths(view))

    with ThreadPoolExecutor(min(_MOST_THREADS, usable_cores())) as pool:
        maps = dict(zip(pairing, all_of(pool, swept, pairing)))
    found = [_agreed(view, shots, maps, pairing[view]) for view in pairing]
    points = np.concatenate([np.zeros((0, 3)), *(some.points for some in found)])
    none = np.zeros((0, 3), np.uint8)
    colors = np.concatenate([none, *(some.colors for some in found)])
    if len(points) > count:
        drawn = np.sort(rng.choice(len(points), count, replace=False))
        points, colors = points[drawn], colors[drawn]
    return Found(points, colors)


def _shot(camera: Pinhole, photo: Photo) -> Shot:
    """What of a photograph counts: what is neither masked nor transparent."""
    valid = photo.valid
    if photo.alpha is not None:
        opaque = photo.alpha == 255
        valid = opaque if valid is None else valid & opaque
    return make_shot(camera, photo.pixels, valid)


class _Surroundings:
    """The cameras of all views, and points to tell by what they have in common.

    Attributes:
      cameras: of the photographs as they are swept.
      points: [M, 3], of the scene or of a ball.
      inside: [V, M] which of them a view shows.
    """

    def __init__(
        self, scene: Dataset, photos: Sequence[Photo], rng: np.random.Generator
    ):
        self.cameras = [
            pinhole(view.viewmat, photo.K, photo.pixels.shape[1::-1], _LONGEST)
            for view, photo in zip(scene.views, photos)
        ]
        self.centres = np.stack([camera.centre for camera in self.cameras])
        if has_points(scene):
            points = scene.points[finite_points(scene)]
            self._farthest = 0.0
        else:
            points = points_in_ball(scene, _SAMPLED, rng)
            self._farthest = _FARTHEST * scene_extent(self.centres)
        if len(points) > _SAMPLED:
            points = points[np.sort(rng.choice(len(points), _SAMPLED, replace=False))]
        self.points = points
        seen = [project(camera, points) for camera in self.cameras]
        self.inside = np.stack([pixels[:, 0] >= 0 for pixels, _ in seen])

    def depths(self, view: int) -> tuple[float, float]:
        """z to look for things between."""
        _, z = project(self.cameras[view], self.points[self.inside[view]])
        low, high = np.percentile(z, [1, 99])
        return _ROOM[0] * low, max(_ROOM[1] * high, self._farthest)

    def neighbours(self, view: int) -> list[int]:
        """The views to hold a view against, the best first, four at most.

        Best are those that see much of what it sees, from some 12° beside it and from
        as near.
        """
        inside = self.inside[view]
        shared = self.inside & inside
        share = shared.sum(1) / max(1, inside.sum())
        scores = np.zeros(len(self.cameras))
        for other in np.flatnonzero(share >= _LEAST_SHARED):
            points = self.points[shared[other]]
            mine, theirs = points - self.centres[view], points - self.centres[other]
            near, far = np.linalg.norm(mine, axis=1), np.linalg.norm(theirs, axis=1)
            cosine = np.median(np.sum(mine * theirs, 1) / (near * far))
            angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
            if other != view and _LEAST_ANGLE < angle < _WIDEST_ANGLE:
                off = np.log(angle / _BEST_ANGLE), np.median(np.log(near / far))
                scores[other] = share[other] * np.exp(-np.sum(np.square(off)))
        best = np.argsort(-scores, kind="stable")[:_NEIGHBOURS]
        return [int(other) for other in best if scores[other] > 0]


def _paired(around: _Surroundings) -> dict[int, list[int]]:
    """The views to sweep, each with its neighbours; those without are left out."""
    chosen = list(range(len(around.cameras)))
    if len(chosen) > _MOST_VIEWS:
        seeds = _spread_out(around.centres, _SEEDS)
        agreeing = [view for seed in seeds for view in around.neighbours(seed)[:2]]
        chosen = sorted({*seeds, *agreeing})
    pairing = {view: around.neighbours(view) for view in chosen}
    return {view: others for view, others in pairing.items() if others}


def _spread_out(centres: np.ndarray, count: int) -> list[int]:
    """At most so many views, each as far as can be from those before it."""
    chosen = [0]
    apart = np.full(len(centres), np.inf)
    while len(chosen) < count:
        last = centres[chosen[-1]]
        apart = np.minimum(apart, np.linalg.norm(centres - last, axis=1))
        chosen.append(int(np.argmax(apart)))
    return sorted(set(chosen))


def _agreed(
    view: int, shots: dict[int, Shot], maps: dict[int, DepthMap], others: list[int]
) -> Found:
    """What a view found, where enough of the others that were swept found it too."""
    shot, mine = shots[view], maps[view]
    rows, cols = np.nonzero(mine.score > _LEAST_SCORE)
    points = unproject(shot.camera, rows, cols, mine.inverse[rows, cols])
    votes = np.zeros(len(points), int)
    others = [other for other in others if other in maps]
    for other in others:
        votes += _confirmed(points, shots[other].camera, maps[other])
    kept = votes >= min(_AGREEING, max(1, len(others)))
    return Found(points[kept], shot.colors[rows[kept], cols[kept]])


def _confirmed(points: np.ndarray, camera: Pinhole, found: DepthMap) -> np.ndarray:
    """[M] which points a view found where they are."""
    pixels, z = project(camera, points)
    inside = pixels[:, 0] >= 0
    col, row = np.where(inside[:, None], pixels, 0).astype(int).T
    off = np.abs(1 / np.where(inside, z, 1) - found.inverse[row, col])
    scored = found.score[row, col] > _LEAST_SCORE
    return inside & scored & (off < _STEPS * found.step)
