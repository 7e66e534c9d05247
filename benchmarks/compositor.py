"""Claim: compositing in JAX takes at most a small multiple of plain C++ on two cores.

``python benchmarks/compositor.py [--queued] [RUN…]`` times the default compositor (8 ×
8 tiles, own lists) against C++ with two threads over the standard exact 16 × 16 lists
of the same scene, without early termination, alternating; forward, and value and
gradient. The C++ gradient is vectorised over pixels (tuned), or goes pixel by pixel as
GPU code does (plain). The chunked compositor is timed too. One view of each run folder
is added. ``--queued`` gives JAX the threads that queued calls need.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import measure
import numpy as np
import scenes
import yardstick
from as_cli import QUEUED
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import gsjax
from gsjax.raster.compositing import fused, schedules
from gsjax.raster.compositing.alpha import alphas, pixel_centres
from gsjax.raster.compositing.blending import (
    running_product,
    splats_of,
    tables_of,
)
from gsjax.raster.compositing.chunked import (
    composite_chunks,
    composite_steps,
    take_rows,
)
from gsjax.raster.compositing.compositor import composite
from gsjax.raster.lists import binning
from gsjax.raster.lists.depth_order import depth_order
from gsjax.raster.primitives.ellipsoid import conics_of, project


class Prepared(NamedTuple):
    """A view up to its tile lists, on every device.

    Attributes:
      spread: (function, whether each argument is divided among devices) → a function of
        the arguments that calls ``function(device, *arguments)`` on every device.
      grid, room: arguments of `composite`.
      project, bin: the stages.
      projected, lists, schedule: their results.
    """

    spread: Callable[..., Callable[..., Any]]
    grid: binning.Grid
    room: int
    project: Callable[..., Any]
    bin: Callable[..., Any]
    projected: Any
    lists: Any
    schedule: Any


def prepare(case: scenes.Case, config: gsjax.RasterConfig) -> Prepared:
    """Compile and run the stages before the compositor."""
    gaussians, camera = case.gaussians, case.camera
    devices = jax.local_device_count()
    grid = binning.make_grid(camera.width, camera.height, config.tile_size, devices)
    group = schedules.tiles_per_step(config, grid)
    pairs, chunk = -(-config.pair_capacity // devices), config.chunk_size
    steps = schedules.step_capacity(pairs, grid, group, chunk)
    mesh = Mesh(np.array(jax.local_devices()), ("tiles",))
    index = jnp.arange(devices, dtype=jnp.int32)

    def spread(function, *sharded):
        """Call ``function(device, *arguments)`` on every device; see `binning.Grid`."""

        def local(device, *arguments):
            arguments = [
                jax.tree.map(lambda x: x[0], a) if s else a
                for a, s in zip(arguments, sharded)
            ]
            out = function(device[0], *arguments)
            return jax.tree.map(lambda x: x[None], out)

        axis = PartitionSpec("tiles")
        specs = tuple(axis if s else PartitionSpec() for s in sharded)
        return lambda *a: jax.shard_map(
            local, mesh=mesh, in_specs=(axis, *specs), out_specs=axis,
            check_vma=False,
        )(index, *a)  # fmt: skip

    @jax.jit
    def projected_of(gaussians, camera):
        order, count = depth_order(gaussians, camera, config)
        return project(gaussians, camera, config, order, count)

    def bin_local(device, projected):
        spans = binning.row_spans(projected, grid, device)
        lists = binning.make_lists(projected, spans, grid, device, pairs)
        return lists, schedules.make_schedule(lists, grid, group, chunk, steps)

    bin_all = jax.jit(spread(bin_local, False))
    # Replicated beforehand, as within one program.
    projected = projected_of(gaussians, camera)
    projected = jax.device_put(projected, NamedSharding(mesh, PartitionSpec()))
    lists, schedule = bin_all(projected)
    return Prepared(
        spread, grid, steps, projected_of, bin_all, projected, lists, schedule
    )


def stages(case: scenes.Case, config: gsjax.RasterConfig):
    """Return compiled stages of one view by name, with their inputs bound."""
    gaussians, camera = case.gaussians, case.camera
    spread, grid, steps, projected_of, bin_all, *given = prepare(case, config)
    projected, lists, schedule = given
    group = schedule.tiles.shape[-1]
    share = -(-config.pair_capacity // jax.local_device_count())

    def composite_local(device, projected, lists, schedule):
        return composite(projected, lists, schedule, device, grid, steps, config)

    def chunks_local(device, projected, lists, schedule):
        return composite_chunks(projected, lists, schedule, device, grid, config)

    # Number of Gaussians of a tile, or of a block of tiles, between two checks for open
    # pixels.
    singly = fused.suits(3, projected.u.dtype.itemsize, grid)
    look, turn = (fused.LOOK, fused.TURN) if singly else (config.chunk_size,) * 2
    looks = 2 * schedules.step_capacity(share, grid, group, look)

    def count_local(device, projected, lists):
        """Return evaluations, those that change the image, and whether all fit.

        The first two are [steps].
        """
        tables = tables_of(projected, config)
        by_look = schedules.make_schedule(lists, grid, group, look, looks)
        unrolled = schedules.make_steps(by_look, looks)
        none = projected.u.shape[0]
        work = schedules.make_work(lists, by_look, unrolled, look, none, looks)
        pixels = pixel_centres(grid.tile, projected.u.dtype)

        def step(carried, inputs):
            first, live, block, ranks = inputs
            corner = binning.corners(by_look.tiles[block], grid, device, pixels.dtype)
            splats = take_rows(tables.splats, ranks)
            carried = jnp.where(first, 1, carried)
            go = live & jnp.any(carried > config.transmittance_min, 1, keepdims=True)
            go = (go if singly else jnp.any(go)) & jnp.ones((group, 1), bool)
            alpha = alphas(splats_of(splats, corner), pixels, config)
            total, before = running_product(alpha)
            reached = carried[:, None] * before
            if config.stop_rule == "before":
                reached = reached * (1 - alpha)
            blended = (alpha > 0) & (reached > config.transmittance_min)
            count = jnp.sum(ranks < none, 1, keepdims=True)
            made = -(-count // turn) * turn if singly else turn
            made = jnp.sum(go * made) * alpha.shape[2]
            return carried * total, (made, jnp.sum(go[..., None] & blended))

        open_ = jnp.ones((group, pixels.shape[1]), projected.u.dtype)
        inputs = (work.first, work.live, work.block, work.ranks)
        return *lax.scan(step, open_, inputs)[1], by_look.steps <= looks

    counting = jax.jit(spread(count_local, False, True))
    spread_composite = spread(composite_local, False, True, True)
    compositing = jax.jit(spread_composite)
    by_chunk = jax.jit(spread(chunks_local, False, True, True))
    image = compositing(projected, lists, schedule)
    cotangent = jax.random.normal(jax.random.key(0), image["sums"].shape)

    def steps_local(device, projected, lists, schedule):
        return composite_steps(projected, lists, schedule, device, grid, steps, config)

    def loss(projected, lists, schedule, cotangent, way=spread_composite):
        return jnp.sum(way(projected, lists, schedule)["sums"] * cotangent)

    gradient = jax.jit(jax.value_and_grad(loss))
    spread_steps = spread(steps_local, False, True, True)
    by_step = jax.jit(jax.value_and_grad(partial(loss, way=spread_steps)))
    render = jax.jit(gsjax.render, static_argnames="config")

    def render_loss(params, camera, weight):
        result = gsjax.render(gaussians.replace(params=params), camera, config)
        return jnp.sum(result.rgb * weight)

    weight = jax.random.normal(jax.random.key(1), (camera.height, camera.width, 3))
    training = jax.jit(jax.value_and_grad(render_loss))
    *counts, fits = counting(projected, lists)
    if not np.all(fits):
        raise SystemExit(f"{case.name}: too few steps to count all evaluations")
    evaluations, contributions = (
        float(np.sum(np.asarray(number), dtype=np.float64)) for number in counts
    )
    functions = {
        "project": lambda: projected_of(gaussians, camera),
        "bin": lambda: bin_all(projected),
        "composite": lambda: compositing(projected, lists, schedule),
        "composite by chunks": lambda: by_chunk(projected, lists, schedule),
        "composite v+g": lambda: gradient(projected, lists, schedule, cotangent),
        "v+g by chunks": lambda: by_step(projected, lists, schedule, cotangent),
        "render": lambda: render(gaussians, camera, config=config),
        "render v+g": lambda: training(gaussians.params, camera, weight),
    }
    return functions, projected, evaluations, contributions


def reference(case: scenes.Case, projected, config: gsjax.RasterConfig):
    """Return calls of the C++ compositor over the standard lists, by name."""
    width, height = case.camera.width, case.camera.height
    seen = np.asarray(projected.reach) > 0
    means2d = np.stack([projected.u, projected.v], -1)[seen]
    conics = np.asarray(conics_of(projected))[seen]
    opacity = np.asarray(projected.opacity)[seen]
    colors = np.asarray(projected.colors.T)[seen]
    depth = np.asarray(projected.depth)[seen]
    ranges, ids = yardstick.exact_lists(
        means2d, conics, opacity, depth, width, height, 16, config.alpha_min
    )
    scene = (means2d, conics, opacity, colors, ranges, ids, width, height, np.zeros(3))
    rng = np.random.default_rng(0)
    v_image = rng.normal(size=(height, width, 3)).astype(np.float32)
    v_alpha = rng.normal(size=(height, width)).astype(np.float32)

    def backward(by_pixel):
        return lambda: yardstick.forward_backward(
            *scene, v_image, v_alpha, by_pixel=by_pixel
        )[0]

    functions = {
        "C++": lambda: yardstick.forward(*scene)[0],
        "C++ v+g tuned": backward(False),
        "C++ v+g plain": backward(True),
    }
    return functions, len(ids) * 256


def main() -> None:
    """Measure and save."""
    rows = []
    for case in scenes.real_cases(arg for arg in sys.argv[1:] if arg != "--queued"):
        config = gsjax.exact_config(case.gaussians, case.camera)
        ours, projected, evaluations, contributions = stages(case, config)
        theirs, their_evaluations = reference(case, projected, config)
        ms = measure.interleaved({**ours, **theirs})
        rows.append(
            {
                "scene": case.name,
                **{f"{name} ms": value for name, value in ms.items()},
                "forward / C++": ms["composite"] / ms["C++"],
                "by chunks / forward": ms["composite by chunks"] / ms["composite"],
                "v+g by chunks / v+g": ms["v+g by chunks"] / ms["composite v+g"],
                "v+g / C++ tuned": ms["composite v+g"] / ms["C++ v+g tuned"],
                "v+g / C++ plain": ms["composite v+g"] / ms["C++ v+g plain"],
                "render / composite": ms["render"] / ms["composite"],
                "evaluations M": evaluations / 1e6,
                "evaluations per contribution": evaluations / contributions,
                "C++ evaluations M": their_evaluations / 1e6,
                "ns C++": 1e6 * ms["C++"] / their_evaluations,
                "ns C++ v+g tuned": 1e6 * ms["C++ v+g tuned"] / their_evaluations,
                "ns C++ v+g plain": 1e6 * ms["C++ v+g plain"] / their_evaluations,
            }
        )
    measure.save("compositor_queued" if QUEUED else "compositor", rows, claim=__doc__)


if __name__ == "__main__":
    main()
