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
# # A scene that moves
#
# On the command line, a scene that moves takes one more word:
#
# ```sh
# gsjax sfm VIDEO -o dataset --moving
# gsjax train dataset -o run --motion trajectories
# gsjax render run --path orbit -o movie.webm
# gsjax view run
# ```
#
# This notebook trains one in memory, on photographs that are computed: a ball slides, a
# ring turns and the lid of a crate opens, seen by six fixed cameras at nine times. So
# the result can be compared with the truth from places and at times that no photograph
# shows. It takes about two minutes on two cores.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import gsjax
from gsjax.synthetic import moving, raycaster
from gsjax.train.config import scaled

WIDTH, HEIGHT, STEPS = 128, 96, 900
SETTINGS = moving.MovingDemoSettings(cameras=6, times=9, photos=18)

_, K = raycaster.demo_cameras(1, WIDTH, HEIGHT)


def camera_of(moment):
    size = {"width": WIDTH, "height": HEIGHT}
    return gsjax.make_camera(viewmat=moment.viewmat, K=K, **size)


def truth(moment):
    return moving.moving_photograph(moment, (WIDTH, HEIGHT))


moments = moving.fixed_cameras(SETTINGS) + moving.travelling_camera(SETTINGS)
dataset, photos = gsjax.make_dataset(
    [truth(moment) for moment in moments],
    gsjax.stack_cameras([camera_of(moment) for moment in moments]),
    *raycaster.surface_points(4000, scene=moving.moving_solids(0.0)),
    times=[moment.time for moment in moments],
)
len(dataset.views)

# %% [markdown]
# ## Still, and moving
#
# The same photographs, first without and then with a motion. `trajectories` gives each
# Gaussian polynomials in time for its place, rotation and colour, and a lifetime.

# %%
config = scaled(gsjax.preset("fast"), STEPS).replace(
    initial="points", max_gaussians=8000
)
still = gsjax.fit(dataset, photos, config)
result = gsjax.fit(dataset, photos, config.replace(motion="trajectories"))

# %% [markdown]
# `result.at(t)` returns the Gaussians at a time from 0 to 1; they are rendered as any
# others. The test views lie between the cameras and between the times of the
# photographs.

# %%
tests = moving.held_out_moments(SETTINGS)


def picture(gaussians, moment):
    view = gsjax.render_exact(gaussians, camera_of(moment), config.raster)
    return np.clip(np.asarray(view.rgb), 0, 1)


def psnr(image, wanted):
    return -10 * np.log10(np.mean(np.square(image - wanted)))


pictures = [
    (truth(m), picture(still.gaussians, m), picture(result.at(m.time), m))
    for m in tests[1::4]
]
figure, axes = plt.subplots(3, 3, figsize=(9, 7))
for row, moment, images in zip(axes, tests[1::4], pictures):
    for axis, image, name in zip(row, images, ("truth", "still", "moving")):
        quality = "" if name == "truth" else f", {psnr(image, images[0]):.1f} dB"
        axis.imshow(image)
        axis.set_title(f"t = {moment.time:.2f}: {name}{quality}", fontsize=9)
        axis.axis("off")
figure.tight_layout()

# %%
gain = [psnr(b, truth) - psnr(a, truth) for truth, a, b in pictures]
print(f"motion gains {np.mean(gain):.1f} dB on these views")
assert np.mean(gain) > 2

# %% [markdown]
# ## What moves
#
# From a share of the run on, Gaussians that stay within a quarter of a pixel are kept
# still. The speed of the others is a derivative like any other: `jax.jvp` of the model
# by time.

# %%
model, params = result.model, result.state.params
means = jax.jit(lambda t: model.at(params, t).params.means)
places, speeds = jax.jvp(means, (jnp.float32(0.5),), (jnp.float32(1.0),))

active = np.asarray(result.state.gaussians.active)
kept_still = np.asarray(params.model.buffers["moving"]) == 0
speed = np.linalg.norm(np.asarray(speeds), axis=1)
print(f"{kept_still[active].mean():.0%} of the Gaussians are kept still")

figure, axis = plt.subplots(figsize=(5, 5))
x, y, _ = np.asarray(places)[active].T
points = axis.scatter(x, y, c=np.minimum(speed[active], 3), s=2, cmap="inferno")
axis.set(aspect="equal", xlim=(-2.3, 2.3), ylim=(-2.3, 2.3))
axis.set_title("from above, t = 0.5: speed in units per duration")
figure.colorbar(points, shrink=0.8)
# %% [markdown]
# The ball, the ring and the lid are fast; what surrounds them is dark.
#
# ## Camera and time apart
#
# A movie is a sequence of cameras with times. On the command line, `--freeze-time` and
# `--freeze-camera` stop one of them.

# %%
ring, _ = raycaster.demo_cameras(8, WIDTH, HEIGHT)
rows = {
    "time runs": [moving.Moment(tests[2].viewmat, t) for t in (0.0, 0.33, 0.67, 1.0)],
    "camera moves": [moving.Moment(viewmat, 0.6) for viewmat in ring[:4]],
}
figure, axes = plt.subplots(2, 4, figsize=(10, 4))
for row, (name, sequence) in zip(axes, rows.items()):
    for axis, moment in zip(row, sequence):
        axis.imshow(picture(result.at(moment.time), moment))
        axis.set_title(f"{name}: t = {moment.time:.2f}", fontsize=9)
        axis.axis("off")
figure.tight_layout()

# %% [markdown]
# ## Limits
#
# The pictures are soft where something moves fast, and motions are polynomials in time.
# With a single camera, the sides that it does not see at a time are guesses. The page
# *Moving scenes* has more on both models and their limits.
