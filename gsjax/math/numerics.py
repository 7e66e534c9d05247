"""Guarded elementary functions: every singularity of the library lives here.

Each function is finite, with finite derivatives, for every input it documents; the
input as well as the output is guarded (double ``where``), because a ``where`` on
the output alone still multiplies an infinite derivative by zero.
"""

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.errors import InputError
from gsjax.runtime.devices import on_cpu

Array = jax.Array

# Range of log scales that the projection can square in float32 without overflow
# (e^20 = 4.9e8) or loss to denormals (e^-40, squared 1.8e-35). Values beyond are
# clipped, not culled: a finite Gaussian stays visible.
LOG_SCALE_RANGE = (-40.0, 20.0)


def in_float64(tree):
    """The same pytree with its floats in float64; within ``jax.enable_x64(True)``."""

    def one(leaf):
        floating = jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating)
        return jnp.asarray(np.asarray(leaf), jnp.float64) if floating else leaf

    return jax.tree.map(one, tree)


def host_array(value) -> Array | np.ndarray:
    """What is JAX's, or has a part that is, in JAX; all else in NumPy.

    There nothing is compiled: in a new process each kind of operation, by shape and
    dtype, takes JAX some 20 ms, on however few numbers.
    """
    leaves = jax.tree.leaves(value)
    if any(isinstance(x, jax.Array) or hasattr(x, "__jax_array__") for x in leaves):
        return jnp.asarray(value)
    return np.asarray(value)


def real_floats(name: str, value) -> Array | np.ndarray:
    """An array of the type that JAX has for floats; in no memory of the caller's.

    What NumPy need not convert is JAX's then, which copies it once.

    Raises:
      InputError: if it is complex; ``name`` says what.
    """
    array, dtype = host_array(value), jnp.result_type(float)
    if jnp.issubdtype(array.dtype, jnp.complexfloating):
        raise InputError(f"{name} is complex; pass real numbers")
    if isinstance(array, np.ndarray) and array.dtype == dtype:
        return jnp.asarray(array)
    return array.astype(dtype)


def to_device(tree):
    """The same pytree, what is NumPy's of it in JAX; it may share that memory.

    Nothing is compiled for that: `jax.numpy.asarray` compiles its copying.
    """

    def one(leaf):
        return jax.device_put(leaf) if isinstance(leaf, np.ndarray) else leaf

    return jax.tree.map(one, tree)


def safe_divide(numerator: Array, denominator: Array, where: Array) -> Array:
    """``numerator / denominator`` where ``where``, else 0, with finite derivatives."""
    return jnp.where(where, numerator / jnp.where(where, denominator, 1), 0)


def safe_sqrt(x: Array) -> Array:
    """Square root with value and derivative 0 at and below 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def materialize_mask(mask: Array) -> Array:
    """``mask``, on a CPU worked out once.

    By a division: XLA's CPU backend (jax 0.10.2) takes all that leads to a mask for so
    cheap that it does it anew in each kernel that uses it.
    """
    if not on_cpu():
        return mask
    one = np.float32(1)
    return one / jnp.where(mask, one, np.float32(np.inf)) > 0


def materialize(values: tuple[Array, ...], mask: Array) -> tuple[Array, ...]:
    """``values``, and what is derived by them, on a CPU worked out once, as `materialize_mask` is.

    Args:
      values: equally shaped arrays.
      mask: what of them counts; the rest may come out as halves.
    """
    if not on_cpu():
        return values
    one = jnp.where(mask, 1, 2).astype(values[0].dtype)
    return tuple(value / one for value in values)


def near_one(components: tuple[Array, ...], fallback: tuple[float, ...]):
    """A vector times the power of two that brings its largest number to 3/4 … 3/2.

    Exact: no number is rounded, but what is 2^-126 times the largest. Afterwards
    neither 1e-23 nor 1e20 leaves the range of float32 when squared. A vector that is
    zero, denormal or not finite becomes ``fallback`` with zero derivative.

    Args:
      components: equally shaped arrays.

    Returns:
      The components of the vector, and a mask of where it was usable.
    """
    size = jax.lax.stop_gradient(
        jnp.max(jnp.stack([jnp.abs(c) for c in components]), axis=0)
    )
    limits = jnp.finfo(size.dtype)
    # A NaN fails both comparisons: guards are phrased positively.
    good = (size >= limits.tiny) & (size < jnp.inf)
    # The largest numbers would be rounded to infinity: those stay below 4. A division,
    # not a product with the inverse, for the reason that `materialize_mask` gives.
    below = jnp.minimum(jnp.where(good, size, 1), 2.0 ** (limits.maxexp - 2))
    scale = jax.lax.reduce_precision(below, limits.nexp, 0)
    scaled = tuple(jnp.where(good, c, f) / scale for c, f in zip(components, fallback))
    return scaled, good


def safe_normalize(components: tuple[Array, ...], fallback: tuple[float, ...]):
    """Unit vector of ``components``, as `near_one` takes and returns them."""
    scaled, good = near_one(components, fallback)
    norm = jnp.sqrt(sum(c * c for c in scaled))
    return tuple(c / norm for c in scaled), good


def logit(probability: Array) -> Array:
    """Inverse of the sigmoid; probabilities are clamped to [2^-24, 1 - 2^-23].

    Both ends come back from `jax.nn.sigmoid` with a slope: that of the logit of
    1 - 2^-24 is rounded to 1.
    """
    p = jnp.clip(probability, 2.0**-24, 1 - 2.0**-23)
    return jnp.log(p) - jnp.log1p(-p)


def all_within(tree, limit: float = float("inf")) -> Array:
    """[] bool: whether all numbers of a pytree, in size, are below ``limit``."""
    good = jnp.asarray(True)
    for leaf in jax.tree.leaves(tree):
        good &= jnp.all(jnp.abs(leaf) < limit)
    return good


def exp_log_scale(log_scale: Array) -> Array:
    """``exp`` clipped to `LOG_SCALE_RANGE` in the log domain; zero slope beyond."""
    low, high = LOG_SCALE_RANGE
    inside = (log_scale >= low) & (log_scale <= high)
    return jnp.exp(jnp.where(inside, log_scale, jnp.clip(log_scale, low, high)))


# 2^f for |f| ≤ 1/2 is 1 + f (c1 + f (c2 + …)), relative error 1e-7: fitted to the
# smallest largest error, by reweighted least squares.
_EXP2 = (0.0013264726, 0.009671513, 0.055507336, 0.24022242, 0.693147)
# Added to a float32 that is an integer below 2^22, it leaves that in the low bits.
_INTEGER = 1.5 * 2.0**23


@jax.custom_jvp
def exp_negative(x: Array) -> Array:
    """``exp(x)`` for x ≤ 0, to 1e-6 down to −12 and 4e-6 to −87; 1e-38 below.

    In float32 on a CPU in fewer operations than `jnp.exp`: nothing has to be guarded
    above, and one term less is enough. Elsewhere it is `jnp.exp`.
    """
    if x.dtype != jnp.float32 or not on_cpu():
        return jnp.exp(x)
    power = jnp.maximum(x * np.float32(np.log2(np.e)), -126)
    whole = jax.lax.round(power, jax.lax.RoundingMethod.TO_NEAREST_EVEN)
    part = power - whole
    value = jnp.float32(_EXP2[0])
    for coefficient in (*_EXP2[1:], 1.0):
        value = value * part + coefficient
    exponent = jax.lax.bitcast_convert_type(whole + _INTEGER, jnp.int32) << 23
    bits = jax.lax.bitcast_convert_type(value, jnp.int32) + exponent
    return jax.lax.bitcast_convert_type(bits, jnp.float32)


@exp_negative.defjvp
def _exp_negative_jvp(primals, tangents):
    value = exp_negative(*primals)
    return value, value * tangents[0]
