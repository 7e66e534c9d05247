"""Camera paths through a captured scene: orbit, spiral, interpolation of the cameras.

World → camera matrices [·, 4, 4] in and out, float64, OpenCV axes. Degenerate input
(one camera, equal or parallel cameras) never gives NaN; each docstring names the
fallback. Axes: B given cameras, F frames of the path, S dense samples of it.
"""

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from gsjax.cameras.camera import look_at
from gsjax.data.types import View, unexpected
from gsjax.errors import InputError

# Minimum of the least eigenvalue, the mean squared sine between the optical axes and
# their common direction, at which the axes locate the scene: a spread of 2°.
_PARALLEL = np.sin(np.radians(2.0)) ** 2
_STEEPEST = np.radians(85.0)
_ALIKE = np.cos(np.radians(45.0))  # between directions that face one side of a scene
_SAMPLES = 512  # between two keyframes, to measure the length of a path


class Intrinsics(NamedTuple):
    """Intrinsics K [3, 3] in px of an image of width × height."""

    K: np.ndarray
    width: int
    height: int


def median_intrinsics(views: Sequence[View]) -> Intrinsics:
    """Return the most common image size of the views, and the median K for it.

    Raises:
      InputError: if there is no view.
    """
    if not views:
        raise unexpected("views", "at least one", "none", "pass those of a dataset")
    sizes = Counter((view.width, view.height) for view in views)
    width, height = max(sizes, key=lambda size: (sizes[size], size))
    scaled = [v.K * ([width / v.width], [height / v.height], [1]) for v in views]
    return Intrinsics(np.median(scaled, axis=0), width, height)


def focus_point(viewmats, depth: float | None = None) -> np.ndarray:
    """Return the point [3] that is nearest to the optical axes of all cameras.

    If the cameras do not look at one point (a single camera, axes within about 2°, or
    diverging axes), it is straight ahead of their mean position.

    Args:
      viewmats: [B, 4, 4].
      depth: distance ahead in that case; None takes the spread of the cameras, or 1.

    Raises:
      InputError: if the shape is wrong, there is no camera, or a value is not finite.
    """
    centres, axes = _centres_and_axes(viewmats)
    ahead = axes[:, 2]
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    if np.linalg.eigvalsh(across.mean(axis=0))[0] > _PARALLEL:
        moment = np.einsum("bij,bj->i", across, centres)
        focus = np.linalg.solve(across.sum(axis=0), moment)
        if np.median(((focus - centres) * ahead).sum(axis=1)) > 0:
            return focus
    if depth is None:
        spread = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
        depth = 2 * spread if spread > 1e-9 else 1.0
    return centres.mean(axis=0) + depth * _mean_direction(ahead)


def up_direction(viewmats) -> np.ndarray:
    """Return the up direction [3] of the scene, orthogonal to the cameras' x axes.

    Cameras are held level more often than they look level. If all x axes are parallel,
    or cameras were rolled, it is the mean of their up directions.

    Raises:
      InputError: as `focus_point`.
    """
    _, axes = _centres_and_axes(viewmats)
    mean = _mean_direction(-axes[:, 1])
    right = axes[:, 0]
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    level = vectors[:, 0] * np.sign(vectors[:, 0] @ mean)
    return level if values[1] > _PARALLEL and level @ mean > 0.5 else mean


def orbit(viewmats, frames: int, *, depth: float | None = None) -> np.ndarray:
    """Return a closed circular path [F, 4, 4] around `focus_point`.

    Its axis is `up_direction`, its radius and elevation are the median distance and the
    mean elevation of the cameras (at most 85°), and it starts at the azimuth of the
    first camera, or anywhere if that has none.

    Args:
      viewmats: [B, 4, 4].
      frames: F; frame F would be frame 0.
      depth: as `focus_point`.

    Raises:
      InputError: as `focus_point`, or if ``frames`` is below 1.
    """
    centres, _ = _centres_and_axes(viewmats, frames)
    focus, up = focus_point(viewmats, depth), up_direction(viewmats)
    offsets = centres - focus
    distances = np.linalg.norm(offsets, axis=1)
    distance = float(np.median(distances)) or depth or 1.0
    sines = (offsets @ up) / np.where(distances > 0, distances, 1)
    elevation = np.arcsin(np.clip(sines, -1, 1)).mean()
    elevation = np.clip(elevation, -_STEEPEST, _STEEPEST)
    start = offsets[0] - (offsets[0] @ up) * up
    if np.linalg.norm(start) < 1e-6 * distance:
        start = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    start = start / np.linalg.norm(start)
    turns = 2 * np.pi * np.arange(frames) / frames
    around = np.outer(np.cos(turns), start)
    around += np.outer(np.sin(turns), np.cross(up, start))
    eyes = np.cos(elevation) * around + np.sin(elevation) * up
    return np.stack([look_at(focus + distance * eye, focus, up) for eye in eyes])


def unseen_angle(viewmats, *, depth: float | None = None) -> float:
    """Return the largest angle in degrees of an `orbit` without a camera.

    It is 360 if all cameras have one azimuth, as a single one does.

    Raises:
      InputError: as `focus_point`.
    """
    centres, _ = _centres_and_axes(viewmats)
    offsets = centres - focus_point(viewmats, depth)
    up = up_direction(viewmats)
    across = np.cross(np.eye(3)[np.abs(up).argmin()], up)
    angles = np.arctan2(offsets @ np.cross(up, across), offsets @ across)
    angles = np.sort(angles)
    return float(np.degrees(np.diff(angles, append=angles[0] + 2 * np.pi).max()))


def spiral(
    viewmats, frames: int, *, turns: int = 2, depth: float | None = None
) -> np.ndarray:
    """Return a closed spiral [F, 4, 4] that looks at the focus of the cameras.

    It is centred on the mean pose and as wide as the 90th percentile of the cameras'
    offsets, at least 3 % of the distance of the focus. If the cameras surround the
    scene, only those within 45° of the first one's direction count. Mildenhall et al.,
    "Local Light Field Fusion", 2019.

    Args:
      viewmats: [B, 4, 4].
      frames: F; frame F would be frame 0.
      turns: number of turns during one movement back and forth.
      depth: as `focus_point`.

    Raises:
      InputError: as `focus_point`, or if ``frames`` is below 1.
    """
    viewmats = np.asarray(viewmats, np.float64)
    centres, axes = _centres_and_axes(viewmats, frames)
    # For a ring that looks down, the mean direction and the mean up are parallel.
    upward = _mean_direction(-axes[:, 1]) @ _mean_direction(axes[:, 2])
    if np.linalg.norm(axes[:, 2].mean(axis=0)) < _ALIKE or abs(upward) > _ALIKE:
        alike = axes[:, 2] @ axes[0, 2] >= _ALIKE
        viewmats, centres, axes = viewmats[alike], centres[alike], axes[alike]
    middle = centres.mean(axis=0)
    ahead = _mean_direction(axes[:, 2])
    focus = focus_point(viewmats, depth)
    distance = max((focus - middle) @ ahead, 1e-9)
    pose = look_at(middle, middle + ahead, _mean_direction(-axes[:, 1]))[:3, :3]
    reach = np.percentile(np.abs((centres - middle) @ pose.T), 90, axis=0)
    reach = np.maximum(reach, distance * np.asarray([0.03, 0.03, 0]))
    # Keeps the path in front of the focus.
    reach[2] = min(reach[2], 0.5 * distance)
    phase = 2 * np.pi * np.arange(frames) / frames
    steps = [np.cos(turns * phase), np.sin(turns * phase), np.sin(phase)]
    eyes = middle + (np.stack(steps, -1) * reach) @ pose
    target = middle + distance * ahead
    return np.stack([look_at(eye, target, -pose[1]) for eye in eyes])


def interpolate(
    viewmats, frames: int, *, closed: bool = False, depth: float | None = None
) -> np.ndarray:
    """Return a smooth path [F, 4, 4] through all the cameras, in their order.

    Centripetal Catmull–Rom splines (Yuksel et al. 2011) of positions and quaternions,
    normalised, so the path and its first derivative are continuous. Frames are at equal
    steps of sqrt(movement² + (distance of the focus · rotation)²), about the movement
    of the image. Consecutive equal cameras count once; a single camera stands still.

    Args:
      viewmats: [B, 4, 4].
      frames: F; the first and the last are the first and the last camera, unless
        ``closed``: then frame F would be frame 0.
      closed: return to the first camera.
      depth: as `focus_point`.

    Raises:
      InputError: as `focus_point`, or if ``frames`` is below 1.
    """
    from scipy.interpolate import CubicHermiteSpline
    from scipy.spatial.transform import Rotation

    centres, axes = _centres_and_axes(viewmats, frames)
    away = focus_point(viewmats, depth) - centres
    scale = np.median(np.linalg.norm(away, axis=1)) or 1.0
    keys = np.concatenate([centres, Rotation.from_matrix(axes).as_quat()], axis=1)
    keys = _aligned(keys[[*range(len(keys)), 0]] if closed else keys)
    steps = _steps(keys, scale)
    apart = steps > 1e-9 * max(steps.sum(), scale)
    keys = np.concatenate([keys[:1], keys[1:][apart]])
    if len(keys) == 1:
        return np.tile(_matrices(keys), (frames, 1, 1))
    knots = np.concatenate([[0], np.cumsum(np.sqrt(steps[apart]))])
    path = CubicHermiteSpline(knots, keys, _tangents(keys, knots, closed))
    pieces = len(keys) - 1
    places = np.linspace(0, pieces, pieces * _SAMPLES + 1)
    dense = np.interp(places, np.arange(pieces + 1), knots)
    lengths = np.concatenate([[0], np.cumsum(_steps(path(dense), scale))])
    even = np.linspace(0, lengths[-1], frames, endpoint=not closed)
    return _matrices(path(np.interp(even, lengths, dense)))


def _centres_and_axes(viewmats, frames: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return positions [B, 3] and rotations [B, 3, 3], rows right, down, ahead."""
    if frames < 1:
        raise unexpected("frames", "at least 1", frames, "pass 60, for instance")
    viewmats = np.asarray(viewmats, np.float64)
    if viewmats.ndim != 3 or viewmats.shape[1:] != (4, 4) or len(viewmats) == 0:
        expected = "shape [B, 4, 4] with at least one camera"
        raise unexpected("viewmats", expected, viewmats.shape, "stack the matrices")
    if not np.isfinite(viewmats).all():
        raise InputError("viewmats: expected finite values; remove the damaged cameras")
    axes = viewmats[:, :3, :3]
    return -np.einsum("bij,bi->bj", axes, viewmats[:, :3, 3]), axes


def _mean_direction(directions: np.ndarray) -> np.ndarray:
    """Return the mean unit direction [3], or the first direction if they cancel."""
    mean = directions.mean(axis=0)
    length = np.linalg.norm(mean)
    return mean / length if length > 1e-3 else directions[0]


def _aligned(keys: np.ndarray) -> np.ndarray:
    """Flip quaternions of keyframes [·, 3 + 4] to at most half a turn from the last."""
    keys = keys.copy()
    for before, key in pairwise(keys):
        if before[3:] @ key[3:] < 0:
            key[3:] *= -1
    return keys


def _steps(keys: np.ndarray, scale: float) -> np.ndarray:
    """Return the distances of neighbours; an angle counts as a length of ``scale``."""
    moved = np.linalg.norm(np.diff(keys[:, :3], axis=0), axis=1)
    quats = keys[:, 3:] / np.linalg.norm(keys[:, 3:], axis=1, keepdims=True)
    # The chord of unit quaternions is 2 sin(angle / 4).
    chord = np.linalg.norm(np.diff(quats, axis=0), axis=1)
    return np.hypot(moved, scale * 4 * np.arcsin(np.minimum(chord / 2, 1)))


def _tangents(keys: np.ndarray, knots: np.ndarray, closed: bool) -> np.ndarray:
    """Return the derivatives of the parabolas through three neighbouring keyframes."""
    gaps = np.diff(knots)[:, None]
    slopes = np.diff(keys, axis=0) / gaps
    tangents = np.empty_like(keys)

    def between(before, after, gap_before, gap_after):
        return (before * gap_after + after * gap_before) / (gap_before + gap_after)

    tangents[1:-1] = between(slopes[:-1], slopes[1:], gaps[:-1], gaps[1:])
    if closed:
        # The last keyframe equals the first; its quaternion may have the other sign.
        sign = np.ones(7)
        sign[3:] = np.sign(keys[0, 3:] @ keys[-1, 3:])
        tangents[0] = between(sign * slopes[-1], slopes[0], gaps[-1], gaps[0])
        tangents[-1] = sign * tangents[0]
    elif len(keys) == 2:
        tangents[:] = slopes[0]
    else:
        tangents[0] = 2 * slopes[0] - tangents[1]
        tangents[-1] = 2 * slopes[-1] - tangents[-2]
    return tangents


def _matrices(keys: np.ndarray) -> np.ndarray:
    """Return the view matrices [S, 4, 4] of keyframes."""
    from scipy.spatial.transform import Rotation

    viewmats = np.tile(np.eye(4), (len(keys), 1, 1))
    viewmats[:, :3, :3] = Rotation.from_quat(keys[:, 3:]).as_matrix()
    viewmats[:, :3, 3] = -np.einsum("bij,bj->bi", viewmats[:, :3, :3], keys[:, :3])
    return viewmats
