"""Checks of the inputs of a run, and detection of divergence; on the host."""

import warnings
from collections import deque
from collections.abc import Sequence

import numpy as np

from gsjax.cameras.distortion import project_points
from gsjax.data.extent import require_points
from gsjax.data.types import Dataset, Photo
from gsjax.errors import DivergedError, InputError
from gsjax.train.state import Metrics

# The usual causes of an empty view.
POSE_HINT = (
    "poses may be inverted (camera → world instead of world → camera) or in OpenGL "
    "axes (y up, z backward): invert them, or flip their y and z axes"
)
_MAX_BAD_STEPS = 50
_SAMPLED = 20_000
_NOT_IN_VIEW = "no Gaussian was in view"
# Photographs of empty space have a lower loss.
_EMPTY_LOSS = 0.01


def has_valid_pixels(photo: Photo) -> bool:
    """Return whether any pixel of a photograph is valid."""
    return photo.valid is None or bool(photo.valid.any())


def check_photos(dataset: Dataset, photos: Sequence[Photo]) -> None:
    """Check photographs before training; warn of those that are masked completely.

    Raises:
      InputError: if all are masked, their number is not that of the views, or one does
        not have the shapes and dtypes of `Photo`.
    """
    if len(photos) != len(dataset.views) or not photos:
        raise InputError(
            f"photos: expected one for each of {len(dataset.views)} views, got "
            f"{len(photos)}; load them with load_photos(dataset.views)"
        )
    for view, photo in zip(dataset.views, photos):
        photo.require(view.name)
    pairs = zip(dataset.views, photos)
    masked = [view.name for view, photo in pairs if not has_valid_pixels(photo)]
    if len(masked) == len(photos):
        raise InputError(
            f"{dataset.source}: expected photographs with valid pixels, got "
            f"{len(photos)} that are masked completely; invert the masks (black is "
            "excluded) or remove them"
        )
    if masked:
        warnings.warn(
            f"{dataset.source}: {len(masked)} of {len(photos)} photographs are masked "
            f"completely and are not used: {', '.join(masked[:3])}",
            UserWarning,
            stacklevel=2,
        )


def check_points(dataset: Dataset) -> None:
    """Check that points are in front of cameras, beyond the near plane.

    Warns if more than half of those in front are nearer than the near plane.

    Raises:
      InputError: if there are no points, or none can be drawn by any camera, so that
        the Gaussians would have no gradient.
    """
    require_points(dataset)
    points, views = dataset.points, dataset.views
    before, drawn, farthest = _depths(dataset, points[:: 1 + len(points) // _SAMPLED])
    if not drawn:  # in the sample
        before, drawn, farthest = _depths(dataset, points)
    near = max(view.near for view in views)
    unit = "points and poses may have different units"
    if not before:
        raise InputError(
            f"{dataset.source}: expected points in front of the cameras, got all "
            f"{len(points):,} behind all {len(views)}; {POSE_HINT}, or start from "
            "random points (--initial random)"
        )
    if not drawn:
        raise InputError(
            f"{dataset.source}: expected points beyond the near plane {near:.2g}, got "
            f"depths of at most {farthest:.2g}; {unit}: fix the dataset, or start from "
            "random points (--initial random)"
        )
    if drawn < before / 2:
        share = 1 - drawn / before
        warnings.warn(
            f"{dataset.source}: {share:.0%} of the points in front of a camera are "
            f"nearer than the near plane {near:.2g} and not drawn; {unit}",
            UserWarning,
            stacklevel=2,
        )


def check_in_view(dataset: Dataset, means: np.ndarray, source: str) -> None:
    """Check that one of the initial means [N, 3] is inside a view.

    Raises:
      InputError: if none is; ``source`` is the subject of the message.
    """
    for view in dataset.views:
        points = means @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        pixels, depth, seen = project_points(view.lens, view.K, points)
        inside = (pixels >= 0) & (pixels <= (view.width, view.height))
        if np.any(seen & (depth > view.near) & inside.all(-1)):
            return
    raise InputError(
        f"{source}: expected a scene in the coordinates of {dataset.source}, got none "
        f"of {len(means):,} Gaussians in any of {len(dataset.views)} views; pass one "
        "that was trained on this dataset"
    )


def _depths(dataset: Dataset, points: np.ndarray) -> tuple[int, int, float]:
    """Return over all views: points in front, points beyond near, largest depth."""
    before, drawn, farthest = 0, 0, 0.0
    for view in dataset.views:
        local = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        _, depth, seen = project_points(view.lens, view.K, local)
        depth = depth[seen]  # removes NaN
        before += len(depth)
        drawn += int((depth > view.near).sum())
        farthest = max(farthest, depth.max(initial=0))
    return before, drawn, farthest


class Health:
    """Counter of failed steps, which stops runs that diverge.

    Attributes:
      bad: number of failed steps in a row.
    """

    def __init__(self, steps: int):
        self.bad = 0
        self._warned = False
        # Half of a short run, which ends before 50 failures.
        self._limit = min(_MAX_BAD_STEPS, max(1, steps // 2))
        self._recent = deque[bool](maxlen=2 * _MAX_BAD_STEPS)

    def check(self, metrics: Metrics) -> None:
        """Record a step; warn once if no Gaussian is in view.

        Raises:
          DivergedError: if too many steps failed.
        """
        fault = _fault(metrics)
        self.bad = 0 if fault is None else self.bad + 1
        lost = fault == _NOT_IN_VIEW
        self._recent.append(fault is not None and not lost)
        count, limit, span = sum(self._recent), self._limit, len(self._recent)
        if lost:
            if not self._warned:
                self._warned = True
                warnings.warn(
                    f"training step {int(metrics.step)}: {_NOT_IN_VIEW}; {POSE_HINT}",
                    UserWarning,
                    stacklevel=3,
                )
            # Some views may show nothing of a scene that others show.
            count, limit, span = self.bad, _MAX_BAD_STEPS, self.bad
        if fault and count >= limit:
            raise DivergedError(
                f"{fault} in {count} of the last {span} steps, up to step "
                f"{int(metrics.step)}; check the photographs and poses, or train again "
                "with lower rates (TrainConfig.rates)"
            )


def _fault(metrics: Metrics) -> str | None:
    if not metrics.finite:
        return "the loss, its gradient or a Gaussian was not finite"
    if metrics.psnr < 0:  # a larger error than between any two images in [0, 1]
        return "the PSNR was below 0 dB"
    if metrics.pairs == 0 and metrics.loss > _EMPTY_LOSS:
        return _NOT_IN_VIEW
    return None
