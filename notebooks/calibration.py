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
# # Calibrate a camera by gradients
#
# `gsjax.render` is differentiable by every number of the camera: its pose, its focal
# length and the coefficients of its lens. This notebook takes a photograph of a known
# scene through a lens with barrel distortion, forgets the focal length and the
# distortion, and finds both again with `jax.value_and_grad` and `optax`.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import gsjax
from gsjax.synthetic.torus_knot import torus_knot_scene
from gsjax.viewer.notebook import show

WIDTH, HEIGHT = 96, 72
made = torus_knot_scene(800, frames=8, width=WIDTH, height=HEIGHT)
scene, background = made.gaussians, jnp.asarray(made.background)
camera = made.cameras[0]

# %% [markdown]
# ## The camera as a function of two numbers
#
# OpenCV's lens moves a point at radius $r$ from the axis, at unit focal length, to
# $r\,(1 + k_1 r^2 + k_2 r^4)$. A negative $k_1$ bends straight lines outwards. The two
# unknowns are the logarithm of a factor on the focal length, and $k_1$. `make_camera`
# accepts traced values, so it can be called inside the loss.
#
# The preset is `accurate`, because gradients by camera parameters need its low α
# threshold. One compiled program returns the loss, its gradient and the picture.

# %%
CONFIG = gsjax.RasterConfig.accurate(
    pair_capacity=16_384,
    outputs=("rgb",),
    occlusion=False,
    num_size_buckets=1,
    devices=1,
)


def calibrated(x):
    """Return the camera with a log factor on the focal length, and k1."""
    log_factor, k1 = x
    factor = jnp.exp(log_factor)
    K = camera.K.at[0, 0].multiply(factor).at[1, 1].multiply(factor)
    return gsjax.make_camera(
        viewmat=camera.viewmat,
        K=K,
        width=WIDTH,
        height=HEIGHT,
        lens="opencv",
        coefficients=jnp.stack([k1, 0.0, 0.0, 0.0]),
    )


def loss_of(x, photo):
    """Return the mean squared error, and the picture."""
    seen = gsjax.render(scene, calibrated(x), CONFIG, background)
    return jnp.mean((seen.rgb - photo) ** 2), (seen.rgb, seen.overflowed)


program = jax.jit(jax.value_and_grad(loss_of, has_aux=True))


def picture(x):
    """Return the picture [H, W, 3]."""
    (_, (rgb, overflowed)), _ = program(x, jnp.zeros((HEIGHT, WIDTH, 3)))
    assert not overflowed
    return rgb


true = jnp.asarray([0.0, -0.1])
start = jnp.asarray([0.03, 0.0])  # 3 % too long, no distortion
photo, first_guess = picture(true), picture(start)

# %% [markdown]
# ## Descent
#
# The loss is the mean squared error. Adam makes steps of about its learning rate,
# whatever the size of the gradient; both unknowns are of the order of 0.1, so one rate
# serves both. The rate falls to a hundredth, which lets the last digits settle. The
# gradient shrinks by orders of magnitude on the way, so its means over past steps are
# short (`b1`, `b2`).

# %%
STEPS = 80
adam = optax.adam(optax.cosine_decay_schedule(0.03, STEPS, 0.01), b1=0.8, b2=0.9)
x, moments = start, adam.init(start)
path, losses = [x], []
for _ in range(STEPS):
    (loss, _), gradient = program(x, photo)
    change, moments = adam.update(gradient, moments)
    x = optax.apply_updates(x, change)
    path.append(x)
    losses.append(float(loss))

focal = float(camera.K[0, 0])
for name, (log_factor, k1) in {"true": true, "start": start, "found": x}.items():
    print(f"{name:5}  focal {focal * np.exp(log_factor):7.3f} px   k1 {k1:+.5f}")

# %%
figure, (left, middle, right) = plt.subplots(
    1, 3, figsize=(11, 2.8), layout="constrained"
)
left.semilogy(losses)
left.set(title="mean squared error", xlabel="step")
values = np.asarray(path)
for ax, title, found, goal in (
    (middle, "focal length [px]", focal * np.exp(values[:, 0]), focal),
    (right, "k1", values[:, 1], float(true[1])),
):
    ax.plot(found)
    ax.axhline(goal, color="black", lw=0.8, ls="--")
    ax.set(title=title, xlabel="step")
plt.show()

# %% [markdown]
# The photograph, the first guess and the result; below, the errors of both, five times
# enlarged. At first all edges away from the axis are double.

# %%
last = picture(x)
errors = [jnp.abs(image - photo) for image in (first_guess, last)]
show(photo, first_guess, last, captions=["photograph", "start", "found"])
show(
    *[jnp.clip(5 * error, 0, 1) for error in errors],
    captions=["error at the start × 5", "error at the end × 5"],
)

# %%
assert abs(float(x[0])) < 2e-4
assert abs(float(x[1] - true[1])) < 1e-3
assert losses[-1] < 1e-4 * losses[0]

# %% [markdown]
# ## When the scene is unknown
#
# `gsjax.fit` optimises the same numbers along with the scene:
# `TrainConfig(refine_intrinsics=True)` for focal lengths, principal point and
# distortion, `refine_shutter=True` for the motion of cameras with a rolling shutter,
# and `refine_poses=True` for the poses.
