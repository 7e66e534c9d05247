"""Pixels that are not wanted are skipped, and those that are do not change."""

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
    camera_of,
    needs_two_devices,
    render,
    scene_of,
)

import gsjax
from gsjax.errors import InputError

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
    """[rows, cols] of tiles that hold a wanted pixel."""
    padded = np.pad(mask, ((0, -HEIGHT % TILE), (0, -WIDTH % TILE)))
    rows, cols = (size // TILE for size in padded.shape)
    return padded.reshape(rows, TILE, cols, TILE).any((1, 3))


@pytest.mark.new_emitters
@pytest.mark.parametrize("devices", [1, pytest.param(2, marks=needs_two_devices)])
@pytest.mark.parametrize("kind", ["random", "huge", "wall"])
def test_wanted_pixels_are_the_same_bits(kind, devices):
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
        if kind != "huge" or name != "around":  # where all splats span the hole
            assert int(some.demand.pairs) < int(whole.demand.pairs), name
        outside = ~np.kron(tiles_of(mask), np.ones((TILE, TILE), bool))
        outside = outside[:HEIGHT, :WIDTH]
        assert outside.any()
        assert (np.asarray(some.alpha)[outside] == 0).all()
    everything = render(scene, camera, config, BACKGROUND, mask=mask | True)
    assert int(everything.demand.pairs) == int(whole.demand.pairs)
    np.testing.assert_array_equal(everything.rgb, whole.rgb)


@pytest.mark.parametrize("name", ["disc", "rows", "pixel", "nothing"])
def test_no_pair_outside_of_what_is_wanted(name):
    """Of a mask whose rows of tiles have no gap, the counts are just those inside."""
    scene, camera = scene_of("random")
    mask = masks()[name]
    every_tile = {}
    for row, col in np.argwhere(tiles_of(mask)):
        alone = np.zeros_like(mask)
        alone[row * TILE : (row + 1) * TILE, col * TILE : (col + 1) * TILE] = True
        every_tile[row, col] = int(
            render(scene, camera, COMPAT, mask=alone).demand.pairs
        )
    found = render(scene, camera, COMPAT, BACKGROUND, mask=mask)
    assert int(found.demand.pairs) == sum(every_tile.values())
    tiles = np.kron(tiles_of(mask), np.ones((TILE, TILE), bool))[:HEIGHT, :WIDTH]
    assert (np.asarray(found.alpha)[~tiles] == 0).all()
    outside = np.asarray(found.rgb)[~tiles]
    np.testing.assert_allclose(
        outside, np.broadcast_to(BACKGROUND, outside.shape), rtol=1e-12
    )
    assert (name == "nothing") == (not every_tile)


@pytest.mark.parametrize("name", ["disc", "around"])
def test_gradients_of_wanted_pixels_are_those_of_the_whole(name, report):
    scene, camera = scene_of("random")
    mask = masks()[name]
    weight = np.random.default_rng(0).normal(size=mask.shape) * mask

    def gradient(skip):
        def loss(params, camera):
            view = gsjax.render(
                scene.replace(params=params), camera, COMPAT,
                mask=jnp.asarray(mask) if skip else None,
            )  # fmt: skip
            return jnp.sum((view.rgb.sum(-1) + view.depth) * weight)

        return jax.jit(jax.grad(loss, (0, 1)))(scene.params, camera)

    one, other = gradient(False), gradient(True)
    worst = 0.0
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        if not jnp.issubdtype(a.dtype, jnp.floating):
            continue
        scale = float(jnp.abs(a).max())
        worst = max(worst, float(jnp.abs(a - b).max()) / max(scale, 1e-30))
    assert float(jnp.abs(one[0].means).max()) > 0
    report("gradient with and without what is not wanted", worst, 1e-11)
    assert worst < 1e-11


def test_too_little_room_is_told_and_regrown():
    """Of a mask with a hole, whose pairs are counted but not blended."""
    scene, camera = scene_of("huge")
    mask = masks()["around"]
    wanted = render(scene, camera, COMPAT, mask=mask)
    cramped = COMPAT.replace(pair_capacity=int(wanted.demand.capacity) - 1)
    assert bool(render(scene, camera, cramped, mask=mask).overflowed)
    found = gsjax.render_exact(scene, camera, cramped, mask=mask)
    assert not bool(found.overflowed)
    np.testing.assert_array_equal(found.rgb[mask], wanted.rgb[mask])


def test_a_mask_for_each_camera_of_a_batch():
    scene, camera = scene_of("random")
    cameras = jax.tree.map(lambda a: jnp.stack([a, a]), camera)
    pair = np.stack([masks()["disc"], masks()["rows"]])
    both = render(scene, cameras, COMPAT, mask=pair)
    mapped = jax.vmap(lambda c, m: gsjax.render(scene, c, COMPAT, mask=m))
    in_vmap = jax.jit(mapped)(cameras, pair)
    for index, mask in enumerate(pair):
        alone = render(scene, camera, COMPAT, mask=mask)
        np.testing.assert_array_equal(both.rgb[index], alone.rgb)
        np.testing.assert_allclose(in_vmap.rgb[index], alone.rgb, atol=1e-12)
        assert int(in_vmap.demand.pairs[index]) == int(alone.demand.pairs)


@pytest.mark.parametrize(
    "mask", [np.ones((HEIGHT, WIDTH + 1), bool), np.ones((HEIGHT, WIDTH))]
)
def test_refusals(mask):
    scene, camera = scene_of("random")
    with pytest.raises(InputError, match=r"mask has shape .* of bool is wanted"):
        gsjax.render(scene, camera_of(), COMPAT, mask=mask)
    batch = jax.tree.map(lambda a: a[None], camera)
    with pytest.raises(InputError, match="mask has shape"):
        gsjax.render(scene, batch, COMPAT, mask=np.ones((HEIGHT, WIDTH), bool))
