"""Loops over single numbers, for CPUs: each is one compiled kernel.

XLA's CPU backend compiles a `while` to one kernel if its turn touches less than 1 kB
(by default), however large the arrays are that it carries. A turn then takes a
nanosecond or two, else some hundred times as long. So a turn holds arithmetic on
numbers, and slices and updates of a few, but no gather, scatter or sort. Values that it
reads from an array that it also writes are carried over from the turn before: else XLA
copies the array in every turn. Loops with larger turns are kernels where XLA is told
`gsjax.runtime.setup.KERNEL_BYTES`.

No derivative is taken here, and a batch goes one after another.

Axis legend: I items, T tiles.
"""

from collections.abc import Sequence
from functools import cache

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import sequential_vmap

from gsjax.runtime.setup import KERNEL_BYTES

Array = jax.Array

STRETCH = 256  # slots that `places` reads or skips together
_UNROLL = 4  # counts that `cumulative_sum` adds in a turn; 16 would exceed 1 kB


@cache
def large_loops_are_kernels() -> bool:
    """Return whether loops whose turn touches `KERNEL_BYTES` are kernels here.

    One is compiled to find out.
    """
    numbers = jax.ShapeDtypeStruct((KERNEL_BYTES // 9,), jnp.float32)  # 8 bytes each

    def loop(x):
        return fori_loop(0, 9, lambda _, x: 2 * x + 1, x)

    with jax.disable_jit(False):
        program = jax.jit(loop).lower(numbers).compile().as_text() or ""
    return "xla_cpu_small_call" in program and not has_interpreted_loop(program)


def has_interpreted_loop(program: str) -> bool:
    """Return whether a compiled program's text has a `while` outside of kernels."""
    return " while(" in program[program.index("ENTRY") :]


def part_at(values: Array, start: Sequence[Array], shape: Sequence[int]) -> Array:
    """Return the part of ``values`` from ``start``, [] each and none below 0."""
    return lax.dynamic_slice(values, start, shape, allow_negative_indices=False)


def with_part(values: Array, part: Array, start: Sequence[Array]) -> Array:
    """Return ``values`` with ``part`` in the place that `part_at` reads."""
    return lax.dynamic_update_slice(values, part, start, allow_negative_indices=False)


def _at(values: Array, index: Array) -> Array:
    """Return the number [1] at ``index`` [1]."""
    return part_at(values, (index[0],), (1,))


def _put(values: Array, number: Array, index: Array) -> Array:
    """Return ``values`` with ``number`` [1] at ``index`` [1], or at the last place."""
    return with_part(values, number, (index[0],))


def fori_loop(start, end, turn, state):
    """Run a `lax.fori_loop` that counts in 32 bits."""
    return lax.fori_loop(jnp.int32(start), jnp.int32(end), turn, state)


@sequential_vmap
def cumulative_sum(counts: Array) -> Array:
    """Return inclusive sums [n] int32 of counts [n] int32."""
    size = counts.shape[0]
    counts = jnp.pad(counts, (0, -size % _UNROLL))

    def turn(i, state):
        total, out = state
        start, sums = (i * _UNROLL,), []
        some = part_at(counts, start, (_UNROLL,))
        for count in jnp.split(some, _UNROLL):
            total = total + count
            sums.append(total)
        out = with_part(out, jnp.concatenate(sums), start)
        return total, out

    init = (jnp.zeros(1, jnp.int32), jnp.zeros_like(counts))
    return fori_loop(0, counts.shape[0] // _UNROLL, turn, init)[1][:size]


@sequential_vmap
def append(
    count: Array, kept: Array, columns: tuple[Array, ...], chosen: Array
) -> tuple[Array, Array]:
    """Append the chosen rows.

    Args:
      count: [1] int32, number of rows so far.
      kept: [room + 1, C] int32; the last row is spare.
      columns: C arrays [n] int32.
      chosen: [n] bool.

    Returns:
      The new ``count``, not limited to the room, and ``kept``.
    """

    def turn(i, state):
        count, kept = state
        row = jnp.concatenate([_at(column, i[None]) for column in columns])
        kept = with_part(kept, row[None], (count[0], jnp.int32(0)))
        return count + _at(numbers, i[None]), kept

    numbers = chosen.astype(jnp.int32)
    return fori_loop(0, numbers.shape[0], turn, (count, kept))


@sequential_vmap
def places(chosen: Array, some: Array, index: Array) -> tuple[Array, Array]:
    """Return the places where ``chosen`` is set, compacted to the front.

    Args:
      chosen: [n] bool.
      some: [⌈n / STRETCH⌉] bool, stretches with a set element.
      index: [room + 1] values for unused places; the last is spare.

    Returns:
      ``index`` with the rising places of the first ``room``, and the number [] int32 of
      set elements, not limited to the room.
    """
    numbers = chosen.astype(jnp.int32)
    lengths = jnp.where(some, STRETCH, 0)

    def turn(i, state):
        count, index = state
        i = i[None]
        return count + _at(numbers, i), _put(index, i, count)

    def of_stretch(i, state):
        start = i * STRETCH
        end = jnp.minimum(start + _at(lengths, i[None])[0], numbers.shape[0])
        return fori_loop(start, end, turn, state)

    init = (jnp.zeros(1, jnp.int32), index)
    count, found = fori_loop(0, lengths.shape[0], of_stretch, init)
    return _put(found, index[-1:], count), count[0]


@sequential_vmap
def scatter_items(kept: Array, items: Array, place: Array, out: Array) -> Array:
    """Scatter the values of items to lists, as in a counting sort.

    Args:
      kept: [I, 3] int32: value, first and count. The value goes to the lists first …
        first + count − 1.
      items: [] int32, number of items.
      place: [T] int32, where in ``out`` each list begins.
      out: storage of the lists.

    Returns:
      ``out`` with the lists, each in the order of the items.
    """

    def of_item(i, state):
        place, out = state
        item = part_at(kept, (i, jnp.int32(0)), (1, 3))[0]
        mine, tile, count = item[:1], item[1:2], item[2:]

        def one(state):
            tile, end, mine, at, place, out = state
            place, out = _put(place, at + 1, tile), _put(out, mine, at)
            tile = tile + 1
            return tile, end, mine, _at(place, tile), place, out

        state = (tile, tile + count, mine, _at(place, tile), place, out)
        *_, place, out = lax.while_loop(lambda s: s[0][0] < s[1][0], one, state)
        return place, out

    return fori_loop(0, items, of_item, (place, out))[1]
