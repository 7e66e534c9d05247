"""Laws of the photometric loss."""

import jax
import numpy as np
import pytest

from gsjax.train.losses import photometric, photometric_batch
from gsjax.train.metrics import ssim


def l1(image, target, weight=None):
    return photometric(image, target, weight, 0.0)


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
    assert photometric(x, x, None, share) == pytest.approx(0, abs=1e-12)
    assert photometric(x, y) == photometric(x, y, None, 0.2)


def test_excluded_pixels_have_no_effect():
    x, y, weight = pictures()
    spoilt = np.where(weight[..., None] > 0, x, np.nan)
    value, grad = jax.value_and_grad(l1)(spoilt, y, weight)
    wanted, slope = jax.value_and_grad(l1)(x, y, weight)
    assert value == wanted
    np.testing.assert_array_equal(grad, slope)
    assert (slope != 0).any()


@pytest.mark.parametrize("loss", [l1, photometric])
def test_equal_pixels_have_no_gradient(loss):
    x, y, _ = pictures()
    equal = np.zeros(x.shape, bool)
    equal[3:9, 4:] = True
    image = np.where(equal, y, x)
    slope = jax.grad(lambda image: l1(image, y))(image)
    np.testing.assert_allclose(slope, np.sign(image - y) / image.size, atol=1e-18)
    slope = np.asarray(jax.grad(lambda image: loss(image, y))(y))
    np.testing.assert_allclose(slope, 0, atol=1e-15)


def test_without_valid_pixels_there_is_no_gradient():
    x, y, weight = pictures()
    value, grad = jax.value_and_grad(photometric)(x, y, 0 * weight)
    assert np.isfinite(value)
    assert (grad == 0).all()


@pytest.mark.parametrize(
    ("height", "share", "devices"),
    [(7, 0.2, 2), (30, 0.0, 2)],
)
def test_devices_do_not_change_the_loss(height, share, devices):
    """Also with an odd number of rows, and bands smaller than the window."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(size=(2, 2, height, 14, 3))
    mask = np.float64(rng.uniform(size=(2, height, 14)) > 0.3)
    mask[1] = 0

    def total(losses):
        return losses @ np.array([1.0, 2.0])

    def apart(images, weights):
        axes = (0, 0, None if weights is None else 0)
        return total(
            jax.vmap(lambda i, t, w: photometric(i, t, w, share), axes)(
                images, y, weights
            )
        )

    def spread(images, weights):
        return total(photometric_batch(images, y, weights, share, devices))

    for weights in (mask, None):
        found, slope = jax.jit(jax.value_and_grad(spread))(x, weights)
        wanted, wanted_slope = jax.jit(jax.value_and_grad(apart))(x, weights)
        np.testing.assert_allclose(found, wanted, rtol=1e-12)
        np.testing.assert_allclose(slope, wanted_slope, atol=1e-15)
        assert (slope != 0).any()
