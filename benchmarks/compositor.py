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
from gsjax.raster.compositing.alpha import evaluate, pixel_centres
from gsjax.raster.compositing.blending import running_product, splats_of, tables_of
from gsjax.raster.compositing.chunked import CHUNKED, take_rows
from gsjax.raster.compositing.compositor import composite
from gsjax.raster.compositing.types import Task, Tiles
from gsjax.raster.lists import binning
from gsjax.raster.primitives.ellipsoid import ELLIPSOID
from gsjax.raster.render_camera import visible_order
from gsjax.raster.types import Inputs, Projection
from gsjax.runtime.devices import platform_name


class Prepared(NamedTuple):
    """A view up to its tile lists, on every device.

    Attributes:
      spread: (function, whether each argument is divided among devices) → a function of
        the arguments that calls ``function(device, *arguments)`` on every device.
      task: static description of compositing.
      share: pair capacity of a device.
      project, bin: the stages.
      projection, lists: their results.
    """

    spread: Callable[..., Callable[..., Any]]
    task: Task
    share: int
    project: Callable[..., Any]
    bin: Callable[..., Any]
    projection: Projection
    lists: Any


def prepare(case: scenes.Case, config: gsjax.RasterConfig) -> Prepared:
    """Compile and run the stages before the compositor."""
    camera, devices = case.camera, jax.local_device_count()
    grid = binning.make_grid(camera.width, camera.height, config.tile_size, devices)
    share = -(-config.pair_capacity // devices)
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
    def project(gaussians, camera):
        inputs = Inputs(gaussians, camera)
        order, count = visible_order(ELLIPSOID, inputs, config)
        return ELLIPSOID.project(inputs, config, order, count)

    def bin_local(device, footprint):
        return binning.make_lists(footprint, grid, device, share)

    bin_all = jax.jit(spread(bin_local, False))
    # Replicated beforehand, as within one program.
    projection = project(case.gaussians, camera)
    projection = jax.device_put(projection, NamedSharding(mesh, PartitionSpec()))
    task = Task(
        platform=platform_name(),
        colors=projection.channels.colors.shape[0],
        itemsize=projection.splat.u.dtype.itemsize,
        grid=grid,
        config=config,
    )
    lists = bin_all(projection.footprint)
    return Prepared(spread, task, share, project, bin_all, projection, lists)


def count_evaluations(made: Prepared) -> tuple[float, float]:
    """Return evaluations (a Gaussian at a pixel), and those that change the image."""
    task, config, grid = made.task, made.task.config, made.task.grid
    group = schedules.tiles_per_step(config, grid)
    # Number of Gaussians of a tile, or of a block of tiles, between two checks for open
    # pixels.
    singly = fused.suits(task)
    chunk, turn = (fused.BLOCK, fused.TURN) if singly else (config.chunk_size,) * 2
    room = 2 * schedules.step_capacity(made.share, grid, group, chunk)

    def count_local(device, projection, lists):
        """Return evaluations, those that change the image, and whether all fit.

        The first two are [steps].
        """
        tables = tables_of(projection.splat, projection.channels, config)
        schedule = schedules.make_schedule(lists, grid, group, chunk, room)
        steps = schedules.make_steps(schedule, room)
        none = projection.splat.u.shape[0]
        work = schedules.make_work(lists, schedule, steps, chunk, none, room)
        pixels = pixel_centres(grid.tile, tables.splats.dtype)

        def step(carried, inputs):
            first, live, block, ranks = inputs
            corner = binning.corners(schedule.tiles[block], grid, device, pixels.dtype)
            splats = take_rows(tables.splats, ranks)
            carried = jnp.where(first, 1, carried)
            go = live & jnp.any(carried > config.transmittance_min, 1, keepdims=True)
            go = (go if singly else jnp.any(go)) & jnp.ones((group, 1), bool)
            alpha = evaluate(splats_of(splats, corner), pixels, config).alpha
            total, before = running_product(alpha)
            reached = carried[:, None] * before
            if config.stop_rule == "before":
                reached = reached * (1 - alpha)
            blended = (alpha > 0) & (reached > config.transmittance_min)
            count = jnp.sum(ranks < none, 1, keepdims=True)
            evaluated = -(-count // turn) * turn if singly else turn
            evaluated = jnp.sum(go * evaluated) * alpha.shape[2]
            return carried * total, (evaluated, jnp.sum(go[..., None] & blended))

        open_ = jnp.ones((group, pixels.shape[1]), pixels.dtype)
        inputs = (work.first, work.live, work.block, work.ranks)
        return *lax.scan(step, open_, inputs)[1], schedule.steps <= room

    counting = jax.jit(made.spread(count_local, False, True))
    *counts, fits = counting(made.projection, made.lists)
    if not np.all(fits):
        raise SystemExit("compositor.py: too few steps to count all evaluations")
    evaluations, contributions = (
        float(np.sum(np.asarray(number), dtype=np.float64)) for number in counts
    )
    return evaluations, contributions


def stages(case: scenes.Case, config: gsjax.RasterConfig):
    """Return compiled stages of one view by name, with their inputs bound."""
    gaussians, camera = case.gaussians, case.camera
    made = prepare(case, config)
    task, projection, lists = made.task, made.projection, made.lists

    def on_all(kernel):
        def local(device, projection, lists):
            tiles = Tiles(projection.splat, projection.channels, lists, device)
            return kernel(tiles)

        return made.spread(local, False, True)

    chosen = on_all(lambda tiles: composite(tiles, task)[0])
    compositing = jax.jit(chosen)
    by_chunk = jax.jit(on_all(partial(CHUNKED.forward, task=task)))
    image = compositing(projection, lists)
    cotangent = jax.random.normal(jax.random.key(0), image["sums"].shape)

    def loss(projection, lists, cotangent, kernel=chosen):
        return jnp.sum(kernel(projection, lists)["sums"] * cotangent)

    gradient = jax.jit(jax.value_and_grad(loss))
    by_step = on_all(partial(CHUNKED.differentiable, task=task))
    by_step = jax.jit(jax.value_and_grad(partial(loss, kernel=by_step)))
    render = jax.jit(gsjax.render, static_argnames="config")

    def render_loss(params, camera, weight):
        result = gsjax.render(gaussians.replace(params=params), camera, config)
        return jnp.sum(result.rgb * weight)

    weight = jax.random.normal(jax.random.key(1), (camera.height, camera.width, 3))
    training = jax.jit(jax.value_and_grad(render_loss))
    functions = {
        "project": lambda: made.project(gaussians, camera),
        "bin": lambda: made.bin(projection.footprint),
        "composite": lambda: compositing(projection, lists),
        "composite by chunks": lambda: by_chunk(projection, lists),
        "composite v+g": lambda: gradient(projection, lists, cotangent),
        "v+g by chunks": lambda: by_step(projection, lists, cotangent),
        "render": lambda: render(gaussians, camera, config=config),
        "render v+g": lambda: training(gaussians.params, camera, weight),
    }
    return functions, projection, *count_evaluations(made)


def conics_of(splat) -> np.ndarray:
    """Return the entries (a, b, c) of the inverse 2D covariances [R, 3]."""
    inv_sx, slope, inv_sy, _ = (np.asarray(number) for number in splat.shape)
    b = -slope * inv_sy**2
    return np.stack([inv_sx**2 - slope * b, b, inv_sy**2], axis=-1)


def reference(case: scenes.Case, projection, config: gsjax.RasterConfig):
    """Return calls of the C++ compositor over the standard lists, by name."""
    width, height = case.camera.width, case.camera.height
    seen = np.asarray(projection.footprint.reach) > 0
    splat, channels = projection.splat, projection.channels
    means2d = np.stack([splat.u, splat.v], -1)[seen]
    conics = conics_of(splat)[seen]
    opacity = np.asarray(splat.shape[-1])[seen]
    colors = np.asarray(channels.colors.T)[seen]
    depth = np.asarray(channels.depth)[seen]
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
        ours, projection, evaluations, contributions = stages(case, config)
        theirs, their_evaluations = reference(case, projection, config)
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
