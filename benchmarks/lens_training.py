"""Claim: training through a lens is as good as training on an ideal pinhole.

``python benchmarks/lens_training.py`` ray casts 40 photographs of the still life of
`gsjax demo` through a pinhole, an OpenCV lens and a fisheye, with OpenCV's own inverse
of each lens. It trains on 35 of each with the demo's settings (``--steps``,
``--seeds``), and compares the other five, through the lens they were taken with. Focal
lengths differ so that the still life fills an equal share of the photographs. In
"undistorted", photographs are resampled to pinholes before training; the held-out ones
are not. The claim holds if lenses differ by less than 0.1 dB from the pinhole.

``python benchmarks/lens_training.py DATASET...`` compares training through the lens
with training on undistorted photographs, on datasets of ``gsjax sfm``. Held-out
photographs are compared both as they were taken and undistorted.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import as_cli  # noqa: F401
import measure
import numpy as np

import gsjax
from gsjax.data.photos import undistort_photo
from gsjax.data.splits import split_views
from gsjax.data.types import Dataset, Photo
from gsjax.runs.demo import demo_config
from gsjax.synthetic import raycaster
from gsjax.synthetic.optics import Optics
from gsjax.train.config import TrainConfig, preset, scaled
from gsjax.train.evaluation import Summary, evaluate, summarise
from gsjax.train.loop import FitResult, fit, subset

PHOTOS, SIZE, POINTS = 40, (320, 240), 5000
OPTICS = (
    Optics(),
    Optics("opencv", (-0.25, 0.06, 0.001, -0.001)),
    Optics("fisheye", (0.05, -0.01, 0.0, 0.0)),
)


class Capture(NamedTuple):
    """Photographs of the still life, with their true cameras.

    Attributes:
      images: [H, W, 3] float32 each.
      viewmats: [4, 4] each.
      K: [3, 3].
      optics: one for each photograph.
    """

    images: list[np.ndarray]
    viewmats: list[np.ndarray]
    K: np.ndarray
    optics: list[Optics]

    def dataset(self, K=None, lens: Optics | None = None, seed: int = 0):
        """Return the dataset and photos, with the true cameras or others.

        Args:
          K: intrinsics other than the true ones.
          lens: a lens other than the true one.
          seed: of the points.
        """
        lens = lens or self.optics[0]
        cameras = gsjax.make_camera(
            viewmat=np.stack(self.viewmats),
            K=self.K if K is None else K,
            width=SIZE[0],
            height=SIZE[1],
            lens=lens.lens,
            coefficients=None if lens.lens == "pinhole" else lens.coefficients,
        )
        points = raycaster.surface_points(POINTS, seed)
        return gsjax.make_dataset(self.images, cameras, *points)


def photograph(optics: Optics, twists: Sequence | None = None) -> Capture:
    """Cast the photographs; ``twists`` are the motions of the cameras, if any."""
    viewmats, K = equal_share(optics._replace(shutter="global"))
    each = [optics] * PHOTOS
    if twists is not None:
        each = [optics._replace(twist=twist) for twist in twists]
    images = [
        raycaster.cast(viewmat, K, *SIZE, 2, optics=its)[0]
        for viewmat, its in zip(viewmats, each)
    ]
    return Capture(images, viewmats, K, each)


def equal_share(optics: Optics) -> tuple[list[np.ndarray], np.ndarray]:
    """Return view matrices, and K with which the still life is as large as usual."""
    viewmats, K = raycaster.demo_cameras(PHOTOS, *SIZE)

    def share(optics: Optics, K: np.ndarray) -> float:
        small = np.diag([0.25, 0.25, 1]) @ K
        size = SIZE[0] // 4, SIZE[1] // 4
        casts = [
            raycaster.cast(v, small, *size, 1, optics=optics) for v in viewmats[::4]
        ]
        return float(np.mean([depth > 0 for _, depth in casts]))

    usual, factor = share(Optics(), K), 1.0
    for _ in range(3 if optics.lens != "pinhole" else 0):
        scaled = np.diag([factor, factor, 1])
        scaled[:2, 2] = (1 - factor) * K[:2, 2]
        factor *= np.sqrt(usual / share(optics, scaled @ K))
    K = K.copy()
    K[(0, 1), (0, 1)] *= factor
    return viewmats, K


def train(dataset: Dataset, photos: Sequence[Photo], config: TrainConfig) -> FitResult:
    """Train on the training views."""
    chosen, _ = split_views(dataset.views)
    return fit(subset(dataset, chosen), [photos[i] for i in chosen], config)


def held_out(
    result: FitResult, dataset: Dataset, photos: Sequence[Photo], config: TrainConfig
) -> Summary:
    """Return PSNR and SSIM of the held-out views."""
    _, rest = split_views(dataset.views)
    views = [dataset.views[i] for i in rest]
    shown = [photos[i] for i in rest]
    options = {"config": config.raster, "shutter": config.shutter}
    return summarise(evaluate(result.gaussians, views, shown, **options))


def rows_of(capture: Capture, steps: int, seed: int) -> list[dict]:
    """Return the results of one lens, with and without undistortion."""
    dataset, photos = capture.dataset(seed=seed)
    lens = capture.optics[0].lens
    ways = {"": photos}
    if lens == "opencv":
        ways[", undistorted"] = [
            undistort_photo(view.name, photo)
            for view, photo in zip(dataset.views, photos)
        ]
    config, rows = demo_config(steps, seed), []
    for name, seen in ways.items():
        begun = time.perf_counter()
        result = train(dataset, seen, config)
        seconds = time.perf_counter() - begun
        found = held_out(result, dataset, photos, config)
        row = {"photographs": lens + name, "seed": seed, "psnr": found.psnr}
        row |= {"ssim": found.ssim, "gaussians": int(result.gaussians.active.sum())}
        rows.append({**row, "focal": capture.K[0, 0], "seconds": seconds})
        print(rows[-1], file=sys.stderr)
    return rows


def photo_rows(folder: str, steps: int, seed: int) -> list[dict]:
    """Return the results of a dataset, through its lens and undistorted."""
    config = scaled(preset("fast"), steps).replace(seed=seed)
    dataset = gsjax.load_dataset(folder)
    photos = gsjax.load_photos(dataset.views, config.max_size)
    straight = [
        undistort_photo(view.name, photo) for view, photo in zip(dataset.views, photos)
    ]
    rows = []
    for name, seen in {"lens": photos, "undistorted": straight}.items():
        result = train(dataset, seen, config)
        row = {"dataset": Path(folder).name, "training": name, "seed": seed}
        row["psnr"] = held_out(result, dataset, photos, config).psnr
        row["psnr, undistorted"] = held_out(result, dataset, straight, config).psnr
        rows.append({**row, "gaussians": int(result.gaussians.active.sum())})
        print(rows[-1], file=sys.stderr)
    return rows


def main(steps: int, seeds: int) -> None:
    """Measure and save."""
    rows = []
    for optics in OPTICS:
        capture = photograph(optics)
        for seed in range(seeds):
            rows += rows_of(capture, steps, seed)
    for row in rows:
        (usual,) = (r["psnr"] for r in rows[:seeds] if r["seed"] == row["seed"])
        row["over pinhole, dB"] = row["psnr"] - usual
    measure.save("lens_training", rows, claim=__doc__, steps=steps)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("datasets", nargs="*")
    given = parser.parse_args()
    if given.datasets:
        rows = [
            row
            for folder in given.datasets
            for seed in range(given.seeds)
            for row in photo_rows(folder, given.steps, seed)
        ]
        measure.save("lens_photos", rows, claim=__doc__, steps=given.steps)
    else:
        main(given.steps, given.seeds)
