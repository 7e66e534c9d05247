"""Claim: what training leaves out changes nothing relevant; and how much it saves.

``python benchmarks/training_skips.py DATASET...`` trains with ``fast`` and every 8th
view held out, as is and with half-size images in the first quarter (``levels``). On the
result it measures, with and without:

- ``prune_invisible``: Gaussians that no photograph shows, by the size of the file and
  the bits of the training views;
- ``skip_masked``: a step whose photographs are masked except for a disc, and the
  relative difference of the gradients;
- occlusion culling, which is off in training: time and compile time of a gradient, and
  the number of pairs that it removes.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import as_cli  # noqa: F401
import jax
import jax.numpy as jnp
import measure
import numpy as np

import gsjax
from gsjax.data.extent import extent_of
from gsjax.data.photos import load_photos
from gsjax.raster.exact import count_demand
from gsjax.runs.evaluation import evaluate_views
from gsjax.train.capacity_policy import capacities_for
from gsjax.train.config import Level, TrainConfig, preset
from gsjax.train.frames import draw, make_frames
from gsjax.train.loop import FitResult, fit, subset
from gsjax.train.state import make_setup
from gsjax.train.step import make_stages, make_train_step
from gsjax.train.visibility_pruning import prune_invisible

SHARES = (0.75, 0.5, 0.25)  # of the pixels that stay valid


class Trained:
    """A dataset and what was trained on it."""

    def __init__(self, folder: Path, config: TrainConfig):
        scene = gsjax.load_dataset(folder)
        held = range(0, len(scene.views), 8)
        train = [i for i in range(len(scene.views)) if i not in held]
        self.config = config
        self.scene, self.test = subset(scene, train), subset(scene, list(held))
        self.photos = load_photos(self.scene.views, config.max_size)
        self.held_out = load_photos(self.test.views, config.max_size)
        self.extent = extent_of(self.scene)
        self.frames = make_frames(self.scene.views, self.photos)

    def fit(self, config: TrainConfig) -> tuple[FitResult, float]:
        """Train; return the result and the seconds, compiling included."""
        begun = time.perf_counter()
        result = fit(self.scene, self.photos, config)
        jax.block_until_ready(result.state.gaussians)
        return result, time.perf_counter() - begun

    def psnr(self, gaussians) -> float:
        """Return the mean PSNR of the held-out views, dB."""
        found = evaluate_views(gaussians, self.test, self.held_out, self.config)
        return float(np.mean([view.psnr for view in found]))


def of_levels(name: str, trained: Trained, result: FitResult, seconds: float) -> dict:
    """Compare small images at first with full ones from the start."""
    config = trained.config.replace(levels=(Level(0.0, 2), Level(0.25, 1)))
    jax.clear_caches()
    other, coarse = trained.fit(config)
    with_it, without = trained.psnr(other.gaussians), trained.psnr(result.gaussians)
    return {
        "dataset": name, "skip": "levels", "unit": "s of training",
        "with": coarse, "without": seconds, "ratio": coarse / seconds,
        "changes": f"held out {with_it:.2f} dB with, {without:.2f} dB without",
    }  # fmt: skip


def of_unseen(name: str, trained: Trained, result: FitResult) -> dict:
    """Compare with and without the Gaussians that no photograph shows."""
    config, frames = trained.config, trained.frames
    after, dropped = prune_invisible(
        result.state, frames, make_setup(config, trained.extent)
    )
    raster = config.raster.replace(outputs=("rgb",))
    differ = 0
    for index in range(frames.count):
        camera = jax.tree.map(lambda a, i=index: a[i], frames.camera)
        one, other = (
            gsjax.render_exact(scene, camera, raster).rgb
            for scene in (result.gaussians, after.gaussians)
        )
        differ += int(np.sum(np.asarray(one) != np.asarray(other)))
    with tempfile.TemporaryDirectory() as folder:
        sizes = []
        for scene in (after.gaussians, result.gaussians):
            path = Path(folder) / f"{len(sizes)}.ply"
            gsjax.save(path, scene)
            sizes.append(path.stat().st_size / 1e6)
    quality = [trained.psnr(s) for s in (after.gaussians, result.gaussians)]
    total = int(gsjax.num_active(result.gaussians))
    return {
        "dataset": name, "skip": "prune_invisible", "unit": "MB of splat.ply",
        "with": sizes[0], "without": sizes[1], "ratio": sizes[0] / sizes[1],
        "changes": f"{dropped} of {total} Gaussians; {differ} numbers of the trained "
        f"views; held out {quality[0]:.3f} dB with, {quality[1]:.3f} dB without",
    }  # fmt: skip


def of_masks(name: str, trained: Trained, result: FitResult, share: float) -> dict:
    """Time a step whose photographs are masked except for a disc in the middle."""
    config, frames, state = trained.config, trained.frames, result.state
    height, width = frames.pixels.shape[1:3]
    y, x = np.mgrid[:height, :width]
    apart = ((x + 0.5) / width - 0.5) ** 2 + ((y + 0.5) / height - 0.5) ** 2
    disc = apart <= np.quantile(apart, share)
    batch = draw(frames, jnp.zeros(1, jnp.int32))
    batch = batch._replace(valid=jnp.asarray(disc)[None])
    pairs, _ = capacities_for(state, frames, config, config.schedule)
    raster = config.raster.replace(pair_capacity=pairs)
    steps = {
        skip: jax.jit(
            make_train_step(
                config.replace(skip_masked=skip), trained.extent, raster=raster
            )
        )
        for skip in (True, False)
    }  # fmt: skip
    # Adam normalises steps, so gradients are compared by the first moments.
    fresh = state.replace(step=jnp.int32(1))
    zero = jax.tree.map(jnp.zeros_like, state.moments)
    fresh = fresh.replace(moments=zero)
    slopes = [steps[skip](fresh, batch)[0].moments[0].mu for skip in (True, False)]
    worst = max(
        float(jnp.abs(a - b).max()) / max(float(jnp.abs(b).max()), 1e-30)
        for a, b in zip(*map(jax.tree.leaves, slopes), strict=True)
    )
    ms = measure.interleaved(
        {skip: lambda s=step: s(fresh, batch) for skip, step in steps.items()}
    )
    return {
        "dataset": name, "skip": f"skip_masked, {share:.0%} left", "unit": "ms a step",
        "with": ms[True], "without": ms[False], "ratio": ms[True] / ms[False],
        "changes": f"gradients {worst:.1e} of the largest",
    }  # fmt: skip


def of_occlusion(name: str, trained: Trained, result: FitResult) -> list[dict]:
    """Time the gradient of a step and its compiling without occlusion culling."""
    config, frames, state = trained.config, trained.frames, result.state
    pairs, _ = capacities_for(state, frames, config, config.schedule)
    raster = config.raster.replace(pair_capacity=pairs)
    batch = draw(frames, jnp.zeros(config.batch, jnp.int32))
    looks, seconds, pairs = {}, {True: [], False: []}, {}
    for occlusion in (False, True, True, False):
        searching = raster.replace(occlusion=occlusion)
        jax.clear_caches()
        begun = time.perf_counter()
        look = make_stages(make_setup(config, trained.extent), searching).differentiate
        looks[occlusion] = jax.jit(look).lower(state, batch).compile()
        seconds[occlusion].append(time.perf_counter() - begun)
    seconds = {kind: float(np.mean(found)) for kind, found in seconds.items()}
    for occlusion in looks:
        pairs[occlusion] = sum(
            count_demand(
                result.gaussians,
                jax.tree.map(lambda a, i=index: a[i], frames.camera),
                raster.replace(occlusion=occlusion),
            ).pairs.item()
            for index in range(frames.count)
        )
    ms = measure.interleaved(
        {kind: lambda f=look: f(state, batch) for kind, look in looks.items()}
    )
    hidden = pairs[False] - pairs[True]
    changes = f"{hidden} of {pairs[False]} pairs of {frames.count} views are hidden"
    return [
        {
            "dataset": name, "skip": "search for what is hidden", "unit": unit,
            "with": found[False], "without": found[True],
            "ratio": found[False] / found[True], "changes": changes,
        }
        for unit, found in (("s of compiling", seconds), ("ms a gradient", ms))
    ]  # fmt: skip


def main() -> None:
    """Measure and save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("datasets", nargs="+", type=Path, metavar="DATASET")
    rows = []
    for folder in parser.parse_args().datasets:
        config = preset("fast").replace(prune_invisible=False)
        trained = Trained(folder, config)
        result, seconds = trained.fit(config)
        rows.append(of_unseen(folder.name, trained, result))
        rows += [of_masks(folder.name, trained, result, share) for share in SHARES]
        rows += of_occlusion(folder.name, trained, result)
        rows.append(of_levels(folder.name, trained, result, seconds))
        measure.save("training_skips", rows, claim=__doc__)


if __name__ == "__main__":
    main()
