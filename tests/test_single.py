"""Compositing on a CPU, Gaussian by Gaussian and chunk by chunk, is plain blending; and
the first is one compiled kernel wherever it is chosen.
"""

import os
import re
import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import on_cpu

from gsjax import RasterConfig, devices
from gsjax.raster import composite, loops, schedules, single
from gsjax.raster.bins import Lists, corners, make_grid
from gsjax.raster.types import Projected

pytestmark = on_cpu

WIDTH, HEIGHT, RANKS, CHANNELS = 24, 24, 90, 3
LENGTHS = 0, 1, 2, 7, 8, 9, 40, 64, 0  # of the tiles' lists
ALL = ("rgb", "depth", "median_depth")


def splats(dtype, channels=CHANNELS) -> Projected:
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0, 24, (2, RANKS))
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
    corner = np.asarray(corners(tiles, grid, np.int32(0), np.float64))
    for tile, pixel in np.ndindex(grid.tiles, area):
        row, column = divmod(pixel, grid.tile)
        at, passed = corner[tile] + (column + 0.5, row + 0.5), 1.0
        for i in lists.ranks[lists.start[tile] :][: lists.length[tile]]:
            dx, dy = at - (p.u[i], p.v[i])
            y1, y2 = p.inv_sx[i] * dx, p.inv_sy[i] * (dy - p.slope[i] * dx)
            alpha = p.opacity[i] * np.exp(-(y1 * y1 + y2 * y2) / 2)
            alpha = min(alpha, config.alpha_cap)
            if alpha < config.alpha_cut:
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


@pytest.mark.parametrize("way", ["single", "chunks"])
@pytest.mark.parametrize(
    "config",
    [
        RasterConfig(outputs=ALL),
        RasterConfig.accurate(outputs=ALL),
        RasterConfig(outputs=ALL, stop=0.02, alpha_cap=1.0, stop_rule="after"),
    ],
    ids=["before", "after", "opaque"],
)
@pytest.mark.parametrize(("dtype", "bar"), [("float32", 1e-5), ("float64", 1e-13)])
def test_both_are_plain_blending(way, config, dtype, bar, report):
    grid = make_grid(WIDTH, HEIGHT, config.tile_size, 1)
    some = jax.tree.map(jnp.asarray, lists())
    projected, device = splats(dtype), jnp.int32(0)
    schedule = schedules.make_schedule(some, grid, 4, config.chunk_size, 100)

    @jax.jit
    def blended(projected, some, schedule):
        if way == "single":
            assert single.suits(projected, grid)
            return single.composite_singly(projected, some, device, grid, config)
        return composite.by_chunks(projected, some, schedule, device, grid, config)

    found = blended(projected, some, schedule)
    wanted = plain(projected, lists(), grid, config)
    stopped = 1 - wanted["sums"][:, -1] <= config.stop * 2
    assert 0 < stopped.mean() < 1
    assert (wanted["median"] > 0).mean() > 0.2
    for name, image in wanted.items():
        assert found[name].dtype == dtype
        error = np.abs(np.asarray(found[name]) - image).max()
        report(f"{way}, {name}, {dtype}", error, bar)
        assert error <= bar, name


def test_lists_that_did_not_fit_are_not_read():
    config = RasterConfig()
    grid = make_grid(WIDTH, HEIGHT, config.tile_size, 1)
    wild = lists()._replace(start=np.full(9, 10**6, np.int32), fit=np.bool_(False))
    found = jax.jit(
        lambda p, some: single.composite_singly(p, some, jnp.int32(0), grid, config)
    )(splats("float32"), wild)
    assert not np.asarray(found["sums"]).any()


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


@pytest.mark.parametrize("tile", [8, 16])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_it_is_one_kernel_wherever_it_suits(tile, dtype):
    """With as many channels as it is chosen for, and not for any number of them."""
    config = RasterConfig(tile_size=tile, outputs=("rgb", "depth", "median_depth"))
    grid = make_grid(8 * tile, 8 * tile, tile, 1)

    def suits(channels):
        return single.suits(described(dtype, channels)[0], grid)

    most = next((n for n in range(200, -1, -1) if suits(n)), None)
    if (tile, dtype) == (16, "float64"):
        assert most is None
        return
    assert 3 <= most < 100
    program = jax.jit(
        lambda p, some, device: single.composite_singly(p, some, device, grid, config)
    )
    compiled = program.lower(*described(dtype, most), np.int32(0)).compile().as_text()
    entry = compiled[compiled.index("ENTRY") :]
    assert "xla_cpu_small_call" in entry
    assert " while(" not in entry
    inside = compiled[: compiled.index("ENTRY")]
    assert inside.count(" while(") == 3  # over tiles, looks and Gaussians
    # Nothing large is copied, and α is evaluated once for each Gaussian of a turn.
    assert f"[64,{most + 2},{tile * tile}]{{2,1,0}} copy(" not in inside
    exponents = re.findall(r" (exponential|round-nearest-even)\(", inside)
    assert len(exponents) == single.TURN


def test_too_small_a_tile_does_not_suit():
    assert not single.suits(splats("float32"), make_grid(24, 24, 4, 1))


def test_without_the_option_it_is_chunks(monkeypatch):
    """As in a program that did not call `use_all_cores`."""
    code = "from gsjax.raster import loops; print(loops.large_are_kernels())"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "XLA_FLAGS": ""},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "False"
    monkeypatch.setattr(loops, "large_are_kernels", lambda: False)
    grid = make_grid(WIDTH, HEIGHT, 8, 1)
    assert not single.suits(splats("float32"), grid)


@pytest.mark.parametrize(
    ("flags", "wanted"),
    [
        (None, "{option}"),
        ("--xla_dump_to=x", "--xla_dump_to=x {option}"),
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
