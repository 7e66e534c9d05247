"""The two classic checks: the order of two splats, and fitting a small picture.

The notebook `splats_and_pictures` shows both at length, and holds the fits to their
bars; here the order is checked to the digits, and the fit for going the right way.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import gsjax
from gsjax.math.sh import rgb_to_dc

LIGHT = {"num_size_buckets": 1, "devices": 1, "outputs": ("rgb",)}
SIGMA, OPACITY, ROW = 1.6, 0.85, 3.5
# Pixel centres lie at + 0.5: 3.5 and 5 px, seen at 2, 4 and 7 px, all half a pixel on.
CENTRES, GREYS, PIXELS = (4.0, 5.5), (0.9, 0.1), [2, 4, 7]


def flat_camera(width, height):
    """One unit of the world is one pixel, whatever its depth."""
    return gsjax.make_camera(
        viewmat=np.eye(4),
        K=np.eye(3),
        width=width,
        height=height,
        lens="orthographic",
    )


def grey_to_sh(grey):
    return jnp.repeat(rgb_to_dc(jnp.asarray(grey))[:, None, None], 3, axis=2)


def two_splats(depths):
    return gsjax.make_gaussians(
        means=[[x, ROW, z] for x, z in zip(CENTRES, depths)],
        quats=[[1.0, 0, 0, 0]] * 2,
        log_scales=np.full((2, 3), np.log(SIGMA)),
        logit_opacities=np.full(2, np.log(OPACITY / (1 - OPACITY))),
        sh=grey_to_sh(GREYS),
    )


def by_hand(x, depths):
    """Σ c α Π (1 − α of those before), in numpy."""
    through, value = np.ones_like(x), np.zeros_like(x)
    for k in np.argsort(depths):
        alpha = OPACITY * np.exp(-((x - CENTRES[k]) ** 2) / (2 * SIGMA**2))
        value, through = value + GREYS[k] * alpha * through, through * (1 - alpha)
    return value


@pytest.mark.parametrize("preset", ["compat", "accurate", "fast"])
@pytest.mark.parametrize(
    ("depths", "expected"),
    [((1.0, 2.0), [0.4996, 0.7419, 0.1058]), ((2.0, 1.0), [0.4354, 0.2891, 0.0816])],
    ids=["bright in front", "dark in front"],
)
def test_order_of_two_splats(preset, depths, expected):
    config = getattr(gsjax.RasterConfig, preset)(dilation=0.0, **LIGHT)
    scene, camera = two_splats(depths), flat_camera(10, 7)
    image = np.asarray(gsjax.render_exact(scene, camera, config).rgb)
    row = image[3, PIXELS]
    exact = by_hand(np.asarray(PIXELS) + 0.5, depths)
    rounding = 20 * np.finfo(image.dtype).eps
    np.testing.assert_allclose(row, np.stack([exact] * 3, 1), rtol=0, atol=rounding)
    np.testing.assert_allclose(row[:, 0], expected, rtol=0, atol=5e-5)

    swapped = jax.tree.map(lambda a: a[::-1], scene)
    np.testing.assert_array_equal(
        image, gsjax.render_exact(swapped, camera, config).rgb
    )


SIZE, COUNT, STEPS = 64, 20, 60
RATES = gsjax.GaussianParams(
    means=0.6, quats=0.05, log_scales=0.1, logit_opacities=0.1, sh=0.14
)


def the_picture():
    axis = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
    x, y = np.meshgrid(axis, axis)
    bump = np.exp(-8 * ((x - 0.4) ** 2 + (y + 0.3) ** 2))
    picture = 0.5 + 0.45 * np.sin(5 * x) * np.cos(4 * y) + 0.25 * bump
    return jnp.asarray(np.clip(picture, 0, 1), jnp.result_type(float))


def scattered(picture):
    """Round Gaussians spread at random, with the colour of the pixel below."""
    rng = np.random.default_rng(0)
    golden = 1.32471795724
    steps = np.arange(COUNT)[:, None] / [golden, golden**2]
    xy = (steps + rng.uniform(size=2)) % 1 * SIZE
    cols, lines = xy.astype(int).T
    return gsjax.make_gaussians(
        means=np.column_stack([xy, 1 + rng.permutation(COUNT) / COUNT]),
        quats=np.tile([1.0, 0, 0, 0], (COUNT, 1)),
        log_scales=np.full((COUNT, 3), np.log(SIZE / np.sqrt(COUNT))),
        logit_opacities=np.zeros(COUNT),
        sh=grey_to_sh(picture[lines, cols]),
    )


@partial(jax.jit, static_argnames="config")
def fit(gaussians, picture, config):
    camera, adam = flat_camera(SIZE, SIZE), optax.scale_by_adam()

    def loss_of(params):
        out = gsjax.render(gaussians.replace(params=params), camera, config)
        return jnp.mean((out.rgb - picture[..., None]) ** 2), out.overflowed

    def step(state, _):
        params, moments = state
        (loss, over), grads = jax.value_and_grad(loss_of, has_aux=True)(params)
        directions, moments = adam.update(grads, moments)
        params = jax.tree.map(lambda p, r, d: p - r * d, params, RATES, directions)
        return (params, moments), (loss, over)

    state = (gaussians.params, adam.init(gaussians.params))
    (params, _), (losses, over) = jax.lax.scan(step, state, None, length=STEPS)
    return params, losses, jnp.any(over)


def test_a_fit_of_twenty_gaussians_approaches_the_picture():
    picture = the_picture()
    start = scattered(picture)
    # Every Gaussian in every one of the 64 tiles: there can be no more pairs.
    config = gsjax.RasterConfig.accurate(
        chunk_size=16, pair_capacity=64 * COUNT, **LIGHT
    )
    params, losses, over = fit(start, picture, config)
    assert not over
    # 6.1e-2 at the start and 2.9e-4 (35 dB) after 60 steps, in float32 and float64.
    assert losses[-1] < losses[0] / 50
    assert losses[-1] < 1e-3
    # Nothing along the line of sight shows in an orthographic view, and its gradient
    # is zero to the last bit, so that Adam leaves it where it was.
    np.testing.assert_array_equal(params.means[:, 2], start.params.means[:, 2])
    np.testing.assert_array_equal(
        params.log_scales[:, 2], start.params.log_scales[:, 2]
    )
    assert float(jnp.max(jnp.abs(params.means - start.params.means))) > 1
    # The three channels of a grey picture are treated alike.
    np.testing.assert_array_equal(params.sh[..., 0], params.sh[..., 1])
    np.testing.assert_array_equal(params.sh[..., 0], params.sh[..., 2])
