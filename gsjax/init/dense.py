"""Dense points of a dataset: depths on which several views agree.

Views are swept against their neighbours (`gsjax.init.plane_sweep`); a depth becomes a
point if other views find it too.

Axis legend: V views, M points.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from gsjax.data.extent import finite_points, has_points, scene_extent
from gsjax.data.photos import undistort_photo
from gsjax.data.types import Dataset, Photo
from gsjax.errors import InputError
from gsjax.init.gaussians import points_in_ball
from gsjax.init.plane_sweep import (
    DepthMap,
    PinholeCamera,
    SweepImage,
    make_sweep_image,
    project,
    scaled_pinhole,
    sweep,
    unproject,
)
from gsjax.runtime.machine import map_concurrently, usable_cores

# Angles in degrees between the directions from which two views see a point: small ones
# make depth uncertain, and windows do not match at large ones.
_MIN_ANGLE, _BEST_ANGLE, _MAX_ANGLE = 0.5, 12.0, 60.0
_MAX_NEIGHBOURS = 4
_AGREEING = 2  # other views that have to confirm a depth
_MIN_OVERLAP = 0.1  # share of the points of a view that another sees
_SAMPLED = 2000  # points to choose neighbours by
_MIN_SCORE = 0.6
_MAX_DEPTH_STEPS = 1.5  # difference at which two depths still agree
_DEPTH_MARGIN = (0.8, 1.3)  # beyond the depths of the known points
# Extents, for a dataset without points. Surfaces beyond the range of a sweep give false
# matches within it; planes uniform in 1 / z make a large range cheap.
_FARTHEST = 60.0
_MAX_THREADS = 16  # 20 MB each


class SweepSettings(NamedTuple):
    """Settings of `find_points`.

    Attributes:
      longest_side: px that photographs are scaled down to.
      max_views: number of views up to which all are swept.
      seed_views: otherwise, number of distant views to sweep, each with its two best
        neighbours.
    """

    longest_side: int = 192
    max_views: int = 48
    seed_views: int = 16


class DensePoints(NamedTuple):
    """Points [M, 3] float64 and their colours [M, 3] uint8."""

    points: np.ndarray
    colors: np.ndarray


def find_points(
    dataset: Dataset,
    photos: Sequence[Photo],
    count: int,
    *,
    seed: int = 0,
    settings: SweepSettings | None = None,
) -> DensePoints:
    """Return points that a view and two of its neighbours agree on (or its only one).

    The depth range of a view covers the points of the dataset. If there are none, it
    reaches from the ball around the point that the cameras look at to 60 extents.

    Args:
      dataset: cameras and points.
      photos: one for each view; masked and transparent pixels are ignored.
      count: upper limit; a random subset is drawn from more points.
      seed: seed of the random draws.
      settings: default `SweepSettings()`.

    Returns:
      The points; none if the views do not overlap or have no texture.

    Raises:
      InputError: if there is not one photo for each view.
      MissingExtraError: if OpenCV is absent.
    """
    if len(photos) != len(dataset.views):
        raise InputError(
            f"photos: expected {len(dataset.views)}, one for each view, got "
            f"{len(photos)}"
        )
    pairs = zip(dataset.views, photos)
    photos = [undistort_photo(view.name, photo) for view, photo in pairs]
    rng, settings = np.random.default_rng(seed), settings or SweepSettings()
    overlap = _ViewOverlap(dataset, photos, rng, settings.longest_side)
    pairing = _choose_pairs(overlap, settings)
    needed = sorted({*pairing, *(view for some in pairing.values() for view in some)})
    images = {
        view: _sweep_image(overlap.cameras[view], photos[view]) for view in needed
    }

    def swept(view: int) -> DepthMap:
        others = [images[other] for other in pairing[view]]
        return sweep(images[view], others, *overlap.depth_range(view))

    with ThreadPoolExecutor(min(_MAX_THREADS, usable_cores())) as pool:
        maps = dict(zip(pairing, map_concurrently(pool, swept, pairing)))
    found = [
        _consistent_points(v, images, maps, others) for v, others in pairing.items()
    ]
    points = np.concatenate([np.zeros((0, 3)), *(some.points for some in found)])
    none = np.zeros((0, 3), np.uint8)
    colors = np.concatenate([none, *(some.colors for some in found)])
    if len(points) > count:
        drawn = np.sort(rng.choice(len(points), count, replace=False))
        points, colors = points[drawn], colors[drawn]
    return DensePoints(points, colors)


def _sweep_image(camera: PinholeCamera, photo: Photo) -> SweepImage:
    """Return the image to sweep, without masked and transparent pixels."""
    valid = photo.valid
    if photo.alpha is not None:
        opaque = photo.alpha == 255
        valid = opaque if valid is None else valid & opaque
    return make_sweep_image(camera, photo.pixels, valid)


class _ViewOverlap:
    """The cameras of all views, and sample points that measure their overlap.

    Attributes:
      cameras: of the scaled photographs.
      points: [M, 3] points of the dataset, or of `points_in_ball`.
      inside: [V, M] bool, which points a view sees.
    """

    def __init__(
        self,
        dataset: Dataset,
        photos: Sequence[Photo],
        rng: np.random.Generator,
        longest: int,
    ):
        self.cameras = [
            scaled_pinhole(view.viewmat, photo.K, photo.pixels.shape[1::-1], longest)
            for view, photo in zip(dataset.views, photos)
        ]
        self.centres = np.stack([camera.centre for camera in self.cameras])
        if has_points(dataset):
            points = dataset.points[finite_points(dataset)]
            self._farthest = 0.0
        else:
            points = points_in_ball(dataset, _SAMPLED, rng)
            self._farthest = _FARTHEST * scene_extent(self.centres)
        if len(points) > _SAMPLED:
            points = points[np.sort(rng.choice(len(points), _SAMPLED, replace=False))]
        self.points = points
        seen = [project(camera, points) for camera in self.cameras]
        self.inside = np.stack([pixels[:, 0] >= 0 for pixels, _ in seen])

    def depth_range(self, view: int) -> tuple[float, float]:
        """Return the smallest and largest z to sweep."""
        _, z = project(self.cameras[view], self.points[self.inside[view]])
        low, high = np.percentile(z, [1, 99])
        return _DEPTH_MARGIN[0] * low, max(_DEPTH_MARGIN[1] * high, self._farthest)

    def neighbours(self, view: int) -> list[int]:
        """Return the views to sweep a view against, best first.

        The score of a view is its overlap, weighted by how near the angle between the
        views is to 12° and the ratio of their distances to 1.
        """
        inside = self.inside[view]
        shared = self.inside & inside
        share = shared.sum(1) / max(1, inside.sum())
        scores = np.zeros(len(self.cameras))
        for other in np.flatnonzero(share >= _MIN_OVERLAP):
            points = self.points[shared[other]]
            mine, theirs = points - self.centres[view], points - self.centres[other]
            near, far = np.linalg.norm(mine, axis=1), np.linalg.norm(theirs, axis=1)
            cosine = np.median(np.sum(mine * theirs, 1) / (near * far))
            angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
            if other != view and _MIN_ANGLE < angle < _MAX_ANGLE:
                off = np.log(angle / _BEST_ANGLE), np.median(np.log(near / far))
                scores[other] = share[other] * np.exp(-np.sum(np.square(off)))
        best = np.argsort(-scores, kind="stable")[:_MAX_NEIGHBOURS]
        return [int(other) for other in best if scores[other] > 0]


def _choose_pairs(
    overlap: _ViewOverlap, settings: SweepSettings
) -> dict[int, list[int]]:
    """Return the views to sweep and their neighbours; views without are left out."""
    chosen = list(range(len(overlap.cameras)))
    if len(chosen) > settings.max_views:
        seeds = farthest_point_sample(overlap.centres, settings.seed_views)
        partners = [other for seed in seeds for other in overlap.neighbours(seed)[:2]]
        chosen = sorted({*seeds, *partners})
    pairing = {view: overlap.neighbours(view) for view in chosen}
    return {view: others for view, others in pairing.items() if others}


def farthest_point_sample(points: np.ndarray, count: int) -> list[int]:
    """Return at most ``count`` indices of points [M, 3] far from one another."""
    chosen = [0]
    apart = np.full(len(points), np.inf)
    while len(chosen) < count:
        last = points[chosen[-1]]
        apart = np.minimum(apart, np.linalg.norm(points - last, axis=1))
        chosen.append(int(np.argmax(apart)))
    return sorted(set(chosen))


def _consistent_points(
    view: int,
    images: dict[int, SweepImage],
    maps: dict[int, DepthMap],
    others: list[int],
) -> DensePoints:
    """Return the points of a view that enough of the swept neighbours confirm."""
    image, mine = images[view], maps[view]
    rows, cols = np.nonzero(mine.score > _MIN_SCORE)
    points = unproject(image.camera, rows, cols, mine.inverse[rows, cols])
    votes = np.zeros(len(points), int)
    others = [other for other in others if other in maps]
    for other in others:
        votes += _is_confirmed(points, images[other].camera, maps[other])
    kept = votes >= min(_AGREEING, max(1, len(others)))
    return DensePoints(points[kept], image.colors[rows[kept], cols[kept]])


def _is_confirmed(
    points: np.ndarray, camera: PinholeCamera, depths: DepthMap
) -> np.ndarray:
    """Return [M] bool: whether the depth map of a view has each point."""
    pixels, z = project(camera, points)
    inside = pixels[:, 0] >= 0
    col, row = np.where(inside[:, None], pixels, 0).astype(int).T
    off = np.abs(1 / np.where(inside, z, 1) - depths.inverse[row, col])
    scored = depths.score[row, col] > _MIN_SCORE
    return inside & scored & (off < _MAX_DEPTH_STEPS * depths.step)
