"""Claim: training recovers the lens and the rolling shutter of the photographs.

``python benchmarks/calibration.py`` ray casts photographs of the still life of
`gsjax demo` through an OpenCV lens, and from cameras that turn during the exposure. It
trains (``--steps``, ``--seeds``) with the true cameras and with wrong ones that are
optimised with the scene: a focal length 2 % too long and no distortion, or cameras that
stand still (``--parts lens`` leaves these out). Poses are the true ones. The claim
holds if focal lengths are found to 0.2 %, k1 to 0.01 and the motion to 1 px, and if the
PSNR of held-out views is within 0.3 dB of that with the true cameras. Held-out views
have the refined intrinsics; their motions, which training does not see, are the true
ones.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace

import as_cli  # noqa: F401
import lens_training
import measure
import numpy as np
from scipy.spatial.transform import Rotation

from gsjax.data.extent import extent_of
from gsjax.data.splits import split_views
from gsjax.data.types import Dataset, Photo, View
from gsjax.runs.demo import demo_config
from gsjax.runs.refined_cameras import refine_dataset, refine_photos
from gsjax.synthetic.optics import Optics
from gsjax.synthetic.raycaster import surface_points
from gsjax.train.config import Level, TrainConfig
from gsjax.train.loop import subset

LENS = Optics("opencv", (-0.1, 0.02, 0.0, 0.0))
SHUTTER = "top_to_bottom"
TOO_LONG = 1.02
DISPLACEMENT = 20.0  # px over the exposure
# The motion is first found where it is few pixels long.
LEVELS = (Level(0.0, 8), Level(0.1, 4), Level(0.2, 2), Level(0.3, 1))
NO_LENS = dict.fromkeys(("focal off, %", "centre off, px", "k1 off", "k2 off"))
NO_MOTION = {"motion off, px": None, "largest, px": None}


def twists() -> list[np.ndarray]:
    """Return a turn of each camera about a direction of its image.

    The camera stays where it is, so that the translation changes along with the
    rotation.
    """
    viewmats, K = lens_training.equal_share(Optics())
    ways = np.random.default_rng(0).uniform(0, 2 * np.pi, len(viewmats))
    found = []
    for viewmat, way in zip(viewmats, ways):
        turn = DISPLACEMENT / K[0, 0] * np.array([np.cos(way), np.sin(way), 0])
        shift = Rotation.from_rotvec(turn).apply(viewmat[:3, 3]) - viewmat[:3, 3]
        found.append(np.concatenate([turn, shift]))
    return found


def with_twists(dataset: Dataset, chosen: list[int], motions) -> Dataset:
    """Return the dataset with the motions of some views; others stand still."""
    views = list(dataset.views)
    for index in chosen:
        views[index] = replace(views[index], twist=np.asarray(motions[index]))
    return replace(dataset, views=tuple(views))


def displaced(view: View, twist: np.ndarray | None) -> np.ndarray:
    """Return pixels [M, 2] of surface points after the exposure; NaN if outside."""
    twist = np.zeros(6) if twist is None else np.array(twist, float)
    points, _ = surface_points(500)
    rotation = Rotation.from_rotvec(twist[:3]).as_matrix() @ view.viewmat[:3, :3]
    local = points @ rotation.T + view.viewmat[:3, 3] + twist[3:]
    pixels = (local @ view.K.T)[:, :2] / local[:, 2:]
    inside = ((pixels > 0) & (pixels < lens_training.SIZE)).all(1)
    return np.where(inside[:, None], pixels, np.nan)


def motion_errors(true: Dataset, found: Dataset, chosen: list[int]) -> np.ndarray:
    """Return the mean distance in px at the last row, for each training view."""
    errors = []
    for view, refined in ((true.views[i], found.views[i]) for i in chosen):
        moved = displaced(view, view.twist) - displaced(view, refined.twist)
        errors.append(np.nanmean(np.linalg.norm(moved, axis=-1)))
    return np.asarray(errors)


def refined(
    result, dataset: Dataset, photos: list[Photo], config: TrainConfig
) -> tuple[Dataset, list[Photo]]:
    """Return the dataset and photos with the cameras that training found."""
    chosen, _ = split_views(dataset.views)
    extent = extent_of(subset(dataset, chosen))
    found = refine_dataset(dataset, chosen, result.state.refinement, extent, config)
    return found, refine_photos(photos, dataset.views, found.views)


def run(name: str, seed: int, case, config: TrainConfig):
    """Train, evaluate and return the row, the dataset and the photos found."""
    dataset, photos = case
    begun = time.perf_counter()
    result = lens_training.train(dataset, photos, config)
    seconds = time.perf_counter() - begun
    found, seen = refined(result, dataset, photos, config)
    return {"cameras": name, "seed": seed, "seconds": seconds}, result, found, seen


def lens_rows(capture, config: TrainConfig, seed: int) -> list[dict]:
    """Return the results with the true lens, and from a wrong one."""
    K = capture.K.copy()
    K[(0, 1), (0, 1)] *= TOO_LONG
    straight = LENS._replace(coefficients=(0.0,) * 4)
    wrong = capture.dataset(K, straight, seed)
    refining = config.replace(refine_intrinsics=True)
    cases = {
        "true lens": (capture.dataset(seed=seed), config),
        "wrong lens": (wrong, config),
        "wrong lens, refined": (wrong, refining),
    }
    rows = []
    for name, (case, its) in cases.items():
        row, result, found, seen = run(name, seed, case, its)
        row["psnr"] = lens_training.held_out(result, found, seen, its).psnr
        view = found.views[0]
        focal = view.K[(0, 1), (0, 1)] / capture.K[(0, 1), (0, 1)] - 1
        values = () if view.lens is None else view.lens.coefficients
        lens = np.subtract(values, LENS.coefficients)
        centre = view.K[:2, 2] - capture.K[:2, 2]
        off = {"focal off, %": 100 * np.abs(focal).max()}
        off |= {"centre off, px": np.abs(centre).max()}
        off |= {"k1 off": abs(lens[0]), "k2 off": abs(lens[1])}
        rows.append({**row, **off, **NO_MOTION})
        print(rows[-1], file=sys.stderr)
    return rows


def shutter_rows(capture, config: TrainConfig, seed: int) -> list[dict]:
    """Return the results with the true motions, and from cameras that stand still."""
    given, photos = capture.dataset(seed=seed)
    chosen, rest = split_views(given.views)
    motions = [optics.twist for optics in capture.optics]
    true = with_twists(given, [*chosen, *rest], motions)
    # Training does not see the motions of the held-out views.
    still = with_twists(given, rest, motions)
    still = with_twists(still, chosen, np.zeros((len(motions), 6)))
    config = config.replace(shutter=SHUTTER, levels=LEVELS)
    refining = config.replace(refine_shutter=True, shutter_rate=2e-3)
    cases = {
        "true motion": (true, config.replace(raster=refining.raster)),
        "no motion": (still, config.replace(raster=refining.raster)),
        "no motion, refined": (still, refining),
    }
    rows = []
    for name, (start, its) in cases.items():
        row, result, found, seen = run(name, seed, (start, photos), its)
        row["psnr"] = lens_training.held_out(result, found, seen, its).psnr
        errors = motion_errors(true, found, chosen)
        off = {"motion off, px": errors.mean(), "largest, px": errors.max()}
        rows.append({**row, **NO_LENS, **off})
        print(rows[-1], file=sys.stderr)
    return rows


def main(steps: int, seeds: int, parts: str) -> None:
    """Measure and save."""
    rows = []
    for seed in range(seeds):
        config, some = demo_config(steps, seed), []
        if "lens" in parts:
            some.append(lens_rows(lens_training.photograph(LENS), config, seed))
        if "shutter" in parts:
            moving = lens_training.photograph(Optics(shutter=SHUTTER), twists())
            some.append(shutter_rows(moving, config, seed))
        for part in some:
            for row in part:
                rows.append({**row, "over true, dB": row["psnr"] - part[0]["psnr"]})
    measure.save("calibration", rows, claim=__doc__, steps=steps)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--parts", default="lens and shutter")
    given, _ = parser.parse_known_args()
    main(given.steps, given.seeds, given.parts)
