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
# # Splats and pictures
#
# This notebook has three small experiments with the rasteriser alone: `gsjax.render`,
# its gradient, and Adam.
#
# 1. **Order matters.** Two overlapping splats (projected Gaussians), whose colours can
#    be computed by hand.
# 2. **Fitting a picture.** A grey picture of 48 × 48 pixels from 20 to 200 Gaussians.
# 3. **Signs of failure.** Too few Gaussians, or a bad start: how their widths show it,
#    and what density control does about it.
#
# All scenes are flat and seen through an *orthographic* camera whose intrinsics are the
# identity. One unit of the world is then one pixel, and the projection of a Gaussian is
# the Gaussian without its z. Pixel centres lie at + 0.5: pixel 2 of a row is sampled at
# x = 2.5.

# %%
import time
from functools import partial

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
from matplotlib.collections import PatchCollection
from matplotlib.patches import Ellipse

import gsjax
from gsjax.densify.adaptive import AdaptiveSettings, adaptive
from gsjax.densify.types import Observation, apply_edit
from gsjax.gaussians import num_active
from gsjax.math.rotations import covariance
from gsjax.math.sh import dc_to_rgb, rgb_to_dc


def flat_camera(width, height, zoom=1.0):
    """Return a camera that looks along +z at the xy plane, ``zoom`` pixels per unit."""
    return gsjax.make_camera(
        viewmat=np.eye(4),
        K=np.diag([zoom, zoom, 1.0]),
        width=width,
        height=height,
        lens="orthographic",
    )


def grey_to_sh(grey):
    """Return degree-0 coefficients [N, 1, 3] of grey values [N]."""
    return jnp.repeat(rgb_to_dc(jnp.asarray(grey))[:, None, None], 3, axis=2)


# %% [markdown]
# ## 1. Order matters
#
# Splats are blended front to back. Each adds its colour $c_k$, weighted by its own
# opacity $\alpha_k$ at the pixel and by the light that those before it let through:
#
# $$ C = \sum_k c_k\,\alpha_k \prod_{j<k} (1 - \alpha_j). $$
#
# Take a bright splat (0.9) and a dark one (0.1), both of opacity 0.85, round, with σ =
# 1.6 px, at x = 4.0 and 5.5. What a pixel shows depends on which is in front. The
# formula is short enough to evaluate by hand, and the renderer must agree.

# %%
SIGMA, OPACITY, ROW = 1.6, 0.85, 3.5
CENTRES, GREYS = (4.0, 5.5), (0.9, 0.1)  # bright, dark
PIXELS = [2, 4, 7]
EXPECTED = {
    "bright in front": [0.4996, 0.7419, 0.1058],
    "dark in front": [0.4354, 0.2891, 0.0816],
}
DEPTHS = {"bright in front": (1.0, 2.0), "dark in front": (2.0, 1.0)}


def two_splats(depths):
    """Return the bright and the dark splat at these depths."""
    return gsjax.make_gaussians(
        means=[[x, ROW, z] for x, z in zip(CENTRES, depths)],
        quats=[[1.0, 0, 0, 0]] * 2,
        log_scales=np.full((2, 3), np.log(SIGMA)),
        logit_opacities=np.full(2, np.log(OPACITY / (1 - OPACITY))),
        sh=grey_to_sh(GREYS),
    )


def by_hand(x, depths):
    """Evaluate the sum above in NumPy and float64."""
    through, value = np.ones_like(x), np.zeros_like(x)
    for k in np.argsort(depths):
        alpha = OPACITY * np.exp(-((x - CENTRES[k]) ** 2) / (2 * SIGMA**2))
        value, through = value + GREYS[k] * alpha * through, through * (1 - alpha)
    return value


PLAIN = {
    "dilation": 0.0, "outputs": ("rgb",), "num_size_buckets": 1, "devices": 1,
    "occlusion": False, "pair_capacity": 256,
}  # fmt: skip
config = gsjax.RasterConfig.accurate(**PLAIN)
small_camera = flat_camera(10, 7)
rows = {}
for name, depths in DEPTHS.items():
    image = gsjax.render_exact(two_splats(depths), small_camera, config).rgb
    row = np.asarray(image[3, :, 0])
    exact = by_hand(np.asarray(PIXELS) + 0.5, depths)
    print(f"{name:16}", row[PIXELS].round(4), "exact", exact.round(6))
    np.testing.assert_allclose(row[PIXELS], exact, rtol=0, atol=1e-6)
    assert row[PIXELS].round(4).tolist() == np.float32(EXPECTED[name]).tolist()
    rows[name] = row

# %% [markdown]
# For this comparison the dilation is turned off: by default 0.3 px² is added to the
# projected covariance, which would widen both splats.
#
# The order comes from the depth alone. The order in which splats are *stored* makes no
# difference, not even in the last bit:

# %%
for depths in DEPTHS.values():
    scene = two_splats(depths)
    swapped = jax.tree.map(lambda a: a[::-1], scene)
    first = gsjax.render_exact(scene, small_camera, config).rgb
    assert float(first.max()) > 0.1
    second = gsjax.render_exact(swapped, small_camera, config).rgb
    np.testing.assert_array_equal(first, second)

# %%
x = np.linspace(0, 10, 400)
figure, axes = plt.subplots(1, 2, figsize=(9, 2.6), sharey=True, layout="constrained")
for (name, depths), plot in zip(DEPTHS.items(), axes):
    plot.plot(x, by_hand(x, depths), color="0.6", label="formula")
    plot.plot(np.arange(10) + 0.5, rows[name], "o", ms=3, label="rendered")
    for pixel in PIXELS:
        value = rows[name][pixel]
        plot.annotate(
            f"{value:.4f}",
            (pixel + 0.5, value),
            xytext=(7, -2) if pixel > 2 else (-42, 2),
            textcoords="offset points",
        )
    plot.set(title=name, xlim=(0, 10), ylim=(0, 0.85), xlabel="x [px]")
axes[0].set_ylabel("grey value")
axes[1].legend(frameon=False)
plt.show()

# %% [markdown]
# ## 2. Fitting a picture
#
# The picture, on $[-1, 1]^2$, clipped to $[0, 1]$:
#
# $$ 0.5 + 0.45 \sin(5x)\cos(4y)
#    + 0.25\, e^{-8\left((x - 0.4)^2 + (y + 0.3)^2\right)}. $$
#
# Only one hill is high enough to be clipped; it has a flat top with a crease around it.
# The rest is smooth.

# %%
SIZE, STEPS = 48, 400
BARS = {20: 34.0, 60: 44.0, 200: 48.0}  # PSNR in dB that a fit must reach
SLOTS = max(BARS)

axis = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
px, py = np.meshgrid(axis, axis)
bump = np.exp(-8 * ((px - 0.4) ** 2 + (py + 0.3) ** 2))
smooth = 0.5 + 0.45 * np.sin(5 * px) * np.cos(4 * py) + 0.25 * bump
picture = jnp.asarray(np.clip(smooth, 0, 1), jnp.result_type(float))
camera = flat_camera(SIZE, SIZE)
print(f"{np.sum(smooth > 1)} pixels clipped at 1, {np.sum(smooth < 0)} at 0")

# %% [markdown]
# **Parameters.** All fields of `GaussianParams`, for an ordinary scene of SH degree 0.
# Nothing tells the optimiser that the scene is flat: along z, depth and the third scale
# do not affect the image, so their gradient is zero and the order stays as it was.
#
# **Start.** Centres on the R2 sequence (Roberts 2018), an even spread without a grid;
# depths in random order; round, with σ equal to the mean distance of neighbours;
# opacity 1/2; the colour of the pixel below.
#
# **Optimiser.** Adam on the mean squared error, one learning rate per field, reduced
# along a cosine to 1 %.
#
# **Settings.** `accurate`: with its α threshold of 1e-5 Gaussians end softly; the 1/255
# of `compat` ends each with a small step. One device, one compiled size
# (`num_size_buckets=1`) and only `rgb`, because compiling is most of the time here.

# %%
RATES = gsjax.GaussianParams(
    means=0.5, quats=0.05, log_scales=0.1, logit_opacities=0.1, sh=0.14
)
CONFIG = gsjax.RasterConfig.accurate(
    outputs=("rgb",),
    chunk_size=16,
    num_size_buckets=1,
    devices=1,
    occlusion=False,
    pair_capacity=6144,
)
DECAY = optax.cosine_decay_schedule(1.0, STEPS, alpha=0.01)


def initial_scene(count, slots=SLOTS, side=SIZE):
    """Spread ``count`` Gaussians over the picture, or over its first ``side`` px."""
    rng = np.random.default_rng(0)
    golden = 1.32471795724  # the real root of g³ = g + 1
    steps = np.arange(count)[:, None] / [golden, golden**2]
    xy = (steps + rng.uniform(size=2)) % 1 * side
    depths = 1 + rng.permutation(count) / count
    cols, lines = xy.astype(int).T
    return gsjax.make_gaussians(
        means=np.column_stack([xy, depths]),
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.full((count, 3), np.log(side / np.sqrt(count))),
        logit_opacities=np.zeros(count),
        sh=grey_to_sh(picture[lines, cols]),
        capacity=slots,
    )


def descend(params, directions, index):
    """Apply one step of Adam with the learning rate of each field."""
    return jax.tree.map(
        lambda p, rate, d: p - DECAY(index) * rate * d, params, RATES, directions
    )


@jax.jit
def fit(gaussians):
    """Fit in one program: the scene, the losses [STEPS] and the overflow flag."""
    adam = optax.scale_by_adam()

    def loss_of(params):
        out = gsjax.render(gaussians.replace(params=params), camera, CONFIG)
        return jnp.mean((out.rgb - picture[..., None]) ** 2), out.overflowed

    def step(state, index):
        params, moments = state
        grad = jax.value_and_grad(loss_of, has_aux=True)
        (loss, overflowed), grads = grad(params)
        directions, moments = adam.update(grads, moments)
        return (descend(params, directions, index), moments), (loss, overflowed)

    state = (gaussians.params, adam.init(gaussians.params))
    (params, _), (losses, overflowed) = jax.lax.scan(step, state, jnp.arange(STEPS))
    return gaussians.replace(params=params), losses, jnp.any(overflowed)


def psnr(mean_squared_error):
    """Return dB, for values between 0 and 1."""
    return -10 * np.log10(np.asarray(mean_squared_error))


@partial(jax.jit, static_argnames="config")
def image_of(gaussians, config=CONFIG):
    """Return the image [H, W] of a scene."""
    return gsjax.render(gaussians, camera, config).rgb[..., 0]


# %% [markdown]
# One program serves all counts: a scene has 200 slots, of which 20, 60 or all are
# active. The room for (tile, Gaussian) pairs is fixed too, while the Gaussians grow as
# they are fitted. The program returns whether any of its steps overflowed; if one had,
# its gradients would have been wrong.

# %%
begin = time.perf_counter()
results = {}
for count, bar in BARS.items():
    scene, losses, overflowed = fit(initial_scene(count))
    assert not overflowed, "increase pair_capacity"
    image = image_of(scene)
    value = float(psnr(jnp.mean((image - picture) ** 2)))
    results[count] = value, scene, losses, image
    print(f"{count:3} Gaussians: {value:.2f} dB (at least {bar})")
    assert value >= bar
print(f"{time.perf_counter() - begin:.0f} s, compiling included")

# %% [markdown]
# The figure shows the fits and their errors, each error on its own scale. The outlines
# are at one standard deviation, filled with the splat's colour and opacity, and drawn
# from back to front.


# %%
def widths(scene):
    """Return σ [N, 2] of both axes in px, narrow first, and the axes [N, 2, 2]."""
    params = scene.params
    blocks = np.asarray(covariance(params.quats, jnp.exp(params.log_scales)))
    squares, vectors = np.linalg.eigh(blocks[:, :2, :2])
    return np.sqrt(np.maximum(squares, 0)), vectors


def outlines(scene):
    """Return the 1-σ ellipses, back to front, as a collection of patches."""
    params = scene.params
    means = np.asarray(params.means)
    sigmas, vectors = widths(scene)
    shown = np.flatnonzero(scene.active)
    order = shown[np.argsort(-means[shown, 2])]
    angles = np.degrees(np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0]))
    greys = np.clip(np.asarray(dc_to_rgb(params.sh[:, 0])), 0, 1)
    opacities = np.asarray(jax.nn.sigmoid(params.logit_opacities))
    patches = [Ellipse(means[i, :2], *(2 * sigmas[i]), angle=angles[i]) for i in order]
    faces = np.column_stack([greys, opacities])[order]
    return PatchCollection(patches, facecolor=faces, edgecolor="tab:orange", lw=0.6)


def draw_outlines(ax, scene):
    """Draw the outlines on the black background of the picture."""
    ax.add_collection(outlines(scene))
    ax.set(xlim=(0, SIZE), ylim=(SIZE, 0), aspect="equal", facecolor="black")


figure, axes = plt.subplots(3, 4, figsize=(10, 7.4), layout="constrained")
for ax in axes.flat:
    ax.set(xticks=[], yticks=[])
axes[0, 0].imshow(picture, cmap="gray", vmin=0, vmax=1)
axes[0, 0].set_title("picture")
axes[1, 0].axis("off")
axes[2, 0].axis("off")
for (count, (value, scene, _, image)), column in zip(results.items(), axes[:, 1:].T):
    column[0].imshow(image, cmap="gray", vmin=0, vmax=1)
    column[0].set_title(f"{count} Gaussians, {value:.1f} dB")
    error = np.asarray(image - picture)
    limit = np.abs(error).max()
    column[1].imshow(error, cmap="RdBu", vmin=-limit, vmax=limit)
    column[1].set_title(f"error, ± {limit:.4f}", fontsize=9)
    draw_outlines(column[2], scene)
plt.show()

# %% [markdown]
# ## 3. Signs of failure, and density control
#
# All of this went well because the start was good: an even spread, with widths that
# overlap. A real scene starts with points where a matcher found something, and none
# elsewhere. Two signs of failure show in the widths, σ along the two axes of each
# ellipse:
#
# - **At the floor.** The renderer adds 0.3 px² to every projected covariance, so below
#   σ = $\sqrt{0.3}$ = 0.55 px most of what is drawn is that filter. The width cannot be
#   learnt either: the derivative of the variance by log σ is 2 σ². A dot tends to stay
#   a dot.
# - **At the cap.** Where there are too few Gaussians, each has to cover more than it
#   can resolve, and smears. Nothing in the loss prevents that; here σ is limited to
#   half of the picture's side.
#
# A third sign is the gradient of the loss with respect to the projected means, the
# *pull*. Density control uses it: where the image pulls a Gaussian step after step, one
# is not enough.

# %%
FEW, MANY = 8, 60
FLOOR, CAP = float(np.sqrt(CONFIG.dilation)), SIZE / 2
DOT = 0.003  # px
STRATEGY = adaptive(
    AdaptiveSettings(
        start=40,
        stop=200,
        every=30,
        threshold=1e-3,
        clone_below=0.1,
        revised_opacity=True,
        reset_every=0,
        max_gaussians=MANY,
    ),
    extent=SIZE,
)


def thin(scene, width=None):
    """Make a scene flat along z, and all Gaussians ``width`` px wide if given."""
    logs = scene.params.log_scales.at[:, 2].set(np.log(0.1))
    if width is not None:
        logs = logs.at[:, :2].set(np.log(width))
    return scene.replace(params=scene.params.replace(log_scales=logs))


@jax.jit
def watched_fit(gaussians, controlled, key):
    """Fit; return the scene, the losses and counts [STEPS], and the pull [N]."""
    adam = optax.scale_by_adam(b2=0.95)
    probe = jnp.zeros((gaussians.capacity, 2))

    def loss_of(params, probe, gaussians):
        scene = gaussians.replace(params=params)
        out = gsjax.render(scene, camera, CONFIG, probe=probe)
        return jnp.mean((out.rgb - picture[..., None]) ** 2), out.radii

    def step(state, index):
        gaussians, moments, stats = state
        grad = jax.value_and_grad(loss_of, (0, 1), has_aux=True)
        (loss, radii), (grads, pull) = grad(gaussians.params, probe, gaussians)
        directions, moments = adam.update(grads, moments)
        params = descend(gaussians.params, directions, index)
        bounded = jnp.minimum(params.log_scales, np.log(CAP))
        gaussians = gaussians.replace(params=params.replace(log_scales=bounded))
        seen = Observation(pull[None], radii[None], width=SIZE, height=SIZE)
        stats = STRATEGY.observe(stats, seen)

        def edit():
            random = jax.random.fold_in(key, index)
            plan, fresh = STRATEGY.plan(random, index + 1, gaussians, stats)
            return *apply_edit(plan, moments), fresh

        state = jax.lax.cond(
            controlled & STRATEGY.due(index + 1),
            edit,
            lambda: (gaussians, moments, stats),
        )
        return state, (loss, num_active(state[0]))

    state = (gaussians, adam.init(gaussians.params), STRATEGY.init(gaussians))
    (fitted, _, stats), (losses, counts) = jax.lax.scan(step, state, jnp.arange(STEPS))
    return fitted, losses, counts, stats.gradient / jnp.maximum(stats.views, 1)


# %% [markdown]
# The fit is that of section 2, with the limit on σ and with a `probe`: zeros that are
# added to the projected means, whose gradient is the pull. An argument switches the
# strategy on or off, so that all fits are runs of one program.
#
# Three choices matter. The scene is *thin*, 0.1 px along z, because the halves of a
# split are drawn from the Gaussian in all three directions and must stay in front of
# the camera. Adam *forgets* faster ($\beta_2$ = 0.95), because a new Gaussian has
# moments of zero while the bias correction counts the steps of all. Opacities are *not
# reset*; the run is too short to recover.
#
# There are four fits: 8 and 60 Gaussians from an even spread; 60 from a bad start, all
# in one corner, as dots of σ = 0.003 px; and 8 from such a start with density control
# up to 60.

# %%
few_even, many_even = f"{FEW}, even", f"{MANY}, even"
many_bad, grown = f"{MANY}, bad start", f"{FEW} to {MANY}, bad start"
RUNS = {  # count, px of the side that they start in, σ, whether controlled
    few_even: (FEW, SIZE, None, False),
    many_even: (MANY, SIZE, None, False),
    many_bad: (MANY, SIZE / 4, DOT, False),
    grown: (FEW, SIZE / 4, DOT, True),
}
begin = time.perf_counter()
watched, quality, floored, capped, pulls = {}, {}, {}, {}, {}
for name, (count, side, width, controlled) in RUNS.items():
    start = thin(initial_scene(count, slots=MANY, side=side), width)
    scene, losses, counts, pull = watched_fit(start, controlled, jax.random.key(0))
    active = np.asarray(scene.active)
    image = image_of(scene)
    sigmas = widths(scene)[0][active]
    watched[name] = scene, losses, counts, image, sigmas
    quality[name] = float(psnr(jnp.mean((image - picture) ** 2)))
    floored[name] = np.mean(sigmas[:, 0] < FLOOR)
    capped[name] = np.mean(sigmas[:, 1] > 0.99 * CAP)
    pulls[name] = np.median(np.asarray(pull)[active])
    print(
        f"{name:18} {quality[name]:5.1f} dB; {floored[name]:3.0%} at the floor,"
        f" {capped[name]:3.0%} at the cap; median pull {pulls[name]:.1e}"
    )
print(f"{time.perf_counter() - begin:.0f} s, compiling included")

# %%
assert pulls[few_even] > 3 * pulls[many_even]  # too few are pulled
assert floored[many_even] < 0.1  # a good start has few at the floor,
assert floored[many_bad] > 0.4  # a bad one many,
assert floored[grown] < 0.2  # density control few
assert watched[grown][2][0] == FEW
assert watched[grown][2][-1] > 2 * FEW
assert quality[grown] > quality[many_bad] + 2
assert quality[many_even] > quality[grown]  # a good start is better still

# %% [markdown]
# The first row shows the widths. Each Gaussian counts twice, with its narrow and with
# its wide axis; axes narrower than 0.001 px are drawn at 0.001 px. The grey ranges are
# the floor and the cap. Below are the errors, on one scale, and the outlines.

# %%
figure, axes = plt.subplots(3, 4, figsize=(12, 8), layout="constrained")
edges = 0.98 * np.geomspace(1e-3, SIZE, 33)  # one edge is just below the cap
for name, (top, middle, bottom) in zip(RUNS, axes.T):
    scene, _, _, image, sigmas = watched[name]
    both = np.clip(sigmas, edges[0], None).T.tolist()
    colors = ("tab:blue", "tab:orange")
    top.hist(
        both, edges, stacked=True, color=colors, label=("narrow axis", "wide axis")
    )
    top.axvspan(edges[0], FLOOR, color="0.9", zorder=0)
    top.axvspan(0.99 * CAP, edges[-1], color="0.9", zorder=0)
    top.set(xscale="log", xlim=edges[[0, -1]], xlabel="σ [px]")
    top.set_title(f"{name}: {quality[name]:.1f} dB", fontsize=10)
    shown = middle.imshow(image - picture, cmap="RdBu", vmin=-0.04, vmax=0.04)
    draw_outlines(bottom, scene)
    for ax in (middle, bottom):
        ax.set(xticks=[], yticks=[])
axes[0, 0].set_ylabel("Gaussians")
axes[0, 0].legend(frameon=False, loc="upper left")
axes[1, 0].set_ylabel("fit − picture")
figure.colorbar(shown, ax=axes[1], pad=0.01, aspect=12, ticks=[-0.04, 0, 0.04])
plt.show()

# %% [markdown]
# From an even spread, 8 Gaussians are too few: the image pulls at them many times as
# hard as at 60 of them. From the bad start, many of the 60 stay at the floor; they are
# drawn as dots and needles, but the others describe the picture.
#
# Density control does not repair a dot. The run starts with so few Gaussians that each
# has something to do and grows out of the floor. The strategy waits for that
# (`start=40`) and then adds where the image pulls: small Gaussians are cloned, large
# ones are split, and the new ones inherit a useful width.
#
# The result is no better than that of a good start. Use density control if no good
# start is known.

# %% [markdown]
# ## Summary
#
# - Blending does not commute. The same two splats give 0.74 or 0.29 at the same pixel,
#   and only the depth decides which.
# - The order cannot be differentiated, and need not be: here it was random and never
#   changed.
# - A renderer that is differentiable in every parameter needs no special optimiser:
#   Adam, one learning rate per field, and a falling schedule.
# - Look at the widths. Many at the cap may mean too few Gaussians; many at the floor
#   mean a start that was too narrow and does not recover.
# - Settings of size and speed (tiles, chunks, capacity, devices) leave the image
#   unchanged. Under `jit` the capacity is fixed: check `overflowed`.
