"""Claim: one compiled loop over single Gaussians takes no longer than plain C++.

``python benchmarks/one_kernel.py [RUN …]`` times three compositors of one view in turn,
forward: that of the library, chunk by chunk; the C++ of `yardstick`; and a loop that
blends one Gaussian into one tile a turn, in plain JAX, until its pixels have stopped.
XLA makes one kernel of a loop whose turn touches little, by default less than 1 kB
(`gsjax.raster.loops`). A turn of 64 pixels touches three, so this process raises that
limit, by an option that is read when JAX starts. It is an experiment: the library has
no such compositor. Its picture is held against that of the chunks, and the program
fails if they differ, or if XLA made no single kernel.
"""

from __future__ import annotations

import os
import sys

# Before JAX starts, and before `as_cli` starts this process anew.
os.environ["XLA_FLAGS"] = " ".join(
    [
        os.environ.get("XLA_FLAGS", ""),
        "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=65536",
    ]
)

import as_cli  # noqa: F401
import compositor
import jax
import jax.numpy as jnp
import measure
import numpy as np
import scenes
from jax import lax

import gsjax
from gsjax.numerics import exp_negative
from gsjax.raster import bins
from gsjax.raster.alpha import pixel_centres
from gsjax.raster.blend import columns_of, table_of
from gsjax.raster.composite import composite
from gsjax.raster.types import Array, Projected, RasterConfig

BETWEEN = 8  # turns from one look at who has stopped to the next
LOOPS = 3  # over tiles, over looks, over Gaussians
TOLERANCE = 1e-4


def part(values: Array, *start: Array, size: tuple[int, ...] = (1,)) -> Array:
    """A slice that begins within ``values``."""
    return lax.dynamic_slice(values, start, size, allow_negative_indices=False)


def by_gaussian(
    projected: Projected,
    lists: bins.Lists,
    device: Array,
    ones: Array,
    grid: bins.Grid,
    config: RasterConfig,
) -> Array:
    """Colours and alpha [T, C, P] of a device's tiles, before the background.

    ``ones`` [P] are 1 in a way that XLA does not know: it works out anew in every
    kernel what it takes for cheap, α for each channel, but not a quotient.
    """
    columns = columns_of(projected._replace(probe=None), config)
    rows = table_of([column for some in columns.values() for column in some])
    channels, width = len(columns["channels"]), rows.shape[1]
    x, y = map(jnp.asarray, pixel_centres(grid.tile, rows.dtype))
    tiles = lax.iota(jnp.int32, grid.tiles)
    left, top = bins.corners(tiles, grid, device, rows.dtype).T

    def of_tile(tile, images):
        start = part(lists.start, tile)
        end = start + part(lists.length, tile)
        corner_x, corner_y = part(left, tile), part(top, tile)

        def blend(state):
            place, end, carried, sums = state
            rank = part(lists.ranks, place[0])[0]
            row = part(rows, rank, jnp.int32(0), size=(1, width))[0]
            u, v, inv_sx, slope, inv_sy, opacity, *values = jnp.split(row, width)
            dx, dy = x - (u - corner_x), y - (v - corner_y)
            y1, y2 = inv_sx * dx, inv_sy * (dy - slope * dx)
            alpha = opacity * exp_negative(-0.5 * (y1 * y1 + y2 * y2))
            alpha = jnp.where(alpha < config.alpha_cap, alpha, config.alpha_cap)
            alpha = jnp.where(alpha >= config.alpha_cut, alpha, 0) / ones
            behind = carried * (1 - alpha)
            reached = behind if config.stop_rule == "before" else carried
            weight = jnp.where(reached > config.stop, carried * alpha, 0) / ones
            sums = tuple(s + weight * value for s, value in zip(sums, values))
            return place + 1, end, behind, sums

        def some(state):
            place, end, carried, sums = state
            there = jnp.minimum(place + BETWEEN, end)
            init = (place, there, carried, sums)
            place, _, carried, sums = lax.while_loop(not_at_end, blend, init)
            return place, end, carried, sums

        def not_at_end(state):
            return state[0][0] < state[1][0]

        def open_(state):
            return not_at_end(state) & jnp.any(state[2] > config.stop)

        nothing = jnp.zeros_like(x)
        init = (start, end, jnp.ones_like(x), (nothing,) * channels)
        *_, sums = lax.while_loop(open_, some, init)
        at = tile, jnp.int32(0), jnp.int32(0)
        return lax.dynamic_update_slice(
            images, jnp.stack(sums)[None], at, allow_negative_indices=False
        )

    images = jnp.zeros((grid.tiles, channels, x.size), rows.dtype)
    return lax.fori_loop(jnp.int32(0), jnp.int32(grid.tiles), of_tile, images)


def measured(case: scenes.Case) -> dict[str, float | str]:
    """A row: milliseconds, and how far the pictures differ."""
    config = gsjax.exact_config(case.gaussians, case.camera)
    given = compositor.prepare(case, config)
    projected, lists, schedule = given.projected, given.lists, given.schedule

    def chunks(device, projected, lists, schedule):
        place = given.grid, given.room, config
        return composite(projected, lists, schedule, device, *place)

    def loop(device, projected, lists, ones):
        return by_gaussian(projected, lists, device, ones, given.grid, config)

    ones = jnp.ones(given.grid.tile**2)
    by_chunk = jax.jit(given.spread(chunks, False, True, True))
    by_loop = jax.jit(given.spread(loop, False, True, False))
    by_loop = by_loop.lower(projected, lists, ones).compile()
    if by_loop.as_text().count('xla_cpu_small_call="true"') != LOOPS:
        raise SystemExit("XLA made no single kernel of the loops")
    images = by_chunk(projected, lists, schedule)["sums"]
    found = by_loop(projected, lists, ones)
    difference = float(jnp.max(jnp.abs(found - images)))
    if not difference < TOLERANCE:
        raise SystemExit(f"{case.name}: pictures differ by {difference}")
    theirs, _ = compositor.reference(case, projected, config)
    ms = measure.interleaved(
        {
            "chunks": lambda: by_chunk(projected, lists, schedule),
            "loop": lambda: by_loop(projected, lists, ones),
            "C++": theirs["C++"],
        }
    )
    pairs = int(np.sum(np.asarray(lists.length), dtype=np.int64))
    return {
        "scene": case.name,
        **{f"{name} ms": value for name, value in ms.items()},
        "loop / chunks": ms["loop"] / ms["chunks"],
        "chunks / C++": ms["chunks"] / ms["C++"],
        "loop / C++": ms["loop"] / ms["C++"],
        "evaluations M, at most": pairs * given.grid.tile**2 / 1e6,
        "largest difference": difference,
    }


def main() -> None:
    """Measure and save."""
    rows = [measured(case) for case in scenes.real_cases(sys.argv[1:])]
    measure.save("one_kernel", rows, claim=__doc__)


if __name__ == "__main__":
    main()
