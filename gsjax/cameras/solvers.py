"""Roots and inverses of lens functions, with exact derivatives.

A root is found without derivative; two Newton steps from it follow that are
differentiated. Newton's method doubles the order to which a result is exact in each
step, so that derivatives of the root up to the third order are those of the implicit
function theorem, in forward and reverse mode.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

Array = jax.Array

SAMPLES = 1024  # of a grid
_PART, _LEVELS = 32, 6
_HALVINGS, _NEWTON = 30, 6


def first_true(stops: Callable[[Array], Array], grid: Array) -> Array:
    """Return the smallest value at which a condition holds, or infinity.

    The condition is sampled on the rising ``grid``, then on ever smaller parts of it,
    to the precision of the type. It is taken to hold from its first sample on. No
    derivative is taken.

    Args:
      stops: values [S] → bool [S].
      grid: [S], from the first value to the last.
    """
    grid = lax.stop_gradient(grid)
    share = jnp.linspace(0, 1, _PART, dtype=grid.dtype)

    def finer(_, ends):
        low, high = ends
        some = low + (high - low) * share
        at = jnp.argmax(stops(some).at[-1].set(True))
        return some[jnp.maximum(at - 1, 0)], some[at]

    found = stops(grid)
    at = jnp.argmax(found)
    ends = grid[jnp.maximum(at - 1, 0)], grid[at]
    low, high = lax.fori_loop(0, _LEVELS, finer, ends)
    return jnp.where(jnp.any(found), low + (high - low) / 2, jnp.inf)


def invert_rising(
    function: Callable[[Array, Array], Array], c: Array, target: Array, high: Array
) -> Array:
    """Return x in [0, high] with function(c, x) = target.

    Args:
      function: element-wise in x, rising on [0, high].
      c: values of the function, by which the result is differentiated.
      target: any shape; beyond the range of the function, an end is returned.
      high: the largest x, of a shape that broadcasts to that of the target.
    """
    low, high = jnp.zeros_like(target), high + jnp.zeros_like(target)
    low, high, goal, fixed = lax.stop_gradient((low, high, target, c))

    def halve(_, ends):
        low, high = ends
        middle = low + (high - low) / 2
        below = function(fixed, middle) < goal
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    low, high = lax.fori_loop(0, _HALVINGS, halve, (low, high))

    def step(c, x: Array, target: Array) -> Array:
        value, slope = jax.jvp(lambda x: function(c, x), (x,), (jnp.ones_like(x),))
        good = slope > 0
        return x - jnp.where(good, (value - target) / jnp.where(good, slope, 1), 0)

    x = low + (high - low) / 2
    for _ in range(2):
        x = lax.stop_gradient(step(fixed, x, goal))
    return step(c, step(c, x, target), target)


def invert_plane(
    plane: Callable[[Array, Array, Array], tuple[Array, Array]],
    c: Array,
    target: tuple[Array, Array],
    start: tuple[Array, Array],
) -> tuple[Array, Array]:
    """Return (x, y) with plane(c, x, y) = target, by Newton's method from ``start``."""

    def step(c, at, target):
        one, zero = jnp.ones_like(at[0]), jnp.zeros_like(at[0])
        value, by_x = jax.jvp(lambda *p: plane(c, *p), at, (one, zero))
        _, by_y = jax.jvp(lambda *p: plane(c, *p), at, (zero, one))
        det = by_x[0] * by_y[1] - by_y[0] * by_x[1]
        good = jnp.abs(det) > 0
        scale = jnp.where(good, 1 / jnp.where(good, det, 1), 0)
        du, dv = value[0] - target[0], value[1] - target[1]
        return (
            at[0] - scale * (by_y[1] * du - by_y[0] * dv),
            at[1] - scale * (by_x[0] * dv - by_x[1] * du),
        )

    at, goal, fixed = lax.stop_gradient((start, target, c))
    at = lax.fori_loop(0, _NEWTON, lambda _, at: step(fixed, at, goal), at)
    at = lax.stop_gradient(at)
    return step(c, step(c, at, target), target)
