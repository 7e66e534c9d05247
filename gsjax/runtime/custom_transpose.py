"""Linear maps whose transpose is computed in a way of its own.

JAX has rules of one's own for what is differentiated forward (`jax.custom_jvp`, which
reverse mode then transposes) or backward (`jax.custom_vjp`, which forward mode
refuses), and for the transpose of a map there is `linear_call`, which knows neither
batches nor a second derivative. So this is a primitive, by JAX's public means for
those (`jax.extend`).
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
    """``forward(*given, *argument)``, whose transpose is ``transpose``.

    Args:
      forward: (*given, *argument) → arrays, linear in the argument and differentiable.
        Where only the transpose is wanted, it is not so much as traced.
      transpose: (*given, *cotangents) → cotangents of the argument; differentiable.
      given: arrays; what is differentiated of them is so by ``forward``.
      argument: arrays.
      like: what the results have the shapes and types of.
    """
    shapes = tuple(jax.ShapeDtypeStruct(a.shape, a.dtype) for a in like)
    return _apply.bind(
        *given, *argument, forward=forward, transpose=transpose, count=len(given),
        shapes=shapes,
    )  # fmt: skip


def jvp_of_active(
    function: Callable[..., T], primals: Arrays, tangents: Sequence, still: type
) -> tuple[T, T]:
    """`jax.jvp` by what moves alone: all whose tangent is not ``still``."""
    moving = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, still)]

    def by_moving(*values):
        some = dict(zip(moving, values))
        return function(*(some.get(i, value) for i, value in enumerate(primals)))

    return jax.jvp(
        by_moving, [primals[i] for i in moving], [tangents[i] for i in moving]
    )


def _evaluated(*values, forward, transpose, count, shapes):
    del transpose, count, shapes
    return list(forward(*values))


_apply.def_impl(_evaluated)
mlir.register_lowering(_apply, mlir.lower_fun(_evaluated, multiple_results=True))


@_apply.def_abstract_eval
def _shapes_of(*values, forward, transpose, count, shapes):
    del values, forward, transpose, count
    return [ShapedArray(one.shape, one.dtype) for one in shapes]


def _jvp(primals, tangents, **params):
    count = params["count"]
    known, slopes = tangents[:count], tangents[count:]
    if not all(isinstance(tangent, ad.Zero) for tangent in known):
        return jvp_of_active(params["forward"], primals, tangents, ad.Zero)
    slopes = [ad.instantiate_zeros(slope) for slope in slopes]
    values = _apply.bind(*primals, **params)
    return values, _apply.bind(*primals[:count], *slopes, **params)


def _transposed(cotangents, *values, transpose, count, **_):
    cotangents = [ad.instantiate_zeros(cotangent) for cotangent in cotangents]
    return [None] * count + list(transpose(*values[:count], *cotangents))


def _batched(values, axes, *, forward, transpose, count, shapes):
    """Both maps of a batch: each is as `jax.vmap` makes it."""
    size = next(v.shape[a] for v, a in zip(values, axes) if a is not None)
    values = [
        value if axis is None else jnp.moveaxis(value, axis, 0)
        for value, axis in zip(values, axes)
    ]
    axes = [None if axis is None else 0 for axis in axes]
    # Of the argument all: what comes back to one that is shared is summed by this.
    argument = [
        jnp.broadcast_to(value, (size, *value.shape)) if axis is None else value
        for value, axis in zip(values[count:], axes[count:])
    ]
    given, known = values[:count], axes[:count]
    found = _apply.bind(
        *given,
        *argument,
        forward=jax.vmap(forward, (*known, *(0 for _ in argument))),
        transpose=jax.vmap(transpose, (*known, *(0 for _ in shapes))),
        count=count,
        shapes=tuple(
            jax.ShapeDtypeStruct((size, *one.shape), one.dtype) for one in shapes
        ),
    )
    return found, [0] * len(found)


ad.primitive_jvps[_apply] = _jvp
ad.primitive_transposes[_apply] = _transposed
batching.primitive_batchers[_apply] = _batched
