"""What is masked or hidden is skipped: that changes no bit, and it does skip."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    ALL,
    BACKGROUND,
    COMPAT,
    COUNT,
    HEIGHT,
    PRESETS,
    WIDTH,
    assert_not_empty,
    camera_of,
    frustum_points,
    gaussians_at,
    needs_two_devices,
    render,
    scene_of,
)
from pictures import assert_same

import gsjax

TILE = COMPAT.tile_size


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


@pytest.mark.parametrize("preset", ["compat", "accurate"])  # both stop rules
@pytest.mark.parametrize(
    ("layers", "across"), [(0, 1.0), (8, 1.0), (40, 0.3), ("wall", None)]
)
def test_culling_behind_opaque_parts_changes_no_bit(preset, layers, across):
    config = PRESETS[preset]
    gaussians, camera = scene_of("wall")
    if layers != "wall":
        gaussians, camera = scene_behind(layers, across), camera_of()
    with_it = render(gaussians, camera, config=config)
    without = render(gaussians, camera, config=config.replace(occlusion=False))
    assert not with_it.overflowed
    assert_not_empty(with_it.alpha)
    assert_same(with_it, without)
    seen, whole = np.asarray(with_it.visible), np.asarray(without.visible)
    assert not (seen & ~whole).any()
    pairs = int(with_it.demand.pairs) / int(without.demand.pairs)
    if layers == 0:
        np.testing.assert_array_equal(seen, whole)
        assert pairs == 1
    if layers == 8:
        assert seen.sum() < 0.9 * whole.sum()
    assert pairs <= {8: 0.6, "wall": 0.4}.get(layers, 1)


@pytest.mark.parametrize("value", [np.nan, 1e33])
def test_gaussians_that_are_not_drawn_hide_nothing(value):
    """Opaque, wide and in front, but with a colour that cannot be drawn."""
    gaussians, camera, features = scene_behind(8), camera_of(), jnp.ones((COUNT, 2))
    sh = gaussians.params.sh.at[:8, -1, 1].set(value)
    spoilt = gaussians.replace(params=gaussians.params.replace(sh=sh))
    config = PRESETS["compat"]
    for scene, colors in ((spoilt, None), (gaussians, features.at[:8, 1].set(value))):
        found = render(scene, camera, config, features=colors)
        whole = render(scene, camera, config.replace(occlusion=False), features=colors)
        assert_same(found, whole, (*ALL, "radii"))
    good = render(gaussians, camera, config, features=features)
    assert good.visible.sum() < 0.9 * whole.visible.sum()


def masks() -> dict[str, np.ndarray]:
    """[H, W] bool: a disc, what is around it, a few rows, one pixel, nothing."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    disc = (x - 15) ** 2 + (y - 12) ** 2 < 10**2
    pixel = np.zeros_like(disc)
    pixel[20, 33] = True
    return {
        "disc": disc,
        "around": ~disc,
        "rows": (y > 5) & (y < 9),
        "pixel": pixel,
        "nothing": np.zeros_like(disc),
    }


def tiles_of(mask: np.ndarray) -> np.ndarray:
    """Return [rows, cols] bool: tiles that hold a pixel of the mask."""
    padded = np.pad(mask, ((0, -HEIGHT % TILE), (0, -WIDTH % TILE)))
    rows, cols = (size // TILE for size in padded.shape)
    return padded.reshape(rows, TILE, cols, TILE).any((1, 3))


def pixels_of(tiles: np.ndarray) -> np.ndarray:
    return np.kron(tiles, np.ones((TILE, TILE), bool))[:HEIGHT, :WIDTH]


@pytest.mark.parametrize("devices", [1, pytest.param(2, marks=needs_two_devices)])
@pytest.mark.parametrize("kind", ["random", "huge"])
def test_pixels_inside_keep_every_bit(kind, devices):
    scene, camera = scene_of(kind)
    config = COMPAT.replace(devices=devices)
    whole = render(scene, camera, config, BACKGROUND)
    assert_not_empty(whole.alpha)
    for name, mask in masks().items():
        some = render(scene, camera, config, BACKGROUND, mask=mask)
        for output in ALL:
            wanted, found = getattr(whole, output), getattr(some, output)
            np.testing.assert_array_equal(wanted[mask], found[mask], err_msg=name)
        np.testing.assert_array_equal(whole.radii, some.radii)
        if (kind, name) != ("huge", "around"):  # there all splats span the hole
            assert int(some.demand.pairs) < int(whole.demand.pairs), name
        outside = ~pixels_of(tiles_of(mask))
        assert outside.any()
        assert (np.asarray(some.alpha)[outside] == 0).all()
        assert np.abs(np.asarray(some.rgb)[outside] - BACKGROUND).max() <= 1e-12
    everything = render(scene, camera, config, BACKGROUND, mask=mask | True)
    assert int(everything.demand.pairs) == int(whole.demand.pairs)
    np.testing.assert_array_equal(everything.rgb, whole.rgb)


def test_no_pair_outside_of_the_mask():
    """If rows of tiles have no gap, exactly the pairs of the tiles are counted."""
    scene, camera = scene_of("random")

    def pairs(mask):
        return int(render(scene, camera, COMPAT, BACKGROUND, mask=mask).demand.pairs)

    for name in ("disc", "rows", "pixel", "nothing"):
        tiles, total = tiles_of(masks()[name]), 0
        for row, col in np.argwhere(tiles):
            alone = np.zeros_like(tiles)
            alone[row, col] = True
            total += pairs(pixels_of(alone))
        assert pairs(masks()[name]) == total
        assert (name == "nothing") == (total == 0)


def test_gradients_do_not_depend_on_what_is_skipped(report):
    scene, camera = scene_behind(8), camera_of()
    weights = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH))

    @partial(jax.jit, static_argnames="occlusion")
    def gradient(weight, mask, occlusion=False):
        config = COMPAT.replace(outputs=("rgb", "depth"), occlusion=occlusion)

        def loss(params, viewmat):
            seen = camera.replace(viewmat=viewmat)
            view = gsjax.render(scene.replace(params=params), seen, config, mask=mask)
            return jnp.sum((view.rgb.sum(-1) + view.depth) * weight)

        return jax.grad(loss, (0, 1))(scene.params, camera.viewmat)

    every = np.ones_like(weights)
    culled, whole = (gradient(every, every > 0, occlusion=o) for o in (True, False))
    for a, b in zip(jax.tree.leaves(culled[0]), jax.tree.leaves(whole[0])):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    for name in ("disc", "around"):
        mask = masks()[name]
        whole = gradient(weights * mask, every > 0)
        some = gradient(weights * mask, mask)
        for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(some), strict=True):
            error = float(jnp.abs(a - b).max() / jnp.abs(a).max())
            report(f"gradient with and without a mask, {name}", error, 1e-11)
            assert error < 1e-11
