"""Linear maps with a custom transpose: derivatives of every kind, and batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.runtime.custom_transpose import custom_transpose

RNG = np.random.default_rng(0)
A, B, X, Y = (jnp.asarray(RNG.normal(size=5)) for _ in range(4))


def forward(a, b, x, y):
    """A map of x and y, linear in both; a and b are given."""
    return [jnp.sin(a) * x + b * y, jnp.sum(a * b * y)]


def transpose(a, b, p, q):
    return [jnp.sin(a) * p, b * p + a * b * q]


def mapped(a, b, x, y, forward=forward, transpose=transpose):
    return custom_transpose(forward, transpose, (a, b), (x, y), (x, jnp.zeros(())))


def loss(a, b, x, y, way=mapped):
    first, second = way(a, b, x, y)
    return jnp.sum(jnp.cos(first)) + second**2


def plain(*values):
    return loss(*values, way=forward)


def same(found, wanted):
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-13)


@pytest.mark.parametrize("kind", [lambda f: f, jax.jit])
def test_values_and_derivatives_of_every_kind(kind):
    point, slope = (A, B, X, Y), (B, Y, A, X)
    every = (0, 1, 2, 3)
    for function in (
        lambda f: lambda: f(*point),
        lambda f: lambda: jax.grad(f, (2, 3))(*point),
        lambda f: lambda: jax.grad(f, every)(*point),
        lambda f: lambda: jax.jvp(f, point, slope),
        lambda f: lambda: jax.jvp(lambda x: f(A, B, x, Y), (X,), (Y,)),
        lambda f: lambda: jax.jvp(jax.grad(f, every), point, slope),
        lambda f: lambda: jax.hessian(f, every)(*point),
    ):
        same(kind(function(loss))(), function(plain)())


@pytest.mark.parametrize(
    "axes", [(0, None, None, None), (None, None, 0, 1), (0, 0, 0, 0)]
)
def test_batches(axes):
    point = [
        value if axis is None else jnp.stack([value, 2 * value, value - 1], axis)
        for value, axis in zip((A, B, X, Y), axes)
    ]
    every = (0, 1, 2, 3)

    def summed(f):
        return lambda *point: jax.vmap(f, axes)(*point).sum()

    same(jax.grad(summed(loss), every)(*point), jax.grad(summed(plain), every)(*point))
    of_each = jax.value_and_grad(loss, every), jax.value_and_grad(plain, every)
    same(*(jax.vmap(one, axes)(*point) for one in of_each))


def test_what_is_unused_is_not_traced_or_zero():
    def never(*_):
        raise AssertionError("traced")

    def back(x):
        return sum(jnp.sum(out) for out in mapped(A, B, x, Y, forward=never))

    def ahead(x):
        return mapped(A, B, x, Y, transpose=never)

    slope = jax.jit(lambda x: jax.vjp(back, x)[1](1.0)[0])
    same(slope(X), jnp.sin(A))
    same(jax.jvp(ahead, (X,), (Y,))[1], forward(A, B, Y, 0 * Y))
    same(jax.grad(lambda x, y: mapped(A, B, x, y)[1], (0, 1))(X, Y), (0 * X, A * B))
