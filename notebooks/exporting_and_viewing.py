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
# A scene goes to a file and comes back, becomes smaller, and what that costs is
# measured; it turns around in a movie, and becomes a page that opens offline. On the
# command line: `gsjax export`, `gsjax render`, `gsjax view`, `gsjax info`.

# %%
import importlib.util
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import gsjax
from gsjax.plots.histograms import histograms
from gsjax.synthetic.torus_knot import torus_knot_scene
from gsjax.viewer.notebook import Picture, movie, show

WIDTH, HEIGHT, FRAMES = 160, 120, 30
CONFIG = gsjax.RasterConfig(
    outputs=("rgb",), occlusion=False, num_size_buckets=1, devices=1
)
kept = tempfile.TemporaryDirectory(prefix="gsjax-")
folder = Path(kept.name)

made = torus_knot_scene(4000, frames=FRAMES, width=WIDTH, height=HEIGHT)
cameras, background = made.cameras, jnp.asarray(made.background)

# %% [markdown]
# The scene is a torus knot over a floor. To it comes what every trained scene has:
# faint Gaussians, 3000 of them, that drift about and hardly show. And its SH degree is
# 3, as in most files, though all bands above the first are zero, for nothing needed
# them.

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
# ## To a file and back
#
# PLY, with the names of properties that every viewer of Gaussians knows, 32 bits a
# number. What is float32 comes back bit for bit.

# %%
path = folder / "scene.ply"
gsjax.save(path, scene)
again = gsjax.load(path)
for before, after in zip(jax.tree.leaves(scene), jax.tree.leaves(again)):
    np.testing.assert_array_equal(before, after)
size = path.stat().st_size
header = path.read_bytes().split(b"end_header")[0].decode().split("\n")
print("\n".join([*header[:5], "…", *header[-6:]]))
print(f"{size:,} bytes, {size / gsjax.num_active(scene):.0f} a Gaussian")

# %% [markdown]
# ## What it consists of
#
# The picture that `gsjax info SCENE.ply --plot OUT.png` draws. Two hills of opacity:
# the knot, near 1, and the dust, near 0. The surfaces are of flat Gaussians, all 1 to
# 6.7; the dust has any shape.

# %%
Picture(histograms(scene, title="knot and dust"))

# %% [markdown]
# ## Smaller, and the same
#
# `plan` without a budget leaves out what cannot change a picture: bands that are zero,
# and Gaussians that are fainter than the cut of 1/255 everywhere. It says what it did,
# and also chooses settings to render with.

# %%
planned = gsjax.plan(
    scene, cameras[:: FRAMES // 3], config=CONFIG, background=made.background
)
print("\n".join(planned.lines()))

# %% [markdown]
# Held against the whole scene, over six views around it: as exact as rounding allows.


# %%
def views_of(gaussians):
    """[6, H, W, 3]: pictures from around."""
    return np.stack(
        [
            gsjax.render_exact(gaussians, camera, CONFIG, background).rgb
            for camera in cameras[:: FRAMES // 6]
        ]
    )


def bytes_of(gaussians):
    """Size of the file."""
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
# ## Smaller, at a price
#
# From there on it costs something: Gaussians that are seen, though hardly, and the band
# that holds the highlights.


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
# Throwing out by opacity does well here, for the dust is faint and there is little of
# it before anything. At 0.5 the rim of the floor goes too, which fades out with faint
# Gaussians, and that one sees. Degree 0 takes the highlights off the knot, and saves
# the nine of 26 numbers that they are made of.

# %%
quality = {name: psnr for name, (_, psnr, _) in rows.items()}
assert quality["opacity > 0.01"] > quality["opacity > 0.05"] > quality["opacity > 0.5"]
assert quality["opacity > 0.05"] > 35 > quality["SH degree 0"]
assert rows["opacity > 0.05"][0] < 0.95 * rows["plan"][0]
assert rows["SH degree 0"][0] < 0.75 * rows["plan"][0]

# %% [markdown]
# ## The same in fewer bits
#
# `.spz` holds the same Gaussians with every number rounded, and packs them: means in 24
# bits, rotations in 32 together, all others in 8 or fewer. Most viewers for the web
# read it. (`save` also writes `.splat`, which the first of them read: 32 bytes each, of
# SH degree 0.) `gsjax export RUN scene.spz` does it on the command line.

# %%
packed = folder / "scene.spz"
gsjax.save(packed, base)
views = views_of(gsjax.load(packed))
psnr = -10 * np.log10(np.mean((views - full) ** 2))
times = bytes_of(base) / packed.stat().st_size
print(f"{packed.stat().st_size:,} bytes, {times:.1f} times less; {psnr:.1f} dB")
assert times > 4
assert psnr > 45

# %% [markdown]
# ## Around it
#
# The orbit as a movie within the notebook, in the colours of the settings above, and
# the same for a file: `gsjax render SCENE.ply --cameras DATASET --path orbit -o
# orbit.webm`, or from Python `gsjax.io.movies.write_movie`.

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
# `gsjax view SCENE.ply` serves an interactive viewer, `gsjax view SCENE.ply --html
# scene.html` writes it as one page, Gaussians and all, that needs no network and no
# Python. The page is drawn by viser, an extra: `pip install viser`. It shows
# one colour from all sides (SH degree 0); that is why the highlights stand still there.

# %%
if importlib.util.find_spec("viser") is None:
    print("viser is not installed, so there is no page: pip install viser")
else:
    from gsjax.viewer.opening import open_exhibit
    from gsjax.viewer.page import write_page

    gsjax.save(folder / "light.ply", light)
    shown = open_exhibit(folder / "light.ply", up="+z")
    page = write_page(shown.exhibit, folder / "scene.html", title="a knot")
    print(f"scene.html: {page.drawn:,} Gaussians, {page.size / 2**20:.2f} MiB")
    assert page.drawn == gsjax.num_active(light)
    text = (folder / "scene.html").read_text(encoding="utf-8")
    assert "<title>a knot</title>" in text
    assert "https://cdn" not in text
kept.cleanup()

# %% [markdown]
# ## What to take away
#
# - `save` and `load` lose nothing of a PLY. What is lost, is lost by choosing: `select`
#   by any mask, `with_sh_degree`, `plan` within an error that you name, `.spz`.
# - Look before cutting: a histogram shows whether there are two kinds of Gaussians to
#   tell apart, and pictures show what a threshold takes along.
# - Movies and pages are files without anything beside them, to be handed on.
