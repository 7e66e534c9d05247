"""Laws of the optimiser: Adam, learning rates by label, inactive slots."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from gsjax.gaussians import GaussianParams
from gsjax.train.optimiser import Rates, gaussian_rates, make_optimiser

COUNT, EXTENT, STEPS = 5, 3.0, 7
RATES = Rates(means=(2e-3, 5e-5), quats=3e-3, cooling=0.2)
SHAPES = {
    "means": (3,),
    "quats": (4,),
    "log_scales": (3,),
    "logit_opacities": (),
    "sh": (9, 3),
}


@partial(jax.jit, static_argnums=0)
def step(rates, params, grads, moments, fraction):
    optimiser = make_optimiser(gaussian_rates(rates, EXTENT))
    moments = optimiser.init(params) if moments is None else moments
    updates, moments = optimiser.update(grads, moments, params, fraction=fraction)
    return optax.apply_updates(params, updates), moments


def draw(rng, dtype=np.float64):
    return GaussianParams(
        **{
            name: jnp.asarray(rng.normal(size=(COUNT, *shape)), dtype)
            for name, shape in SHAPES.items()
        }
    )


def rate_of(rates, name, fraction):
    """Return the rate after a fraction of the run, which may exceed 1."""
    fraction = min(fraction, 1)
    if name == "means":
        first, last = rates.means
        return EXTENT * first ** (1 - fraction) * last**fraction
    late = max(0, fraction - rates.cooling_from) / (1 - rates.cooling_from)
    share = rates.cooling**late
    if name == "sh":
        return share * np.where(np.arange(9) == 0, rates.sh_dc, rates.sh_rest)[:, None]
    return share * getattr(rates, name)


@pytest.mark.parametrize(
    "rates",
    [
        RATES,
        RATES._replace(means=(1e-3, 1e-3), cooling_from=0.0),
        Rates(means=(0.0, 0.0)),
    ],
)
def test_the_update_is_that_of_adam(rates):
    """Rates are log-linear in the fraction of the run, and constant beyond 1."""
    rng = np.random.default_rng(0)
    params, moments = draw(rng), None
    wanted = {name: np.asarray(getattr(params, name)) for name in SHAPES}
    first = {name: np.zeros_like(value) for name, value in wanted.items()}
    second = {name: np.zeros_like(value) for name, value in wanted.items()}
    for count in range(1, STEPS + 1):
        grads, fraction = draw(rng), (count - 1) / (STEPS - 2)
        params, moments = step(rates, params, grads, moments, fraction)
        for name in SHAPES:
            g = np.asarray(getattr(grads, name))
            first[name] = 0.9 * first[name] + 0.1 * g
            second[name] = 0.999 * second[name] + 0.001 * g * g
            m, v = first[name] / (1 - 0.9**count), second[name] / (1 - 0.999**count)
            rate = rate_of(rates, name, fraction)
            wanted[name] = wanted[name] - rate * m / (np.sqrt(v) + 1e-15)
            np.testing.assert_allclose(getattr(params, name), wanted[name], rtol=1e-10)
            np.testing.assert_allclose(getattr(moments[0].mu, name), first[name])


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

    params = start = jax.tree.map(fill(garbage), draw(rng, np.float32))
    moments = None
    for _ in range(3):
        grads = jax.tree.map(fill(0), draw(rng, np.float32))
        params, moments = step(RATES, params, grads, moments, 0.5)
    for name in SHAPES:
        before, after = getattr(start, name), getattr(params, name)
        assert after.dtype == np.float32
        np.testing.assert_array_equal(after[dead], before[dead])
        assert (after[~dead] != before[~dead]).all()
        for moment in (moments[0].mu, moments[0].nu):
            assert (getattr(moment, name)[dead] == 0).all()
