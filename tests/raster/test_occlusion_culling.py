"""What is left out behind opaque parts changes no bit, and it is left out indeed."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    ALL,
    COUNT,
    HEIGHT,
    PRESETS,
    WIDTH,
    assert_not_empty,
    camera_of,
    frustum_points,
    gaussians_at,
    render,
)
from stages import order_of, project

from gsjax.raster.lists.occlusion_culling import (
    ALPHA_MARGIN,
    SQUARE,
    STOP_MARGIN,
    _halve,
    closed_from,
)
from gsjax.raster.types import Splat


def scene_behind(layers: int, across: float = 1.0):
    """COUNT Gaussians, of which the nearest ``layers`` are wide and opaque.

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


@partial(jax.jit, static_argnames="config")
def front_to_back(gaussians, camera, config):
    """The order with and without what is hidden, and what was projected of it all."""
    whole = config.replace(occlusion=False)
    order, count = order_of(gaussians, camera, whole)
    left, _ = order_of(gaussians, camera, config)
    return order, left, project(gaussians, camera, whole, order, count)


@pytest.mark.new_emitters
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize(("layers", "across"), [(0, 1.0), (8, 1.0), (40, 0.3)])
def test_bit_equal_with_and_without(preset, layers, across):
    config = PRESETS[preset]
    gaussians, camera = scene_behind(layers, across), camera_of()
    with_it = render(gaussians, camera, config=config)
    without = render(gaussians, camera, config=config.replace(occlusion=False))
    assert not with_it.overflowed
    assert_not_empty(with_it.alpha)
    for name in ALL:
        np.testing.assert_array_equal(getattr(with_it, name), getattr(without, name))
    seen, whole = np.asarray(with_it.visible), np.asarray(without.visible)
    assert not (seen & ~whole).any()
    if layers == 0:
        np.testing.assert_array_equal(seen, whole)
    if layers == 8:
        assert seen.sum() < 0.9 * whole.sum()
        assert int(with_it.demand.pairs) < 0.6 * int(without.demand.pairs)
    if layers == 0:
        assert int(with_it.demand.pairs) == int(without.demand.pairs)


@pytest.mark.parametrize("kind", ["colours", "features"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e33])
def test_what_is_not_drawn_hides_nothing(kind, value):
    """Opaque, wide and before all others, but with a colour that cannot be drawn."""
    gaussians, camera, config = scene_behind(8), camera_of(), PRESETS["compat"]
    features = np.ones((COUNT, 2))
    if kind == "colours":
        sh = gaussians.params.sh.at[:8, -1, 1].set(value)
        gaussians = gaussians.replace(params=gaussians.params.replace(sh=sh))
    else:
        features[:8, 1] = value
    given = jnp.asarray(features) if kind == "features" else None
    whole, count = order_of(gaussians, camera, config.replace(occlusion=False))
    order, left = order_of(gaussians, camera, config, given)
    assert left == count
    np.testing.assert_array_equal(order, whole)
    good, _ = order_of(scene_behind(8), camera, config, jnp.ones((COUNT, 2)))
    assert (np.asarray(good) < COUNT).sum() < 0.9 * count


@pytest.mark.parametrize("preset", PRESETS)
def test_what_is_hidden_was_never_blended(preset):
    """Against a dense composite: no pixel gives a hidden rank any weight."""
    config, camera = PRESETS[preset], camera_of()
    order, left, p = front_to_back(scene_behind(40, 0.5), camera, config)
    behind = ~np.isin(order, left)
    assert 10 < behind[np.asarray(p.footprint.reach) > 0].sum() < COUNT
    ys, xs = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    columns = p.splat.u, p.splat.v, *p.splat.shape
    u, v, inv_sx, slope, inv_sy, opacity = (
        np.asarray(a)[:, None, None] for a in columns
    )
    dx, dy = xs - u, ys - v
    y2 = inv_sy * (dy - slope * dx)
    alpha = opacity * np.exp(-0.5 * ((inv_sx * dx) ** 2 + y2**2))
    alpha = np.minimum(alpha, config.alpha_max) * (alpha >= config.alpha_min)
    after = np.cumprod(1 - alpha, axis=0)
    before = np.concatenate([np.ones_like(after[:1]), after[:-1]])
    tested = after if config.stop_rule == "before" else before
    blended = (alpha > 0) & (tested > config.transmittance_min)
    assert not blended[behind].any()
    assert blended[~behind].any()


def test_gradients_agree():
    config, camera = PRESETS["compat"], camera_of()
    gaussians = scene_behind(8)

    def gradient(config):
        def loss(params):
            return (
                render(gaussians.replace(params=params), camera, config=config)
                .rgb[..., 0]
                .sum()
            )

        return jax.grad(loss)(gaussians.params)

    one, other = gradient(config), gradient(config.replace(occlusion=False))
    assert float(abs(one.means).max()) > 0
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other)):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


def test_a_square_stays_open_without_candidates():
    config, camera = PRESETS["compat"], camera_of()
    *_, p = front_to_back(scene_behind(40, 0.5), camera, config)
    search = jax.jit(closed_from, static_argnums=(3, 4))
    for count, some in ((0, False), (40, True)):
        args = p.splat, p.channels.depth, np.int32(count), (WIDTH, HEIGHT), config
        closed = search(*args)
        assert (np.asarray(closed) < np.inf).any() == some


@pytest.mark.parametrize("count", [7, 33, 40])
def test_squares_close_where_the_corners_are_opaque(count):
    """Against a loop over Gaussians, of which a step takes 16, and the last fewer."""
    config, camera = PRESETS["compat"], camera_of()
    *_, p = front_to_back(scene_behind(40, 0.5), camera, config)
    splats = [np.asarray(a)[:40] for a in (p.splat.u, p.splat.v, *p.splat.shape)]
    depth = np.asarray(p.channels.depth)[:40]
    splats[-1] = np.where(np.arange(40) < count, splats[-1], 0)
    search = jax.jit(closed_from, static_argnums=(3, 4))
    front = Splat(*splats[:2], tuple(splats[2:]))
    closed = search(front, depth, np.int32(count), (WIDTH, HEIGHT), config)
    rows, cols = closed.shape
    x, y = np.meshgrid(np.arange(cols + 1) * SQUARE, np.arange(rows + 1) * SQUARE)
    through, wanted = np.ones((rows, cols)), np.full((rows, cols), np.inf)
    for u, v, inv_sx, slope, inv_sy, opacity, far in zip(*splats, depth):
        y1, y2 = inv_sx * (x - u), inv_sy * (y - v - slope * (x - u))
        alpha = opacity * np.exp(-0.5 * (y1 * y1 + y2 * y2)) * ALPHA_MARGIN
        alpha = np.where(alpha > config.alpha_min, alpha, 0).clip(max=config.alpha_max)
        four = alpha[:-1, :-1], alpha[:-1, 1:], alpha[1:, :-1], alpha[1:, 1:]
        through *= 1 - np.min(four, axis=0)
        shut = (through <= config.transmittance_min * STOP_MARGIN) & (wanted == np.inf)
        wanted[shut] = far
    assert (wanted < np.inf).any() == (count > 7)
    assert (wanted == np.inf).any()
    np.testing.assert_array_equal(closed, wanted)


def test_halve_takes_maxima_of_what_exists():
    closed = np.arange(15, dtype=np.float32).reshape(3, 5)
    np.testing.assert_array_equal(_halve(closed), [[6, 8, 9], [11, 13, 14]])
