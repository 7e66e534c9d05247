"""Culling behind opaque parts changes no bit, and it does cull."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    ALL,
    COUNT,
    PRESETS,
    WIDTH,
    assert_not_empty,
    camera_of,
    frustum_points,
    gaussians_at,
    render,
    scene_of,
)
from stages import order_of

import gsjax

RULES = ("compat", "accurate")  # the stop rules "before" and "after"


def scene_behind(layers: int, across: float = 1.0):
    """Return COUNT Gaussians; the nearest ``layers`` are wide and opaque.

    ``across`` is their σ in image widths; they stand in the left half of the view.
    """
    rng = np.random.default_rng(0)
    points = frustum_points(rng, near=3.0)
    scales = np.exp(rng.normal(-2, 0.5, (COUNT, 3)))
    opacities = rng.uniform(0.1, 0.9, COUNT)
    points[:layers] = [-0.25, 0.0, 1.0]
    points[:layers, 2] += 0.01 * np.arange(layers)
    scales[:layers] = across * WIDTH / 40
    opacities[:layers] = 0.9999
    return gaussians_at(points, scales, opacities)


@pytest.mark.parametrize("preset", RULES)
@pytest.mark.parametrize(
    ("layers", "across"), [(0, 1.0), (8, 1.0), (40, 0.3), ("wall", None)]
)
def test_bit_equal_with_and_without(preset, layers, across):
    config = PRESETS[preset]
    gaussians, camera = scene_of("wall")
    if layers != "wall":
        gaussians, camera = scene_behind(layers, across), camera_of()
    with_it = render(gaussians, camera, config=config)
    without = render(gaussians, camera, config=config.replace(occlusion=False))
    assert not with_it.overflowed
    assert_not_empty(with_it.alpha)
    for name in ALL:
        np.testing.assert_array_equal(getattr(with_it, name), getattr(without, name))
    seen, whole = np.asarray(with_it.visible), np.asarray(without.visible)
    assert not (seen & ~whole).any()
    pairs = int(with_it.demand.pairs) / int(without.demand.pairs)
    if layers == 0:
        np.testing.assert_array_equal(seen, whole)
        assert pairs == 1
    if layers == 8:
        assert seen.sum() < 0.9 * whole.sum()
    assert pairs <= {8: 0.6, "wall": 0.4}.get(layers, 1)


def test_gradients_agree():
    gaussians, camera = scene_behind(8), camera_of()

    def gradient(occlusion):
        config = PRESETS["compat"].replace(occlusion=occlusion, outputs=("rgb",))

        def loss(params):
            view = gsjax.render(gaussians.replace(params=params), camera, config)
            return view.rgb[..., 0].sum()

        return jax.jit(jax.grad(loss))(gaussians.params)

    one, other = gradient(True), gradient(False)
    assert float(abs(one.means).max()) > 0
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other)):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


ordered = jax.jit(order_of, static_argnames="config")


@pytest.mark.parametrize("value", [np.nan, 1e33])
def test_gaussians_that_are_not_drawn_hide_nothing(value):
    """Opaque, wide and in front, but with a colour that cannot be drawn."""
    gaussians, camera, config = scene_behind(8), camera_of(), PRESETS["compat"]
    sh = gaussians.params.sh.at[:8, -1, 1].set(value)
    spoilt = gaussians.replace(params=gaussians.params.replace(sh=sh))
    features = jnp.ones((COUNT, 2))
    whole, count = ordered(gaussians, camera, config.replace(occlusion=False))
    for given in ((spoilt, None), (gaussians, features.at[:8, 1].set(value))):
        order, left = ordered(given[0], camera, config, given[1])
        assert left == count
        np.testing.assert_array_equal(order, whole)
    good, _ = ordered(gaussians, camera, config, features)
    assert (np.asarray(good) < COUNT).sum() < 0.9 * count
