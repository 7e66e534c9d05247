"""A strategy beside a training loop of one's own."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from training import EXTENT, HEIGHT, RASTER, WIDTH, dataset, photos, rough_start

import gsjax
from gsjax.densify.adaptive import AdaptiveSettings, adaptive
from gsjax.densify.mcmc import McmcSettings, mcmc
from gsjax.densify.types import Observation, apply_edit

EDITS = {"start": 0, "stop": 12, "every": 4}
ADAPTIVE = adaptive(AdaptiveSettings(**EDITS, threshold=1e-6, reset_every=0), EXTENT)
MCMC = mcmc(McmcSettings(**EDITS, growth=1.3), EXTENT)


@pytest.mark.parametrize("strategy", [ADAPTIVE, MCMC], ids=["adaptive", "mcmc"])
def test_loop(strategy):
    """The loop of the docstring of `Strategy`, with optax.adam."""
    view, target = dataset().views[0], jnp.asarray(photos()[0].pixels / 255)
    camera = gsjax.make_camera(
        viewmat=view.viewmat, K=view.K, width=WIDTH, height=HEIGHT
    )
    optimiser, raster = optax.adam(1e-2), RASTER.replace(outputs=("rgb",))

    @jax.jit
    def update(gaussians, optimiser_state, stats, key):
        def loss(params, probe):
            scene = gaussians.replace(params=params)
            image = gsjax.render(scene, camera, raster, probe=probe)
            return jnp.mean((image.rgb - target) ** 2), image.radii

        probe = jnp.zeros((gaussians.capacity, 2))
        by, radii = jax.grad(loss, (0, 1), has_aux=True)(gaussians.params, probe)
        updates, optimiser_state = optimiser.update(by[0], optimiser_state)
        params = optax.apply_updates(gaussians.params, updates)
        gaussians = gaussians.replace(params=params)
        if strategy.perturb is not None:
            params = strategy.perturb(key, gaussians, jnp.asarray(1e-6))
            gaussians = gaussians.replace(params=params)
        seen = Observation(by[1][None], radii[None], WIDTH, HEIGHT)
        return gaussians, optimiser_state, strategy.observe(stats, seen)

    gaussians = rough_start(0, 96)
    stats, state = strategy.init(gaussians), optimiser.init(gaussians.params)
    counts = []
    for step in range(1, 13):
        key = jax.random.key(step)
        gaussians, state, stats = update(gaussians, state, stats, key)
        if strategy.due(step):
            edit, stats = strategy.plan(key, jnp.int32(step), gaussians, stats)
            gaussians, state = apply_edit(edit, state)
            counts.append(int(gsjax.num_active(gaussians)))
            cleared = np.asarray(edit.cleared)
            assert (state[0].mu.means[cleared] == 0).all()
            assert (state[0].mu.means[~cleared] != 0).any()
    assert len(counts) == 3
    assert 60 < counts[0] <= counts[-1] <= 96
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(gaussians.params))
