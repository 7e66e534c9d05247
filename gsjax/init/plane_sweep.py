"""How far away what a photograph shows is, by plane sweep (Collins 1996).

For every depth of a list the neighbours of a view are warped into it, as if all that it
shows lay in a plane of that depth. Where it does, windows around a pixel look alike:
their zero-mean normalised cross-correlation (ZNCC) is near 1, whatever the exposure.

Axis legend: D depths, H W image.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gsjax.data.photos import scaled_intrinsics, size_within
from gsjax.io.images import opencv

# px, a side: small ones keep edges, large ones find what has little texture.
_WINDOWS = (3, 7)
_LEAST_DEPTHS, _MOST_DEPTHS = 16, 144
_MARGIN = max(_WINDOWS) // 2
# Variance of a window that is told from noise: of 1.5 of 255 grey levels.
_LEAST_VARIANCE = (1.5 / 255) ** 2
# From a pixel as OpenCV counts, from its centre, to ours, and back.
_TO_OURS = np.asarray([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
_TO_THEIRS = np.asarray([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
_OUTSIDE = -1e3  # grey level of what is not there
_REACHES_OUT = -1.0  # the mean of a window is below, with one such pixel in it


class Pinhole(NamedTuple):
    """The camera of a photograph as it is swept.

    Attributes:
      viewmat: [4, 4] world → camera.
      K: [3, 3] intrinsics, px.
      size: width and height, px.
    """

    viewmat: np.ndarray
    K: np.ndarray
    size: tuple[int, int]

    @property
    def centre(self) -> np.ndarray:
        """[3] where it stands."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


class Shot(NamedTuple):
    """A photograph as it is swept.

    Attributes:
      camera: that took it.
      grey: [H, W] float32 in [0, 1], `_OUTSIDE` where nothing counts.
      colors: [H, W, 3] uint8.
    """

    camera: Pinhole
    grey: np.ndarray
    colors: np.ndarray


class DepthMap(NamedTuple):
    """What a sweep found.

    Attributes:
      inverse: [H, W] 1 / z.
      score: [H, W] ZNCC there; −1 where nothing was found.
      step: between two depths, as inverses.
    """

    inverse: np.ndarray
    score: np.ndarray
    step: float


def pinhole(
    viewmat: np.ndarray, K: np.ndarray, size: tuple[int, int], longest: int
) -> Pinhole:
    """The camera of a photograph that is made small.

    Args:
      viewmat, K: of the photograph.
      size: its width and height, px.
      longest: side, px, that it is scaled down to.
    """
    width, height = size_within(*size, longest)
    scaled = scaled_intrinsics(K, width / size[0], height / size[1])
    return Pinhole(np.asarray(viewmat, float), scaled, (width, height))


def make_shot(
    camera: Pinhole, pixels: np.ndarray, valid: np.ndarray | None = None
) -> Shot:
    """A photograph, made as small as its camera is.

    Args:
      camera: from `pinhole`.
      pixels: [H, W, 3] uint8 RGB.
      valid: [H, W] bool, what counts; or None for all.
    """
    cv2 = opencv()
    small = cv2.resize(pixels, camera.size, interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    if valid is not None:
        missing = (~valid).astype(np.float32)
        missing = cv2.resize(missing, camera.size, interpolation=cv2.INTER_AREA)
        grey[missing > 0] = _OUTSIDE
    return Shot(camera, grey, small)


def project(camera: Pinhole, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(pixels [M, 2], z [M]) of points [M, 3]; pixels −1 of what is not in view."""
    seen = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    z = seen[:, 2]
    before = z > 0
    pixels = (seen @ camera.K.T)[:, :2] / np.where(before, z, 1)[:, None]
    inside = before & np.all((pixels >= 0) & (pixels < camera.size), 1)
    return np.where(inside[:, None], pixels, -1), z


def unproject(camera: Pinhole, rows, cols, inverse: np.ndarray) -> np.ndarray:
    """[M, 3] world points behind pixels, by their 1 / z."""
    rays = np.stack([cols + 0.5, rows + 0.5, np.ones(len(rows))], 1)
    seen = rays @ np.linalg.inv(camera.K).T / inverse[:, None]
    return (seen - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]


def sweep(
    shot: Shot, neighbours: Sequence[Shot], nearest: float, farthest: float
) -> DepthMap:
    """Find the depth of every pixel that looks alike in the neighbours at one.

    At each depth the better half of the neighbours count: what is hidden in the others
    looks like nothing. Depths are as dense as a pixel of the neighbour that sees most
    of a shift, up to 144, evenly in 1 / z; between them by a parabola.

    Args:
      shot: the view.
      neighbours: one or more.
      nearest, farthest: z to look between.
    """
    width, height = shot.camera.size
    warps = [_Warp(shot.camera, other) for other in neighbours]
    shift = max(warp.shift(1 / farthest, 1 / nearest) for warp in warps)
    count = int(np.clip(np.ceil(shift), _LEAST_DEPTHS, _MOST_DEPTHS))
    inverses = np.linspace(1 / farthest, 1 / nearest, count)
    view = _View(shot.grey)
    counted = (len(warps) + 1) // 2
    scores = np.empty((count, height, width), np.float32)
    best = np.empty((counted, height, width), np.float32)
    less = np.empty((height, width), np.float32)
    for depth, inverse in enumerate(inverses):
        best.fill(-len(_WINDOWS))
        for warp in warps:
            new = view.likeness(warp.image(inverse))
            for held in best:  # the best of them, then the next
                np.minimum(held, new, out=less)
                np.maximum(held, new, out=held)
                new, less = less, new
        np.sum(best, axis=0, out=scores[depth])
    scores /= counted * len(_WINDOWS)
    return _chosen(scores, inverses, view.usable)


class _Warp:
    """A neighbour, seen from the view through a plane: H = A + b (0 0 1) / z."""

    def __init__(self, camera: Pinhole, other: Shot):
        theirs = other.camera
        turn = theirs.viewmat[:3, :3] @ camera.viewmat[:3, :3].T
        move = theirs.viewmat[:3, 3] - turn @ camera.viewmat[:3, 3]
        self.turn = theirs.K @ turn @ np.linalg.inv(camera.K)
        self.move = np.outer(theirs.K @ move, [0, 0, 1])
        self.size, self.grey = camera.size, other.grey

    def shift(self, low: float, high: float) -> float:
        """The longest way, px, of a pixel in the neighbour's image over the depths."""
        width, height = self.size
        x, y = (a.ravel() for a in np.meshgrid([0, 0.5, 1], [0, 0.5, 1]))
        corners = np.stack([x * width, y * height, np.ones(9)])
        ways = np.zeros(9)
        before = None
        for inverse in np.linspace(low, high, 33):
            seen = (self.turn + inverse * self.move) @ corners
            good = seen[2] > 1e-9
            place = seen[:2] / np.where(good, seen[2], 1)
            limit = [[self.grey.shape[1]], [self.grey.shape[0]]]
            good &= np.all((place > 0) & (place < limit), 0)
            if before is not None:
                both = good & before[1]
                way = np.linalg.norm(place - before[0], axis=0)
                ways += np.where(both, way, 0)
            before = place, good
        return float(ways.max())

    def image(self, inverse: float) -> np.ndarray:
        """[H, W] the neighbour warped into the view."""
        cv2 = opencv()
        plane = self.turn + inverse * self.move
        matrix = _TO_THEIRS @ plane @ _TO_OURS
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        image = cv2.warpPerspective(
            self.grey, matrix, self.size, flags=flags, borderValue=_OUTSIDE
        )
        # What is behind the neighbour would be seen upside down. z is linear.
        width, height = self.size
        by_x, by_y, constant = plane[2]
        if constant + min(0, by_x * width) + min(0, by_y * height) <= 0:
            across, down = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
            image[by_x * across + by_y * down + constant <= 0] = _OUTSIDE
        image[image < 0] = _OUTSIDE  # partly, too
        return image


class _View:
    """The windows of a view, of every size, to be held against those of others.

    Attributes:
      usable: [H, W] where the largest has something to tell it from others by.
    """

    def __init__(self, grey: np.ndarray):
        self._grey = _with_margin(grey)
        # An image, its square and its product with the view, one above the other: to be
        # filtered in one go.
        self._moments: np.ndarray = np.empty((3, *self._grey.shape), np.float32)
        self._set(grey)
        self._windows = []
        for side in _WINDOWS:
            mean, square, _ = self._means(side)
            variance = square - mean * mean
            scale = 1 / np.sqrt(np.maximum(variance, _LEAST_VARIANCE))
            self._windows.append((side, mean, scale))
            self.usable = (variance > _LEAST_VARIANCE) & (mean > _REACHES_OUT)

    def likeness(self, other: np.ndarray) -> np.ndarray:
        """[H, W] the sum over the windows of their ZNCC with those of an image, −1
        where they reach out of it."""
        self._set(other)
        total = np.zeros(other.shape, np.float32)
        for side, my_mean, my_scale in self._windows:
            mean, square, score = self._means(side)
            square -= mean * mean
            score -= mean * my_mean
            score *= my_scale
            score /= np.sqrt(np.maximum(square, _LEAST_VARIANCE))
            score[mean < _REACHES_OUT] = -1
            total += score
        return total

    def _set(self, other: np.ndarray) -> None:
        image = _with_margin(other)
        self._moments[0] = image
        np.multiply(image, image, out=self._moments[1])
        np.multiply(image, self._grey, out=self._moments[2])

    def _means(self, side: int) -> np.ndarray:
        """[3, H, W] the moments in windows of that side."""
        tall = self._moments.reshape(-1, self._grey.shape[1])
        window, border = (side, side), opencv().BORDER_REFLECT
        means = opencv().boxFilter(tall, -1, window, borderType=border)
        return means.reshape(self._moments.shape)[:, _MARGIN:-_MARGIN]


def _with_margin(image: np.ndarray) -> np.ndarray:
    """Above and below as much more as a window reaches out, mirrored."""
    cv2 = opencv()
    return cv2.copyMakeBorder(image, _MARGIN, _MARGIN, 0, 0, cv2.BORDER_REFLECT)


def _chosen(scores: np.ndarray, inverses: np.ndarray, usable: np.ndarray) -> DepthMap:
    """The best of scores [D, H, W]; none where that is the first or last depth."""
    count = len(inverses)
    best = np.argmax(scores, axis=0)
    middle = np.clip(best, 1, count - 2)

    def at(offset: int) -> np.ndarray:
        return np.take_along_axis(scores, (middle + offset)[None], 0)[0]

    before, here, after = at(-1), at(0), at(1)
    bend = before - 2 * here + after
    bent = bend < -1e-6
    beside = 0.5 * (before - after) / np.where(bent, bend, 1)
    beside = np.where(bent, np.clip(beside, -0.5, 0.5), 0)
    step = float(inverses[1] - inverses[0])
    found = usable & (best == middle)
    return DepthMap(
        inverse=inverses[0] + step * (middle + beside),
        score=np.where(found, here, -1),
        step=step,
    )
