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
# # Gradients beyond training
#
# Most splatting renderers provide one derivative: the reverse-mode gradient that
# training needs. `gsjax.render` also supports `jvp`, `linearize`, `vmap` and second
# derivatives, and their combinations. This notebook uses them for four things:
#
# 1. **Forward mode**: how an image changes with the pose of its camera, for
#    Gauss–Newton.
# 2. **`vmap` over seeds**: three training runs as one program.
# 3. **`vmap` over cameras**.
# 4. **Hessian–vector products**: which Gaussians can be removed.
#
# All scenes are small, so compiling takes longer than running. XLA compiles a program
# on one core; the programs are therefore defined first and compiled side by side, in
# threads.

# %%
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import gsjax
from gsjax.data.types import Dataset, View
from gsjax.math.rotations import quaternion_to_matrix
from gsjax.synthetic.raycaster import cast, demo_cameras, surface_points
from gsjax.synthetic.torus_knot import torus_knot_scene
from gsjax.viewer.notebook import show

SMALL = {"outputs": ("rgb",), "occlusion": False, "num_size_buckets": 1, "devices": 1}
compiler = ThreadPoolExecutor(2)


def compiled(function, *arguments):
    """Compile a function for arguments like these, in a thread."""
    return compiler.submit(lambda: jax.jit(function).lower(*arguments).compile())


# %% [markdown]
# ## The programs
#
# **An image and its six tangents.** A camera moves in six ways. `jax.linearize` returns
# the image and the function that maps a motion to a change of the image; `vmap` applies
# it to all six. Reverse mode would need one pass for each of the image's 9216 numbers
# to get the same Jacobian.
#
# A motion is three angles and three lengths, in the camera's own axes. The quaternion
# $(1, \omega/2)$ is normalised where it is used; to first order it rotates by $\omega$,
# and nothing is singular at 0. The preset is `accurate`, because pose gradients of the
# default preset miss Gaussians that cross its α threshold of 1/255.

# %%
POSE = gsjax.RasterConfig.accurate(pair_capacity=8192, **SMALL)
made = torus_knot_scene(400, frames=8, width=64, height=48)
knot, camera, behind = made.gaussians, made.cameras[0], jnp.asarray(made.background)


def moved(x):
    """Return the camera after a motion [6]."""
    turn = quaternion_to_matrix(jnp.concatenate([jnp.ones(1), x[:3] / 2]))
    motion = jnp.eye(4).at[:3, :3].set(turn).at[:3, 3].set(x[3:])
    return camera.replace(viewmat=motion @ camera.viewmat)


def picture_at(x):
    view = gsjax.render(knot, moved(x), POSE, behind)
    return view.rgb, view.overflowed


def with_tangents(x):
    """Return rgb [H, W, 3], its Jacobian [H, W, 3, 6], and the overflow flag."""
    rgb, push, overflowed = jax.linearize(picture_at, x, has_aux=True)
    return rgb, jax.vmap(push, out_axes=-1)(jnp.eye(6)), overflowed


posing = compiled(with_tangents, jnp.zeros(6))

# %% [markdown]
# **Three training runs.** Photographs of the still life of `gsjax demo`, 48 × 36
# pixels, from 12 places; every fourth is held out. 250 Gaussians of SH degree 0, Adam,
# one random view per step, and `lax.scan` over all steps. The seed chooses the initial
# points and the views. `jax.vmap(fit)` does all runs at once; it starts here and
# continues in a thread.

# %%
WIDTH, HEIGHT, VIEWS, N, SEEDS, STEPS = 48, 36, 12, 250, 3, 120
CONFIG = gsjax.RasterConfig(chunk_size=16, pair_capacity=2048, **SMALL)
viewmats, K = demo_cameras(VIEWS, WIDTH, HEIGHT)
photos = jnp.asarray([cast(v, K, WIDTH, HEIGHT, samples=2)[0] for v in viewmats])
cameras = gsjax.make_camera(viewmat=viewmats, K=K, width=WIDTH, height=HEIGHT)
test = np.arange(0, VIEWS, 4)
train = np.setdiff1d(np.arange(VIEWS), test)

RATES = gsjax.GaussianParams(
    means=0.01, quats=0.02, log_scales=0.03, logit_opacities=0.05, sh=0.03
)
ADAM = optax.scale_by_adam()
DECAY = optax.exponential_decay(1.0, STEPS, 0.1)


def start(seed):
    """Return Gaussians at random points on the surfaces."""
    views = [View("", Path(), v, K, WIDTH, HEIGHT) for v in viewmats]
    scene = Dataset(Path(), "", tuple(views), *surface_points(N, seed))
    return gsjax.init_gaussians(scene, sh_degree=0, opacity=0.5, scale=0.7)


def one_of(batch, index):
    return jax.tree.map(lambda a: a[index], batch)


def fit(gaussians, key):
    """Train; return the scene, the losses [STEPS] and the largest pair demand."""

    def loss_of(params, view):
        scene = gaussians.replace(params=params)
        out = gsjax.render(scene, one_of(cameras, view), CONFIG)
        return jnp.mean((out.rgb - photos[view]) ** 2), out.demand.capacity

    def step(state, index):
        params, moments = state
        draw = jax.random.fold_in(key, index)
        view = jax.random.choice(draw, jnp.asarray(train))
        (loss, demand), grads = jax.value_and_grad(loss_of, has_aux=True)(params, view)
        directions, moments = ADAM.update(grads, moments)
        params = jax.tree.map(
            lambda p, rate, d: p - DECAY(index) * rate * d, params, RATES, directions
        )
        return (params, moments), (loss, demand)

    state = gaussians.params, ADAM.init(gaussians.params)
    (params, _), (losses, demands) = jax.lax.scan(step, state, jnp.arange(STEPS))
    return gaussians.replace(params=params), losses, jnp.max(demands)


starts = jax.tree.map(lambda *a: jnp.stack(a), *[start(seed) for seed in range(SEEDS)])
keys = jax.random.split(jax.random.key(0), SEEDS)
fitting = compiler.submit(jax.jit(jax.vmap(fit)), starts, keys)

# %% [markdown]
# **All cameras in one call.** A camera is a pytree; `vmap` maps over its arrays.


# %%
def picture_from(gaussians, camera):
    return gsjax.render(gaussians, camera, CONFIG).rgb


first = one_of(starts, 0)
seeing = compiled(jax.vmap(picture_from, in_axes=(None, 0)), first, cameras)

# %% [markdown]
# **A Hessian–vector product.** Give each Gaussian a factor $m_i$ on its opacity, 1 now,
# and ask how a change of the factors affects the images of all training views:
#
# $$ L(m) = \tfrac12 \sum_{\text{views}} \lVert I(m) - I(1) \rVert^2. $$
#
# At $m = 1$ this is 0, and so is its gradient; the Hessian there is exactly
# Gauss–Newton's $J^\top J$. It has 62 500 entries and is never formed. Forward mode
# over reverse mode multiplies it by a vector, at the cost of a few gradients.


# %%
def masked(gaussians, factors):
    """Multiply opacities by ``factors`` [N]."""
    opacities = jax.nn.sigmoid(gaussians.params.logit_opacities) * factors
    logits = jnp.log(opacities) - jnp.log1p(-opacities)
    params = gaussians.params.replace(logit_opacities=logits)
    return gaussians.replace(params=params)


def hessian_times(gaussians, vector):
    """Return H v [N], summed over the training views."""
    ones = jnp.ones(N)

    def of_view(camera):
        def loss(factors):
            seen = picture_from(masked(gaussians, factors), camera)
            # I(1) is this image, as a constant.
            return 0.5 * jnp.sum((seen - jax.lax.stop_gradient(seen)) ** 2)

        return jax.jvp(jax.grad(loss), (ones,), (vector,))[1]

    return jnp.sum(jax.lax.map(of_view, one_of(cameras, train)), axis=0)


multiplying = compiled(hessian_times, first, jnp.ones(N))

# %% [markdown]
# ## 1. Pose estimation
#
# The photograph shows the knot from a pose that we pretend not to know. We start 2.4
# degrees and a sixth of a unit away, which is about four pixels. First the tangents at
# the true pose: how each pixel changes as the camera rotates or shifts. Grey is no
# change.

# %%
program = posing.result()
photo, tangents, overflowed = program(jnp.zeros(6))
assert not overflowed
WAYS = ["turn about x", "turn about y", "turn about z", "shift x", "shift y", "shift z"]
shades = [0.5 + 0.25 * tangents[..., i] / np.std(tangents[..., i]) for i in range(6)]
show(photo, *shades, captions=["photograph", *WAYS], columns=4, zoom=2)

# %% [markdown]
# Each is compared with the difference of two images 0.0003 units to either side:

# %%
for i in range(6):
    step = 3e-4 * jnp.eye(6)[i]
    ahead, back = program(step)[0], program(-step)[0]
    difference = (ahead - back) / 6e-4
    off = np.linalg.norm(difference - tangents[..., i])
    relative = off / np.linalg.norm(difference)
    assert relative < 0.02, f"{WAYS[i]}: {relative:.3f}"
    print(f"{WAYS[i]:13} against differences: {relative:.1e}")

# %% [markdown]
# **Gauss–Newton** linearises the image and solves for the motion that explains the
# residual: $x \leftarrow x - (J^\top J)^{-1} J^\top r$, with a little damping (1e-3 of
# the diagonal). This is a 6 × 6 system. **Adam** uses the gradient of the same error,
# $J^\top r$, from the same program, with a learning rate of 0.02.


# %%
matrix_of = jax.jit(lambda x: moved(x).viewmat)


def errors(x):
    """Return the rotation and position error of a motion, in degrees and units."""
    viewmat, true = (np.asarray(m, float) for m in (matrix_of(x), camera.viewmat))
    turn = viewmat[:3, :3] @ true[:3, :3].T
    sine = np.linalg.norm(turn - turn.T) / np.sqrt(8)
    centres = [-m[:3, :3].T @ m[:3, 3] for m in (viewmat, true)]
    return np.degrees(np.arcsin(min(sine, 1))), np.linalg.norm(centres[0] - centres[1])


def gauss_newton(x, iterations):
    path = [x]
    for _ in range(iterations):
        rgb, jacobian, _ = program(x)
        J, r = np.asarray(jacobian, float).reshape(-1, 6), np.ravel(rgb - photo)
        H = J.T @ J
        x = x - jnp.asarray(np.linalg.solve(H + 1e-3 * np.diag(np.diag(H)), J.T @ r))
        path.append(x)
    return path


def adam(x, iterations, rate=0.02):
    path, moments = [x], ADAM.init(x)
    for _ in range(iterations):
        rgb, jacobian, _ = program(x)
        gradient = jnp.tensordot(rgb - photo, jacobian, axes=3)
        direction, moments = ADAM.update(gradient, moments)
        x = x - rate * direction
        path.append(x)
    return path


offset = jnp.asarray([0.018, -0.024, 0.03, 0.06, -0.09, 0.12])
by_newton, by_adam = gauss_newton(offset, 12), adam(offset, 50)
for name, path in (("start", [offset]), ("Gauss–Newton", by_newton), ("Adam", by_adam)):
    degrees, units = errors(path[-1])
    print(f"{name:13} {len(path) - 1:2} steps: {degrees:.5f}°, {units:.6f} units off")

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
for name, path in (("Gauss–Newton", by_newton), ("Adam", by_adam)):
    degrees, units = np.transpose([errors(x) for x in path])
    left.plot(degrees, ".-", ms=4, lw=1, label=name)
    right.plot(units, ".-", ms=4, lw=1, label=name)
left.set(yscale="log", xlabel="step", title="rotation, degrees off")
right.set(yscale="log", xlabel="step", title="position, units off")
left.legend(frameon=False)
plt.show()
before, after = program(offset)[0], program(by_newton[-1])[0]
show(
    *[np.abs(image - photo) for image in (before, after)],
    captions=["error at the start", "error at the end"],
    zoom=2,
)

# %% [markdown]
# The first steps overshoot, because the checkerboard repeats itself and an image is far
# from linear over several pixels; then the error falls several times per step. From
# farther away, blur both images first: the blur of a tangent is the tangent of the
# blur.

# %%
degrees, units = np.transpose([errors(x) for x in by_newton])
assert degrees[0] > 2
assert units[0] > 0.1
assert degrees[-1] < 0.01
assert units[-1] < 0.002
assert errors(by_adam[-1])[0] > 10 * degrees[-1]
assert float(jnp.abs(after - photo).max()) < 0.02

# %% [markdown]
# ## 2. Three seeds, one program
#
# One call trains all three, each from different points and with different views. The
# spread of the results is chance. A difference between two settings is significant only
# if it exceeds this spread.

# %%
scenes, losses, demands = fitting.result()
assert int(demands.max()) <= CONFIG.pair_capacity
see = seeing.result()
images = [see(one_of(scenes, seed), cameras) for seed in range(SEEDS)]


def held_out(images):
    """Return the PSNR of the held-out views in dB."""
    return float(-10 * jnp.log10(jnp.mean((images[test] - photos[test]) ** 2)))


quality = [held_out(seen) for seen in images]
print("held out:", ", ".join(f"{value:.2f} dB" for value in quality))

figure, ax = plt.subplots(figsize=(7, 2.6), layout="constrained")
smooth = np.ones(15) / 15
for seed in range(SEEDS):
    mean = np.convolve(losses[seed], smooth, mode="valid")
    ax.plot(-10 * np.log10(mean), lw=1, label=f"seed {seed}")
ax.set(xlabel="step", ylabel="PSNR, mean of 15 [dB]")
ax.legend(frameon=False)
plt.show()
show(
    photos[0],
    *[seen[0] for seen in images],
    captions=["held out", *(f"seed {seed}" for seed in range(SEEDS))],
    columns=4,
    zoom=2,
)
assert min(quality) > 18
assert max(quality) - min(quality) < 1.5
assert len({round(value, 4) for value in quality}) == SEEDS

# %% [markdown]
# In a notebook a batch of scenes displays itself as a sheet of sketches:

# %%
scenes

# %% [markdown]
# ## 3. All cameras in one call
#
# The images above came from `vmap` over 12 cameras. A batched camera,
# `gsjax.render(gaussians, cameras, config)`, renders the same images in turn, with the
# memory of one.

# %%
show(images[0], columns=6, zoom=2)

# %% [markdown]
# ## 4. Which Gaussians can be removed?
#
# Three methods choose the Gaussians to remove. The baseline removes the least opaque
# first. The second uses the Hessian: removing Gaussian $i$ means $m_i = 0$, a step of
# −1, and costs $\tfrac12 H_{ii}$. The diagonal is estimated from products with random
# signs, $H_{ii} = \mathrm{E}[v_i (H v)_i]$ (Hutchinson), here 32 of them.
#
# That holds for one Gaussian at a time. If two Gaussians can replace each other, either
# may be removed, but not both. If a set $S$ is removed already, one more costs
# $\tfrac12 H_{ii} + (H 1_S)_i$, which takes one more product. So the third method
# prunes in rounds of 10 % and evaluates the cost again after each.

# %%
scene = one_of(scenes, 0)
times = multiplying.result()
rng = np.random.default_rng(0)
signs = rng.choice(np.float32([-1, 1]), (32, N))
diagonal = np.mean([v * times(scene, jnp.asarray(v)) for v in signs], axis=0)
opacity = np.asarray(jax.nn.sigmoid(scene.params.logit_opacities))

# The Hessian is symmetric and positive semidefinite.
u, v = (jnp.asarray(rng.normal(size=N), jnp.float32) for _ in range(2))
Hu, Hv = times(scene, u), times(scene, v)
np.testing.assert_allclose(u @ Hv, v @ Hu, rtol=1e-3)
assert min(float(u @ Hu), float(v @ Hv)) > 0

# %%
FRACTIONS = np.arange(0, 0.71, 0.1)
gone = np.zeros(N, bool)
by_rounds = []
for fraction in FRACTIONS:
    product = times(scene, jnp.asarray(gone, jnp.float32))
    cost = np.where(gone, -np.inf, 0.5 * np.maximum(diagonal, 0) + product)
    gone = np.zeros(N, bool)
    gone[np.argsort(cost)[: round(fraction * N)]] = True
    by_rounds.append(~gone)


def all_but_first(score):
    """Return the remaining mask of each fraction if the lowest scores go first."""
    rank = np.argsort(np.argsort(score))
    return [rank >= round(fraction * N) for fraction in FRACTIONS]


orders = {
    "opacity": all_but_first(opacity),
    "½ diagonal of H": all_but_first(diagonal),
    "H, in rounds of 10 %": by_rounds,
}
curves = {
    name: [
        held_out(see(gsjax.select(scene, jnp.asarray(mask)), cameras)) for mask in masks
    ]
    for name, masks in orders.items()
}

figure, ax = plt.subplots(figsize=(7, 3.4), layout="constrained")
for name, values in curves.items():
    ax.plot(100 * FRACTIONS, values, ".-", lw=1.2, label=name)
ax.set(xlabel="Gaussians removed [%]", ylabel="PSNR of held-out views [dB]")
ax.legend(frameon=False)
plt.show()
half = int(np.argmin(np.abs(FRACTIONS - 0.5)))
for name, values in curves.items():
    print(f"{name:20} {values[half]:.2f} dB with half removed")
show(
    photos[0],
    images[0][0],
    *[
        see(gsjax.select(scene, jnp.asarray(masks[half])), cameras)[0]
        for masks in orders.values()
    ],
    captions=["photograph", "all", "opacity", "diagonal", "rounds"],
    columns=5,
    zoom=2,
)

# %%
assert all(mask.sum() == N - round(f * N) for f, mask in zip(FRACTIONS, by_rounds))
assert all(len(set(np.round(values, 6))) > 4 for values in curves.values())
assert curves["½ diagonal of H"][half] > curves["opacity"][half] + 0.5
assert curves["H, in rounds of 10 %"][half] > curves["opacity"][half] + 0.5

# %% [markdown]
# ## Summary
#
# - Forward mode suits few inputs and many outputs. Six tangents of an image cost a few
#   renders, and with them the pose of a camera is a least-squares problem: a dozen
#   steps to the limit of float32, where Adam has not converged after fifty.
# - A training run is a function like any other: `vmap` gives error bars.
# - Curvature contains what opacity does not: how much each Gaussian covers, and what it
#   hides. With half of the Gaussians removed, held-out views are better by the diagonal
#   than by opacity, and better still in rounds. Further training after pruning repairs
#   most of the loss in either case.
