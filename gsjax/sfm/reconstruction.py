"""Structure from motion: from photographs or a video to a dataset with cameras.

SIFT features, matching, incremental mapping by COLMAP (Schönberger and Frahm,
"Structure-from-Motion Revisited", CVPR 2016) through pycolmap, then undistortion.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from gsjax.data.video import sharpest_frames
from gsjax.errors import InputError, SfmError
from gsjax.runtime.files import write_json
from gsjax.sfm.engine import Tell, colmap, quiet_and_seeded
from gsjax.sfm.mapping import (
    Shot,
    best_pair,
    extract,
    match,
    match_again,
    reconstruct,
    why_not,
)
from gsjax.sfm.output import install, refuse_output, staging, write_dataset
from gsjax.sfm.photos import (
    Photograph,
    Workshop,
    find_photos,
    prepare_photos,
)

EXHAUSTIVE_UP_TO = 60  # photos: 1770 pairs, minutes on two cores


@dataclass(frozen=True)
class SfmSettings:
    """How cameras are looked for.

    Attributes:
      matcher: which pairs are matched: "exhaustive" for all; "sequential" for
        neighbours in order of the names; "auto" for the former with at most 60 photos,
        the latter with more and with video.
      camera: which photos share their intrinsics: "single" for all; "per-image" for
        none; "auto" for those that have the same size and the same camera and focal
        length in EXIF.
      max_size: px of the longer side; larger photos are scaled down to it, for the
        features and for the dataset. 0 leaves them as they are.
      frames: how many are taken from a video.
      masks: folder of masks for the photos; nothing is looked for where they are
        black, nor where the photos are less than half opaque. IMG.png, IMG.jpg or
        IMG.jpg.png for IMG.jpg.
      seed: of COLMAP's random numbers.
    """

    matcher: Literal["auto", "exhaustive", "sequential"] = "auto"
    camera: Literal["auto", "single", "per-image"] = "auto"
    max_size: int = 1600
    frames: int = 100
    masks: Path | None = None
    seed: int = 0


@dataclass(frozen=True)
class SfmReport:
    """What came of it; also in the dataset as sfm.json.

    Attributes:
      source, output: the photos or the video, and the dataset.
      registered: points seen in each image that has a camera, by its name.
      unregistered: why each of the others has none.
      points: how many there are in space.
      mean_reprojection_error: px.
      mean_track_length: in how many images a point is seen on average.
      cameras: how many different intrinsics.
      other_models: images in each of the smaller models that were left out.
      seconds: each phase's.
      settings: what was asked for, with "auto" resolved in ``matcher``.
    """

    source: str
    output: str
    registered: dict[str, int]
    unregistered: dict[str, str]
    points: int
    mean_reprojection_error: float
    mean_track_length: float
    cameras: int
    other_models: list[int]
    settings: dict[str, Any]
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def problem(self) -> str | None:
        """What is wrong if fewer than half of the images are registered."""
        good, bad = len(self.registered), len(self.unregistered)
        if good >= bad:
            return None
        return (
            f"only {good} of {good + bad} images could be registered (they are in "
            f"{self.output}); {_remedy(self.settings['matcher'])}"
        )


def run_sfm(
    source: Path,
    output: Path,
    settings: SfmSettings | None = None,
    *,
    overwrite: bool = False,
    tell: Tell | None = None,
) -> SfmReport:
    """Find the cameras of photographs and write a dataset that can be trained on.

    ``output`` gets ``images/`` (upright and undistorted), ``masks/`` of photographs
    that have one or are transparent somewhere, ``sparse/0/`` (COLMAP's binary model,
    PINHOLE cameras) and ``sfm.json``. It appears when all is done, or not at all; other
    files in it are left alone.

    Args:
      source: a folder of photographs, or a video.
      output: folder of the dataset.
      settings: default `SfmSettings()`.
      overwrite: replace a dataset that this function wrote earlier.
      tell: is called with lines of progress.

    Returns:
      The report. Where ``report.problem`` is not None, fewer than half of the images
      are registered.

    Raises:
      InputError: if something is wrong with the files.
      SfmError: if there is no model at all.
      MissingExtraError: without pycolmap or OpenCV.
    """
    settings = SfmSettings() if settings is None else settings
    tell = (lambda _: None) if tell is None else tell
    colmap()
    _check(source, settings)
    refuse_output(output, (source, settings.masks), overwrite)
    seconds: dict[str, float] = {}
    with staging(output) as stage, quiet_and_seeded(settings.seed):
        work = Workshop(stage)
        with _timed("photos", seconds):
            photographs = _collect(source, settings, work, tell)
        matcher = _matcher(settings, source, len(photographs))
        models = _solve(photographs, matcher, settings, work, seconds, tell)
        report = _report(
            source, output, models, photographs, work, asdict(settings), seconds
        )
        report.settings["matcher"] = matcher
        dataset = stage / "dataset"
        dataset.mkdir()
        with _timed("undistortion", seconds):
            tell(f"undistorting {len(report.registered)} images")
            write_dataset(models[0], photographs, work, dataset)
        write_json(dataset / "sfm.json", _facts(report), indent=2)
        install(dataset, output, stage)
    return report


def _check(source: Path, settings: SfmSettings) -> None:
    if not source.exists():
        raise InputError(f"{source}: no such folder of photos, nor a video")
    if settings.max_size and settings.max_size < 64:
        raise InputError(f"max_size {settings.max_size}: at least 64, or 0, is wanted")
    if settings.frames < 2:
        raise InputError(f"frames {settings.frames}: at least 2 are wanted")
    if settings.masks is not None and not source.is_dir():
        raise InputError(f"{source}: masks go with a folder of photos, not a video")


def _collect(
    source: Path, settings: SfmSettings, work: Workshop, tell: Tell
) -> list[Photograph]:
    """The working files of the photographs, or of the frames of a video."""
    work.photos.mkdir()
    work.masks.mkdir()
    size = settings.max_size
    if source.is_dir():
        paths = find_photos(source)
        tell(f"reading {len(paths)} photos")
        found = prepare_photos(paths, settings.masks, work, size)
        masked = sum(photo.mask for photo in found)
        if masked or settings.masks is not None:
            told = "have a mask or are transparent in part"
            tell(f"{masked} of {len(found)} photos {told}")
    else:
        frames = sharpest_frames(source, settings.frames, size)  # refuses what is none
        tell(f"choosing the sharpest {settings.frames} frames")
        found = []
        for number, pixels in frames:
            name = f"frame_{number:06d}.jpg"
            found.append(work.add(number, name, pixels, None, "video"))
        if len(found) < 2:
            raise InputError(f"{source}: only {len(found)} frames of it can be read")
    return _with_cameras(found, settings.camera)


def _with_cameras(photographs: list[Photograph], choice: str) -> list[Photograph]:
    """The photographs, sharing cameras as chosen.

    Raises:
      InputError: if those of different sizes are to share one.
    """
    if choice == "auto":
        return photographs
    shots = [photo.shot for photo in photographs]
    if choice == "per-image":
        keys = [shot.file for shot in shots]
    else:
        keys = ["single"] * len(shots)
        sizes = {(shot.width, shot.height): shot.file for shot in shots}
        if len(sizes) > 1:
            told = ", ".join(f"{name} is {w}x{h}" for (w, h), name in sizes.items())
            raise InputError(
                f"--camera single wants photos of one size: {told}; pass --camera auto"
            )
    focal = next((s.focal for s in shots if s.focal), None)
    changed = []
    for photo, key in zip(photographs, keys):
        own = photo.shot.focal if choice == "per-image" else focal
        changed.append(photo._replace(shot=photo.shot._replace(camera=key, focal=own)))
    return changed


def _remedy(matcher: str) -> str:
    """What to do where cameras are not found, which were matched so."""
    every = "" if matcher == "exhaustive" else "--matcher exhaustive, or "
    return (
        "photos that overlap by two thirds or more, sharp, of a scene with texture "
        f"that stays still, help; so may {every}a larger --max-size"
    )


def _matcher(settings: SfmSettings, source: Path, count: int) -> str:
    if settings.matcher != "auto":
        return settings.matcher
    few = source.is_dir() and count <= EXHAUSTIVE_UP_TO
    return "exhaustive" if few else "sequential"


def _solve(
    photographs: list[Photograph],
    matcher: str,
    settings: SfmSettings,
    work: Workshop,
    seconds: dict[str, float],
    tell: Tell,
) -> list[Any]:
    """The models, largest first.

    Raises:
      SfmError: if there is none.
    """
    count, seed = len(photographs), settings.seed
    database = _database(work)
    masks = work.masks if any(photo.mask for photo in photographs) else None
    shots = [photo.shot for photo in photographs]
    with _timed("features", seconds):
        tell(f"features of {count} images")
        extract(database, work.photos, masks, shots, tell)
    with _timed("matching", seconds):
        tell(f"matching, {matcher}")
        match(database, count, matcher, seed, tell)
    with _timed("mapping", seconds):
        tell("mapping")
        models = reconstruct(database, work.photos, work.folder / "models", seed, tell)
    if models and models[0].num_reg_images() < count:
        with _timed("second effort", seconds):
            models[0] = _second_effort(models[0], shots, work, seed, tell)
    if models:
        return models
    most, pairs = best_pair(database)
    raise SfmError(
        f"no cameras could be found for the {count} images; {pairs} pairs of them "
        f"match, the best by {most} features; {_remedy(matcher)}"
    )


def _second_effort(
    model: Any, shots: list[Shot], work: Workshop, seed: int, tell: Tell
) -> Any:
    """The model, extended by images that were not placed in it at first."""
    placed = {image.name for image in model.images.values()}
    missing = {shot.file for shot in shots} - placed
    tell(f"looking again at {len(missing)} images that were not placed")
    pairs = match_again(_database(work), missing, work.folder / "pairs", seed, tell)
    if not pairs:
        return model
    start, models = work.folder / "start", work.folder / "extended"
    start.mkdir()
    model.write_binary(start)
    database = _database(work)
    found = reconstruct(database, work.photos, models, seed, tell, start=start)
    more = found and found[0].num_reg_images() > model.num_reg_images()
    return found[0] if more else model


def _database(work: Workshop) -> Path:
    return (work.folder / "database.db").resolve()


def _report(
    source: Path,
    output: Path,
    models: list[Any],
    photographs: list[Photograph],
    work: Workshop,
    settings: dict[str, Any],
    seconds: dict[str, float],
) -> SfmReport:
    best, *others = models
    seen = {image.name: image.num_points3D for image in best.images.values()}
    names = {photo.shot.file: photo.name for photo in photographs}
    registered = {names[file]: int(seen[file]) for file in names if file in seen}
    lost = set(names) - set(seen)
    why = why_not(_database(work), names, set(seen)) if lost else {}
    unregistered = {names[file]: reason for file, reason in why.items()}
    settings["masks"] = None if settings["masks"] is None else str(settings["masks"])
    return SfmReport(
        source=str(source),
        output=str(output),
        registered=registered,
        unregistered=unregistered,
        points=best.num_points3D(),
        mean_reprojection_error=best.compute_mean_reprojection_error(),
        mean_track_length=best.compute_mean_track_length(),
        cameras=best.num_cameras(),
        other_models=[model.num_reg_images() for model in others],
        settings=settings,
        seconds=seconds,
    )


def _facts(report: SfmReport) -> dict[str, Any]:
    return {**asdict(report), "pycolmap": colmap().__version__}


@contextmanager
def _timed(phase: str, seconds: dict[str, float]) -> Iterator[None]:
    start = time.monotonic()
    yield
    seconds[phase] = round(time.monotonic() - start, 2)
