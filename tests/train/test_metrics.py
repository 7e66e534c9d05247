"""Laws of PSNR, SSIM and the photometric loss, against direct sums over windows."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.errors import InputError
from gsjax.train import ssim_window
from gsjax.train.losses import photometric, photometric_batch
from gsjax.train.metrics import psnr, ssim, ssim_map, weighted_mean

# One pixel, smaller than the window, and larger than the blocks.
SIZES = [(1, 1), (3, 20), (24, 32), (70, 400)]
# Smaller than the window, one block, several blocks, several segments.
PLANES = [(1, 1, 3), (4, 3, 1), (70, 40, 3), (3, 700, 3)]
METHODS = {"loops": ssim_window._by_loops, "products": ssim_window._by_products}

maps = jax.jit(ssim_map)


@jax.jit
def scores(x, y, weight):
    return psnr(x, y, weight), ssim(x, y, weight), photometric(x, y, weight)


gradients = jax.jit(jax.grad(lambda *given: sum(scores(*given)), (0, 1)))


def pair(height, width, channels=3, seed=0):
    """Return an image and a noisy copy, in [0, 1]."""
    rng = np.random.default_rng(seed)
    ramp = np.add.outer(np.arange(height), np.arange(width)) / (height + width)
    first = np.clip(ramp[..., None] + 0.3 * rng.uniform(size=channels), 0, 1)
    noise = 0.1 * rng.normal(size=(height, width, channels))
    return first, np.clip(first + noise, 0, 1)


def dense_means(plane):
    """Return the means by sums over 11 × 11 px, zero padded."""
    window = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(window, window) / window.sum() ** 2
    height, width = plane.shape[:2]
    padded = np.pad(plane, ((5, 5), (5, 5), (0, 0)))
    total = np.zeros_like(plane)
    for i in range(11):
        for j in range(11):
            total += window[i, j] * padded[i : i + height, j : j + width]
    return total


def dense_ssim(x, y):
    mx, my, xx, yy, xy = map(dense_means, (x, y, x * x, y * y, x * y))
    vx, vy, covar = xx - mx**2, yy - my**2, xy - mx * my
    return ((2 * mx * my + 1e-4) * (2 * covar + 9e-4)) / (
        (mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4)
    )


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shape", PLANES, ids=str)
def test_means_are_weighted_sums(shape, method):
    planes = list(np.random.default_rng(0).normal(size=(2, *shape)))
    found = METHODS[method](list(map(jnp.asarray, planes)))
    for one, plane in zip(found, planes, strict=True):
        np.testing.assert_allclose(one, dense_means(plane), rtol=0, atol=1e-14)


def test_derivatives_of_means_are_the_map_itself():
    x, slope, other = jnp.asarray(np.random.default_rng(1).normal(size=(3, 9, 14, 3)))

    def means(x):
        return ssim_window.window_means((x,))[0]

    first = means(slope)
    slopes = jax.grad(lambda x: jnp.sum(means(x) ** 2) / 2)
    one_by_one = jnp.stack([slopes(x), slopes(other)])
    for found, wanted in (
        (jax.jvp(means, (x,), (slope,))[1], first),
        (jax.vjp(means, x)[1](slope)[0], first),
        (jax.jvp(slopes, (x,), (slope,))[1], means(first)),
        (jax.grad(lambda x: jnp.vdot(slopes(x), slope))(x), means(first)),
        (jax.vmap(slopes)(jnp.stack([x, other])), one_by_one),
    ):
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-14)
    np.testing.assert_allclose(jnp.vdot(first, other), jnp.vdot(slope, means(other)))


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
    np.testing.assert_allclose(ssim(x, y), wanted.mean(), rtol=1e-11)


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
        found, back = scores(x, y, None), scores(y, x, None)
        assert found[0] == back[0]
        np.testing.assert_allclose(found[1:], back[1:], rtol=1e-12)
        assert -1 <= found[1] < 1 - 1e-3
        assert scores(x, 1 - x, None)[1] < found[1]
        for dtype, bar in ((np.float32, 1e-6), (np.float64, 1e-12)):
            same = jnp.asarray(x, dtype)
            quality, likeness, loss = scores(same, same, None)
            assert quality == np.inf
            assert abs(likeness - 1) <= bar
            assert abs(loss) <= bar


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, bool])
@pytest.mark.parametrize("measure", [psnr, ssim])
def test_integer_images_are_rejected(dtype, measure):
    x, y = (picture.astype(np.float32) for picture in pair(24, 32))
    for both in ((x.astype(dtype), y), (x, y.astype(dtype))):
        for call in (measure, jax.jit(measure)):
            with pytest.raises(InputError, match=r"image: expected .*image / 255"):
                call(*both)


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
    spoilt = [np.float32(np.where(hidden, garbage, image)) for image in (x, y)]
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


# The photometric loss.


def pictures():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(size=(2, 15, 14, 3))
    return x, y, np.float64(rng.uniform(size=(15, 14)) > 0.3)


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_the_formula(share):
    x, y, weight = pictures()
    for mask in (None, weight):
        mean = np.average(np.abs(x - y).mean(-1), weights=mask)
        wanted = (1 - share) * mean + share * (1 - ssim(x, y, mask))
        np.testing.assert_allclose(photometric(x, y, mask, share), wanted, rtol=1e-12)
    assert photometric(x, y) == photometric(x, y, None, 0.2)


def test_pixels_that_are_equal_or_all_excluded_have_no_gradient():
    x, y, weight = pictures()
    image = x.copy()
    image[3:9, 4:] = y[3:9, 4:]
    slope = jax.grad(photometric)(image, y, None, 0.0)
    np.testing.assert_allclose(slope, np.sign(image - y) / image.size, atol=1e-18)
    for share in (0.0, 0.2):
        slope = jax.grad(photometric)(y, y, None, share)
        np.testing.assert_allclose(slope, 0, atol=1e-15)
    value, slope = jax.value_and_grad(photometric)(x, y, 0 * weight)
    assert np.isfinite(value)
    assert (slope == 0).all()


@pytest.mark.parametrize(("height", "share"), [(7, 0.2), (30, 0.0)])
def test_devices_do_not_change_the_loss(height, share):
    """Also with an odd number of rows, and bands smaller than the window."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(size=(2, 2, height, 14, 3))
    mask = np.float64(rng.uniform(size=(2, height, 14)) > 0.3)
    mask[1] = 0

    def apart(images, weights):
        weights = [None, None] if weights is None else weights
        losses = [photometric(*one, share) for one in zip(images, y, weights)]
        return losses[0] + 2 * losses[1]

    def spread(images, weights):
        losses = photometric_batch(images, y, weights, share, devices=2)
        return losses[0] + 2 * losses[1]

    for weights in (mask, None):
        found, slope = jax.jit(jax.value_and_grad(spread))(x, weights)
        wanted, wanted_slope = jax.jit(jax.value_and_grad(apart))(x, weights)
        np.testing.assert_allclose(found, wanted, rtol=1e-12)
        np.testing.assert_allclose(slope, wanted_slope, atol=1e-15)
        assert (slope != 0).any()
