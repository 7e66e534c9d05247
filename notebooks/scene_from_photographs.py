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
# From photographs with known cameras to Gaussians, through the doors of the library:
# `load_dataset`, `split_views`, `load_photos`, `fit`, `evaluate`. The command line does
# the same with `gsjax train DATASET -o RUN`.
#
# There is nothing to download. The photographs are of a still life that exists as
# formulas only, and a small ray caster takes them. It knows nothing of Gaussians, so
# the task is a fair one, only small: 28 pictures of 128 × 96 pixels. For photographs of
# your own, put the folder that `gsjax sfm PHOTOS -o DATASET` writes in place of this
# one, and leave everything else as it is, the sizes excepted.

# %%
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import gsjax
from gsjax.data.camera_paths import median_intrinsics, orbit
from gsjax.plots.contact_sheets import SheetRow, comparison
from gsjax.plots.curves import Series, curves
from gsjax.synthetic.raycaster import DemoDatasetSettings, cast, write_demo_dataset
from gsjax.train.config import preset, scaled
from gsjax.train.loop import Hooks
from gsjax.viewer.notebook import Picture, live, movie, show

PHOTOS, WIDTH, HEIGHT, STEPS = 28, 128, 96, 360

# %% [markdown]
# ## The photographs
#
# A dataset is a folder: photographs, and a file that says where each was taken, here
# `transforms.json` with a few thousand coloured points, as structure from motion would
# have found them, a little off.

# %%
kept = tempfile.TemporaryDirectory(prefix="gsjax-")
folder = Path(kept.name) / "still_life"
settings = DemoDatasetSettings(PHOTOS, WIDTH, HEIGHT, samples=2, points=2000)
write_demo_dataset(folder, settings)

scene = gsjax.load_dataset(folder)
train, test = gsjax.split_views(scene.views, every=8)
photos = gsjax.load_photos(scene.views)
print(sorted(path.name for path in folder.iterdir()))
print(f"{len(scene.views)} views, {len(scene.points)} points, {scene.format}")
print(f"{len(train)} to train with, {len(test)} held out: {test}")

show(
    *[photos[i].pixels for i in range(0, PHOTOS, 4)],
    captions=[
        f"{Path(scene.views[i].name).stem}{', held out' if i in test else ''}"
        for i in range(0, PHOTOS, 4)
    ],
    columns=7,
)

# %% [markdown]
# ## What training starts from
#
# One Gaussian for each point, round, half as wide as its neighbours are far, of the
# point's colour, and half opaque: so the preset `fast`, used below, begins. Of real
# photographs it would first look for more points on which they agree
# (`initial="dense"`); here there are enough. This is a sketch of it, that is, discs:

# %%
start = gsjax.init_gaussians(scene, sh_degree=1, opacity=0.5, scale=0.5)
start

# %% [markdown]
# ## Training
#
# The settings are those of the preset `fast`, made shorter: L1 and SSIM, Adam with a
# rate for each kind of number. Other than there, Gaussians come and go by adaptive
# density control, which clones and splits them where the picture wants to move them,
# and removes those that hardly show. There is room for 4000 at most.
#
# `fit` calls back after each step. `live` is such a hook: it draws the held-out view it
# is given, beside its photograph, over and over in the same place. What is left of it
# here is the last drawing.

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
    """The camera that took a view."""
    return gsjax.make_camera(viewmat=view.viewmat, K=view.K, width=WIDTH, height=HEIGHT)


watched = test[1]
preview = live(
    camera_of(scene.views[watched]),
    photos[watched].pixels,
    every=60,
    config=config.raster,
)
records = []
hooks = Hooks(step=lambda progress: records.append(progress.record()), state=preview)
result = gsjax.fit(
    gsjax.subset(scene, train), [photos[i] for i in train], config, hooks=hooks
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
# ## How good is it?
#
# Views that were trained on say little: enough Gaussians reproduce any of them, and may
# be a mess from elsewhere. What counts is the views held out.

# %%
results = list(
    gsjax.evaluate(
        result.gaussians,
        [scene.views[i] for i in test],
        [photos[i] for i in test],
        config=config.raster,
    )
)
summary = gsjax.summarise(results)
for one in results:
    print(f"{one.name}: {one.psnr:.2f} dB, SSIM {one.ssim:.3f}")
print(f"mean: {summary.psnr:.2f} dB, SSIM {summary.ssim:.3f}")

rows = [SheetRow(Path(r.name).stem, r.truth, r.render, r.depth) for r in results[:3]]
Picture(comparison(rows, width=WIDTH))

# %% [markdown]
# From left to right the photograph, the render, their difference four times as large,
# and the depth, near in red and far in blue. Errors sit where colours jump, at outlines
# and between the stripes: there more Gaussians are wanted.
#
# Nobody gave a depth to learn from. The ray caster knows it, so it can be asked how far
# off it is, where the render is opaque.

# %%
off = []
for i, one in zip(test, results):
    view = scene.views[i]
    _, depth = cast(view.viewmat, view.K, WIDTH, HEIGHT, samples=1)
    both = (depth > 0) & (one.depth > 0)
    off.append(np.abs(one.depth - depth)[both] / depth[both])
off = np.concatenate(off)
print(f"depth: off by {np.median(off):.2%} in the middle, 90 % of pixels"
      f" below {np.quantile(off, 0.9):.2%}")  # fmt: skip

# %% [markdown]
# ## The way there
#
# A step sees one view, and views differ; the mean over as many steps as there are views
# is the curve to look at. Below it the number of Gaussians.

# %%
steps = np.asarray([record["step"] for record in records])
psnrs = np.asarray([record["psnr"] for record in records])
window = len(train)
mean = np.convolve(psnrs, np.ones(window) / window, mode="valid")
counts = [record["gaussians"] for record in records]
lines = [
    Series("view of the step", steps, psnrs, faint=True),
    Series(f"mean of {window}", steps[window // 2 :][: len(mean)], mean),
]
top = curves(lines, title="PSNR in training, dB", size=(720, 260))
bottom = curves([Series("active", steps, counts)], title="Gaussians", size=(720, 180))
Picture(np.concatenate([top, bottom]))

# %% [markdown]
# ## Around it
#
# `orbit` goes once around what the cameras look at. The movie is a part of the notebook
# and needs no file beside it.

# %%
viewmats = orbit(np.stack([view.viewmat for view in scene.views]), 36)
lens = median_intrinsics(scene.views)
drawn = config.raster.replace(outputs=("rgb", "depth"))
black = jnp.zeros(3)
begin = time.perf_counter()
turn = [
    gsjax.render_exact(
        result.gaussians,
        gsjax.make_camera(viewmat=viewmat, K=lens.K, width=WIDTH, height=HEIGHT),
        drawn,
        black,
    ).rgb
    for viewmat in viewmats
]
jax.block_until_ready(turn)
print(f"{1e3 * (time.perf_counter() - begin) / len(turn):.0f} ms a frame")
movie(turn, fps=12, width=360)

# %% [markdown]
# ## To keep
#
# A standard PLY, for gsjax and for any other viewer.

# %%
path = folder / "still_life.ply"
gsjax.save(path, result.gaussians)
again = gsjax.load(path)
assert gsjax.num_active(again) == gsjax.num_active(result.gaussians)
print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")
gsjax.compact(result.gaussians, int(gsjax.num_active(result.gaussians)))

# %%
assert summary.psnr > 25, f"{summary.psnr:.2f} dB on the views held out"
assert mean[-1] > mean[0] + 8
assert int(gsjax.num_active(result.gaussians)) > 2000
assert np.median(off) < 0.02
assert all(np.asarray(frame).max() > 0.3 for frame in turn)
kept.cleanup()

# %% [markdown]
# ## What to take away
#
# - Cameras and a few points in, Gaussians out. Most of the seconds here went into
#   compiling, which a longer run does not notice.
# - Measure on views that were held out, and look at the error and at the depth beside
#   the picture: a good picture from a wrong depth comes apart between the views.
# - `fit` runs in memory and tells everything through hooks; what is drawn or kept of it
#   is up to the caller. `make_train_step` is the same step as a pure function, for
#   loops of your own.
