"""Linear maps with a transpose of their own.

JAX lets a function define its forward derivative (`jax.custom_jvp`, transposed by JAX)
or its backward one (`jax.custom_vjp`, without forward mode). `linear_call` defines the
transpose of a map but supports neither batches nor second derivatives. So this is a
primitive, by JAX's public means for those (`jax.extend`).
"""

from collections.abc import Callable, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

Array = jax.Array
T = TypeVar("T")
Arrays = Sequence[Array]
_apply = Primitive("linear_with_transpose")
_apply.multiple_results = True


def custom_transpose(
    forward: Callable[..., Arrays],
    transpose: Callable[..., Arrays],
    given: Arrays,
    argument: Arrays,
    like: Arrays,
) -> list[Array]:
    """Return ``forward(*given, *argument)``, with ``transpose`` as its transpose.

    Args:
      forward: (*given, *argument) → arrays, linear in the argument and differentiable.
        Not traced where only the transpose is used.
      transpose: (*given, *cotangents) → cotangents of the argument; differentiable.
      given: arrays; derivatives by them go through ``forward``.
      argument: arrays.
      like: arrays with the shapes and types of the results.
    """
    shapes = tuple(jax.ShapeDtypeStruct(a.shape, a.dtype) for a in like)
    return _apply.bind(
        *given, *argument, forward=forward, transpose=transpose, count=len(given),
        shapes=shapes,
    )  # fmt: skip


def jvp_of_active(
    function: Callable[..., T], primals: Arrays, tangents: Sequence, zero: type
) -> tuple[T, T]:
    """Return `jax.jvp` by the primals whose tangent is not of type ``zero``."""
    active = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, zero)]

    def by_active(*values):
        some = dict(zip(active, values))
        return function(*(some.get(i, value) for i, value in enumerate(primals)))

    return jax.jvp(
        by_active, [primals[i] for i in active], [tangents[i] for i in active]
    )


def _evaluate(*values, forward, transpose, count, shapes):
    del transpose, count, shapes
    return list(forward(*values))


_apply.def_impl(_evaluate)
mlir.register_lowering(_apply, mlir.lower_fun(_evaluate, multiple_results=True))


@_apply.def_abstract_eval
def _abstract(*values, forward, transpose, count, shapes):
    del values, forward, transpose, count
    return [ShapedArray(one.shape, one.dtype) for one in shapes]


def _jvp(primals, tangents, **params):
    count = params["count"]
    of_given, slopes = tangents[:count], tangents[count:]
    if not all(isinstance(tangent, ad.Zero) for tangent in of_given):
        return jvp_of_active(params["forward"], primals, tangents, ad.Zero)
    slopes = [ad.instantiate_zeros(slope) for slope in slopes]
    values = _apply.bind(*primals, **params)
    return values, _apply.bind(*primals[:count], *slopes, **params)


def _transpose(cotangents, *values, transpose, count, **_):
    cotangents = [ad.instantiate_zeros(cotangent) for cotangent in cotangents]
    return [None] * count + list(transpose(*values[:count], *cotangents))


def _batch(values, axes, *, forward, transpose, count, shapes):
    """Batch both maps by `jax.vmap`."""
    size = next(v.shape[a] for v, a in zip(values, axes) if a is not None)
    values = [
        value if axis is None else jnp.moveaxis(value, axis, 0)
        for value, axis in zip(values, axes)
    ]
    axes = [None if axis is None else 0 for axis in axes]
    # All of the argument: this sums the cotangents of an element that is shared.
    argument = [
        jnp.broadcast_to(value, (size, *value.shape)) if axis is None else value
        for value, axis in zip(values[count:], axes[count:])
    ]
    given, given_axes = values[:count], axes[:count]
    found = _apply.bind(
        *given,
        *argument,
        forward=jax.vmap(forward, (*given_axes, *(0 for _ in argument))),
        transpose=jax.vmap(transpose, (*given_axes, *(0 for _ in shapes))),
        count=count,
        shapes=tuple(
            jax.ShapeDtypeStruct((size, *one.shape), one.dtype) for one in shapes
        ),
    )
    return found, [0] * len(found)


ad.primitive_jvps[_apply] = _jvp
ad.primitive_transposes[_apply] = _transpose
batching.primitive_batchers[_apply] = _batch
