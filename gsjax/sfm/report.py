"""Report of structure from motion: what was found, what not, and why."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsjax.sfm.mapping import match_groups, registration_failures
from gsjax.sfm.photos import PreparedPhoto

_SHOWN = 3  # names of a scene


@dataclass(frozen=True)
class SfmReport:
    """Outcome of structure from motion; stored in the dataset as sfm.json.

    Attributes:
      source, output: the photos or the video, and the dataset.
      registered: image name → number of points seen in it, for images with a camera.
      unregistered: image name → reason, for images without a camera in any scene.
      points: number of points in space.
      mean_reprojection_error: px.
      mean_track_length: mean number of images that see a point.
      cameras: number of different intrinsics.
      scenes: folder within the dataset → names of its images, for each further scene:
        images that match among themselves, but not those of the dataset.
      tried: a line for each attempt at mapping.
      seconds: duration of each phase.
      times: with ``moving``, the times of the frames, and how what moves was left out
        of the matching; else None.
      settings: the settings, with "auto" resolved in ``matcher``.
    """

    source: str
    output: str
    registered: dict[str, int]
    unregistered: dict[str, str]
    points: int
    mean_reprojection_error: float
    mean_track_length: float
    cameras: int
    scenes: dict[str, list[str]]
    settings: dict[str, Any]
    tried: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    times: str | None = None

    @property
    def problem(self) -> str | None:
        """A message if fewer than half of the images have a camera, else None."""
        good, bad = len(self.registered), len(self.unregistered)
        if good + sum(map(len, self.scenes.values())) >= bad:
            return None
        return (
            f"only {good} of {good + bad} images could be registered (they are in "
            f"{self.output}); {advice(self.settings['matcher'])}"
        )

    def told_scenes(self) -> list[str]:
        """Return a line for each further scene."""
        return [
            f"{len(names)} other images show another scene, or one without overlap "
            f"with the first ({some(names)}): {Path(self.output) / folder}"
            for folder, names in self.scenes.items()
        ]


def advice(matcher: str) -> str:
    """Return what to try if cameras are not found."""
    exhaustive = "" if matcher == "exhaustive" else "--matcher exhaustive or "
    return (
        "take sharp photos that overlap by two thirds or more, of a static scene with "
        f"texture, or try {exhaustive}a larger --max-size"
    )


def some(names: Sequence[str]) -> str:
    """Return the first names, and dots if there are more."""
    more = ["…"] if len(names) > _SHOWN else []
    return ", ".join([*names[:_SHOWN], *more])


def told_times(photos: Sequence[PreparedPhoto]) -> str:
    """Return the times of frames, and what was left out of the matching, as a line."""
    seconds = [photo.seconds or 0.0 for photo in photos]
    masked = sum(photo.mask for photo in photos)
    by = "geometric verification alone"
    if masked:
        by = f"the masks of {masked} of {len(photos)} frames and geometric verification"
    return (
        f"times of {len(photos)} frames, {min(seconds):.2f} to {max(seconds):.2f} s; "
        f"what moves was left out by {by}"
    )


def statistics(
    models: dict[str, Any], photos: Sequence[PreparedPhoto], database: Path
) -> dict[str, Any]:
    """Return the fields of `SfmReport` that describe the models.

    Args:
      models: by folder within the dataset, that of the dataset itself first.
      photos: all of them.
      database: COLMAP's.
    """
    best, *_ = models.values()
    seen = {image.name: image.num_points3D for image in best.images.values()}
    names = {photo.record.file: photo.name for photo in photos}
    files = {
        place: {image.name for image in model.images.values()}
        for place, model in models.items()
    }
    lost = set(names).difference(*files.values())
    why = {}
    if lost:
        why = registration_failures(database, names, set(seen))
        why = {file: reason for file, reason in why.items() if file in lost}
        why |= _in_groups(database, names, lost)
    return {
        "registered": {names[file]: int(seen[file]) for file in names if file in seen},
        "unregistered": {names[file]: reason for file, reason in why.items()},
        "points": best.num_points3D(),
        "mean_reprojection_error": best.compute_mean_reprojection_error(),
        "mean_track_length": best.compute_mean_track_length(),
        "cameras": best.num_cameras(),
        "scenes": {
            place: [names[file] for file in names if file in found]
            for place, found in files.items()
            if place
        },
    }


def _in_groups(database: Path, names: dict[str, str], lost: set[str]) -> dict[str, str]:
    """Return the reason of images that match only one another."""
    found = {}
    for group in match_groups(database):
        if group <= lost:
            told = some(sorted(names[file] for file in group))
            why = f"matches only others without a camera ({told}): another scene?"
            found |= dict.fromkeys(group, why)
    return found
