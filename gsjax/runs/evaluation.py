"""Evaluation of a run on its held-out or training views, and the files it writes."""

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gsjax.data.image_files import short_names
from gsjax.data.photos import load_photos
from gsjax.data.types import Dataset, Photo
from gsjax.errors import InputError
from gsjax.io import images
from gsjax.plots.contact_sheets import SheetRow, comparison
from gsjax.runs import folder as run_folder
from gsjax.runs.folder import RunFiles
from gsjax.runs.moving import load_moving
from gsjax.runs.refined_cameras import refine_photos
from gsjax.runtime.files import finite_or_none, make_folder, write_file, write_json
from gsjax.train.config import TrainConfig
from gsjax.train.evaluation import Summary, ViewResult, evaluate, summarise
from gsjax.train.health import has_valid_pixels
from gsjax.train.loop import subset
from gsjax.train.motion.scene import Scene, gaussians_at

PREVIEWED = 4  # views in a preview


def evaluate_run(folder: Path, *, which: str = "test") -> Summary:
    """Evaluate the `splat.ply` of a run and write the files of `run_files`.

    ``which`` are the "test" or "train" views; the latter have files of their own.

    Raises:
      InputError: if the folder is no run, or has no such view with a visible pixel.
    """
    settings = run_folder.load_settings(folder)
    files = run_folder.run_files(folder, which)
    given = run_folder.load_split(settings)
    split = run_folder.with_refined_cameras(given, files)
    chosen = split.test if which == "test" else split.train
    if not chosen:
        other = "train" if which == "test" else "test"
        fault = f"the run has no {which} views; pass --views {other}"
        raise InputError(f"{folder}: {fault}")
    splat, origin = run_folder.require_splat(folder), split.dataset.origin
    if settings.config.motion == "none":
        scene = run_folder.load_scene(splat, origin)
    else:
        scene = load_moving(files.motion, settings.config, origin)
    dataset = subset(split.dataset, chosen)
    before = subset(given.dataset, chosen).views
    config = settings.config
    photos = load_photos(before, config.max_size, undistort=config.undistort)
    photos = refine_photos(photos, before, dataset.views)
    if not any(map(has_valid_pixels, photos)):
        fault = f"all {len(photos)} {which} views are fully masked"
        raise InputError(f"{folder}: {fault}; hold out others (--test-images)")
    return write_evaluation(files, config, scene, dataset, photos, which)


def evaluate_views(
    scene: Scene, dataset: Dataset, photos: list[Photo], config: TrainConfig
) -> Iterator[ViewResult]:
    """Evaluate all views of ``dataset`` with the render settings of a run."""
    background = run_folder.background_color(config)
    return evaluate(
        scene,
        dataset.views,
        photos,
        config=config.raster,
        background=background,
        shutter=config.shutter,
    )


def write_evaluation(
    files: RunFiles,
    config: TrainConfig,
    scene: Scene,
    dataset: Dataset,
    photos: list[Photo],
    which: str,
) -> Summary:
    """Evaluate all views; write numbers, renders and preview, as `write_file`."""
    make_folder(files.renders)
    start, results = time.perf_counter(), []
    names = short_names([view.name for view in dataset.views])
    for name, result in zip(names, evaluate_views(scene, dataset, photos, config)):
        path = files.renders / f"{name}.png"
        make_folder(path.parent)
        write_file(path, images.encode_png(images.to_8_bit(result.render)))
        results.append(result)
    summary = summarise(results)
    # PSNR of a view is null without errors; both are null if every pixel is masked.
    each = [
        {
            "name": result.name,
            "psnr": finite_or_none(result.psnr),
            "ssim": finite_or_none(result.ssim),
            "size": result.depth.shape[::-1],
        }
        for result in results
    ]
    content = {
        "which": which,
        **summary._asdict(),
        "psnr": finite_or_none(summary.psnr),
        "ssim": finite_or_none(summary.ssim),
        "seconds": round(time.perf_counter() - start, 3),
        "gaussians": int(np.sum(gaussians_at(scene, 0.0).active)),
        "each": each,
    }
    write_json(files.eval, content)
    write_preview(files, results)
    return summary


def write_preview(files: RunFiles, results: list[ViewResult]) -> None:
    """Write the preview of some of the evaluated views; as `write_file`."""
    few = np.unique(np.linspace(0, len(results) - 1, PREVIEWED).astype(int))
    rows = [
        SheetRow(results[i].name, results[i].truth, results[i].render, results[i].depth)
        for i in few
    ]
    write_file(files.preview, images.encode_png(comparison(rows)))
