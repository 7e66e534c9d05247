"""More points of a scene than structure from motion gives: those on which views agree.

Every view is swept against its neighbours (`gsjax.scene.sweep`), and what it finds is a
point if others find it too. A training that starts from them need not grow a scene out
of a few hundred points, and knows from the start how far away things are.

Axis legend: V views, M points.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from gsjax.machine import usable_cores
from gsjax.scene.initialise import has_points, points_in_ball
from gsjax.scene.sweep import DepthMap, Shot, make_shot, project, sweep, unproject
from gsjax.scene.types import Photo, Scene

_LONGEST = 192  # px, of the photographs as they are swept
_MOST_VIEWS = 48  # that are swept: a few hundred pixels each would do
_NEIGHBOURS = 4
# Between the directions from which two views see a point: narrow ones tell little of
# how far it is, and at wide ones windows do not look alike.
_BEST_ANGLE, _WIDEST_ANGLE = 12.0, 60.0  # degrees
_LEAST_SHARED = 0.1  # of what one view shows, in the other
_SAMPLED = 2000  # points to choose neighbours by
_LEAST_SCORE = 0.6
_AGREEING = 2  # other views
_STEPS = 1.5  # of depths, that two may differ by and still agree
_ROOM = (0.8, 1.3)  # beyond the depths of the points that are known


class Found(NamedTuple):
    """Points [M, 3] float64 and their colours [M, 3] uint8."""

    points: np.ndarray
    colors: np.ndarray


def find_points(
    scene: Scene, photos: Sequence[Photo], count: int, *, seed: int = 0
) -> Found:
    """Points on which at least two views, and one more, agree.

    Of a scene of more than 48 views, so many that lie far from one another are looked
    at. Depths are looked for where the scene's points are or, if it has none, in the
    ball around what its cameras look at.

    Args:
      scene: its cameras and points.
      photos: one for each view; what is masked or transparent is left out.
      count: of more points than that, that many are drawn.
      seed: of what is drawn.

    Returns:
      As many as there are; none where the views do not overlap or nothing in them can
      be told from its surroundings.

    Raises:
      MissingExtraError: if OpenCV is absent.
    """
    rng = np.random.default_rng(seed)
    if has_points(scene):
        known = scene.points[np.isfinite(scene.points).all(1)]
    else:
        known = points_in_ball(scene, _SAMPLED, rng)
    if len(known) > _SAMPLED:
        known = known[np.sort(rng.choice(len(known), _SAMPLED, replace=False))]
    chosen = _spread_out(np.stack([view.centre for view in scene.views]), _MOST_VIEWS)
    shots = [_shot_of(scene, photos, index) for index in chosen]
    pairing = _neighbours(shots, known)
    with ThreadPoolExecutor(usable_cores()) as pool:
        maps = list(pool.map(lambda i: _swept(shots, pairing[i], known, i), pairing))
    maps = dict(zip(pairing, maps))
    found = [_agreed(shots, maps, pairing[i], i) for i in pairing]
    points = np.concatenate([np.zeros((0, 3)), *(some.points for some in found)])
    colors = np.concatenate(
        [np.zeros((0, 3), np.uint8), *(some.colors for some in found)]
    )
    if len(points) > count:
        drawn = np.sort(rng.choice(len(points), count, replace=False))
        points, colors = points[drawn], colors[drawn]
    return Found(points, colors)


def _spread_out(centres: np.ndarray, count: int) -> list[int]:
    """At most so many views, each as far as can be from those before it."""
    if len(centres) <= count:
        return list(range(len(centres)))
    chosen = [0]
    apart = np.full(len(centres), np.inf)
    while len(chosen) < count:
        last = centres[chosen[-1]]
        apart = np.minimum(apart, np.linalg.norm(centres - last, axis=1))
        chosen.append(int(np.argmax(apart)))
    return sorted(set(chosen))


def _shot_of(scene: Scene, photos: Sequence[Photo], index: int) -> Shot:
    view, photo = scene.views[index], photos[index]
    valid = photo.valid
    if photo.alpha is not None:
        opaque = photo.alpha == 255
        valid = opaque if valid is None else valid & opaque
    return make_shot(photo.pixels, valid, view.viewmat, photo.K, _LONGEST)


def _neighbours(shots: list[Shot], known: np.ndarray) -> dict[int, list[int]]:
    """For each view that has any, the views to hold it against, the best first.

    Best are those that see much of what it sees, from some 12° beside it and as near.
    """
    count = len(shots)
    seen = [project(shot, known) for shot in shots]
    inside = np.stack([pixels[:, 0] >= 0 for pixels, _ in seen])
    centres = np.stack([_centre(shot) for shot in shots])
    towards = known - centres[:, None]
    distance = np.linalg.norm(towards, axis=2)
    towards = towards / np.maximum(distance, 1e-300)[..., None]
    pairing = {}
    for one in range(count):
        scores = np.zeros(count)
        for other in range(count):
            both = inside[one] & inside[other]
            share = both.sum() / max(1, inside[one].sum())
            if other == one or share < _LEAST_SHARED:
                continue
            cosine = np.sum(towards[one, both] * towards[other, both], axis=1)
            angle = np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1)))
            if not 0.5 < angle < _WIDEST_ANGLE:
                continue
            nearer = np.median(np.log(distance[one, both] / distance[other, both]))
            off = np.log(angle / _BEST_ANGLE) ** 2 + nearer**2
            scores[other] = share * np.exp(-off)
        best = np.argsort(-scores, kind="stable")[:_NEIGHBOURS]
        best = [int(other) for other in best if scores[other] > 0]
        if best:
            pairing[one] = best
    return pairing


def _centre(shot: Shot) -> np.ndarray:
    return -shot.viewmat[:3, :3].T @ shot.viewmat[:3, 3]


def _swept(
    shots: list[Shot], others: list[int], known: np.ndarray, index: int
) -> DepthMap:
    pixels, z = project(shots[index], known)
    low, high = np.percentile(z[pixels[:, 0] >= 0], [1, 99])
    neighbours = [shots[other] for other in others]
    return sweep(shots[index], neighbours, _ROOM[0] * low, _ROOM[1] * high)


def _agreed(
    shots: list[Shot], maps: dict[int, DepthMap], others: list[int], index: int
) -> Found:
    """What a view found, where enough of the others found it too."""
    shot, mine = shots[index], maps[index]
    rows, cols = np.nonzero(mine.score > _LEAST_SCORE)
    points = unproject(shot, rows, cols, mine.inverse[rows, cols])
    votes = np.zeros(len(points), int)
    others = [other for other in others if other in maps]
    for other in others:
        pixels, z = project(shots[other], points)
        inside = pixels[:, 0] >= 0
        col, row = np.where(inside[:, None], pixels, 0).astype(int).T
        theirs = maps[other]
        off = np.abs(1 / np.where(inside, z, 1) - theirs.inverse[row, col])
        good = theirs.score[row, col] > _LEAST_SCORE
        votes += inside & good & (off < _STEPS * theirs.step)
    kept = votes >= min(_AGREEING, max(1, len(others)))
    return Found(points[kept], shot.colors[rows[kept], cols[kept]])
