"""What changes an image by no more than rounding, and why it changes it at all.

*Tile and chunk sizes*: positions are relative to the tile's corner, and products and
sums are taken chunk by chunk, so they associate differently (≤ 2e-5 in float32). A
*batch* of cameras, *mapped* cameras and the *occlusion* switch: XLA fuses the
projection of another program differently (a few units in the last place).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ALL, BACKGROUND, COMPAT, COUNT, camera_of, cast, render, scene_of
from pictures import KINDS, images, largest_difference

import gsjax


def test_single_batch_and_vmap(report):
    for dtype, bar in ((jnp.float32, 1e-6), (jnp.float64, 4e-15)):
        gaussians, first = cast(scene_of("random"), dtype)
        second = cast(camera_of(centre=(30.0, 8.0)), dtype)
        cameras = gsjax.stack_cameras([first, second])
        background = jnp.asarray(BACKGROUND, dtype)
        batch = render(gaussians, cameras, COMPAT, background)
        mapped = jax.jit(
            jax.vmap(lambda c, g, b: gsjax.render(g, c, COMPAT, b), (0, None, None))
        )(cameras, gaussians, background)
        for i, camera in enumerate((first, second)):
            wanted = images(gaussians, camera, dtype=dtype)
            for way, out in (("batch", batch), ("vmap", mapped)):
                one = out._replace(**{name: getattr(out, name)[i] for name in ALL})
                error = largest_difference(one, wanted)
                report(f"{way}, {dtype.__name__}", error, bar)
                assert error <= bar, way
        assert np.abs(batch.rgb[0] - batch.rgb[1]).max() > 0.1
        assert batch.demand.pairs == mapped.demand.pairs.sum()
        assert batch.demand.visible == mapped.demand.visible.max()
        assert batch.demand.capacity == mapped.demand.capacity.max()


def test_a_batch_of_one(report):
    """It has the leading axis everywhere, radii included."""
    gaussians, camera = cast(scene_of("random"), jnp.float32)
    wanted = images(gaussians, camera)
    batch = images(gaussians, gsjax.stack_cameras([camera]))
    assert batch.radii.shape == (1, COUNT)
    np.testing.assert_allclose(batch.radii[0], wanted.radii, rtol=1e-6)
    assert (wanted.radii > 0).any()
    for name in ALL:
        assert getattr(batch, name).shape == (1, *getattr(wanted, name).shape)
    one = batch._replace(**{name: getattr(batch, name)[0] for name in ALL})
    error = largest_difference(one, wanted)
    report("batch of one", error, 1e-6)
    assert error <= 1e-6
    assert batch.demand == wanted.demand


@pytest.mark.parametrize(
    "changes",
    [
        {"tile_size": 16},
        {"tile_size": 32},
        {"tile_size": 4, "chunk_size": 8},
        {"chunk_size": 128},
    ],
    ids=str,
)
def test_tile_and_chunk_sizes(changes, report):
    for kind in KINDS:
        scene = scene_of(kind)
        found = images(*scene, COMPAT.replace(**changes))
        error = largest_difference(found, images(*scene))
        report(f"{kind}, {changes}", error, 2e-5)
        assert error <= 2e-5, kind


def test_occlusion(report):
    """It drops work, and only what does not show; also with many in front."""
    for dtype, bar in ((jnp.float32, 5e-7), (jnp.float64, 1e-15)):
        for kind in ("wall", "random", "saturated"):
            scene = scene_of(kind)
            plain = images(*scene, COMPAT.replace(occlusion=False), dtype)
            found = images(*scene, dtype=dtype)
            error = largest_difference(found, plain)
            report(f"occlusion, {kind}, {dtype.__name__}", error, bar)
            assert error <= bar, kind
            assert found.demand.pairs <= plain.demand.pairs
            if kind == "wall":
                assert found.demand.pairs < 0.4 * plain.demand.pairs
