"""Scenes that the benchmarks share, as `Gaussians` with a `Camera`.

Real data are in ``shared/data`` beside the checkout and are not part of it; without
them, only the synthetic scenes exist.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

import gsjax
from gsjax.bench.scenes import facing_camera
from gsjax.math.sh import rgb_to_dc

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


class Case(NamedTuple):
    """A scene and a view of it."""

    name: str
    gaussians: gsjax.Gaussians
    camera: gsjax.Camera


def _gaussians(means, quats, scales, opacities, colors) -> gsjax.Gaussians:
    return gsjax.make_gaussians(
        means=means,
        quats=quats,
        log_scales=np.log(scales),
        logit_opacities=np.log(opacities) - np.log1p(-opacities),
        sh=rgb_to_dc(colors)[:, None],
    )


def guitar() -> Case:
    """Return guitar.ply, a trained scene of 91 k Gaussians, at 800 × 600."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # 667 opacities of +inf are clamped
        gaussians = gsjax.load(DATA / "guitar" / "guitar.ply")
    return Case("guitar", gaussians, facing_camera(gaussians, 800, 600))


def garden(count: int = 100_000, opacity: float = 0.1) -> Case:
    """Return SfM points of the garden, as training starts, at 648 × 420."""
    data = np.load(DATA / "garden" / "garden.npz", allow_pickle=False)
    rng = np.random.default_rng(0)
    chosen = rng.permutation(len(data["means3d"]))[:count]
    means = data["means3d"][chosen].astype(np.float64)
    spacing = cKDTree(means).query(means, 4)[0][:, 1:]
    scale = np.sqrt(np.mean(spacing**2, axis=1))
    gaussians = _gaussians(
        means,
        rng.normal(size=(count, 4)),
        np.repeat(scale[:, None], 3, axis=1),
        np.full(count, opacity),
        data["colors"][chosen] / 255,
    )
    camera = gsjax.make_camera(
        viewmat=data["viewmats"][0], K=data["Ks"][0], width=648, height=420
    )
    return Case("garden", gaussians, camera)


def shell(count: int, width: int, height: int, seed: int = 0) -> Case:
    """Return flat splats on a bumpy sphere around the origin, as after training.

    Three quarters lie on the surface with high opacity, a quarter is faint and
    scattered. The splats shrink with the count, so that the surface is covered about
    four times.
    """
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    radius = 1 + 0.1 * np.sin(5 * normal[:, :1]) * np.cos(4 * normal[:, 1:2])
    faint = rng.random(count) < 0.25
    radius = np.where(faint[:, None], rng.uniform(0.2, 1.4, (count, 1)), radius)
    size = 2.0 / np.sqrt(count) * np.exp(rng.normal(0, 0.4, (count, 1)))
    scales = size * np.array([1, 0.7, 0.15]) * np.exp(rng.normal(0, 0.2, (count, 3)))
    # The rotation that takes z to the normal: the half-way quaternion.
    quats = np.stack(
        [1 + normal[:, 2], -normal[:, 1], normal[:, 0], np.zeros(count)], axis=1
    )
    quats += 1e-6
    opacity = np.where(faint, rng.uniform(0.02, 0.3, count), rng.beta(4, 1.5, count))
    gaussians = _gaussians(
        normal * radius,
        quats,
        scales,
        np.clip(opacity, 0.01, 0.995),
        0.5 + 0.45 * np.sin(4 * normal + rng.normal(0, 0.1, (count, 3))),
    )
    focal = 1.1 * min(width, height)
    camera = gsjax.make_camera(
        viewmat=gsjax.look_at((0.4, -2.6, 0.8), (0, 0, 0)),
        K=[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]],
        width=width,
        height=height,
    )
    return Case(f"shell-{count}", gaussians, camera)


class Run(NamedTuple):
    """Contents of a run folder.

    Attributes:
      gaussians: its scene.
      seen: the training cameras.
      between: 400 cameras on a smooth path through them.
    """

    gaussians: gsjax.Gaussians
    seen: list[gsjax.Camera]
    between: list[gsjax.Camera]


def of_run(folder: Path) -> Run:
    """Load the scene and the cameras of a run of ``gsjax train``."""
    from gsjax.runs.folder import load_scene, load_settings, load_split, run_files
    from gsjax.runs.trajectories import CAMERA_PATHS, path_entries, view_entries

    settings = load_settings(folder)
    split = load_split(settings)
    size = settings.config.max_size
    seen = view_entries(split.views("train"), max_size=size)
    path = CAMERA_PATHS["interpolate"]
    between = path_entries(split.dataset, path, frames=400, max_size=size)
    return Run(
        load_scene(run_files(folder).splat, split.dataset.origin),
        [entry.camera for entry in seen],
        [entry.camera for entry in between],
    )


def real_cases(runs: Iterable[str] = ()) -> list[Case]:
    """Return guitar and garden if present, else a synthetic stand-in.

    One view of each run folder is added.
    """
    cases = [shell(90_000, 800, 600)]
    if (DATA / "guitar").is_dir():
        cases = [guitar(), garden()]
    for folder in runs:
        run = of_run(Path(folder))
        cases.append(Case(Path(folder).name, run.gaussians, run.between[0]))
    return cases
