"""Kernels of CPUs are plain blending, and the hand-written reverse pass is a transpose.

The fused loops must be one compiled kernel wherever they are chosen.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import AS_USERS, on_cpu
from pictures import assert_close

from gsjax import RasterConfig
from gsjax.raster.compositing import chunked, fused, fused_vjp
from gsjax.raster.compositing.blending import running_product
from gsjax.raster.compositing.types import (
    Task,
    Tiles,
    pixel_channels,
    summed_channels,
)
from gsjax.raster.lists.binning import Lists, corners, make_grid
from gsjax.raster.primitives.surfel import SURFEL
from gsjax.raster.types import Channels, Splat
from gsjax.runtime import loops

pytestmark = on_cpu

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
    lengths = np.int32(LENGTHS)
    ranks = [np.sort(rng.choice(RANKS, n, replace=False)) for n in LENGTHS]
    ranks = np.concatenate([*ranks, np.full(20, 7)]).astype(np.int32)
    start = (np.cumsum(lengths) - lengths).astype(np.int32)
    known = {"ranks": ranks, "start": start, "length": lengths, "fit": np.bool_(True)}
    lists = Lists(**{name: known.get(name, np.int32(0)) for name in Lists._fields})
    return Tiles(*values, jax.tree.map(jnp.asarray, lists), jnp.int32(DEVICE))


def plain(tiles: Tiles, grid, config) -> dict[str, np.ndarray]:
    """Blend in float64, Gaussian by Gaussian."""
    tiles = jax.tree.map(lambda a: np.asarray(a, np.float64), tiles)
    splat, channels = tiles.splat, tiles.channels
    inv_sx, slope, inv_sy, opacity = splat.shape
    values = np.stack([*channels.colors, channels.depth, np.ones(RANKS)])
    numbers, area = np.arange(grid.tiles), grid.tile**2
    corner = np.asarray(corners(numbers, grid, np.int32(DEVICE), np.float64))
    rows, columns = np.divmod(np.arange(area), grid.tile)
    ranks, start, length = (np.asarray(a, int) for a in (
        tiles.lists.ranks, tiles.lists.start, tiles.lists.length))  # fmt: skip
    sums, median = np.zeros((grid.tiles, len(values), area)), np.zeros((9, area))
    for tile in numbers:
        passed, live = np.ones(area), np.ones(area, bool)
        for i in ranks[start[tile] :][: length[tile]]:
            dx = corner[tile, 0] + columns + 0.5 - splat.u[i]
            dy = corner[tile, 1] + rows + 0.5 - splat.v[i]
            y1, y2 = inv_sx[i] * dx, inv_sy[i] * (dy - slope[i] * dx)
            alpha = opacity[i] * np.exp(-(y1 * y1 + y2 * y2) / 2)
            alpha = np.where(alpha < config.alpha_min, 0, alpha)
            alpha = np.minimum(alpha, config.alpha_max)
            if config.stop_rule == "before":
                live &= passed * (1 - alpha) > config.transmittance_min
            alpha = alpha * live
            behind = passed * (1 - alpha)
            sums[tile] += passed * alpha * values[:, i, None]
            median[tile, (passed > 0.5) & (behind <= 0.5)] = channels.depth[i]
            passed = behind
            live &= passed > config.transmittance_min
    return {"sums": sums, "median": median}


OPAQUE = RasterConfig(outputs=ALL, alpha_max=1.0, stop_rule="after")
STOPS = {
    "before": RasterConfig(outputs=ALL),
    "after": RasterConfig.accurate(outputs=ALL),
    "opaque before": OPAQUE.replace(transmittance_min=0.02, stop_rule="before"),
    "opaque after": OPAQUE.replace(transmittance_min=0.6),
    "to the last": OPAQUE.replace(transmittance_min=0.0),
}


@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize(("dtype", "bar"), [("float32", 1e-5), ("float64", 1e-13)])
def test_kernels_are_plain_blending(stop, dtype, bar, report):
    config, tiles = STOPS[stop], tiles_of(dtype)
    task = task_of(config.replace(tiles_per_step=4), dtype)
    wanted = plain(tiles, task.grid, config)
    left = 1 - wanted["sums"][:, -1]
    assert (left < 0.5).mean() > 0.3
    assert (left > 0.99).mean() > 0.2
    assert (wanted["median"] > 0).mean() > 0.2
    for kernel in (fused_vjp.FUSED, chunked.CHUNKED):
        assert kernel.suits(task)
        found = jax.jit(lambda tiles, k=kernel: k.forward(tiles, task))(tiles)
        for name, image in wanted.items():
            assert found[name].dtype == dtype
            error = np.abs(np.asarray(found[name]) - image).max()
            report(f"{kernel.name}, {name}, {dtype}", error, bar)
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
        given = tiles, residuals, {"sums": cotangent}, task
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
                assert_close(report, f"{name}, {kind}, {dtype}", a, b, bar)


def test_lists_that_did_not_fit_are_not_read():
    task, tiles = task_of(RasterConfig(), "float32"), tiles_of("float32")
    start, fit = jnp.full(9, 10**6, jnp.int32), jnp.asarray(False)
    tiles = tiles._replace(lists=tiles.lists._replace(start=start, fit=fit))

    @jax.jit
    def both(tiles):
        images, residuals = fused.composite_fused(tiles, task, keep=True)
        ones = jax.tree.map(jnp.ones_like, {"sums": images["sums"]})
        back = fused_vjp.backward(tiles, residuals, ones, task)
        return images["sums"], residuals.blocks, back

    for array in jax.tree.leaves(both(tiles)):
        assert not np.asarray(array).any()


GEOMETRY = ("rgb", "normals", "depth", "distortion")


@pytest.mark.parametrize(
    ("dtype", "primitive"),
    [("float32", None), ("float64", None), ("float32", SURFEL)],
)
@pytest.mark.parametrize("reverse", [False, True])
def test_one_kernel_wherever_it_suits(reverse, dtype, primitive):
    """With the most colours and with the largest tiles that suit."""
    one = partial(jax.ShapeDtypeStruct, dtype=dtype)
    whole = partial(jax.ShapeDtypeStruct, dtype=np.int32)
    suits = fused_vjp.suits if reverse else fused.suits
    config = RasterConfig() if reverse else RasterConfig(outputs=ALL)
    numbers = 4
    if primitive is not None:
        config, numbers = RasterConfig(primitive=primitive, outputs=GEOMETRY), 8
    names = {"ranks": whole((9000,)), "start": whole((64,)), "length": whole((64,))}
    names["fit"] = jax.ShapeDtypeStruct((), np.bool_)

    def task_with(side, colors):
        return task_of(config, dtype, make_grid(8 * side, 8 * side, side, 1), colors)

    colors = [n for n in range(99) if suits(task_with(8, n))]
    sides = [n for n in range(8, 99) if suits(task_with(n, COLORS))]
    assert colors == list(range(len(colors)))
    assert sides == list(range(8, 8 + len(sides)))
    for task in (task_with(8, colors[-1]), task_with(sides[-1], COLORS)):
        row, size = one((5000,)), task.grid.tile**2
        tiles = Tiles(
            Splat(row, row, (row,) * numbers),
            Channels(
                colors=one((task.colors, 5000)),
                depth=row,
                normals=None if primitive is None else one((3, 5000)),
            ),
            Lists(**{name: names.get(name, whole(())) for name in Lists._fields}),
            whole(()),
        )
        kept = fused.Residuals(
            one((9000 // fused.BLOCK + 64, size)), whole((64,)), whole((64,))
        )
        summed = sum(summed_channels(config, task.colors).values())
        cotangent = {"sums": one((64, summed, size))}
        cotangent |= dict.fromkeys(pixel_channels(config), one((64, size)))

        def run(tiles, kept, cotangent, task=task):
            if reverse:
                return fused_vjp.backward(tiles, kept, cotangent, task)
            return fused.composite_fused(tiles, task, keep=True)

        program = jax.jit(run).lower(tiles, kept, cotangent).compile().as_text()
        assert "xla_cpu_small_call" in program
        assert not loops.has_interpreted_loop(program)


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
def test_fused_kernels_are_chosen_with_the_option_of_xla(option, in_a_process):
    """Then neither the image nor its gradient has a loop outside of a kernel."""
    picture, gradient = map(int, in_a_process(CHOICE, option).split())
    assert (picture == 0) == (gradient == 0) == option


@pytest.mark.usefixtures("float32")
@pytest.mark.parametrize("size", [1, 2, 5, 32])
def test_products_round_less_than_once_a_factor(size):
    """The error of 32 factors, in roundings: two small ones round once together."""
    product = jax.jit(running_product, compiler_options=AS_USERS)
    rng = np.random.default_rng(1)
    for largest, bound in ((0.004, 1.3), (0.2, 1.9), (0.6, 2.7), (1.0, 2.7)):
        alpha = rng.uniform(0, largest, (50, size, 40)).astype(np.float32)
        total, before = product(alpha)
        exact = np.cumprod(1 - alpha.astype(np.float64), 1)
        np.testing.assert_array_equal(before[:, 0], 1)
        for found, wanted in ((total, exact[:, -1]), (before[:, 1:], exact[:, :-1])):
            relative = np.abs(np.asarray(found) / wanted - 1)
            if relative.size:
                assert relative.max() < (16 if size == 32 else 2 * size) * 2.0**-24
                assert np.sqrt(np.mean(relative**2)) < bound * 2.0**-24
