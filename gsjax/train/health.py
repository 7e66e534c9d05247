"""Whether there is anything to learn, and whether a run still learns it.

Both are looked at on the host, and neither changes a bit of what is computed.
"""

import warnings
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gsjax.data.extent import require_points
from gsjax.data.types import Dataset, Photo
from gsjax.errors import DivergedError, InputError
from gsjax.train.state import Metrics

_MAX_BAD_STEPS = 50
_SAMPLED = 20_000
_LOST = "nothing of the scene was in view"
# A loss above it is not that of photographs of nothing.
_SOMETHING = 0.01


def is_seen(photo: Photo) -> bool:
    """Whether any pixel of a photograph counts."""
    return photo.valid is None or bool(photo.valid.any())


def check_photos(scene: Dataset, photos: Sequence[Photo]) -> None:
    """Warn of photographs that are masked altogether.

    Raises:
      InputError: if all are, or there is not one for each view, or one has pixels of
        another kind than `Photo` says.
    """
    if len(photos) != len(scene.views) or not photos:
        raise InputError(
            f"{len(photos)} photos for {len(scene.views)} views; one for each is wanted"
        )
    for view, photo in zip(scene.views, photos):
        photo.require(view.name)
    masked = [v.name for v, photo in zip(scene.views, photos) if not is_seen(photo)]
    if len(masked) == len(photos):
        raise InputError(
            f"{scene.source}: no pixel is left to learn from: all {len(photos)} "
            "photographs are masked altogether; black is what a mask leaves out: "
            "invert the masks, or remove them"
        )
    if masked:
        warnings.warn(
            f"{scene.source}: {len(masked)} of {len(photos)} photographs are masked "
            f"altogether and teach nothing: {', '.join(masked[:3])}",
            UserWarning,
            stacklevel=2,
        )


def check_points(scene: Dataset) -> None:
    """See that points lie before cameras, and not too near to be drawn.

    Warns where half of those that lie before a camera are too near to it.

    Raises:
      InputError: if no camera sees one: such Gaussians would never be drawn, nor
        move; or if there are none.
    """
    require_points(scene)
    points, views = scene.points, scene.views
    found = _depths(scene, points[:: 1 + len(points) // _SAMPLED])
    if not found.drawn:  # by those of a sample; all decide
        found = _depths(scene, points)
    near = max(view.near for view in views)
    unit = "are points and poses in one unit of length?"
    if not found.before:
        raise InputError(
            f"{scene.source}: all {len(points):,} points lie behind all {len(views)} "
            "cameras; are the poses camera → world where world → camera is wanted, or "
            "their axes others? Mend the dataset, or start from random points "
            "(--initial random)"
        )
    if not found.drawn:
        raise InputError(
            f"{scene.source}: no point is farther than {found.farthest:.2g} from a "
            f"camera, and what is nearer than {near:.2g} is not drawn; {unit} Mend "
            "the dataset, or start from random points (--initial random)"
        )
    if found.drawn < found.before / 2:
        share = 1 - found.drawn / found.before
        warnings.warn(
            f"{scene.source}: {share:.0%} of the points before a camera are nearer to "
            f"it than {near:.2g}, and not drawn; {unit}",
            UserWarning,
            stacklevel=2,
        )


def check_in_view(scene: Dataset, means: np.ndarray, source: str) -> None:
    """See that some of the Gaussians that a run is to start from are in a picture.

    Args:
      scene: its views.
      means: [N, 3] in the scene's coordinates.
      source: where they are from.

    Raises:
      InputError: if the centre of none is: they are no scene of these photographs.
    """
    for view in scene.views:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            x, y, z = view.viewmat[:3, :3] @ means.T + view.viewmat[:3, 3:]
            u, v, _ = view.K @ np.stack([x / z, y / z, np.ones_like(z)])
        inside = (z > view.near) & (u >= 0) & (u <= view.width)
        if np.any(inside & (v >= 0) & (v <= view.height)):
            return
    raise InputError(
        f"{source}: none of its {len(means):,} Gaussians is in the view of any of the "
        f"{len(scene.views)} cameras of {scene.source}; a scene of this dataset is "
        "wanted, in its coordinates"
    )


class _Depths(NamedTuple):
    """Of points in all views: how many lie before the camera, how many of them far
    enough to be drawn, and how far the farthest is."""

    before: int
    drawn: int
    farthest: float


def _depths(scene: Dataset, points: np.ndarray) -> _Depths:
    before, drawn, farthest = 0, 0, 0.0
    for view in scene.views:
        depth = points @ view.viewmat[2, :3] + view.viewmat[2, 3]
        depth = depth[depth > 0]  # and no NaN
        before += len(depth)
        drawn += int((depth > view.near).sum())
        farthest = max(farthest, depth.max(initial=0))
    return _Depths(before, drawn, farthest)


class Health:
    """Counts the steps that did a run no good.

    Attributes:
      bad: that many in a row, up to now.
    """

    def __init__(self, steps: int):
        self.bad = 0
        # A short run has an end before so many have come together.
        self._limit = min(_MAX_BAD_STEPS, max(1, steps // 2))
        self._lately = deque[bool](maxlen=2 * _MAX_BAD_STEPS)

    def look(self, metrics: Metrics) -> None:
        """Take a step into account.

        Raises:
          DivergedError: at the last of too many bad ones.
        """
        fault = self._fault(metrics)
        self.bad = 0 if fault is None else self.bad + 1
        lost = fault == _LOST
        self._lately.append(fault is not None and not lost)
        count, limit, span = sum(self._lately), self._limit, len(self._lately)
        if lost:  # some views may show nothing of a scene that others show
            count, limit, span = self.bad, _MAX_BAD_STEPS, self.bad
        if fault and count >= limit:
            raise DivergedError(
                f"{fault} in {count} of the last {span} steps, up to step "
                f"{int(metrics.step)}; look for a photograph or a pose that is off, or "
                "train anew with lower rates (TrainConfig.rates)"
            )

    def _fault(self, metrics: Metrics) -> str | None:
        if not metrics.finite:
            return "the loss, its gradient or a Gaussian was not finite"
        if metrics.psnr < 0:  # an error above 1, of colours from 0 to 1
            return "the picture was farther from the photograph than any can be"
        if metrics.pairs == 0 and metrics.loss > _SOMETHING:
            return _LOST
        return None
