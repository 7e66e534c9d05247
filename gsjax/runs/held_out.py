"""How well a run shows the views it did not see, and the files that tell of it."""

import time
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
    background_of,
    load_data,
    load_scene,
    load_settings,
    refined_data,
    run_files,
    saved_splat,
)
from gsjax.runs.refined_cameras import refined_photos
from gsjax.runtime.files import finite_or_none, make_folder, write_file, write_json
from gsjax.train.config import TrainConfig
from gsjax.train.evaluation import Summary, ViewResult, evaluate, summarise
from gsjax.train.health import is_seen
from gsjax.train.loop import subset

_PREVIEWED = 4


def evaluate_run(folder: Path, *, which: str = "test") -> Summary:
    """Evaluate a run anew from its `splat.ply`, and write what `run_files` names.

    Args:
      folder: of the run.
      which: "test", or "train", which is kept beside it.

    Raises:
      InputError: if there is no run or no such view, or they are masked altogether.
    """
    settings, files = load_settings(folder), run_files(folder, which)
    given = load_data(settings)
    data = refined_data(given, files)
    chosen = data.test if which == "test" else data.train
    if not chosen:
        raise InputError(
            f"no {which} views in this run; evaluate the others with --views "
            f"{'train' if which == 'test' else 'test'}"
        )
    gaussians = load_scene(saved_splat(folder), data.scene.origin)
    scene = subset(data.scene, chosen)
    before = subset(given.scene, chosen).views
    photos = load_photos(before, settings.config.max_size)
    photos = refined_photos(photos, before, scene.views)
    if not any(map(is_seen, photos)):
        raise InputError(
            f"all {len(photos)} {which} views of this run are masked altogether: there "
            "is nothing to measure; hold out others (--test-images)"
        )
    return write_evaluation(files, settings.config, gaussians, scene, photos, which)


def results_of(
    gaussians: Gaussians, scene: Dataset, photos: list[Photo], config: TrainConfig
):
    """`evaluate`, of all views of the scene as the run renders them."""
    return evaluate(
        gaussians,
        scene.views,
        photos,
        config=config.raster,
        background=background_of(config),
    )


def write_evaluation(
    files: RunFiles,
    config: TrainConfig,
    gaussians: Gaussians,
    scene: Dataset,
    photos: list[Photo],
    which: str,
) -> Summary:
    """Evaluate all views of ``scene``: numbers, renders and preview.

    Raises:
      InputError: if something cannot be written.
    """
    make_folder(files.renders)
    begun, results = time.perf_counter(), []
    names = short_names([view.name for view in scene.views])
    for name, result in zip(names, results_of(gaussians, scene, photos, config)):
        path = files.renders / f"{name}.png"
        make_folder(path.parent)
        write_file(path, images.encode_png(images.to_8_bit(result.render)))
        results.append(result)
    summary = summarise(results)
    told = {
        "which": which,
        **summary._asdict(),
        "psnr": finite_or_none(summary.psnr),
        "ssim": finite_or_none(summary.ssim),
        "seconds": round(time.perf_counter() - begun, 3),
        "gaussians": int(np.sum(gaussians.active)),
        "each": [_told(result) for result in results],
    }
    write_json(files.eval, told)
    _write_preview(files, results)
    return summary


def _told(result: ViewResult) -> dict:
    """Of one view, for JSON; PSNR null where the render is the photograph itself, both
    where no pixel counts.
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
    scene: Dataset,
    photos: list[Photo],
) -> None:
    """The preview alone, of the first views of ``scene``.

    Raises:
      InputError: if it cannot be written.
    """
    few = subset(scene, range(min(_PREVIEWED, len(scene.views))))
    shown = photos[: len(few.views)]
    _write_preview(files, list(results_of(gaussians, few, shown, config)))


def _write_preview(files: RunFiles, results: list[ViewResult]) -> None:
    few = np.unique(np.linspace(0, len(results) - 1, _PREVIEWED).astype(int))
    rows = [
        SheetRow(results[i].name, results[i].truth, results[i].render, results[i].depth)
        for i in few
    ]
    write_file(files.preview, images.encode_png(comparison(rows)))
