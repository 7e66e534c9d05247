"""Compositing on a CPU, Gaussian by Gaussian and chunk by chunk, is plain blending, and
the way back Gaussian by Gaussian its transpose; each of those by Gaussians is one
compiled kernel wherever it is chosen.
"""

import os
import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import on_cpu

from gsjax import RasterConfig
from gsjax.raster.compositing import chunked, fused, fused_vjp, schedules
from gsjax.raster.lists.binning import Lists, corners, make_grid
from gsjax.raster.types import Projected
from gsjax.runtime import devices, loops

pytestmark = [on_cpu, pytest.mark.as_users]

WIDTH, HEIGHT, RANKS, CHANNELS = 24, 48, 90, 3
DEVICES, DEVICE = 2, 1  # of whose tiles
LENGTHS = 0, 1, 2, 7, 8, 9, 40, 64, 0  # of the tiles' lists
ALL = ("rgb", "depth", "median_depth")


def splats(dtype, channels=CHANNELS) -> Projected:
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0, WIDTH, RANKS), rng.uniform(0, HEIGHT, RANKS)
    depth = np.sort(rng.uniform(1, 9, RANKS))
    inv_sx, inv_sy = 1 / rng.uniform(1, 12, (2, RANKS))
    slope, opacity = rng.normal(0, 0.5, RANKS), rng.beta(1, 0.6, RANKS)
    colors, zero = rng.uniform(-1, 2, (channels, RANKS)), np.zeros(RANKS)
    columns = u, v, depth, inv_sx, slope, inv_sy, zero, zero, opacity, zero
    return Projected(*(jnp.asarray(c, dtype) for c in (*columns, colors, zero)), None)


def lists() -> Lists:
    rng, lengths = np.random.default_rng(1), np.int32(LENGTHS)
    ranks = [np.sort(rng.choice(RANKS, n, replace=False)) for n in LENGTHS]
    ranks = np.concatenate([*ranks, np.full(20, 7)]).astype(np.int32)
    start = (np.cumsum(lengths) - lengths).astype(np.int32)
    known = {"ranks": ranks, "start": start, "length": lengths, "fit": np.bool_(True)}
    return Lists(**{name: known.get(name, np.int32(0)) for name in Lists._fields})


def plain(p: Projected, lists: Lists, grid, config) -> dict[str, np.ndarray]:
    """In float64, Gaussian by Gaussian and pixel by pixel."""
    p = jax.tree.map(lambda a: np.asarray(a, np.float64), p)
    values = np.stack([*p.colors, p.depth, np.ones(RANKS)])
    area, tiles = grid.tile**2, np.arange(grid.tiles)
    sums, median = np.zeros((grid.tiles, len(values), area)), np.zeros((9, area))
    corner = np.asarray(corners(tiles, grid, np.int32(DEVICE), np.float64))
    for tile, pixel in np.ndindex(grid.tiles, area):
        row, column = divmod(pixel, grid.tile)
        at, passed = corner[tile] + (column + 0.5, row + 0.5), 1.0
        for i in lists.ranks[lists.start[tile] :][: lists.length[tile]]:
            dx, dy = at - (p.u[i], p.v[i])
            y1, y2 = p.inv_sx[i] * dx, p.inv_sy[i] * (dy - p.slope[i] * dx)
            alpha = p.opacity[i] * np.exp(-(y1 * y1 + y2 * y2) / 2)
            alpha = min(alpha, config.alpha_max)
            if alpha < config.alpha_min:
                continue
            behind = passed * (1 - alpha)
            if config.stop_rule == "before" and behind <= config.stop:
                break
            sums[tile, :, pixel] += passed * alpha * values[:, i]
            if passed > 0.5 >= behind:
                median[tile, pixel] = p.depth[i]
            passed = behind
            if passed <= config.stop:
                break
    return {"sums": sums, "median": median}


OPAQUE = RasterConfig(outputs=ALL, alpha_max=1.0, stop_rule="after")
STOPS = {
    "before": RasterConfig(outputs=ALL),
    "after": RasterConfig.accurate(outputs=ALL),
    "opaque before": OPAQUE.replace(stop=0.02, stop_rule="before"),
    "opaque after": OPAQUE.replace(stop=0.6),
    "to the last": OPAQUE.replace(stop=0.0),
}


@pytest.mark.parametrize("way", ["single", "chunks"])
@pytest.mark.parametrize("config", STOPS.values(), ids=STOPS)
@pytest.mark.parametrize(("dtype", "bar"), [("float32", 1e-5), ("float64", 1e-13)])
def test_both_are_plain_blending(way, config, dtype, bar, report):
    grid = make_grid(WIDTH, HEIGHT, config.tile_size, DEVICES)
    some = jax.tree.map(jnp.asarray, lists())
    projected, device = splats(dtype), jnp.int32(DEVICE)
    schedule = schedules.make_schedule(some, grid, 4, config.chunk_size, 100)

    @jax.jit
    def blended(projected, some, schedule):
        if way == "single":
            assert fused.suits(CHANNELS, np.dtype(dtype).itemsize, grid)
            given = projected, some, device, grid, config
            return fused.composite_fused(*given)[0]
        return chunked.composite_chunks(projected, some, schedule, device, grid, config)

    found = blended(projected, some, schedule)
    wanted = plain(projected, lists(), grid, config)
    left = 1 - wanted["sums"][:, -1]
    assert (left < 0.5).mean() > 0.3
    assert (left > 0.99).mean() > 0.2
    assert (wanted["median"] > 0).mean() > 0.2
    for name, image in wanted.items():
        assert found[name].dtype == dtype
        error = np.abs(np.asarray(found[name]) - image).max()
        report(f"{way}, {name}, {dtype}", error, bar)
        assert error <= bar, name


BY = {"all": {"splats", "channels"}, "splats": {"splats"}, "channels": {"channels"}}


@pytest.mark.parametrize(
    ("stop", "dtype", "bar"),
    [
        *((stop, "float64", 1e-12) for stop in STOPS),
        *((stop, "float32", 3e-5) for stop in ("before", "after")),
    ],
)
def test_the_way_back_is_the_transpose_of_the_steps(stop, dtype, bar, report):
    """By everything, by splats and by channels alone."""
    config = STOPS[stop].replace(outputs=("rgb", "depth"))
    grid = make_grid(WIDTH, HEIGHT, config.tile_size, DEVICES)
    some, device = jax.tree.map(jnp.asarray, lists()), jnp.int32(DEVICE)
    schedule = schedules.make_schedule(some, grid, 4, config.chunk_size, 100)
    shape = grid.tiles, CHANNELS + 2, grid.tile**2
    cotangent = jnp.asarray(np.random.default_rng(2).normal(size=shape), dtype)

    @jax.jit
    def ways(projected, some, schedule, cotangent):
        assert fused_vjp.suits(CHANNELS, np.dtype(dtype).itemsize, grid, config)

        def sums(projected):
            given = projected, some, schedule, device, grid, 100, config
            return chunked.composite_steps(*given)["sums"]

        given = projected, some, device
        images, kept = fused.composite_fused(*given, grid, config, keeping=True)
        given = *given, kept, cotangent, grid, config
        found = {k: fused_vjp.vjp(*given, frozenset(v)) for k, v in BY.items()}
        wanted, transpose = jax.vjp(sums, projected)
        return images["sums"], wanted, found, transpose(cotangent)[0]

    sums, same, found, wanted = ways(splats(dtype), some, schedule, cotangent)
    np.testing.assert_allclose(sums, same, rtol=0, atol=bar)
    none = {"var_y", "det", "reach", "compensation"}
    for way, by in BY.items():
        for name in set(Projected._fields) - {"probe"}:
            kind = "channels" if name in {"colors", "depth"} else "splats"
            a, b = (np.asarray(getattr(p, name)) for p in (found[way], wanted))
            assert a.dtype == dtype
            if name in none or kind not in by:
                assert not a.any()
                continue
            assert np.linalg.norm(b) > 1
            error = np.linalg.norm(a - b) / np.linalg.norm(b)
            report(f"{way}, {name}, {dtype}", error, bar)
            assert error <= bar, (way, name)


def test_lists_that_did_not_fit_are_not_read():
    config = RasterConfig()
    grid = make_grid(WIDTH, HEIGHT, config.tile_size, DEVICES)
    wild = lists()._replace(start=np.full(9, 10**6, np.int32), fit=np.bool_(False))

    @jax.jit
    def both(p, some):
        given = p, some, jnp.int32(0)
        images, kept = fused.composite_fused(*given, grid, config, keeping=True)
        ones = jnp.ones_like(images["sums"])
        back = fused_vjp.vjp(*given, kept, ones, grid, config)
        return images["sums"], kept.looks, back

    for array in jax.tree.leaves(both(splats("float32"), wild)):
        assert not np.asarray(array).any()


def described(dtype, channels):
    """Shapes and types of a larger case."""

    def one(*shape, dtype=dtype):
        return jax.ShapeDtypeStruct(shape, dtype)

    fields = {name: one(5000) for name in Projected._fields}
    whole = partial(one, dtype=np.int32)
    kept = {"ranks": whole(9000), "start": whole(64), "length": whole(64)}
    kept["fit"] = one(dtype=np.bool_)
    return (
        Projected(**{**fields, "colors": one(channels, 5000), "probe": None}),
        Lists(**{name: kept.get(name, whole()) for name in Lists._fields}),
    )


def compiled(function, *shapes):
    """Its program; asserts that it is one kernel."""
    program = jax.jit(function).lower(*shapes).compile().as_text()
    assert "xla_cpu_small_call" in program
    assert not loops.has_loop_by_turns(program)
    return program[: program.index("ENTRY")]


def largest(suits, dtype):
    """Pairs of tiles' side and colours: the most colours of small tiles, and the
    largest tiles of few colours, that it is chosen for; neither are any number."""
    width = np.dtype(dtype).itemsize

    def most(fits, first):
        fitting = [n for n in range(first, 99) if fits(n)]
        assert fitting == list(range(first, fitting[-1] + 1))
        assert 3 <= fitting[-1] < 98
        return fitting[-1]

    colors = most(lambda n: suits(n, width, make_grid(64, 64, 8, 1)), 0)
    side = most(lambda n: suits(CHANNELS, width, make_grid(64, 64, n, 1)), 8)
    return (8, colors), (side, CHANNELS)


def exponents(inside):
    return len(re.findall(r" (exponential|round-nearest-even)\(", inside))


@pytest.mark.parametrize("keeping", [False, True])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_it_is_one_kernel_wherever_it_suits(dtype, keeping):
    for side, colors in largest(fused.suits, dtype):
        grid = make_grid(8 * side, 8 * side, side, 1)

        def composited(projected, lists, device, cut, grid=grid):
            config = RasterConfig(outputs=ALL).at_cut(cut)
            given = projected, lists, device, grid, config
            return fused.composite_fused(*given, keeping=keeping)

        given = *described(dtype, colors), np.int32(0), jax.ShapeDtypeStruct((), dtype)
        inside = compiled(composited, *given)
        # Over tiles, looks and Gaussians; and where the looks of each tile begin.
        assert inside.count(" while(") == 3 + keeping
        # Nothing large is copied, and α is evaluated once for each Gaussian of a turn.
        assert f"[64,{colors + 2},{side**2}]{{2,1,0}} copy(" not in inside
        assert exponents(inside) == fused.TURN


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_way_back_is_one_kernel_wherever_it_suits(dtype):
    config = RasterConfig()
    one, number = jax.ShapeDtypeStruct, jax.ShapeDtypeStruct((64,), np.int32)
    for side, colors in largest(partial(fused_vjp.suits, config=config), dtype):
        grid = make_grid(8 * side, 8 * side, side, 1)

        def back(projected, lists, device, kept, cotangent, grid=grid):
            given = projected, lists, device, kept, cotangent, grid, config
            return fused_vjp.vjp(*given)

        kept = one((9000 // fused.LOOK + 64, side**2), dtype), number, number
        given = fused.Residuals(*kept), one((64, colors + 2, side**2), dtype)
        inside = compiled(back, *described(dtype, colors), np.int32(0), *given)
        # Over tiles, looks, and Gaussians there and back.
        assert inside.count(" while(") == 4
        assert f"[5001,{colors + 8}]{{1,0}} copy(" not in inside
        assert exponents(inside) == fused_vjp.TURN


def test_what_does_not_suit():
    """Few pixels, of which no vectors are made; turns that touch too much; and of the
    way back what it does not give."""
    config, grid = RasterConfig(), make_grid(64, 64, 8, 1)
    assert not fused.suits(3, 4, make_grid(24, 24, 4, 1))
    assert not fused.suits(200, 4, grid)
    assert not fused.suits(3, 8, make_grid(64, 64, 32, 1))
    assert fused_vjp.suits(3, 4, grid, config)
    assert not fused_vjp.suits(3, 4, grid, config.replace(absgrad=True))
    assert not fused_vjp.suits(3, 4, grid, config.replace(outputs=ALL))


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


@pytest.mark.parametrize(
    ("flags", "wanted"),
    [
        (None, "{option}"),
        (" --xla_dump_to=x", "--xla_dump_to=x {option}"),
        ("{option}", "{option}"),
        ("flags.txt", "flags.txt"),
    ],
)
def test_the_flags_of_others_stay(flags, wanted, monkeypatch):
    option = (
        "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold="
        f"{devices.KERNEL_BYTES}"
    )
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    if flags is not None:
        monkeypatch.setenv("XLA_FLAGS", flags.format(option=option))
    devices.make_kernels_of_loops()
    assert os.environ["XLA_FLAGS"] == wanted.format(option=option)
