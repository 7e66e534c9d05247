"""What training minimises is what its formula says."""

import jax
import numpy as np
import pytest

from gsjax.losses import l1, photometric
from gsjax.metrics import ssim


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


def test_without_ssim_none_is_computed():
    x, y, _ = pictures()
    program = str(jax.make_jaxpr(lambda a, b: photometric(a, b, None, 0.0))(x, y))
    assert "dot_general" not in program
    assert "dot_general" in str(jax.make_jaxpr(photometric)(x, y))


def test_l1_of_what_is_masked():
    x, y, weight = pictures()
    spoilt = np.where(weight[..., None] > 0, x, np.nan)
    value, grad = jax.value_and_grad(l1)(spoilt, y, weight)
    wanted, slope = jax.value_and_grad(l1)(x, y, weight)
    assert value == wanted
    np.testing.assert_array_equal(grad, slope)
    assert (slope != 0).any()


def test_nothing_to_see_is_no_loss_to_learn_from():
    x, y, weight = pictures()
    value, grad = jax.value_and_grad(photometric)(x, y, 0 * weight)
    assert np.isfinite(value)
    assert (grad == 0).all()
