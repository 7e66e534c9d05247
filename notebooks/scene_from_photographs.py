# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A scene from photographs
#
# This notebook trains a scene from photographs with known cameras, with `load_dataset`,
# `split_views`, `load_photos`, `fit` and `evaluate`. On the command line,
# `gsjax train DATASET -o RUN` does the same.
#
# There is nothing to download: a small ray caster takes the photographs of a still life
# that exists as formulas only. It knows nothing of Gaussians, so the task is realistic,
# if small. For photographs of your own, replace the folder with one that
# `gsjax sfm PHOTOS -o DATASET` writes, and adapt the sizes.

# %%
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import gsjax
from gsjax.data.camera_paths import median_intrinsics, orbit
from gsjax.synthetic.raycaster import DemoDatasetSettings, cast, write_demo_dataset
from gsjax.train.config import preset, scaled
from gsjax.viewer.notebook import live, movie, show

PHOTOS, WIDTH, HEIGHT, STEPS = 24, 112, 84, 300

# %% [markdown]
# ## The photographs
#
# A dataset is a folder with photographs and a file with their cameras, here
# `transforms.json`. It also has two thousand coloured points, slightly inaccurate, as
# structure from motion would find them.

# %%
temporary = tempfile.TemporaryDirectory(prefix="gsjax-")
folder = Path(temporary.name) / "still_life"
settings = DemoDatasetSettings(PHOTOS, WIDTH, HEIGHT, samples=2, points=2000)
write_demo_dataset(folder, settings)

dataset = gsjax.load_dataset(folder)
train, test = gsjax.split_views(dataset.views, every=8)
photos = gsjax.load_photos(dataset.views)
print(sorted(path.name for path in folder.iterdir()))
print(f"{len(dataset.views)} views, {len(dataset.points)} points, {dataset.format}")
print(f"{len(train)} to train with, {len(test)} held out: {test}")

show(
    *[photos[i].pixels for i in range(0, PHOTOS, 4)],
    captions=[
        f"{Path(dataset.views[i].name).stem}{', held out' if i in test else ''}"
        for i in range(0, PHOTOS, 4)
    ],
    columns=6,
)

# %% [markdown]
# ## Initialisation
#
# Each point becomes a round Gaussian of the point's colour, half as wide as the
# distance to its neighbours, and half opaque, as in the preset `fast` used below. With
# real photographs `fast` would first search for more points on which they agree
# (`initial="dense"`); here there are enough. Gaussians display themselves as a sketch:

# %%
gsjax.init_gaussians(dataset, sh_degree=1, opacity=0.5, scale=0.5)

# %% [markdown]
# ## Training
#
# The settings are those of the preset `fast`, made shorter: L1 and SSIM, Adam with a
# learning rate for each field. The strategy differs: instead of MCMC, adaptive density
# control adds and removes Gaussians, up to 4000.
#
# `fit` calls its hooks after each step. `live` returns such a hook, which redraws one
# held-out view beside its photograph, always in the same place.

# %%
config = scaled(preset("fast"), STEPS)
config = config.replace(
    strategy="adaptive",
    initial="points",
    max_size=None,
    raster=gsjax.RasterConfig(num_size_buckets=1, devices=1, occlusion=False),
    adaptive=replace(config.adaptive, max_gaussians=4000),
)


def camera_of(view):
    """Return the camera of a view."""
    return gsjax.make_camera(viewmat=view.viewmat, K=view.K, width=WIDTH, height=HEIGHT)


watched = test[1]
preview = live(
    camera_of(dataset.views[watched]),
    photos[watched].pixels,
    every=100,
    config=config.raster,
)
records = []
hooks = gsjax.Hooks(
    step=lambda progress: records.append(progress.record()), state=preview
)
result = gsjax.fit(
    gsjax.subset(dataset, train), [photos[i] for i in train], config, hooks=hooks
)

# %%
last = result.progress
print(
    f"{int(last.metrics.step)} steps in {last.seconds:.0f} s, of these"
    f" {last.compile_seconds:.0f} s compiling;"
    f" {int(gsjax.num_active(result.gaussians))} Gaussians in"
    f" {result.gaussians.capacity} slots"
)

# %% [markdown]
# ## Evaluation
#
# Training views say little: enough Gaussians reproduce any of them and may still look
# wrong from elsewhere. Judge a scene by its held-out views.

# %%
results = list(
    gsjax.evaluate(
        result.gaussians,
        [dataset.views[i] for i in test],
        [photos[i] for i in test],
        config=config.raster,
    )
)
summary = gsjax.summarise(results)
for one in results:
    print(f"{one.name}: {one.psnr:.2f} dB, SSIM {one.ssim:.3f}")
print(f"mean: {summary.psnr:.2f} dB, SSIM {summary.ssim:.3f}")

one = results[0]
nearest = 1 / np.where(one.depth > 0, one.depth, np.inf)
show(
    one.truth,
    one.render,
    4 * np.abs(one.render - one.truth),
    nearest / nearest.max(),
    captions=["photograph", "render", "error x 4", "1 / depth"],
    columns=4,
)

# %% [markdown]
# Errors are at outlines and between stripes, where colours change abruptly; more
# Gaussians would help there.
#
# Depth was not supervised. The ray caster knows the true depth, so the error can be
# measured where the render is opaque.

# %%
off = []
for i, one in zip(test, results):
    view = dataset.views[i]
    _, depth = cast(view.viewmat, view.K, WIDTH, HEIGHT, samples=1)
    both = (depth > 0) & (one.depth > 0)
    off.append(np.abs(one.depth - depth)[both] / depth[both])
off = np.concatenate(off)
print(f"relative depth error: median {np.median(off):.2%},"
      f" 90 % of pixels below {np.quantile(off, 0.9):.2%}")  # fmt: skip

# %% [markdown]
# ## Progress
#
# A step sees one view, and views differ; look at the mean over as many steps as there
# are views.

# %%
steps = np.asarray([record["step"] for record in records])
psnrs = np.asarray([record["psnr"] for record in records])
window = len(train)
mean = np.convolve(psnrs, np.ones(window) / window, mode="valid")
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 2.8), layout="constrained")
left.plot(steps, psnrs, lw=0.5, color="0.7", label="view of the step")
left.plot(steps[window // 2 :][: len(mean)], mean, label=f"mean of {window}")
left.set(xlabel="step", title="PSNR in training [dB]")
left.legend(frameon=False)
right.plot(steps, [record["gaussians"] for record in records])
right.set(xlabel="step", title="Gaussians")
plt.show()

# %% [markdown]
# ## An orbit
#
# `orbit` goes once around what the cameras look at. The movie is part of the notebook.

# %%
viewmats = orbit(np.stack([view.viewmat for view in dataset.views]), 24)
lens = median_intrinsics(dataset.views)
draw = config.raster.replace(outputs=("rgb", "depth"))  # compiled by `evaluate`
black = jnp.zeros(3)
begin = time.perf_counter()
turn = [
    gsjax.render_exact(
        result.gaussians,
        gsjax.make_camera(viewmat=viewmat, K=lens.K, width=WIDTH, height=HEIGHT),
        draw,
        black,
    ).rgb
    for viewmat in viewmats
]
jax.block_until_ready(turn)
print(f"{1e3 * (time.perf_counter() - begin) / len(turn):.0f} ms per frame")
movie(turn, fps=10, width=336)

# %% [markdown]
# ## Save
#
# `save` writes a standard PLY, for gsjax and any other viewer.

# %%
path = folder / "still_life.ply"
gsjax.save(path, result.gaussians)
again = gsjax.load(path)
assert gsjax.num_active(again) == gsjax.num_active(result.gaussians)
print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")
gsjax.compact(result.gaussians, int(gsjax.num_active(result.gaussians)))

# %%
assert summary.psnr > 24, f"{summary.psnr:.2f} dB on the held-out views"
assert mean[-1] > mean[0] + 7
assert int(gsjax.num_active(result.gaussians)) > 1900
assert np.median(off) < 0.025
assert all(np.asarray(frame).max() > 0.3 for frame in turn)
temporary.cleanup()

# %% [markdown]
# ## Summary
#
# - Cameras and a few points in, Gaussians out. Most of the time here was compiling,
#   which hardly matters in a longer run.
# - Measure on held-out views, and look at error and depth beside the image: a good
#   image with wrong depth falls apart between the views.
# - `fit` runs in memory and reports through hooks. `make_train_step` is the same step
#   as a pure function, for loops of your own.
