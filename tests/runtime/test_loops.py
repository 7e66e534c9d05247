"""Loops over single numbers: each is one compiled kernel.

`tests/raster/test_lists.py` compares the lists that they make with brute force.
"""

import re

import jax
import jax.numpy as jnp
import numpy as np
from conftest import on_cpu

from gsjax.runtime import loops

ROOM = 40
SIZE = 3 * loops.STRETCH + 5


def test_places_are_the_indices_of_chosen_slots():
    """In each of a batch, from none to all."""
    rng, shares = np.random.default_rng(1), np.array([0, 0.001, 0.04, 1])
    chosen = rng.random((4, SIZE)) < shares[:, None]
    whole = np.pad(chosen, ((0, 0), (0, -SIZE % loops.STRETCH)))
    some = whole.reshape(4, -1, loops.STRETCH).any(-1)
    past = jnp.full((4, ROOM + 1), SIZE, jnp.int32)
    index, count = jax.jit(jax.vmap(loops.places))(chosen, some, past)
    np.testing.assert_array_equal(count, chosen.sum(1))
    for row, mine in zip(index, chosen):
        wanted = np.append(np.flatnonzero(mine), np.full(ROOM, SIZE))[:ROOM]
        np.testing.assert_array_equal(row[:ROOM], wanted)


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
