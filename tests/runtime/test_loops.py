"""Loops over single numbers agree with NumPy, and each is one compiled kernel."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import on_cpu

from gsjax.runtime import loops

ROOM = 40
SIZE = 3 * loops.STRETCH + 5


def scattered(value, first, count, lists):
    """(value, list) pairs, list by list."""
    out = [[] for _ in range(lists)]
    for v, f, c in zip(value, first, count):
        for place in range(f, f + c):
            out[place].append(v)
    return out


def items_of(seed: int, items: int, lists: int):
    rng = np.random.default_rng(seed)
    first = rng.integers(0, lists, items)
    count = np.minimum(rng.integers(1, 6, items), lists - first)
    return (a.astype(np.int32) for a in (np.arange(items) * 3, first, count))


@pytest.mark.parametrize("seed", range(3))
def test_scatter_items_is_a_counting_sort(seed):
    lists, used = 11, (0, 1, 50)[seed]
    value, first, count = items_of(seed, 50, lists)
    wanted = scattered(value[:used], first, count, lists)
    lengths = np.array([len(each) for each in wanted], np.int32)
    start = np.cumsum(lengths, dtype=np.int32) - lengths
    kept = np.stack([value, first, count], 1)
    out = jax.jit(loops.scatter_items)(
        kept, np.int32(used), start, jnp.full(250, -1, jnp.int32)
    )
    flat = [v for each in wanted for v in each]
    np.testing.assert_array_equal(out[: len(flat)], flat)
    assert (np.asarray(out[len(flat) :]) == -1).all()


@pytest.mark.parametrize("share", [0, 0.02, 0.5, 1])
def test_append_keeps_chosen_rows_up_to_the_capacity(share):
    rng = np.random.default_rng(0)
    columns = rng.integers(0, 99, (2, 3 * ROOM)).astype(np.int32)
    chosen = rng.random(3 * ROOM) < share
    kept = np.zeros((ROOM + 1, 2), np.int32)
    kept[:5] = 7
    count, rows = jax.jit(loops.append)(
        np.array([5], np.int32), kept, tuple(columns), chosen
    )
    assert count[0] == 5 + chosen.sum()
    wanted = np.concatenate([kept[:5], columns[:, chosen].T])[:ROOM]
    np.testing.assert_array_equal(rows[: len(wanted)], wanted)


@pytest.mark.parametrize("share", [0, 0.001, 0.04, 1])
def test_places_are_the_indices_of_chosen_slots(share):
    chosen = np.random.default_rng(1).random(SIZE) < share
    some = np.pad(chosen, (0, -SIZE % loops.STRETCH)).reshape(-1, loops.STRETCH).any(1)
    past = jnp.full(ROOM + 1, SIZE, jnp.int32)
    index, count = jax.jit(loops.places)(chosen, some, past)
    assert count == chosen.sum()
    wanted = np.flatnonzero(chosen)[:ROOM]
    np.testing.assert_array_equal(index[: len(wanted)], wanted)
    assert (np.asarray(index[len(wanted) : ROOM]) == SIZE).all()


def compiled(name: str) -> str:
    """Return the compiled program of a loop, as text."""
    many = jnp.zeros(SIZE, jnp.int32)
    one, some = jnp.zeros(1, jnp.int32), jnp.ones(SIZE, bool)
    rows = jnp.zeros((SIZE, 3), jnp.int32)
    arguments = {
        "cumulative_sum": (many,),
        "append": (one, rows, (many, many, many), some),
        "places": (some, jnp.ones(-(-SIZE // loops.STRETCH), bool), many),
        "scatter_items": (rows, jnp.int32(SIZE), many, many),
    }[name]
    return jax.jit(getattr(loops, name)).lower(*arguments).compile().as_text()


@on_cpu
def test_loops_are_single_kernels_without_copies(in_a_process):
    """By XLA's default threshold. Otherwise an iteration takes 100 times as long."""
    names = "cumulative_sum", "append", "places", "scatter_items"
    code = "from runtime.test_loops import compiled; "
    code += f"print(chr(0).join(map(compiled, {names})))"
    programs = in_a_process(code, option=False).split(chr(0))
    assert len(programs) == len(names)
    for program in programs:
        inside, entry = program.split("ENTRY")
        assert "xla_cpu_small_call" in entry
        assert not loops.has_interpreted_loop(program)
        padded = SIZE + 3  # of counts: a multiple of four
        assert not re.search(rf"\[({SIZE}|{padded})[^ ]* copy\(", inside)


def test_a_batch_runs_sequentially():
    chosen = np.random.default_rng(2).random((3, SIZE)) < 0.03
    some = jnp.ones((3, -(-SIZE // loops.STRETCH)), bool)
    past = jnp.full((3, ROOM + 1), SIZE, jnp.int32)
    index, count = jax.jit(jax.vmap(loops.places))(chosen, some, past)
    np.testing.assert_array_equal(count, chosen.sum(1))
    for row, mine in zip(index, chosen):
        wanted = np.flatnonzero(mine)[:ROOM]
        np.testing.assert_array_equal(row[: len(wanted)], wanted)
