"""Linear interpolation in tables of features, with a transpose that is fast on CPUs.

Axis legend: N points, M rows of a table, C channels, P pairs of rows.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import sequential_vmap

from gsjax.runtime.custom_transpose import custom_transpose
from gsjax.runtime.devices import on_cpu
from gsjax.runtime.loops import fori_loop, part_at, with_part

Array = jax.Array


def weighted_rows(table: Array, first: Array, weights: Array) -> Array:
    """Return weighted sums [N, C] of rows of a table.

    Point n takes P pairs of successive rows, first[n, p] and the next. Differentiable
    in the table; no derivative by the weights is taken.

    Args:
      table: [M, C].
      first: [N, P] int32, from 0 to M − 2.
      weights: [N, P, 2].
    """
    first, weights = lax.stop_gradient(first), lax.stop_gradient(weights)
    like = jnp.zeros((first.shape[0], table.shape[1]), table.dtype)
    sums, spread = (_sums, _spread) if on_cpu() else (_take, _add)

    def forward(first, weights, table):
        return [sums(table, first, weights)]

    def transpose(first, weights, cotangents):
        return [spread(jnp.zeros_like(table), first, weights, cotangents)]

    return custom_transpose(forward, transpose, (first, weights), (table,), (like,))[0]


def _take(table: Array, first: Array, weights: Array) -> Array:
    rows = jnp.stack([first, first + 1], -1)
    values = table.at[rows].get(mode="promise_in_bounds")
    return jnp.sum(values * weights[..., None], (1, 2))


def _add(table: Array, first: Array, weights: Array, cotangents: Array) -> Array:
    rows = jnp.stack([first, first + 1], -1)
    values = cotangents[:, None, None] * weights[..., None]
    return table.at[rows].add(values, mode="promise_in_bounds")


def _pairs(first: Array, i: Array) -> list[tuple[Array, Array]]:
    """Return the starts of the pairs of rows of a point."""
    zero = jnp.int32(0)
    starts = part_at(first, (i, zero), (1, first.shape[1]))[0]
    return [(starts[p], zero) for p in range(first.shape[1])]


def _weights(weights: Array, i: Array) -> Array:
    zero = jnp.int32(0)
    return part_at(weights, (i, zero, zero), (1, *weights.shape[1:]))[0]


@sequential_vmap
def _sums(table: Array, first: Array, weights: Array) -> Array:
    """Return `weighted_rows` by a loop over points."""
    channels = table.shape[1]

    def turn(i, out):
        share = _weights(weights, i)
        total = jnp.zeros(channels, table.dtype)
        for p, start in enumerate(_pairs(first, i)):
            pair = part_at(table, start, (2, channels))
            total += pair[0] * share[p, 0] + pair[1] * share[p, 1]
        return with_part(out, total[None], (i, jnp.int32(0)))

    out = jnp.zeros((first.shape[0], channels), table.dtype)
    return fori_loop(0, first.shape[0], turn, out)


@sequential_vmap
def _spread(table: Array, first: Array, weights: Array, cotangents: Array) -> Array:
    """Return the table with weighted cotangents [N, C] added to its rows."""
    channels, count = table.shape[1], first.shape[0]
    zero = jnp.int32(0)

    def turn(i, table):
        share = _weights(weights, i)
        number = part_at(cotangents, (i, zero), (1, channels))
        for p, start in enumerate(_pairs(first, i)):
            pair = part_at(table, start, (2, channels))
            table = with_part(table, pair + share[p][:, None] * number, start)
        return table

    return fori_loop(0, count, turn, table)
