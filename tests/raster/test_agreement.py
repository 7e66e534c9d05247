"""What changes an image by no more than rounding, and why it changes it at all.

*Tile and chunk sizes*: positions are relative to the tile's corner, and products and
sums are taken chunk by chunk, so they associate differently (≤ 2e-5 in float32). The
*occlusion* switch: XLA fuses the projection of another program differently (a few units
in the last place). Batches are in test_batches.py.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import WHOLE, camera_of, pose, scene_of
from pictures import KINDS, images, largest_difference

import gsjax
from gsjax.math.numerics import in_float64


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
        found = images(*scene, WHOLE.replace(**changes))
        error = largest_difference(found, images(*scene))
        report(f"{kind}, {changes}", error, 2e-5)
        assert error <= 2e-5, kind


@pytest.mark.as_users
def test_occlusion(report):
    """It drops work, and only what does not show; also with many in front."""
    for dtype, bar in ((jnp.float32, 5e-7), (jnp.float64, 1e-15)):
        for kind in ("wall", "random", "saturated"):
            scene = scene_of(kind)
            plain = images(*scene, WHOLE.replace(occlusion=False), dtype)
            found = images(*scene, dtype=dtype)
            error = largest_difference(found, plain)
            report(f"occlusion, {kind}, {dtype.__name__}", error, bar)
            assert error <= bar, kind
            assert found.demand.pairs <= plain.demand.pairs
            if kind == "wall":
                assert found.demand.pairs < 0.4 * plain.demand.pairs


def test_depths_that_differ_by_less_than_a_step_of_float32(report):
    """Opaque ones, each before the next by less than float32 can tell of its z, in any
    order of slots, far from the origin: their order is that of the numbers stored."""
    rng, count = np.random.default_rng(0), 64
    viewmat = (
        pose()
        @ np.r_[np.eye(4)[:3] + [[0, 0, 0, x] for x in (9, -7, 5)], [[0, 0, 0, 1]]]
    )
    camera = camera_of(viewmat=viewmat)
    to_world = np.linalg.inv(np.asarray(camera.viewmat, np.float64))
    seen = np.c_[np.zeros((count, 2)), 3 + 2e-8 * np.arange(count), np.ones(count)]
    fields = {
        "means": (seen @ to_world.T)[:, :3],
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "log_scales": np.full((count, 3), -2.0),
        "logit_opacities": np.full(count, 1.0),
        "sh": rng.uniform(-1, 2, (count, 1, 3)),
    }
    mixed = rng.permutation(count)
    with jax.enable_x64(False):
        fields = {name: np.asarray(v[mixed], np.float32) for name, v in fields.items()}
        scene, narrow = (
            gsjax.make_gaussians(**fields),
            jax.tree.map(jnp.float32, camera),
        )
        found = gsjax.render_exact(scene, narrow, WHOLE).rgb
        row, means = np.asarray(narrow.viewmat)[2], fields["means"]
        as_computed = sum(row[i] * means[:, i] for i in range(3)) + row[3]
    wide, camera = in_float64((scene, narrow))
    z = np.asarray(wide.params.means) @ np.asarray(camera.viewmat)[2, :3]
    # What float32 makes of it is another order.
    assert (np.argsort(z) != np.argsort(as_computed, kind="stable")).any()
    wanted = gsjax.render_exact(wide, camera, WHOLE).rgb
    error = float(jnp.abs(found - wanted).max())
    report("order within a step of float32", error, 1e-5)
    assert error <= 1e-5
