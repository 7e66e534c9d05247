"""Structure from motion: from photographs or a video to a dataset with cameras.

SIFT features, matching and incremental mapping by COLMAP (Schönberger and Frahm,
"Structure-from-Motion Revisited", CVPR 2016) through pycolmap.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from gsjax.data.video import sharpest_frames
from gsjax.errors import InputError, SfmError
from gsjax.runtime.files import write_json
from gsjax.sfm.attempts import Mapped, attempts_of, map_with_attempts
from gsjax.sfm.engine import Progress, colmap, quiet_and_seeded
from gsjax.sfm.mapping import (
    CAMERA_MODELS,
    MIN_INLIERS_EXTENDED,
    MapperLimits,
    extract_features,
    map_incrementally,
    match_features,
    match_groups,
    match_summary,
    rematch_guided,
)
from gsjax.sfm.output import (
    SCENES,
    check_output,
    install_dataset,
    staging_folder,
    write_dataset,
)
from gsjax.sfm.photos import (
    PreparedPhoto,
    WorkFolder,
    add_masks,
    find_photos,
    prepare_photos,
)
from gsjax.sfm.report import SfmReport, advice, statistics, told_times

EXHAUSTIVE_UP_TO = 60  # photos


@dataclass(frozen=True)
class SfmSettings:
    """Settings of structure from motion.

    Attributes:
      matcher: which pairs are matched: "exhaustive" for all; "sequential" for
        neighbours in order of the names; "auto" for "exhaustive" with at most 60
        photos, else "sequential" (also for video).
      camera: which photos share their intrinsics: "single" for all; "per-image" for
        none; "auto" for those of equal size, camera and focal length (EXIF).
      camera_model: COLMAP's camera model that is estimated, of `CAMERA_MODELS`.
      max_size: longer side in px that photos are scaled down to, for the features and
        in the dataset; 0 for no limit.
      frames: number of frames to take from a video.
      masks: folder of masks; black pixels, and those where a photo is less than half
        opaque, are excluded. The mask of IMG.jpg is IMG.png, IMG.jpg or IMG.jpg.png.
      seed: seed of COLMAP's random numbers.
      undistort: whether to resample the photos to ideal pinholes; otherwise they keep
        their pixels and lenses.
      moving: whether the scene of a video moves: frames keep their times, and masks,
        which may then be given for frames by their names in the dataset, are used for
        the features only.
    """

    matcher: Literal["auto", "exhaustive", "sequential"] = "auto"
    camera: Literal["auto", "single", "per-image"] = "auto"
    camera_model: str = "SIMPLE_RADIAL"
    max_size: int = 1600
    frames: int = 100
    masks: Path | None = None
    seed: int = 0
    undistort: bool = False
    moving: bool = False


class _Job(NamedTuple):
    """Values that every step of a reconstruction takes."""

    work: WorkFolder
    output: Path
    seed: int
    progress: Progress
    seconds: dict[str, float]

    @contextmanager
    def timed(self, phase: str) -> Iterator[None]:
        start = time.monotonic()
        yield
        self.seconds[phase] = round(time.monotonic() - start, 2)


def run_sfm(
    source: Path,
    output: Path,
    settings: SfmSettings | None = None,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> SfmReport:
    """Find the cameras of photographs and write a dataset to train on.

    ``output`` gets ``images/`` (upright), ``masks/`` (for photographs that have one or
    are partly transparent), ``sparse/0/`` (COLMAP's binary model, with the lenses that
    were found, or PINHOLE cameras of undistorted photographs) and ``sfm.json``. They
    appear at the end, all or none; other files in the folder are kept.

    Args:
      source: a folder of photographs, or a video.
      output: folder of the dataset.
      settings: default `SfmSettings()`.
      overwrite: whether to replace a dataset that this function wrote.
      progress: called with lines of progress.

    Returns:
      The report; ``report.problem`` is not None if fewer than half of the images are
      registered.

    Raises:
      InputError: if a file or a setting is not valid.
      SfmError: if no model was found.
      MissingExtraError: if pycolmap or OpenCV is absent.
    """
    settings = SfmSettings() if settings is None else settings
    progress = (lambda _: None) if progress is None else progress
    colmap()
    _check(source, settings)
    check_output(output, (source, settings.masks), overwrite)
    with staging_folder(output) as stage, quiet_and_seeded(settings.seed):
        job = _Job(WorkFolder(stage), output, settings.seed, progress, {})
        with job.timed("photos"):
            photos = _collect(source, settings, job)
        matcher = settings.matcher
        if matcher == "auto":
            few = source.is_dir() and len(photos) <= EXHAUSTIVE_UP_TO
            matcher = "exhaustive" if few else "sequential"
        mapped = _solve(photos, settings.camera_model, matcher, job)
        models = {"": mapped.models[0], **_further_scenes(mapped.models)}
        masks = None if settings.masks is None else str(settings.masks)
        resolved = {**asdict(settings), "matcher": matcher, "masks": masks}
        report = SfmReport(
            source=str(source),
            output=str(output),
            settings=resolved,
            seconds=job.seconds,
            times=told_times(photos) if settings.moving else None,
            tried=mapped.tried,
            **statistics(models, photos, job.work.database),
        )
        dataset = stage / "dataset"
        dataset.mkdir()
        with job.timed("dataset"):
            verb = "undistorting" if settings.undistort else "writing"
            progress(f"{verb} {len(report.registered)} images")
            for place, model in models.items():
                write_dataset(
                    model,
                    photos,
                    job.work,
                    dataset / place,
                    undistort=settings.undistort,
                    moving=settings.moving,
                )
        facts = {**asdict(report), "pycolmap": colmap().__version__}
        write_json(dataset / "sfm.json", facts, indent=2)
        install_dataset(dataset, output, stage)
    return report


def _check(source: Path, settings: SfmSettings) -> None:
    if not source.exists():
        raise InputError(f"{source}: no such folder of photos or video; check the path")
    if settings.camera_model not in CAMERA_MODELS:
        raise InputError(
            f"camera_model: expected one of {', '.join(CAMERA_MODELS)}, got "
            f"{settings.camera_model!r}"
        )
    if settings.max_size and settings.max_size < 64:
        raise InputError(
            f"max_size: expected 0 or at least 64 px, got {settings.max_size}"
        )
    if settings.frames < 2:
        raise InputError(f"frames: expected at least 2, got {settings.frames}")
    if settings.moving and source.is_dir():
        raise InputError(
            f"{source}: moving needs a video, got a folder of photos, whose times are "
            "unknown; pass the video"
        )
    if settings.masks is not None and not (source.is_dir() or settings.moving):
        raise InputError(
            f"{source}: masks need a folder of photos, got a video; omit the masks"
        )


def _collect(source: Path, settings: SfmSettings, job: _Job) -> list[PreparedPhoto]:
    """Write the working files of the photographs, or of the frames of a video."""
    job.work.photos.mkdir()
    job.work.masks.mkdir()
    size = settings.max_size
    if source.is_dir():
        skipped = [path for path in (settings.masks, job.output) if path is not None]
        paths = find_photos(source, skipped)
        folders = len({path.parent for path in paths})
        where = f" of {folders} folders" if folders > 1 else ""
        job.progress(f"reading {len(paths)} photos{where}")
        found = prepare_photos(paths, settings.masks, job.work, size, source)
        masked = sum(photo.mask for photo in found)
        if masked or settings.masks is not None:
            job.progress(
                f"{masked} of {len(found)} photos have a mask or are partly transparent"
            )
    else:
        frames = sharpest_frames(source, settings.frames, size)  # rejects other files
        job.progress(f"choosing the sharpest {settings.frames} frames")
        found = []
        for number, pixels, seconds in frames:
            name = f"frame_{number:06d}.jpg"
            photo = job.work.add(number, name, pixels, None, "video")
            found.append(photo._replace(seconds=seconds))
        if settings.masks is not None:
            found = add_masks(found, settings.masks, job.work)
        if len(found) < 2:
            raise InputError(
                f"{source}: only {len(found)} frames can be read, expected at least 2; "
                "export the video again"
            )
    return _with_cameras(found, settings.camera)


def _with_cameras(photos: list[PreparedPhoto], choice: str) -> list[PreparedPhoto]:
    """Return the photographs with camera keys as chosen by `SfmSettings.camera`.

    Raises:
      InputError: if photographs of different sizes would share one camera.
    """
    if choice == "auto":
        return photos
    records = [photo.record for photo in photos]
    if choice == "per-image":
        changed = [record._replace(camera=record.file) for record in records]
    else:
        sizes = {(r.width, r.height): photo.name for r, photo in zip(records, photos)}
        if len(sizes) > 1:
            found = ", ".join(f"{name} is {w}x{h}" for (w, h), name in sizes.items())
            raise InputError(
                "--camera single: expected photos of one size, got "
                f"{found}; pass --camera auto"
            )
        focal = next((record.focal for record in records if record.focal), None)
        changed = [record._replace(camera="single", focal=focal) for record in records]
    return [photo._replace(record=record) for photo, record in zip(photos, changed)]


def _solve(
    photos: list[PreparedPhoto], camera_model: str, matcher: str, job: _Job
) -> Mapped:
    """Return the reconstructed models, largest first, and what was tried.

    Raises:
      SfmError: if there is none.
    """
    count, work = len(photos), job.work
    masks = work.masks if any(photo.mask for photo in photos) else None
    records = [photo.record for photo in photos]
    with job.timed("features"):
        job.progress(f"features of {count} images")
        extract_features(
            work.database, work.photos, masks, records, job.progress, camera_model
        )
    with job.timed("matching"):
        job.progress(f"matching, {matcher}")
        match_features(work.database, count, matcher, job.seed, job.progress)
    with job.timed("mapping"):
        job.progress("mapping")
        mapped = map_with_attempts(
            attempts_of(count, matcher, camera_model),
            work.database,
            (work.photos, work.folder / "models"),
            job.seed,
            job.progress,
            spent=sum(job.seconds.values()),
        )
    models = mapped.models
    placed = {image.name for model in models for image in model.images.values()}
    lost = {record.file for record in records} - placed
    if models and lost:
        with job.timed("second effort"):
            mapped = mapped._replace(models=_extended(models, lost, job))
    if models:
        return mapped
    most, pairs = match_summary(work.database)
    raise SfmError(
        f"no cameras could be found for the {count} images; {pairs} pairs of them "
        f"match, the best by {most} features; tried {'; '.join(mapped.tried)}; "
        f"{advice(matcher)}"
    )


def _extended(models: list[Any], missing: set[str], job: _Job) -> list[Any]:
    """Return the models, extended by images that are missing where that works."""
    work = job.work
    job.progress(f"trying again with {len(missing)} images that were not registered")
    pair_list = work.folder / "pairs"
    if not rematch_guided(work.database, missing, pair_list, job.seed, job.progress):
        return models
    groups, found = match_groups(work.database), []
    for number, model in enumerate(models):
        names = {image.name for image in model.images.values()}
        if not any(names & group and missing & group for group in groups):
            found.append(model)
            continue
        start = work.folder / f"start{number}"
        start.mkdir()
        model.write_binary(start)
        longer = map_incrementally(
            work.database,
            work.photos,
            work.folder / f"extended{number}",
            job.seed,
            job.progress,
            start=start,
            limits=MapperLimits(inliers=MIN_INLIERS_EXTENDED),
        )
        more = longer and longer[0].num_reg_images() > model.num_reg_images()
        found.append(longer[0] if more else model)
    return sorted(found, key=lambda model: -model.num_reg_images())


def _further_scenes(models: list[Any]) -> dict[str, Any]:
    """Return the models that show other images than the larger ones, by folder."""
    scenes: dict[str, Any] = {}
    placed = {image.name for image in models[0].images.values()}
    for model in models[1:]:
        files = {image.name for image in model.images.values()}
        if len(files - placed) > len(files) / 2:
            scenes[f"{SCENES}/{len(scenes) + 2}"] = model
            placed |= files
    return scenes
