"""What changes an image by no more than rounding, and why it changes it at all.

*Tile and chunk sizes*: positions are relative to the tile's corner, and products and
sums are taken chunk by chunk, so they associate differently (≤ 2e-5 in float32). The
*occlusion* switch: XLA fuses the projection of another program differently (a few units
in the last place). Batches are in test_batches.py.
"""

import jax.numpy as jnp
import pytest
from conftest import COMPAT, scene_of
from pictures import KINDS, images, largest_difference


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


@pytest.mark.as_users
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
