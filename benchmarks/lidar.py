"""Claim: training on lidar sweeps renders their ranges to a median of 1 %.

``python benchmarks/lidar.py`` casts the beams of a spinning lidar of 64 rows and 512
columns through the still life of the demo, from ten known poses. Beam directions follow
from elevation and azimuth by a formula, not from the lens of gsjax. Ranges have no
noise; the intensity is the mean albedo. Gaussians start at a subset of the returns of
eight sweeps and train on these with `gsjax.train.depth_loss.depth_term`, and with the
intensities as grey photographs. Two sweeps are held out.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple

import as_cli  # noqa: F401
import jax
import jax.numpy as jnp
import measure
import numpy as np

import gsjax
from gsjax.cameras.lenses import lidar_coefficients, lidar_lens
from gsjax.data.extent import scene_extent
from gsjax.data.types import Dataset, View
from gsjax.densify.adaptive import AdaptiveSettings
from gsjax.synthetic.raycaster import solids
from gsjax.train.depth_loss import depth_term
from gsjax.train.frames import Frames, draw, views_of_step
from gsjax.train.optimiser import Rates

ROWS, COLUMNS = 64, 512
# Denser near the horizon, as those of many lidars; radians.
ELEVATIONS = np.radians(15 - 50 * np.linspace(0, 1, ROWS) ** 1.3)
# Clockwise, from behind.
AZIMUTHS = np.pi - 2 * np.pi * (np.arange(COLUMNS) + 0.5) / COLUMNS
K = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
POINTS, STEPS = 30_000, 400
# Position and heading, pitch and roll in degrees.
TRAINING = [
    ((1.90, 0.00, 0.80), (170, 2, 0)),
    ((1.20, 1.20, 0.60), (-120, 0, 3)),
    ((-0.10, 1.70, 0.85), (-95, -3, 1)),
    ((-1.25, 1.00, 0.60), (-30, 1, -2)),
    ((-1.75, -0.30, 0.80), (10, 3, 2)),
    ((-0.90, -1.40, 0.60), (60, -2, 0)),
    ((0.40, -1.65, 0.80), (95, 0, -3)),
    ((-0.05, 0.05, 0.90), (40, 2, 2)),
]
HELD_OUT = [
    ((1.60, 0.70, 0.70), (-150, -2, 1)),
    ((-0.60, 1.50, 0.75), (-70, 1, -1)),
]


class Sweep(NamedTuple):
    """A sweep of the lidar.

    Attributes:
      viewmat: [4, 4] world → camera.
      ranges: [ROWS, COLUMNS], 0 where there is no return.
      intensity: [ROWS, COLUMNS] in [0, 1].
      points: [M, 3] returns in world coordinates.
    """

    viewmat: np.ndarray
    ranges: np.ndarray
    intensity: np.ndarray
    points: np.ndarray

    @property
    def hit(self) -> np.ndarray:
        """Beams with a return, [ROWS, COLUMNS]."""
        return self.ranges > 0


def rotation(heading: float, pitch: float, roll: float) -> np.ndarray:
    """Return lidar (forward, left, up) → world [3, 3] of angles in degrees."""
    (a, b, c), (x, y, z) = np.cos(r := np.radians((heading, pitch, roll))), np.sin(r)
    turn = np.array([[a, -x, 0], [x, a, 0], [0, 0, 1]])
    nod = np.array([[b, 0, y], [0, 1, 0], [-y, 0, b]])
    return turn @ nod @ np.array([[1, 0, 0], [0, c, -z], [0, z, c]])


def cast(place: tuple[float, ...], angles: tuple[float, ...]) -> Sweep:
    """Return the sweep of a lidar at a place with a heading, pitch and roll."""
    origin, to_world = np.array(place), rotation(*angles)
    elevation, azimuth = np.meshgrid(ELEVATIONS, AZIMUTHS, indexing="ij")
    flat = np.cos(elevation)
    beams = flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)
    directions = to_world @ np.stack(beams).reshape(3, -1)
    ranges, shade = np.full(ROWS * COLUMNS, np.inf), np.zeros(ROWS * COLUMNS)
    for solid in solids():
        offset = origin - solid.centre
        t = solid.shape.hit(solid.axes.T @ offset, solid.axes.T @ directions)
        nearer = t < ranges
        ranges[nearer] = t[nearer]
        points = origin[:, None] + t[nearer] * directions[:, nearer]
        shade[nearer] = solid.albedo(solid.local(points)).mean(0)
    hit = np.isfinite(ranges)
    points = (origin[:, None] + ranges[hit] * directions[:, hit]).T
    viewmat = np.eye(4)
    # The camera's x, y, z are the lidar's right, down and forward.
    viewmat[:3, :3] = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]) @ to_world.T
    viewmat[:3, 3] = -viewmat[:3, :3] @ origin
    ranges = np.where(hit, ranges, 0).reshape(ROWS, COLUMNS)
    return Sweep(viewmat, ranges, shade.reshape(ROWS, COLUMNS), points)


def camera_of(sweeps: list[Sweep]) -> gsjax.Camera:
    """Return the batch of cameras of sweeps."""
    return gsjax.make_camera(
        viewmat=np.stack([sweep.viewmat for sweep in sweeps]),
        K=K,
        width=COLUMNS,
        height=ROWS,
        lens=lidar_lens(ROWS, COLUMNS),
        coefficients=lidar_coefficients(ELEVATIONS, AZIMUTHS),
    )


def frames_of(sweeps: list[Sweep]) -> Frames:
    """Return the intensities as grey photographs."""
    grey = np.stack([np.rint(255 * sweep.intensity) for sweep in sweeps])
    pixels = np.repeat(grey[..., None], 3, -1).astype(np.uint8)
    return Frames(jnp.asarray(pixels), None, camera_of(sweeps))


def start(sweeps: list[Sweep]) -> gsjax.Gaussians:
    """Return Gaussians at a random subset of the returns."""
    points = np.concatenate([sweep.points for sweep in sweeps])
    shades = np.concatenate([sweep.intensity[sweep.hit] for sweep in sweeps])
    chosen = np.random.default_rng(0).choice(len(points), POINTS, replace=False)
    colors = np.rint(255 * np.repeat(shades[chosen, None], 3, 1)).astype(np.uint8)
    views = tuple(
        View(f"{i}", Path(f"{i}"), sweep.viewmat, K, COLUMNS, ROWS)
        for i, sweep in enumerate(sweeps)
    )
    dataset = Dataset(Path("sweeps"), "arrays", views, points[chosen], colors)
    return gsjax.init_gaussians(dataset, sh_degree=0, opacity=0.8, scale=0.8)


def judge(gaussians: gsjax.Gaussians, sweeps: list[Sweep]) -> dict[str, float]:
    """Return errors of range, hit and intensity over all beams of sweeps."""
    camera = camera_of(sweeps)
    single = [jax.tree.map(lambda a, i=i: a[i], camera) for i in range(len(sweeps))]
    views = [gsjax.render_exact(gaussians, one) for one in single]
    depth, alpha, rgb = (
        np.stack([np.asarray(getattr(view, name)) for view in views])
        for name in ("depth", "alpha", "rgb")
    )
    ranges = np.stack([sweep.ranges for sweep in sweeps])
    hit = ranges > 0
    error = np.abs(depth - ranges)[hit] / ranges[hit]
    intensity = np.stack([sweep.intensity for sweep in sweeps])
    square = np.square(np.clip(rgb.mean(-1), 0, 1) - intensity)
    return {
        "range error, median %": 100 * float(np.median(error)),
        "90th percentile %": 100 * float(np.percentile(error, 90)),
        "hit or miss right %": 100 * float(((alpha > 0.5) == hit).mean()),
        "intensity PSNR, dB": -10 * float(np.log10(square.mean())),
    }


def train(
    gaussians: gsjax.Gaussians, sweeps: list[Sweep]
) -> tuple[gsjax.Gaussians, float]:
    """Return the trained Gaussians, and the seconds of the steps with compilation."""
    frames = frames_of(sweeps)
    raster = gsjax.exact_config(gaussians, frames.camera)
    raster = raster.replace(pair_capacity=2 * (raster.pair_capacity or 1))
    config = gsjax.TrainConfig(
        steps=STEPS,
        sh_degree=0,
        background="black",
        strategy="adaptive",
        adaptive=AdaptiveSettings(start=STEPS, stop=STEPS, reset_every=0),
        rates=Rates(cooling=0.1, cooling_from=0.3).times(4.0),
        raster=raster,
    )
    centres = np.stack([-s.viewmat[:3, :3].T @ s.viewmat[:3, 3] for s in sweeps])
    extent = scene_extent(centres)
    ranges = [sweep.ranges for sweep in sweeps]
    terms = [depth_term(ranges, hit_weight=0.2)]
    step = jax.jit(
        gsjax.make_train_step(config, extent, loss_terms=terms), donate_argnums=0
    )
    state = gsjax.init_state(gaussians, config, extent, len(sweeps))
    begun = time.perf_counter()
    for index in range(STEPS):
        view = jnp.asarray(views_of_step(0, index, 1, len(sweeps)))
        state, metrics = step(state, draw(frames, view))
        if index % 50 == 49:
            assert not metrics.overflowed
            print(index + 1, f"{metrics.loss:.4f} {metrics.psnr:.2f} dB",
                  f"{time.perf_counter() - begun:.0f} s", flush=True)  # fmt: skip
    return state.gaussians, time.perf_counter() - begun


def main() -> None:
    """Measure and save."""
    sweeps = [cast(*pose) for pose in TRAINING]
    held_out = [cast(*pose) for pose in HELD_OUT]
    initial, rows = start(sweeps), []

    def add(stage: str, gaussians: gsjax.Gaussians, seconds: float) -> None:
        for kind, judged in (("training", sweeps), ("held out", held_out)):
            found = judge(gaussians, judged)
            rows.append({"stage": stage, "sweeps": kind, **found, "seconds": seconds})
            print(rows[-1], flush=True)

    add("initial", initial, 0.0)
    # Steps donate their state.
    add("trained", *train(jax.tree.map(jnp.copy, initial), sweeps))
    measure.save("lidar", rows, claim=__doc__)


if __name__ == "__main__":
    main()
