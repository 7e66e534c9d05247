"""Guarded elementary functions; all singularities of the library are handled here.

Each function is finite, with finite derivatives, for every input it documents. Inputs
and outputs are both guarded (double ``where``): a ``where`` on the output alone still
multiplies an infinite derivative by zero.
"""

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.errors import InputError
from gsjax.runtime.devices import on_cpu

Array = jax.Array

# Log scales that the projection can square in float32 without overflow (e^20 = 4.9e8)
# or denormals (e^-40, squared 1.8e-35). Values beyond are clipped, not culled.
LOG_SCALE_RANGE = (-40.0, 20.0)


def in_float64(tree):
    """Convert the floats of a pytree to float64; within ``jax.enable_x64(True)``."""

    def one(leaf):
        floating = jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating)
        return jnp.asarray(np.asarray(leaf), jnp.float64) if floating else leaf

    return jax.tree.map(one, tree)


def host_array(value) -> Array | np.ndarray:
    """Return a JAX array if any part of ``value`` is JAX's, else a NumPy array.

    NumPy compiles nothing; JAX compiles each operation anew for each shape and dtype.
    """
    leaves = jax.tree.leaves(value)
    if any(isinstance(x, jax.Array) or hasattr(x, "__jax_array__") for x in leaves):
        return jnp.asarray(value)
    return np.asarray(value)


def real_floats(name: str, value) -> Array | np.ndarray:
    """Return an array of JAX's default float type that shares no memory with ``value``.

    Raises:
      InputError: if it is complex; ``name`` is that of the argument.
    """
    array, dtype = host_array(value), jnp.result_type(float)
    if jnp.issubdtype(array.dtype, jnp.complexfloating):
        raise InputError(f"{name}: expected real numbers, got {array.dtype}")
    if isinstance(array, np.ndarray) and array.dtype == dtype:
        return jnp.asarray(array)
    return array.astype(dtype)


def to_device(tree):
    """Move the NumPy arrays of a pytree to JAX; memory may be shared.

    Compiles nothing, unlike `jax.numpy.asarray`.
    """

    def one(leaf):
        return jax.device_put(leaf) if isinstance(leaf, np.ndarray) else leaf

    return jax.tree.map(one, tree)


def safe_divide(numerator: Array, denominator: Array, where: Array) -> Array:
    """Return ``numerator / denominator`` where ``where``, else 0."""
    return jnp.where(where, numerator / jnp.where(where, denominator, 1), 0)


def safe_sqrt(x: Array) -> Array:
    """Return the square root, with value and derivative 0 at and below 0."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def materialize_mask(mask: Array) -> Array:
    """Return ``mask``, computed only once on CPUs.

    XLA's CPU backend (jax 0.10.2) considers the computation of a mask so cheap that it
    repeats it in every kernel that uses the mask. A division prevents that.
    """
    if not on_cpu():
        return mask
    one = np.float32(1)
    return one / jnp.where(mask, one, np.float32(np.inf)) > 0


def materialize(
    values: tuple[Array, ...], mask: Array | None = None
) -> tuple[Array, ...]:
    """Return ``values``, computed only once on CPUs; see `materialize_mask`.

    Args:
      values: equally shaped arrays.
      mask: which elements are used; the others may come out halved. By default those
        that are not NaN in the first array.
    """
    if not on_cpu():
        return values
    if mask is None:
        mask = values[0] == values[0]
    one = jnp.where(mask, 1, 2).astype(values[0].dtype)
    return tuple(value / one for value in values)


def near_one(components: tuple[Array, ...], fallback: tuple[float, ...]):
    """Scale a vector by the power of two that brings its largest number to 3/4 … 3/2.

    Exact, except for numbers 2^-126 times the largest; afterwards squares stay within
    float32. A vector that is zero, denormal or not finite becomes ``fallback`` with
    zero derivative.

    Args:
      components: equally shaped arrays.

    Returns:
      The components of the vector, and a mask of the usable vectors.
    """
    size = jax.lax.stop_gradient(
        jnp.max(jnp.stack([jnp.abs(c) for c in components]), axis=0)
    )
    limits = jnp.finfo(size.dtype)
    # NaN fails both comparisons.
    good = (size >= limits.tiny) & (size < jnp.inf)
    # The largest numbers would be rounded to infinity, so they are scaled to below 4.
    # The division keeps XLA from repeating the computation; see `materialize_mask`.
    below = jnp.minimum(jnp.where(good, size, 1), 2.0 ** (limits.maxexp - 2))
    scale = jax.lax.reduce_precision(below, limits.nexp, 0)
    scaled = tuple(jnp.where(good, c, f) / scale for c, f in zip(components, fallback))
    return scaled, good


def safe_normalize(components: tuple[Array, ...], fallback: tuple[float, ...]):
    """Return the unit vector of ``components``; arguments and results as `near_one`."""
    scaled, good = near_one(components, fallback)
    norm = jnp.sqrt(sum(c * c for c in scaled))
    return tuple(c / norm for c in scaled), good


def logit(probability: Array) -> Array:
    """Return the inverse of the sigmoid; inputs are clamped to [2^-24, 1 - 2^-23].

    At both ends `jax.nn.sigmoid` still has a derivative other than 0.
    """
    p = jnp.clip(probability, 2.0**-24, 1 - 2.0**-23)
    return jnp.log(p) - jnp.log1p(-p)


def all_within(tree, limit: float = float("inf")) -> Array:
    """Return [] bool: whether the magnitudes of all numbers are below ``limit``."""
    good = jnp.asarray(True)
    for leaf in jax.tree.leaves(tree):
        good &= jnp.all(jnp.abs(leaf) < limit)
    return good


def exp_log_scale(log_scale: Array) -> Array:
    """Return ``exp`` of inputs clipped to `LOG_SCALE_RANGE`; derivative 0 beyond."""
    low, high = LOG_SCALE_RANGE
    inside = (log_scale >= low) & (log_scale <= high)
    return jnp.exp(jnp.where(inside, log_scale, jnp.clip(log_scale, low, high)))


# 2^f for |f| ≤ 1/2 is 1 + f (c1 + f (c2 + …)): a minimax fit, relative error 1e-7.
_EXP2 = (0.0013264726, 0.009671513, 0.055507336, 0.24022242, 0.693147)
# Adding it leaves an integer below 2^22 in the low bits of a float32.
_INTEGER = 1.5 * 2.0**23


@jax.custom_jvp
def exp_negative(x: Array) -> Array:
    """Return ``exp(x)`` for x ≤ 0, to 1e-6 down to −12 and 4e-6 to −87; 1e-38 below.

    Faster than `jnp.exp` in float32 on a CPU: no guard against overflow, one term less.
    Otherwise it is `jnp.exp`.
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
