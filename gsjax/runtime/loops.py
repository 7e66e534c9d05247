"""Loops over single numbers, for CPUs: each is one compiled kernel.

XLA's CPU backend makes one kernel of a `while` whose turn touches less than 1 kB, if it
is not told otherwise (its `SmallWhileLoopHoistingPass`), arrays of any size among what
it carries: a turn then takes a nanosecond or two, and some hundred times as long where
it does not. So a turn holds arithmetic on numbers, slices and updates of a few, and no
gather, scatter or sort; and what it reads of an array that it also writes, it carries
over from the turn before: else XLA copies that array in every turn. No derivative is
taken here, and a batch goes one after another. Loops whose turns hold more, as those of
`gsjax.train.ssim_window`, are kernels where XLA is told `gsjax.runtime.devices.KERNEL_BYTES`.

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

STRETCH = 256  # slots that `places` looks at or leaves out together
_ADDED = 4  # counts that `cumulative_sum` adds in a turn; of 16 it is above 1 kB


@cache
def large_are_kernels() -> bool:
    """Whether this process's XLA makes one kernel also of a loop whose turn touches
    `KERNEL_BYTES`; see `gsjax.use_all_cores`. Found out by compiling one."""
    numbers = jax.ShapeDtypeStruct((KERNEL_BYTES // 9,), jnp.float32)  # 8 bytes each

    def loop(x):
        return fori_loop(0, 9, lambda _, x: 2 * x + 1, x)

    with jax.disable_jit(False):
        program = jax.jit(loop).lower(numbers).compile().as_text() or ""
    return "xla_cpu_small_call" in program and not has_loop_by_turns(program)


def has_loop_by_turns(program: str) -> bool:
    """Whether a `while` of a compiled program's entry is left to be run turn by turn,
    given its text."""
    return " while(" in program[program.index("ENTRY") :]


def part_at(values: Array, start: Sequence[Array], shape: Sequence[int]) -> Array:
    """What of ``values`` begins at ``start``, [] each and none below 0, and is of that
    shape; the last that is, if there is not so much behind it."""
    return lax.dynamic_slice(values, start, shape, allow_negative_indices=False)


def with_part(values: Array, part: Array, start: Sequence[Array]) -> Array:
    """``values`` with ``part`` in the place that `part_at` would take it from."""
    return lax.dynamic_update_slice(values, part, start, allow_negative_indices=False)


def _at(values: Array, index: Array) -> Array:
    """The number [1] at ``index`` [1]."""
    return part_at(values, (index[0],), (1,))


def _put(values: Array, number: Array, index: Array) -> Array:
    """``values`` with ``number`` [1] at ``index`` [1]; at the last if past it."""
    return with_part(values, number, (index[0],))


def fori_loop(start, end, turn, state):
    """A `lax.fori_loop` that counts in 32 bits."""
    return lax.fori_loop(jnp.int32(start), jnp.int32(end), turn, state)


@sequential_vmap
def cumulative_sum(counts: Array) -> Array:
    """Inclusive sums [n] int32 of counts [n] int32."""
    size = counts.shape[0]
    counts = jnp.pad(counts, (0, -size % _ADDED))

    def turn(i, state):
        total, out = state
        start, sums = (i * _ADDED,), []
        some = part_at(counts, start, (_ADDED,))
        for count in jnp.split(some, _ADDED):
            total = total + count
            sums.append(total)
        out = with_part(out, jnp.concatenate(sums), start)
        return total, out

    init = (jnp.zeros(1, jnp.int32), jnp.zeros_like(counts))
    return fori_loop(0, counts.shape[0] // _ADDED, turn, init)[1][:size]


@sequential_vmap
def append(
    count: Array, kept: Array, columns: tuple[Array, ...], chosen: Array
) -> tuple[Array, Array]:
    """Rows of what is chosen, behind those that are there.

    Args:
      count: [1] int32 how many are there.
      kept: [room + 1, C] int32.
      columns: C arrays [n] int32.
      chosen: [n] bool.

    Returns:
      ``count``, not limited to the room, and ``kept`` with more. There is no use for
      the last row.
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
    """Where what is chosen stands, together at the front.

    Args:
      chosen: [n] bool.
      some: [⌈n / STRETCH⌉] bool, in which stretches anything is.
      index: [room + 1] what stands past the last of them.

    Returns:
      ``index`` with the rising places of the first ``room``; and [] int32 how many are
      chosen, not limited to the room. There is no use for the last of ``index``.
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
    """Deal the values of items to lists; the lists of a counting sort.

    Args:
      kept: [I, 3] int32: value, and first and count of the lists first … first +
        count - 1 that it is put into.
      items: [] int32, how many there are.
      place: [T] int32, where in ``out`` each list begins.
      out: where the lists are put.

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
