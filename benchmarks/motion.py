"""Claim: motion gains ≥ 6 dB where things move, and costs ≤ 0.5 dB where they do not.

``python benchmarks/motion.py quality`` makes the datasets of ``gsjax demo --moving``,
with eight fixed cameras and one that travels, and of ``--monocular``, with that one
alone. It trains each without motion and with both motions, by the demo's settings, and
compares held-out photographs, whose viewpoints and times are both new. A pixel moves if
its true colour varies by more than 0.05 over 17 times; this includes shadows, and what
is uncovered. Means of squared errors are taken over all such pixels. Aims: for several
cameras ≥ 6 dB more than the still scene where it moves, ≥ −0.5 dB where it does not,
≥ 30 dB in all, within 300 s; for one camera ≥ 3 dB more where it moves.

``python benchmarks/motion.py time`` compares, at 30,000 Gaussians and in turns, a
training step at 400 × 300 px with that of a still scene (aims: ≤ 1.3 × with
trajectories, ≤ 2 × with a field, of which all or, as after the search for what is
still, 40 % move); a picture of 800 × 600 px at a time with a still one (≤ 1.15 ×); and
such a picture of 30,000 Gaussians with as many more that are not alive, or that are
(aim: the former cost ≤ 0.2 × of the latter).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from typing import Any

import as_cli  # noqa: F401
import jax
import jax.numpy as jnp
import measure
import numpy as np

import gsjax
from gsjax.data.extent import extent_of
from gsjax.data.photos import load_photos
from gsjax.data.splits import split_views
from gsjax.data.types import Dataset, Photo, View
from gsjax.gaussians import Gaussians
from gsjax.raster.exact import exact_config, render_exact
from gsjax.runs.moving_demo import STEPS, moving_demo_config
from gsjax.runtime.devices import replicate
from gsjax.synthetic.moving import (
    Moment,
    MovingDemoSettings,
    moving_photograph,
    moving_solids,
    write_moving_dataset,
)
from gsjax.synthetic.raycaster import surface_points
from gsjax.train.capacity_policy import capacities_for
from gsjax.train.config import TrainConfig
from gsjax.train.frames import draw, make_frames
from gsjax.train.loop import FitResult, fit, subset
from gsjax.train.models import ViewInfo
from gsjax.train.state import TrainState, make_setup, setup_state
from gsjax.train.step import make_stages

WAYS = ("none", "trajectories", "field")
SETS = {
    "several cameras": MovingDemoSettings(),
    "one camera": MovingDemoSettings(cameras=0, photos=96),
}
TIMES, VARIES = 17, 0.05
COUNT, MOVING_SHARE = 30_000, 0.4
REPEATS = 40


def moving_pixels(view: View) -> np.ndarray:
    """Return [H, W] bool: the pixels whose true colour varies over time."""
    size = view.width, view.height
    moments = [Moment(view.viewmat, t) for t in np.linspace(0, 1, TIMES).tolist()]
    casts = np.stack([moving_photograph(moment, size, 1) for moment in moments])
    return np.ptp(casts, 0).max(-1) > VARIES


def decibels(errors: list[np.ndarray]) -> float:
    """Return the PSNR of squared errors [n, 3] of several views together."""
    return float(-10 * np.log10(np.concatenate(errors).mean()))


def camera_of(view: View, photo: Photo) -> gsjax.Camera:
    size = {"width": view.width, "height": view.height}
    return gsjax.make_camera(viewmat=view.viewmat, K=photo.K, near=view.near, **size)


def quality(
    result: FitResult, config: TrainConfig, views: list[View], masks: list[np.ndarray]
) -> dict[str, float]:
    """Return the quality of held-out views: all pixels, moving ones, still ones."""
    model, params = result.model, result.state.params
    at = jax.jit(
        lambda t: params.gaussians if model.at is None else model.at(params, t)
    )
    whole, moving, still, each = [], [], [], []
    for view, photo, mask in zip(views, load_photos(views, None), masks, strict=True):
        gaussians = at(jnp.float32(view.time or 0.0))
        found = render_exact(gaussians, camera_of(view, photo), config.raster)
        image = np.clip(np.asarray(found.rgb), 0, 1)
        errors = np.square(image - photo.over((0, 0, 0)))
        each.append(decibels([errors.reshape(-1, 3)]))
        moving.append(errors[mask])
        still.append(errors[~mask])
        whole.append(errors.reshape(-1, 3))
    return {
        "PSNR, dB": float(np.mean(each)),
        "moving pixels, dB": decibels(moving),
        "still pixels, dB": decibels(still),
    }


def trained(dataset: Dataset, config: TrainConfig) -> FitResult:
    chosen, _ = split_views(dataset.views)
    training = subset(dataset, chosen)
    return fit(training, load_photos(training.views, None), config)


def compared(name: str, settings: MovingDemoSettings, steps: int) -> list[dict]:
    """Train on a dataset without and with motion."""
    rows: list[dict] = []
    with tempfile.TemporaryDirectory() as folder:
        write_moving_dataset(folder, settings)
        dataset = gsjax.load_dataset(folder)
        _, held_out = split_views(dataset.views)
        views = [dataset.views[i] for i in held_out]
        masks = [moving_pixels(view) for view in views]
        for way in WAYS:
            config = moving_demo_config(way, steps)
            begun = time.perf_counter()
            result = trained(dataset, config)
            row: dict[str, Any] = {"dataset": name, "motion": way}
            row["seconds"] = time.perf_counter() - begun
            row |= quality(result, config, views, masks)
            base = rows[0] if rows else row
            for what in ("moving", "still"):
                column = f"{what} pixels, dB"
                row[f"{what}, gain in dB"] = row[column] - base[column]
            buffers = result.state.model.buffers
            active = np.asarray(result.state.gaussians.active)
            share = 0.0 if buffers is None else np.asarray(buffers["moving"])[active]
            row["share that moves"] = float(np.mean(share))
            rows.append(row)
            print(row, file=sys.stderr)
    return rows


def stepper(
    dataset: Dataset, photos: list[Photo], motion: str, share: float
) -> tuple[Any, TrainState, TrainConfig]:
    """Return a step of `COUNT` Gaussians of which a share moves, and its state."""
    config = moving_demo_config(motion)
    setup = make_setup(config, extent_of(dataset))
    points, colors = surface_points(COUNT, 0, moving_solids(0.0))
    dense = Dataset(dataset.source, dataset.format, dataset.views, points, colors)
    gaussians = gsjax.init_gaussians(dense, sh_degree=config.sh_degree, scale=0.5)
    state = setup_state(setup, gaussians, len(dataset.views))
    if share < 1:
        moving = np.random.default_rng(0).uniform(size=gaussians.capacity) < share
        buffers = {**state.model.buffers, "moving": jnp.asarray(moving, jnp.float32)}
        state = state.replace(model=state.model._replace(buffers=buffers))
    frames = make_frames(dataset.views, photos)
    pairs, _ = capacities_for(state, frames, config, setup.schedule)
    stages = make_stages(setup, config.raster.replace(pair_capacity=pairs))
    state, frames = replicate((state, frames))
    view = jnp.zeros(1, jnp.int32)
    differentiate = jax.jit(lambda s, f: stages.differentiate(s, draw(f, view)))
    advance = jax.jit(stages.advance)
    return lambda: advance(state, differentiate(state, frames)), state, config


def times() -> list[dict]:
    """Return the times of steps and pictures, relative to those of a still scene."""
    with tempfile.TemporaryDirectory() as folder:
        size = {"width": 400, "height": 300, "samples": 1}
        few = MovingDemoSettings(cameras=1, times=2, photos=8, held_out=1, **size)
        write_moving_dataset(folder, few)
        dataset = gsjax.load_dataset(folder)
        photos = load_photos(dataset.views, None)
        cases = {"none": ("none", 1.0)}
        for motion in WAYS[1:]:
            cases[motion] = (motion, 1.0)
            cases[f"{motion}, 40 % move"] = (motion, MOVING_SHARE)
        steps = {name: stepper(dataset, photos, *case) for name, case in cases.items()}
        camera = camera_of(dataset.views[0], photos[0])
        camera = replicate(gsjax.resize_camera(camera, 800, 600))
    ms = measure.interleaved(
        {name: step for name, (step, *_) in steps.items()}, REPEATS
    )
    pictures = {name: picture_of(*rest, camera) for name, (_, *rest) in steps.items()}
    drawn = measure.interleaved(pictures, REPEATS)
    rows = [
        {
            "motion": name,
            "step, ms": ms[name],
            "step": ms[name] / ms["none"],
            "picture, ms": drawn[name],
            "picture": drawn[name] / drawn["none"],
        }
        for name in cases
    ]
    rows[0]["cost of the dead, of the living"] = cost_of_the_dead(steps["none"], camera)
    return rows


def picture_of(state: TrainState, config: TrainConfig, camera: gsjax.Camera):
    """Return a function that renders a picture at a time."""
    setup = make_setup(config, 5.0)
    raster = exact_config(state.gaussians, camera, config.raster)

    @jax.jit
    def draw_at(params, camera, moment):
        view = ViewInfo(jnp.int32(0), moment)
        return gsjax.render(setup.model.apply(params, view), camera, raster).rgb

    moment = jnp.float32(0.3)
    return lambda: draw_at(state.params, camera, moment)


def cost_of_the_dead(stepper, camera: gsjax.Camera) -> float:
    """Return what further Gaussians cost a picture if dead, as a share of if alive."""
    _, state, config = stepper
    scene: Gaussians = jax.device_get(state.gaussians)
    twice = gsjax.concatenate(scene, scene)
    dead = np.arange(twice.capacity) >= scene.capacity
    # As `gsjax.train.motion.trajectories.faded` leaves them far from their time.
    logits = np.where(dead, -400.0, np.asarray(twice.params.logit_opacities))
    faded = twice.replace(params=twice.params.replace(logit_opacities=logits))
    calls = {}
    for name, some in {"once": scene, "dead": faded, "alive": twice}.items():
        some = replicate(jax.tree.map(jnp.asarray, some))
        raster = exact_config(some, camera, config.raster)
        program = jax.jit(lambda s, c, r=raster: gsjax.render(s, c, r).rgb)
        calls[name] = lambda p=program, s=some: p(s, camera)
    ms = measure.interleaved(calls, REPEATS)
    print(ms, file=sys.stderr)
    return (ms["dead"] - ms["once"]) / (ms["alive"] - ms["once"])


def main(what: str, steps: int) -> None:
    """Measure and save."""
    if what == "time":
        measure.save("motion_time", times(), claim=__doc__, gaussians=COUNT)
        return
    rows = [row for item in SETS.items() for row in compared(*item, steps)]
    measure.save("motion", rows, claim=__doc__, steps=steps)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("quality", "time"))
    parser.add_argument("--steps", type=int, default=STEPS)
    given = parser.parse_args()
    main(given.what, given.steps)
