"""Evaluation of a run on its held-out or training views, and the files it writes."""

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gsjax.data.image_files import short_names
from gsjax.data.photos import load_photos
from gsjax.data.types import Dataset, Photo
from gsjax.errors import InputError
from gsjax.gaussians import Gaussians
from gsjax.io import images
from gsjax.plots.contact_sheets import SheetRow, comparison
from gsjax.runs.folder import (
    RunFiles,
    background_color,
    load_scene,
    load_settings,
    load_split,
    require_splat,
    run_files,
    with_refined_cameras,
)
from gsjax.runs.refined_cameras import refine_photos
from gsjax.runtime.files import finite_or_none, make_folder, write_file, write_json
from gsjax.train.config import TrainConfig
from gsjax.train.evaluation import Summary, ViewResult, evaluate, summarise
from gsjax.train.health import has_valid_pixels
from gsjax.train.loop import subset

_PREVIEWED = 4


def evaluate_run(folder: Path, *, which: str = "test") -> Summary:
    """Evaluate the `splat.ply` of a run and write the files of `run_files`.

    Args:
      folder: folder of the run.
      which: "test" or "train" views; the files of the latter have names of their own.

    Raises:
      InputError: if the folder is no run, or has no such view with a visible pixel.
    """
    settings, files = load_settings(folder), run_files(folder, which)
    given = load_split(settings)
    split = with_refined_cameras(given, files)
    chosen = split.test if which == "test" else split.train
    if not chosen:
        other = "train" if which == "test" else "test"
        raise InputError(
            f"{folder}: the run has no {which} views; pass --views {other}"
        )
    gaussians = load_scene(require_splat(folder), split.dataset.origin)
    dataset = subset(split.dataset, chosen)
    before = subset(given.dataset, chosen).views
    photos = load_photos(before, settings.config.max_size)
    photos = refine_photos(photos, before, dataset.views)
    if not any(map(has_valid_pixels, photos)):
        raise InputError(
            f"{folder}: all {len(photos)} {which} views are fully masked; hold out "
            "others (--test-images)"
        )
    return write_evaluation(files, settings.config, gaussians, dataset, photos, which)


def evaluate_views(
    gaussians: Gaussians, dataset: Dataset, photos: list[Photo], config: TrainConfig
) -> Iterator[ViewResult]:
    """Evaluate all views of ``dataset`` with the render settings of a run."""
    return evaluate(
        gaussians,
        dataset.views,
        photos,
        config=config.raster,
        background=background_color(config),
    )


def write_evaluation(
    files: RunFiles,
    config: TrainConfig,
    gaussians: Gaussians,
    dataset: Dataset,
    photos: list[Photo],
    which: str,
) -> Summary:
    """Evaluate all views of ``dataset``; write numbers, renders and preview.

    Raises:
      InputError: if a file cannot be written.
    """
    make_folder(files.renders)
    start, results = time.perf_counter(), []
    names = short_names([view.name for view in dataset.views])
    for name, result in zip(names, evaluate_views(gaussians, dataset, photos, config)):
        path = files.renders / f"{name}.png"
        make_folder(path.parent)
        write_file(path, images.encode_png(images.to_8_bit(result.render)))
        results.append(result)
    summary = summarise(results)
    content = {
        "which": which,
        **summary._asdict(),
        "psnr": finite_or_none(summary.psnr),
        "ssim": finite_or_none(summary.ssim),
        "seconds": round(time.perf_counter() - start, 3),
        "gaussians": int(np.sum(gaussians.active)),
        "each": [_record(result) for result in results],
    }
    write_json(files.eval, content)
    _write_preview(files, results)
    return summary


def _record(result: ViewResult) -> dict:
    """Return one view as JSON.

    PSNR is null if the render equals the photograph; both metrics are null if every
    pixel is masked.
    """
    return {
        "name": result.name,
        "psnr": finite_or_none(result.psnr),
        "ssim": finite_or_none(result.ssim),
        "size": result.depth.shape[::-1],
    }


def write_preview(
    files: RunFiles,
    config: TrainConfig,
    gaussians: Gaussians,
    dataset: Dataset,
    photos: list[Photo],
) -> None:
    """Write only the preview, of the first views of ``dataset``.

    Raises:
      InputError: if it cannot be written.
    """
    few = subset(dataset, range(min(_PREVIEWED, len(dataset.views))))
    results = evaluate_views(gaussians, few, photos[: len(few.views)], config)
    _write_preview(files, list(results))


def _write_preview(files: RunFiles, results: list[ViewResult]) -> None:
    few = np.unique(np.linspace(0, len(results) - 1, _PREVIEWED).astype(int))
    rows = [
        SheetRow(results[i].name, results[i].truth, results[i].render, results[i].depth)
        for i in few
    ]
    write_file(files.preview, images.encode_png(comparison(rows)))
