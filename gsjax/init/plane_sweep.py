"""Depth map of a photograph by plane sweep (Collins 1996).

For each of a list of depths the neighbours of a view are warped into it through a plane
at that depth. At the right depth the windows around a pixel match: their zero-mean
normalised cross-correlation (ZNCC) is near 1, at any exposure.

Axis legend: D depths, H W image.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gsjax.data.photos import scaled_intrinsics, size_within
from gsjax.io.images import opencv

# px, side of the windows: small ones keep edges, large ones need less texture.
_WINDOWS = (3, 7)
_MIN_DEPTHS, _MAX_DEPTHS = 16, 144
_MARGIN = max(_WINDOWS) // 2
# Variance of a window above noise: 1.5 of 255 grey levels.
_MIN_VARIANCE = (1.5 / 255) ** 2
# OpenCV has pixel centres at integers, gsjax at + 0.5.
_FROM_OPENCV = np.asarray([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
_TO_OPENCV = np.asarray([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
_INVALID = -1e3  # grey level of pixels outside the image or masked
_INVALID_MEAN = -1.0  # the mean of a window with an invalid pixel is below


class PinholeCamera(NamedTuple):
    """The camera of a scaled photograph.

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
        """Position [3]."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


class SweepImage(NamedTuple):
    """A scaled photograph.

    Attributes:
      camera: its camera.
      grey: [H, W] float32 in [0, 1]; below 0 where invalid.
      colors: [H, W, 3] uint8.
    """

    camera: PinholeCamera
    grey: np.ndarray
    colors: np.ndarray


class DepthMap(NamedTuple):
    """Result of a sweep.

    Attributes:
      inverse: [H, W] 1 / z.
      score: [H, W] ZNCC at that depth; −1 where none was found.
      step: difference of 1 / z between two depths of the sweep.
    """

    inverse: np.ndarray
    score: np.ndarray
    step: float


def scaled_pinhole(
    viewmat: np.ndarray, K: np.ndarray, size: tuple[int, int], longest: int
) -> PinholeCamera:
    """Return the camera of a photograph that is scaled down.

    Args:
      viewmat: [4, 4] world → camera.
      K: [3, 3] intrinsics of the photograph, px.
      size: width and height of the photograph, px.
      longest: upper limit of the longer side, px.
    """
    width, height = size_within(*size, longest)
    scaled = scaled_intrinsics(K, width / size[0], height / size[1])
    return PinholeCamera(np.asarray(viewmat, float), scaled, (width, height))


def make_sweep_image(
    camera: PinholeCamera, pixels: np.ndarray, valid: np.ndarray | None = None
) -> SweepImage:
    """Scale a photograph to the size of its camera.

    Args:
      camera: from `scaled_pinhole`.
      pixels: [H, W, 3] uint8 RGB.
      valid: [H, W] bool, pixels to use; None for all.
    """
    cv2 = opencv()
    small = cv2.resize(pixels, camera.size, interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    if valid is not None:
        missing = (~valid).astype(np.float32)
        missing = cv2.resize(missing, camera.size, interpolation=cv2.INTER_AREA)
        grey[missing > 0] = _INVALID
    return SweepImage(camera, grey, small)


def project(camera: PinholeCamera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (pixels [M, 2], z [M]) of points [M, 3]; pixels are −1 out of view."""
    seen = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    z = seen[:, 2]
    before = z > 0
    pixels = (seen @ camera.K.T)[:, :2] / np.where(before, z, 1)[:, None]
    inside = before & np.all((pixels >= 0) & (pixels < camera.size), 1)
    return np.where(inside[:, None], pixels, -1), z


def unproject(camera: PinholeCamera, rows, cols, inverse: np.ndarray) -> np.ndarray:
    """Return the world points [M, 3] at pixels (rows, cols) [M], by their 1 / z [M]."""
    rays = np.stack([cols + 0.5, rows + 0.5, np.ones(len(rows))], 1)
    seen = rays @ np.linalg.inv(camera.K).T / inverse[:, None]
    return (seen - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]


def sweep(
    image: SweepImage, neighbours: Sequence[SweepImage], nearest: float, farthest: float
) -> DepthMap:
    """Return the depth of every pixel at which it matches the neighbours best.

    The score of a depth is the mean over the better half of the neighbours: a surface
    may be hidden in the others. Depths are uniform in 1 / z, 16 to 144 of them, one for
    each pixel that the image of a point moves in a neighbour; a parabola interpolates.

    Args:
      image: the view.
      neighbours: one or more other views.
      nearest, farthest: range of z.
    """
    width, height = image.camera.size
    warps = [PlaneWarp(image.camera, other) for other in neighbours]
    shift = max(warp.shift(1 / farthest, 1 / nearest) for warp in warps)
    count = int(np.clip(np.ceil(shift), _MIN_DEPTHS, _MAX_DEPTHS))
    inverses = np.linspace(1 / farthest, 1 / nearest, count)
    windows = ZnccWindows(image.grey)
    counted = (len(warps) + 1) // 2
    scores = np.empty((count, height, width), np.float32)
    best = np.empty((counted, height, width), np.float32)
    less = np.empty((height, width), np.float32)
    for depth, inverse in enumerate(inverses):
        best.fill(-len(_WINDOWS))
        for warp in warps:
            new = windows.zncc(warp.image(inverse))
            for held in best:  # keeps the best scores, in order
                np.minimum(held, new, out=less)
                np.maximum(held, new, out=held)
                new, less = less, new
        np.sum(best, axis=0, out=scores[depth])
    scores /= counted * len(_WINDOWS)
    return _best_depths(scores, inverses, windows.usable)


class PlaneWarp:
    """Warp of a neighbour into a view through a plane: H = A + b (0 0 1) / z."""

    def __init__(self, camera: PinholeCamera, other: SweepImage):
        theirs = other.camera
        turn = theirs.viewmat[:3, :3] @ camera.viewmat[:3, :3].T
        move = theirs.viewmat[:3, 3] - turn @ camera.viewmat[:3, 3]
        self.turn = theirs.K @ turn @ np.linalg.inv(camera.K)
        self.move = np.outer(theirs.K @ move, [0, 0, 1])
        self.size, self.grey = camera.size, other.grey

    def shift(self, low: float, high: float) -> float:
        """Return the longest path, px, of a view's pixel over a range of 1 / z."""
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
        """Return the neighbour warped into the view, [H, W]."""
        cv2 = opencv()
        plane = self.turn + inverse * self.move
        matrix = _TO_OPENCV @ plane @ _FROM_OPENCV
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        image = cv2.warpPerspective(
            self.grey, matrix, self.size, flags=flags, borderValue=_INVALID
        )
        # Points behind the neighbour would appear upside down. z is linear.
        width, height = self.size
        by_x, by_y, constant = plane[2]
        if constant + min(0, by_x * width) + min(0, by_y * height) <= 0:
            across, down = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
            image[by_x * across + by_y * down + constant <= 0] = _INVALID
        image[image < 0] = _INVALID  # interpolated with invalid pixels
        return image


class ZnccWindows:
    """Windows of several sizes around every pixel of a view, for comparison by ZNCC.

    Attributes:
      usable: [H, W] bool, where the largest window has texture and no invalid pixel.
    """

    def __init__(self, grey: np.ndarray):
        self._grey = _with_margin(grey)
        # An image, its square and its product with the view, filtered in one call.
        self._moments: np.ndarray = np.empty((3, *self._grey.shape), np.float32)
        self._set(grey)
        self._windows = []
        for side in _WINDOWS:
            mean, square, _ = self._means(side)
            variance = square - mean * mean
            scale = 1 / np.sqrt(np.maximum(variance, _MIN_VARIANCE))
            self._windows.append((side, mean, scale))
            self.usable = (variance > _MIN_VARIANCE) & (mean > _INVALID_MEAN)

    def zncc(self, other: np.ndarray) -> np.ndarray:
        """Return the sum over window sizes of the ZNCC with an image, [H, W].

        A window with invalid pixels contributes −1.
        """
        self._set(other)
        total = np.zeros(other.shape, np.float32)
        for side, my_mean, my_scale in self._windows:
            mean, square, score = self._means(side)
            square -= mean * mean
            score -= mean * my_mean
            score *= my_scale
            score /= np.sqrt(np.maximum(square, _MIN_VARIANCE))
            score[mean < _INVALID_MEAN] = -1
            total += score
        return total

    def _set(self, other: np.ndarray) -> None:
        image = _with_margin(other)
        self._moments[0] = image
        np.multiply(image, image, out=self._moments[1])
        np.multiply(image, self._grey, out=self._moments[2])

    def _means(self, side: int) -> np.ndarray:
        """Return the means of the moments in windows, [3, H, W]."""
        tall = self._moments.reshape(-1, self._grey.shape[1])
        window, border = (side, side), opencv().BORDER_REFLECT
        means = opencv().boxFilter(tall, -1, window, borderType=border)
        return means.reshape(self._moments.shape)[:, _MARGIN:-_MARGIN]


def _with_margin(image: np.ndarray) -> np.ndarray:
    """Extend an image above and below by the reach of a window, mirrored."""
    cv2 = opencv()
    return cv2.copyMakeBorder(image, _MARGIN, _MARGIN, 0, 0, cv2.BORDER_REFLECT)


def _best_depths(
    scores: np.ndarray, inverses: np.ndarray, usable: np.ndarray
) -> DepthMap:
    """Return the maxima of scores [D, H, W]; those at either end of D are rejected."""
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
