"""Pixels outside a mask are skipped; those inside keep every bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    ALL,
    BACKGROUND,
    COMPAT,
    HEIGHT,
    WIDTH,
    assert_not_empty,
    needs_two_devices,
    render,
    scene_of,
)

import gsjax

TILE = COMPAT.tile_size


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


def test_gradients_of_pixels_inside_are_those_of_the_whole(report):
    scene, camera = scene_of("random")
    weights = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH))
    config = COMPAT.replace(outputs=("rgb", "depth"))

    @jax.jit
    def gradient(weight, mask):
        def loss(params, viewmat):
            seen = camera.replace(viewmat=viewmat)
            view = gsjax.render(scene.replace(params=params), seen, config, mask=mask)
            return jnp.sum((view.rgb.sum(-1) + view.depth) * weight)

        return jax.grad(loss, (0, 1))(scene.params, camera.viewmat)

    for name in ("disc", "around"):
        mask = masks()[name]
        whole = gradient(weights * mask, jnp.ones_like(mask))
        some = gradient(weights * mask, mask)
        for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(some), strict=True):
            error = float(jnp.abs(a - b).max() / jnp.abs(a).max())
            report(f"gradient with and without a mask, {name}", error, 1e-11)
            assert error < 1e-11


def test_too_little_capacity_is_reported_and_regrown():
    """With a hole in the mask, whose pairs are counted but not blended."""
    scene, camera = scene_of("huge")
    mask = masks()["around"]
    wanted = render(scene, camera, COMPAT, BACKGROUND, mask=mask)
    cramped = COMPAT.replace(pair_capacity=int(wanted.demand.capacity) - 1)
    assert gsjax.render(scene, camera, cramped, BACKGROUND, mask=mask).overflowed
    found = gsjax.render_exact(scene, camera, cramped, BACKGROUND, mask=mask)
    assert not found.overflowed
    np.testing.assert_array_equal(found.rgb[mask], wanted.rgb[mask])


def test_a_mask_for_each_camera_of_a_batch():
    scene, camera = scene_of("random")
    cameras = jax.tree.map(lambda a: jnp.stack([a, a]), camera)
    pair = np.stack([masks()["disc"], masks()["rows"]])
    both = render(scene, cameras, COMPAT, BACKGROUND, mask=pair)
    mapped = jax.vmap(lambda c, m: gsjax.render(scene, c, COMPAT, BACKGROUND, mask=m))
    in_vmap = jax.jit(mapped)(cameras, pair)
    for index, mask in enumerate(pair):
        alone = render(scene, camera, COMPAT, BACKGROUND, mask=mask)
        np.testing.assert_array_equal(both.rgb[index], alone.rgb)
        np.testing.assert_allclose(in_vmap.rgb[index], alone.rgb, atol=1e-12)
        assert int(in_vmap.demand.pairs[index]) == int(alone.demand.pairs)
