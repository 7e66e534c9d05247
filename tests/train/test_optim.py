"""Laws of the optimiser: Adam, learning rates by label, inactive slots."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from gsjax.gaussians import GaussianParams
from gsjax.train.optimiser import (
    Rates,
    cooling_factor,
    gaussian_rates,
    make_optimiser,
    means_rate,
)

COUNT, EXTENT, STEPS = 5, 3.0, 7
RATES = Rates(means=(2e-3, 5e-5), quats=3e-3, cooling=0.2)
SHAPES = {
    "means": (3,),
    "quats": (4,),
    "log_scales": (3,),
    "logit_opacities": (),
    "sh": (9, 3),
}

OPTIMISER = make_optimiser(gaussian_rates(RATES, EXTENT))


@jax.jit
def step(params, grads, moments, fraction):
    updates, moments = OPTIMISER.update(grads, moments, params, fraction=fraction)
    return optax.apply_updates(params, updates), moments


def draw(rng, dtype=np.float64):
    return GaussianParams(
        **{
            name: jnp.asarray(rng.normal(size=(COUNT, *shape)), dtype)
            for name, shape in SHAPES.items()
        }
    )


def rate_of(name, fraction):
    if name == "means":
        first, last = RATES.means
        logs = (1 - fraction) * np.log(first) + fraction * np.log(last)
        return EXTENT * np.exp(logs)
    share = 1 if fraction < 0.6 else 0.2 ** ((fraction - 0.6) / 0.4)
    if name == "sh":
        return share * np.where(np.arange(9) == 0, RATES.sh_dc, RATES.sh_rest)[:, None]
    return share * getattr(RATES, name)


def test_the_update_is_that_of_adam():
    rng = np.random.default_rng(0)
    params = draw(rng)
    moments = OPTIMISER.init(params)
    wanted = {name: np.asarray(getattr(params, name)) for name in SHAPES}
    first = {name: np.zeros_like(value) for name, value in wanted.items()}
    second = {name: np.zeros_like(value) for name, value in wanted.items()}
    for count in range(1, STEPS + 1):
        grads = draw(rng)
        fraction = (count - 1) / STEPS
        params, moments = step(params, grads, moments, fraction)
        for name in SHAPES:
            g = np.asarray(getattr(grads, name))
            first[name] = 0.9 * first[name] + 0.1 * g
            second[name] = 0.999 * second[name] + 0.001 * g * g
            m, v = first[name] / (1 - 0.9**count), second[name] / (1 - 0.999**count)
            wanted[name] = wanted[name] - rate_of(name, fraction) * m / (
                np.sqrt(v) + 1e-15
            )
            np.testing.assert_allclose(getattr(params, name), wanted[name], rtol=1e-10)
            np.testing.assert_allclose(getattr(moments[0].mu, name), first[name])


def test_the_first_step_is_the_rate():
    rng = np.random.default_rng(1)
    params = draw(rng)
    grads = jax.tree.map(lambda a: a * 1e-6, draw(rng))
    moved, _ = step(params, grads, OPTIMISER.init(params), 0.0)
    for name in SHAPES:
        shift = getattr(moved, name) - getattr(params, name)
        wanted = -np.sign(getattr(grads, name)) * rate_of(name, 0.0)
        np.testing.assert_allclose(shift, wanted, rtol=1e-4)  # of ε


def test_the_rate_of_the_means_is_log_linear():
    fractions = np.linspace(0, 1, 11)
    found = [means_rate(RATES, f, EXTENT) for f in fractions]
    wanted = np.geomspace(2e-3, 5e-5, 11) * EXTENT
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
    assert means_rate(RATES, 2.0, EXTENT) == pytest.approx(wanted[-1], rel=1e-6)
    for rate in (0.0, 1e-3):
        constant = means_rate(Rates(means=(rate, rate)), jnp.asarray(0.3), EXTENT)
        assert constant == pytest.approx(rate * EXTENT)


def test_cooling_is_constant_and_then_log_linear():
    fractions = jnp.asarray([0.0, 0.3, 0.6, 0.8, 1.0, 1.5])
    wanted = [1.0, 1.0, 1.0, np.sqrt(0.2), 0.2, 0.2]
    np.testing.assert_allclose(cooling_factor(RATES, fractions), wanted, rtol=1e-6)
    assert (cooling_factor(Rates(), fractions) == 1).all()
    early = RATES._replace(cooling_from=0.0)
    np.testing.assert_allclose(
        cooling_factor(early, fractions), 0.2 ** fractions.clip(0, 1)
    )


@pytest.mark.parametrize("garbage", [-1.5, np.nan, np.inf])
def test_slots_without_gradient_are_kept(garbage):
    """Whatever inactive slots contain; their moments stay zero."""
    rng = np.random.default_rng(2)
    dead = np.asarray([False, True, False, True, False])

    def fill(value):
        def one(leaf):
            wide = dead.reshape(-1, *(1,) * (leaf.ndim - 1))
            return jnp.where(wide, jnp.asarray(value, leaf.dtype), leaf)

        return one

    start = jax.tree.map(fill(garbage), draw(rng, np.float32))
    params, moments = start, OPTIMISER.init(start)
    for _ in range(3):
        grads = jax.tree.map(fill(0), draw(rng, np.float32))
        params, moments = step(params, grads, moments, 0.5)
    for name in SHAPES:
        before, after = getattr(start, name), getattr(params, name)
        assert after.dtype == np.float32
        np.testing.assert_array_equal(after[dead], before[dead])
        assert (after[~dead] != before[~dead]).all()
        for moment in (moments[0].mu, moments[0].nu):
            assert (getattr(moment, name)[dead] == 0).all()
