"""Claim: a training step costs at most 1.5 times the gradient of its image.

``python benchmarks/training_step.py RUN...`` loads the last checkpoint of runs and
times one step, alternating with its parts: value and gradient of the image, the loss
with its gradient, the optimiser, and one edit of the strategy (not part of every step).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import as_cli  # noqa: F401
import jax
import jax.numpy as jnp
import measure

import gsjax
from gsjax.data.extent import extent_of
from gsjax.data.photos import load_photos
from gsjax.densify.types import apply_edit
from gsjax.raster.tile_render import device_count
from gsjax.runs.checkpoint import load_latest, restore
from gsjax.runs.folder import load_settings, load_split, run_files
from gsjax.train.capacity_policy import capacities_for
from gsjax.train.frames import draw, make_frames, targets, views_of_step
from gsjax.train.initialisation import empty_state
from gsjax.train.loop import subset
from gsjax.train.losses import photometric_batch
from gsjax.train.state import gradients_like, make_setup
from gsjax.train.step import make_stages, optimise


def parts(folder: Path) -> tuple[dict, dict]:
    """Return a description of the step, and calls of the step and its parts by name."""
    settings, split = load_settings(folder), load_split(load_settings(folder))
    config, scene = settings.config, subset(split.dataset, split.train)
    checkpoint = load_latest(run_files(folder).checkpoints)
    extent, views = extent_of(scene), len(scene.views)
    slots = int(checkpoint.meta["capacity"])
    state = restore(checkpoint, empty_state(config, extent, views, slots))
    frames = make_frames(scene.views, load_photos(scene.views, config.max_size))
    pairs, _ = capacities_for(state, frames, config, config.schedule)
    raster = config.raster.replace(pair_capacity=pairs)
    setup = make_setup(config, extent)
    strategy = setup.strategy
    raster = raster.replace(outputs=("rgb",), absgrad=strategy.absgrad)
    stages = make_stages(setup, raster)
    view = views_of_step(config.seed, int(state.step), config.batch, frames.count)
    batch = draw(frames, view)
    target, weight = targets(batch, jnp.float32)
    probe = jnp.zeros((config.batch, slots, 2))
    name = "abs_probe" if strategy.absgrad else "probe"

    # Two programs, as in a run, but without donating the state.
    @jax.jit
    def differentiate(state, frames, view):
        return stages.differentiate(state, draw(frames, view))

    advance = jax.jit(stages.advance)

    @jax.jit
    @jax.value_and_grad
    def picture(differentiated, camera, cotangent):
        params, probe = differentiated
        scene = state.gaussians.replace(params=params)
        view = gsjax.render(scene, camera, raster, jnp.zeros(3), **{name: probe})
        return jnp.sum(view.rgb * cotangent)

    @jax.jit
    @jax.value_and_grad
    def loss(image):
        devices = device_count(raster)
        ssim = config.ssim_weight
        return jnp.mean(photometric_batch(image, target, weight, ssim, devices))

    update = jax.jit(lambda state, grads: optimise(setup, state, grads))

    @jax.jit
    def edit(state):
        plan, fresh = strategy.plan(state.key, state.step, state.gaussians, state.stats)
        return apply_edit(plan, state.moments), fresh

    differentiated = (state.gaussians.params, probe)
    image = 0.9 * target
    _, cotangent = loss(image)
    _, (slopes, _) = picture(differentiated, batch.camera, cotangent)
    grads = jax.tree.map(
        lambda a: jnp.zeros(a.shape, a.dtype), gradients_like(state, config.batch)
    )
    grads = grads._replace(by_slots=grads.by_slots._replace(gaussians=slopes))
    about = {
        "run": folder.name,
        "strategy": config.strategy,
        "size": f"{frames.camera.width} x {frames.camera.height}",
        "gaussians": int(gsjax.num_active(state.gaussians)),
        "slots": slots,
        "pair capacity": raster.pair_capacity,
    }
    return about, {
        "step": lambda: advance(state, differentiate(state, frames, view)),
        "picture v+g": lambda: picture(differentiated, batch.camera, cotangent),
        "loss v+g": lambda: loss(image),
        "optimiser": lambda: update(state, grads),
        "edit": lambda: edit(state),
    }


def main() -> None:
    """Measure and save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    rows = []
    for folder in parser.parse_args().runs:
        about, functions = parts(folder)
        _, metrics, _ = functions["step"]()
        assert metrics.finite
        assert not metrics.overflowed, metrics.pair_capacity
        ms = measure.interleaved(functions)
        rows.append(
            {
                **about,
                **{f"{name} ms": value for name, value in ms.items()},
                "step / picture v+g": ms["step"] / ms["picture v+g"],
            }
        )
    measure.save("training_step", rows, claim=__doc__)


if __name__ == "__main__":
    main()
