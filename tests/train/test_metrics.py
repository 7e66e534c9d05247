"""Laws of PSNR and SSIM, against direct sums over windows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.errors import InputError
from gsjax.train.metrics import psnr, ssim, ssim_map, weighted_mean

# One pixel, smaller than the window, and larger than the blocks.
SIZES = [(1, 1), (3, 20), (24, 32), (70, 400)]

maps = jax.jit(ssim_map)
scores = jax.jit(lambda x, y, w: (psnr(x, y, w), ssim(x, y, w)))


@jax.jit
def gradients(image, target, weight):
    return jax.grad(lambda x, y: psnr(x, y, weight) + ssim(x, y, weight), (0, 1))(
        image, target
    )


def pair(height, width, channels=3, seed=0):
    """Return an image and a noisy copy, in [0, 1]."""
    rng = np.random.default_rng(seed)
    ramp = np.add.outer(np.arange(height), np.arange(width)) / (height + width)
    first = np.clip(ramp[..., None] + 0.3 * rng.uniform(size=channels), 0, 1)
    noise = 0.1 * rng.normal(size=(height, width, channels))
    return first, np.clip(first + noise, 0, 1)


def dense_ssim(x, y):
    """Return the SSIM of each pixel by sums over 11 × 11 px, zero padded."""
    offsets = np.arange(-5, 6)
    window = np.exp(-0.5 * (offsets / 1.5) ** 2)
    window = np.outer(window, window) / window.sum() ** 2
    height, width = x.shape[:2]

    def means(values):
        padded = np.pad(values, ((5, 5), (5, 5), (0, 0)))
        total = np.zeros_like(values)
        for i in range(11):
            for j in range(11):
                total += window[i, j] * padded[i : i + height, j : j + width]
        return total

    mx, my = means(x), means(y)
    vx, vy, covar = means(x * x) - mx**2, means(y * y) - my**2, means(x * y) - mx * my
    return ((2 * mx * my + 1e-4) * (2 * covar + 9e-4)) / (
        (mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)
    )


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_ssim_is_the_sum_over_windows(size, report):
    x, y = pair(*size)
    wanted = dense_ssim(x, y)
    assert np.ptp(wanted) > 1e-3 or size == (1, 1)
    for dtype, bar in ((np.float32, 2e-4), (np.float64, 1e-11)):
        found = maps(jnp.asarray(x, dtype), jnp.asarray(y, dtype))
        assert found.dtype == dtype
        error = np.abs(found - wanted).max()
        report(f"ssim {size} {dtype.__name__}", error, bar)
        assert error <= bar
    if size == (24, 32):
        np.testing.assert_allclose(scores(x, y, None)[1], wanted.mean(), rtol=1e-11)


@pytest.mark.parametrize("types", [("float32", "float64"), ("float64", "float32")])
def test_mixed_dtypes_promote(types):
    x, y = (jnp.asarray(a, t) for a, t in zip(pair(12, 20), types))
    found = maps(x, y)
    assert found.dtype == jnp.float64
    np.testing.assert_allclose(found, maps(*map(jnp.float64, (x, y))), atol=1e-14)
    slope = jax.grad(lambda x: ssim(x, y))(x)
    assert slope.dtype == x.dtype
    wanted = jax.grad(lambda x: ssim(x, jnp.float64(y)))(jnp.float64(x))
    np.testing.assert_allclose(slope, wanted, atol=1e-8)


@pytest.mark.parametrize("channels", [1, 3])
def test_symmetry_bounds_and_identity(channels):
    for seed in range(3):
        x, y = pair(24, 32, channels, seed)
        (quality, between), back = scores(x, y, None), scores(y, x, None)
        assert quality == back[0]
        np.testing.assert_allclose(between, back[1], rtol=1e-12)
        assert -1 <= between < 1 - 1e-3
        assert scores(x, 1 - x, None)[1] < between
        for dtype, bar in ((np.float32, 1e-6), (np.float64, 1e-12)):
            same = jnp.asarray(x, dtype)
            quality, likeness = scores(same, same, None)
            assert quality == np.inf
            assert abs(likeness - 1) <= bar


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, bool])
@pytest.mark.parametrize("measure", [psnr, ssim])
def test_integer_images_are_rejected(dtype, measure):
    x, y = (picture.astype(np.float32) for picture in pair(24, 32))
    for both in ((x.astype(dtype), y), (x, y.astype(dtype))):
        with pytest.raises(InputError, match=r"image: expected .*image / 255"):
            measure(*both)
        with pytest.raises(InputError, match=r"image: expected .*image / 255"):
            jax.jit(measure)(*both)


def test_weights():
    """Pixels of weight 0 are excluded."""
    x, y = pair(13, 17)
    half = np.zeros((13, 17))
    half[:, :9] = 1
    assert np.isnan(psnr(x, y, 0 * half))
    np.testing.assert_allclose(psnr(x, y), -10 * np.log10(np.mean((x - y) ** 2)))
    np.testing.assert_allclose(psnr(x, y, half), psnr(x[:, :9], y[:, :9]))
    np.testing.assert_allclose(ssim(x, y, half), ssim(x[:, :9], y[:, :9]), rtol=1e-11)
    rng = np.random.default_rng(0)
    values, weight = rng.normal(size=(2, 13, 17))
    wanted = np.average(values, weights=weight**2)
    np.testing.assert_allclose(weighted_mean(values, weight**2), wanted)
    assert weighted_mean(values, np.zeros_like(values)) == 0


@pytest.mark.parametrize("garbage", [np.inf, np.nan])
def test_excluded_pixels_have_no_effect(garbage):
    x, y = (np.float32(a) for a in pair(24, 32))
    weight = np.float32(np.random.default_rng(1).uniform(size=(24, 32)) > 0.3)
    hidden = (weight == 0)[..., None]
    spoilt = np.where(hidden, garbage, x), np.where(hidden, garbage, y)
    spoilt = [np.float32(a) for a in spoilt]
    assert not np.array_equal(spoilt[0], x)
    for given in ((spoilt[0], y), (x, spoilt[1]), spoilt):
        for a, b in zip(scores(x, y, weight), scores(*given, weight)):
            assert np.isfinite(a)
            assert a == b
        for a, b in zip(gradients(x, y, weight), gradients(*given, weight)):
            np.testing.assert_array_equal(a, b)
            assert (np.asarray(a)[weight == 0] == 0).all()
            assert (np.asarray(a)[weight > 0] != 0).mean() > 0.9


@pytest.mark.parametrize("weighted", [False, True])
def test_gradients_are_finite_differences(weighted, report):
    rng = np.random.default_rng(2)
    x, y = pair(14, 12)
    weight = rng.uniform(size=(14, 12)) * (rng.uniform(size=(14, 12)) > 0.2)
    weight = weight if weighted else None
    grads = gradients(x, y, weight)
    for _ in range(8):
        way = rng.normal(size=(2, *x.shape))
        slope = sum(np.sum(g * d) for g, d in zip(grads, way))
        ends = [sum(scores(x + h * way[0], y + h * way[1], weight))
                for h in (1e-5, -1e-5)]  # fmt: skip
        wanted = (ends[0] - ends[1]) / 2e-5
        error = abs(slope - wanted) / max(1, abs(wanted))
        report(f"gradient, weighted {weighted}", error, 1e-6)
        assert error <= 1e-6
