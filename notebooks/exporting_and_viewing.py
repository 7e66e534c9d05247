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
# # Exporting and viewing
#
# Save a scene to a file and load it, make it smaller and measure the loss, render an
# orbit, and write a page that opens offline. On the command line: `gsjax export`,
# `gsjax compress`, `gsjax render`, `gsjax view`, `gsjax info`.

# %%
import importlib.util
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import gsjax
from gsjax.compression.types import Goal, HeldOut
from gsjax.plots.figures import histograms
from gsjax.synthetic.torus_knot import torus_knot_scene
from gsjax.viewer.notebook import Picture, movie, show

WIDTH, HEIGHT, FRAMES = 128, 96, 24
CONFIG = gsjax.RasterConfig(
    outputs=("rgb",), occlusion=False, num_size_buckets=1, devices=1
)
temporary = tempfile.TemporaryDirectory(prefix="gsjax-")
folder = Path(temporary.name)

made = torus_knot_scene(4000, frames=FRAMES, width=WIDTH, height=HEIGHT)
cameras, background = made.cameras, jnp.asarray(made.background)

# %% [markdown]
# The scene is a torus knot over a floor, plus 3000 faint floating Gaussians that hardly
# show; every trained scene has some. Its degree of spherical harmonics (SH) is 3, as in
# most files, although all bands above the first are zero.

# %%
rng = np.random.default_rng(0)
count = 3000
dust = gsjax.make_gaussians(
    means=rng.normal((0, 0, 1.3), (1.2, 1.2, 0.7), (count, 3)),
    quats=rng.normal(size=(count, 4)),
    log_scales=rng.normal(-3.2, 0.4, (count, 3)),
    logit_opacities=rng.normal(-5.0, 0.8, count),
    sh=rng.normal(0, 0.4, (count, 4, 3)) * np.array([1, 0.2, 0.2, 0.2])[:, None],
)
scene = gsjax.with_sh_degree(gsjax.concatenate(made.gaussians, dust), 3)
scene

# %% [markdown]
# ## Save and load
#
# PLY uses the property names that every viewer of Gaussians knows, 32 bits per number.
# A float32 scene is restored bit for bit.

# %%
path = folder / "scene.ply"
gsjax.save(path, scene)
again = gsjax.load(path)
for before, after in zip(jax.tree.leaves(scene), jax.tree.leaves(again)):
    np.testing.assert_array_equal(before, after)
size = path.stat().st_size
header = path.read_bytes().split(b"end_header")[0].decode().split("\n")
print("\n".join([*header[:5], "…", *header[-6:]]))
print(f"{size:,} bytes, {size / gsjax.num_active(scene):.0f} per Gaussian")

# %% [markdown]
# ## What the scene consists of
#
# This is the figure of `gsjax info SCENE.ply --plot OUT.png`. Opacity has two modes:
# the knot, near 1, and the dust, near 0. Surfaces consist of flat Gaussians; the dust
# has any shape.

# %%
Picture(histograms(scene, title="knot and dust"))

# %% [markdown]
# ## Smaller without loss
#
# Without a budget, `plan` removes what cannot change an image: bands that are zero, and
# Gaussians below the cut of 1/255 everywhere. It reports what it did, and chooses
# settings for rendering.

# %%
planned = gsjax.plan(
    scene, cameras[:: FRAMES // 2], config=CONFIG, background=made.background
)
print("\n".join(planned.lines()))

# %% [markdown]
# Compared with the whole scene over four views, the difference is rounding.


# %%
def views_of(gaussians):
    """Return images [4, H, W, 3] from around."""
    return np.stack(
        [
            gsjax.render_exact(gaussians, camera, CONFIG, background).rgb
            for camera in cameras[:: FRAMES // 4]
        ]
    )


def bytes_of(gaussians):
    """Return the size of the PLY file."""
    file = folder / "measured.ply"
    gsjax.save(file, gaussians, overwrite=True)
    return file.stat().st_size


full, exact = views_of(scene), views_of(planned.gaussians)
print(f"{size:,} bytes, then {bytes_of(planned.gaussians):,}")
print(f"largest difference {np.abs(exact - full).max():.1e}")
assert full.std() > 0.1
assert np.abs(exact - full).max() < 1e-5
assert bytes_of(planned.gaussians) < 0.5 * size

# %% [markdown]
# ## Smaller with loss
#
# Further reduction changes the image: it removes barely visible Gaussians, and the SH
# band with the highlights.


# %%
def opacity_of(gaussians):
    return jax.nn.sigmoid(gaussians.params.logit_opacities)


def at_least(opacity, gaussians):
    return gsjax.select(gaussians, opacity_of(gaussians) >= opacity)


base = planned.gaussians
smaller = {
    "opacity > 0.01": at_least(0.01, base),
    "opacity > 0.05": at_least(0.05, base),
    "opacity > 0.5": at_least(0.5, base),
    "SH degree 0": gsjax.with_sh_degree(base, 0),
    "0, and > 0.05": gsjax.with_sh_degree(at_least(0.05, base), 0),
}
rows = {"plan": (bytes_of(base), np.inf, exact[0])}
for name, gaussians in smaller.items():
    views = views_of(gaussians)
    psnr = -10 * np.log10(np.mean((views - full) ** 2))
    rows[name] = bytes_of(gaussians), psnr, views[0]
    number = int(gsjax.num_active(gaussians))
    print(f"{name:15} {number:6} Gaussians {rows[name][0]:9,} bytes  {psnr:5.1f} dB")

# %%
figure, ax = plt.subplots(figsize=(6.6, 3.4), layout="constrained")
for name, (file_size, psnr, _) in list(rows.items())[1:]:
    ax.plot(file_size / 1e3, psnr, "o")
    place, aside = (file_size / 1e3, psnr), (7, 4 if "and" not in name else -14)
    ax.annotate(name, place, xytext=aside, textcoords="offset points")
for name, file_size in (("plan, exact", rows["plan"][0]), ("whole", size)):
    ax.axvline(file_size / 1e3, color="0.6", ls=":")
    ax.text(file_size / 1e3, 66, f" {name}", color="0.4", va="top")
ax.set(xlabel="kB", ylabel="PSNR against the whole [dB]")
ax.set(xlim=(0, 1.15 * size / 1e3), ylim=(20, 68))
plt.show()
show(*[row[2] for row in rows.values()], captions=list(rows), columns=3)

# %% [markdown]
# Selecting by opacity works well here, because the dust is faint and little of it is in
# front of anything. At 0.5 the rim of the floor, which fades out with faint Gaussians,
# disappears too. Degree 0 removes the highlights of the knot, and with them nine of the
# 26 numbers of each Gaussian.

# %%
quality = {name: psnr for name, (_, psnr, _) in rows.items()}
assert quality["opacity > 0.01"] > quality["opacity > 0.05"] > quality["opacity > 0.5"]
assert quality["opacity > 0.05"] > 35 > quality["SH degree 0"]
assert rows["opacity > 0.05"][0] < 0.95 * rows["plan"][0]
assert rows["SH degree 0"][0] < 0.75 * rows["plan"][0]

# %% [markdown]
# ## Fewer bits
#
# `.spz` holds the same Gaussians with every number rounded: means in 24 bits, rotations
# in 32 together, all others in 8 or fewer. Most web viewers read it. (`save` also
# writes `.splat`, the format of the first of them: 32 bytes per Gaussian, SH degree 0.)
# On the command line: `gsjax export RUN scene.spz`.

# %%
packed = folder / "scene.spz"
gsjax.save(packed, base)
views = views_of(gsjax.load(packed))
psnr = -10 * np.log10(np.mean((views - full) ** 2))
times = bytes_of(base) / packed.stat().st_size
print(f"{packed.stat().st_size:,} bytes, {times:.1f} times smaller; {psnr:.1f} dB")
assert times > 4
assert psnr > 45

# %% [markdown]
# ## As small as a stated loss allows
#
# `compress` does all of this at once, for a goal: a loss of PSNR, a size, or a largest
# error. It leaves out the Gaussians that the views miss least, lets harmonics share a
# palette, and rounds every number as coarsely as the pictures allow. The loss is
# measured on other views, on the file that it returns; without photographs it is that
# of a scene which matches them at 30 dB. On the command line: `gsjax compress RUN -o
# scene.sog`.

# %%
compressed = gsjax.compress(
    scene,
    cameras[::2],
    goal=Goal(max_loss=0.3),
    config=CONFIG,
    background=made.background,
    held_out=HeldOut(cameras[1::6]),
)
compressed.save(folder / "scene.sog")
print("\n".join(compressed.lines()))
views = views_of(gsjax.load(folder / "scene.sog"))
show(full[0], views[0], captions=["whole", f"{compressed.size / 1e3:.0f} kB"])

# %%
assert compressed.loss <= 0.3
assert compressed.size < packed.stat().st_size / 2
assert np.mean((views - full) ** 2) < 10**-3.5

# %% [markdown]
# ## An orbit
#
# `movie` shows the orbit within the notebook. To write a file, use
# `gsjax render SCENE.ply --cameras DATASET --path orbit -o orbit.webm`, or
# `gsjax.io.movies.write_movie` in Python.

# %%
light = smaller["opacity > 0.05"]
turn = [gsjax.render_exact(light, c, CONFIG, background).rgb for c in cameras]
turntable = movie(turn, fps=12, width=480)
print(turntable)
turntable

# %%
assert turntable.frames == FRAMES
assert len(turntable.data) < 500_000

# %% [markdown]
# ## In a browser, offline
#
# `gsjax view SCENE.ply` starts an interactive viewer.
# `gsjax view SCENE.ply --html scene.html` writes it as one page, Gaussians included,
# that needs neither network nor Python. The page is drawn by viser, an extra:
# `pip install viser`. It shows the same colour from all sides (SH degree 0), so the
# highlights do not move.

# %%
if importlib.util.find_spec("viser") is None:
    print("viser is not installed, so there is no page: pip install viser")
else:
    from gsjax.viewer.opening import load_content
    from gsjax.viewer.page import write_page

    gsjax.save(folder / "light.ply", light)
    shown = load_content(folder / "light.ply", up="+z")
    page = write_page(shown.content, folder / "scene.html", title="a knot")
    print(f"scene.html: {page.drawn:,} Gaussians, {page.size / 2**20:.2f} MiB")
    assert page.drawn == gsjax.num_active(light)
    text = (folder / "scene.html").read_text(encoding="utf-8")
    assert "<title>a knot</title>" in text
    assert "https://cdn" not in text
temporary.cleanup()

# %% [markdown]
# ## Summary
#
# - `save` and `load` lose nothing in a PLY. To make files smaller, you choose what to
#   lose: `select` by any mask, `with_sh_degree`, `plan` within a given error, `.spz`,
#   or `compress` for a stated loss or size.
# - Look before you cut: a histogram shows whether there are two kinds of Gaussians, and
#   images show what a threshold removes.
# - Movies and pages are single files that can be passed on.
