"""Fused and chunked compositing on CPUs are plain blending, and the hand-written
reverse pass is the transpose of the chunks; the fused loops are one compiled kernel
wherever they are chosen.
"""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import on_cpu

from gsjax import RasterConfig
from gsjax.raster.compositing import chunked, fused, fused_vjp
from gsjax.raster.compositing.types import Task, Tiles
from gsjax.raster.lists.binning import Lists, corners, make_grid
from gsjax.raster.types import Channels, Splat
from gsjax.runtime import loops

pytestmark = [on_cpu, pytest.mark.as_users]

WIDTH, HEIGHT, RANKS, COLORS = 24, 48, 90, 3
DEVICES, DEVICE = 2, 1  # of whose tiles
LENGTHS = 0, 1, 2, 7, 8, 9, 40, 64, 0  # of the tiles' lists
ALL = ("rgb", "depth", "median_depth")


def task_of(config, dtype, grid=None, colors=COLORS) -> Task:
    grid = grid or make_grid(WIDTH, HEIGHT, config.tile_size, DEVICES)
    return Task("cpu", colors, np.dtype(dtype).itemsize, grid, config)


def tiles_of(dtype) -> Tiles:
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0, WIDTH, RANKS), rng.uniform(0, HEIGHT, RANKS)
    depth = np.sort(rng.uniform(1, 9, RANKS))
    inv_sx, inv_sy = 1 / rng.uniform(1, 12, (2, RANKS))
    slope, opacity = rng.normal(0, 0.5, RANKS), rng.beta(1, 0.6, RANKS)
    splat = Splat(u, v, (inv_sx, slope, inv_sy, opacity))
    channels = Channels(rng.uniform(-1, 2, (COLORS, RANKS)), depth)
    values = jax.tree.map(lambda a: jnp.asarray(a, dtype), (splat, channels))
    return Tiles(*values, jax.tree.map(jnp.asarray, lists()), jnp.int32(DEVICE))


def lists() -> Lists:
    rng, lengths = np.random.default_rng(1), np.int32(LENGTHS)
    ranks = [np.sort(rng.choice(RANKS, n, replace=False)) for n in LENGTHS]
    ranks = np.concatenate([*ranks, np.full(20, 7)]).astype(np.int32)
    start = (np.cumsum(lengths) - lengths).astype(np.int32)
    known = {"ranks": ranks, "start": start, "length": lengths, "fit": np.bool_(True)}
    return Lists(**{name: known.get(name, np.int32(0)) for name in Lists._fields})


def plain(tiles: Tiles, grid, config) -> dict[str, np.ndarray]:
    """Blend in float64, Gaussian by Gaussian and pixel by pixel."""
    tiles = jax.tree.map(lambda a: np.asarray(a, np.float64), tiles)
    splat, channels, lists = tiles.splat, tiles.channels, tiles.lists
    inv_sx, slope, inv_sy, opacity = splat.shape
    values = np.stack([*channels.colors, channels.depth, np.ones(RANKS)])
    area, numbers = grid.tile**2, np.arange(grid.tiles)
    sums, median = np.zeros((grid.tiles, len(values), area)), np.zeros((9, area))
    corner = np.asarray(corners(numbers, grid, np.int32(DEVICE), np.float64))
    ranks, start, length = (
        np.asarray(a, int) for a in (lists.ranks, lists.start, lists.length)
    )
    for tile, pixel in np.ndindex(grid.tiles, area):
        row, column = divmod(pixel, grid.tile)
        at, passed = corner[tile] + (column + 0.5, row + 0.5), 1.0
        for i in ranks[start[tile] :][: length[tile]]:
            dx, dy = at - (splat.u[i], splat.v[i])
            y1, y2 = inv_sx[i] * dx, inv_sy[i] * (dy - slope[i] * dx)
            alpha = opacity[i] * np.exp(-(y1 * y1 + y2 * y2) / 2)
            alpha = min(alpha, config.alpha_max)
            if alpha < config.alpha_min:
                continue
            behind = passed * (1 - alpha)
            if config.stop_rule == "before" and behind <= config.transmittance_min:
                break
            sums[tile, :, pixel] += passed * alpha * values[:, i]
            if passed > 0.5 >= behind:
                median[tile, pixel] = channels.depth[i]
            passed = behind
            if passed <= config.transmittance_min:
                break
    return {"sums": sums, "median": median}


OPAQUE = RasterConfig(outputs=ALL, alpha_max=1.0, stop_rule="after")
STOPS = {
    "before": RasterConfig(outputs=ALL),
    "after": RasterConfig.accurate(outputs=ALL),
    "opaque before": OPAQUE.replace(transmittance_min=0.02, stop_rule="before"),
    "opaque after": OPAQUE.replace(transmittance_min=0.6),
    "to the last": OPAQUE.replace(transmittance_min=0.0),
}
KERNELS = {"fused": fused_vjp.FUSED, "chunked": chunked.CHUNKED}


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize(("dtype", "bar"), [("float32", 1e-5), ("float64", 1e-13)])
def test_kernels_are_plain_blending(kernel, stop, dtype, bar, report):
    config, tiles = STOPS[stop], tiles_of(dtype)
    task = task_of(config.replace(tiles_per_step=4), dtype)
    assert KERNELS[kernel].suits(task)
    found = jax.jit(lambda tiles: KERNELS[kernel].forward(tiles, task))(tiles)
    wanted = plain(tiles, task.grid, config)
    left = 1 - wanted["sums"][:, -1]
    assert (left < 0.5).mean() > 0.3
    assert (left > 0.99).mean() > 0.2
    assert (wanted["median"] > 0).mean() > 0.2
    for name, image in wanted.items():
        assert found[name].dtype == dtype
        error = np.abs(np.asarray(found[name]) - image).max()
        report(f"{kernel}, {name}, {dtype}", error, bar)
        assert error <= bar, name


KINDS = {"all": {"splats", "channels"}, "splats": {"splats"}, "channels": {"channels"}}


@pytest.mark.parametrize(
    ("stop", "dtype", "bar"),
    [
        ("before", "float64", 1e-12),
        ("opaque after", "float64", 1e-12),
        ("after", "float32", 3e-5),
    ],
)
def test_the_reverse_pass_is_the_transpose_of_the_chunks(stop, dtype, bar, report):
    """For all cotangents, and for those of splats and of channels alone."""
    config = STOPS[stop].replace(outputs=("rgb", "depth"), tiles_per_step=4)
    task, tiles = task_of(config, dtype), tiles_of(dtype)
    assert fused_vjp.suits(task)
    shape = task.grid.tiles, COLORS + 2, task.grid.tile**2
    cotangent = jnp.asarray(np.random.default_rng(2).normal(size=shape), dtype)
    steps = task._replace(room_for_all=True)

    @jax.jit
    def both(tiles, cotangent):
        def sums(splat, channels):
            given = tiles._replace(splat=splat, channels=channels)
            return chunked.composite_steps(given, steps)["sums"]

        images, residuals = fused.composite_fused(tiles, task, keep=True)
        given = tiles, residuals, cotangent, task
        found = {k: fused_vjp.backward(*given, frozenset(v)) for k, v in KINDS.items()}
        wanted, transpose = jax.vjp(sums, tiles.splat, tiles.channels)
        return images["sums"], wanted, found, transpose(cotangent)

    sums, same, found, wanted = both(tiles, cotangent)
    np.testing.assert_allclose(sums, same, rtol=0, atol=bar)
    for name, kinds in KINDS.items():
        for kind, ours, plain in zip(("splats", "channels"), found[name], wanted):
            for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(plain)):
                assert a.dtype == dtype
                if kind not in kinds:
                    assert not np.asarray(a).any()
                    continue
                assert np.linalg.norm(b) > 1
                error = np.linalg.norm(a - b) / np.linalg.norm(b)
                report(f"{name}, {kind}, {dtype}", error, bar)
                assert error <= bar, (name, kind)


def test_lists_that_did_not_fit_are_not_read():
    task, tiles = task_of(RasterConfig(), "float32"), tiles_of("float32")
    start, fit = jnp.full(9, 10**6, jnp.int32), jnp.asarray(False)
    tiles = tiles._replace(lists=tiles.lists._replace(start=start, fit=fit))

    @jax.jit
    def both(tiles):
        images, residuals = fused.composite_fused(tiles, task, keep=True)
        ones = jnp.ones_like(images["sums"])
        back = fused_vjp.backward(tiles, residuals, ones, task)
        return images["sums"], residuals.blocks, back

    for array in jax.tree.leaves(both(tiles)):
        assert not np.asarray(array).any()


def described(dtype, colors) -> Tiles:
    """Return shapes and types of a larger case."""

    def one(*shape, dtype=dtype):
        return jax.ShapeDtypeStruct(shape, dtype)

    whole = partial(one, dtype=np.int32)
    kept = {"ranks": whole(9000), "start": whole(64), "length": whole(64)}
    kept["fit"] = one(dtype=np.bool_)
    return Tiles(
        Splat(one(5000), one(5000), (one(5000),) * 4),
        Channels(one(colors, 5000), one(5000)),
        Lists(**{name: kept.get(name, whole()) for name in Lists._fields}),
        whole(),
    )


def compiled(function, *shapes):
    """Return the program; assert that it is one kernel."""
    program = jax.jit(function).lower(*shapes).compile().as_text()
    assert "xla_cpu_small_call" in program
    assert not loops.has_loop_by_turns(program)
    return program[: program.index("ENTRY")]


def largest(suits, config, dtype):
    """Yield the most colours of small tiles, and the largest tiles of few colours."""

    def most(fits, first):
        fitting = [n for n in range(first, 99) if fits(n)]
        assert fitting == list(range(first, fitting[-1] + 1))
        assert 3 <= fitting[-1] < 98
        return fitting[-1]

    def task(side, colors):
        return task_of(config, dtype, make_grid(8 * side, 8 * side, side, 1), colors)

    yield task(8, most(lambda n: suits(task(8, n)), 0))
    yield task(most(lambda n: suits(task(n, COLORS)), 8), COLORS)


def exponents(inside):
    return len(re.findall(r" (exponential|round-nearest-even)\(", inside))


@pytest.mark.parametrize("keep", [False, True])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_it_is_one_kernel_wherever_it_suits(dtype, keep):
    for task in largest(fused.suits, RasterConfig(outputs=ALL), dtype):

        def composited(tiles, task=task):
            return fused.composite_fused(tiles, task, keep)

        inside = compiled(composited, described(dtype, task.colors))
        # Over tiles, blocks and Gaussians; and where the blocks of each tile begin.
        assert inside.count(" while(") == 3 + keep
        # Nothing large is copied, and α is evaluated once for each Gaussian of a turn.
        size = task.grid.tile**2
        assert f"[64,{task.colors + 2},{size}]{{2,1,0}} copy(" not in inside
        assert exponents(inside) == fused.TURN


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_reverse_pass_is_one_kernel_wherever_it_suits(dtype):
    one, number = jax.ShapeDtypeStruct, jax.ShapeDtypeStruct((64,), np.int32)
    for task in largest(fused_vjp.suits, RasterConfig(), dtype):
        size = task.grid.tile**2

        def back(tiles, residuals, cotangent, task=task):
            return fused_vjp.backward(tiles, residuals, cotangent, task)

        kept = one((9000 // fused.BLOCK + 64, size), dtype), number, number
        given = fused.Residuals(*kept), one((64, task.colors + 2, size), dtype)
        inside = compiled(back, described(dtype, task.colors), *given)
        # Over tiles, blocks, and Gaussians forwards and backwards.
        assert inside.count(" while(") == 4
        assert f"[5001,{task.colors + 8}]{{1,0}} copy(" not in inside
        assert exponents(inside) == fused_vjp.TURN


def test_tasks_that_do_not_suit():
    config = RasterConfig()
    assert not fused.suits(task_of(config, "float32", make_grid(24, 24, 4, 1)))
    assert not fused.suits(task_of(config, "float32", colors=200))
    assert not fused.suits(task_of(config, "float64", make_grid(64, 64, 32, 1)))
    assert fused_vjp.suits(task_of(config, "float32"))
    assert not fused_vjp.suits(task_of(config.replace(absgrad=True), "float32"))
    assert not fused_vjp.suits(task_of(config.replace(outputs=ALL), "float32"))


CHOICE = """
import gsjax; gsjax.use_all_cores(2)
import jax
from conftest import LIGHT, camera_of, frustum_points, gaussians_at, np
scene = gaussians_at(frustum_points(np.random.default_rng(0), 16), 0.1, 0.5)
config = gsjax.RasterConfig(**{**LIGHT, "devices": 2}, outputs=("alpha",))
def picture(scene, camera):
    return gsjax.render(scene, camera, config).alpha
def blended(scene, camera):
    return picture(scene, camera).sum()
for function in (picture, jax.grad(blended, allow_int=True)):
    program = jax.jit(function).lower(scene, camera_of()).compile().as_text()
    lines = program[program.index("ENTRY") :].splitlines()
    print(sum("/composite/" in x and " while(" in x for x in lines))
"""


@pytest.mark.parametrize("option", [True, False])
def test_it_is_chosen_where_xla_was_told(option, in_a_process):
    """By a process that draws at once: a picture and its gradient leave no loop to be
    run by turns; but both do where there is no option."""
    picture, gradient = map(int, in_a_process(CHOICE, option).split())
    assert (picture == 0) == (gradient == 0) == option
