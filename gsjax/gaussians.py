"""Gaussians as a pytree: float arrays of fixed capacity, and a mask of active slots.

Axis legend: N capacity (slots), K spherical-harmonic bases.

`GaussianParams` holds the differentiable floats. The mask is kept beside them because
`jax.grad` rejects boolean leaves. Values of inactive slots are ignored, even NaN.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gsjax.errors import InputError
from gsjax.math import sh as sh_lib
from gsjax.math.numerics import exp_log_scale, real_floats
from gsjax.runtime.devices import place
from gsjax.runtime.settings import as_int

Array = jax.Array


@chex.dataclass(frozen=True, mappable_dataclass=False)
class GaussianParams:
    """The 11 + 3 K numbers of each Gaussian (59 at degree 3), as stored.

    Attributes:
      means: [N, 3] world position.
      quats: [N, 4] rotation, wxyz, any norm above zero.
      log_scales: [N, 3] natural logarithm of the standard deviations.
      logit_opacities: [N] logit of the opacity.
      sh: [N, K, 3] spherical-harmonic coefficients, K = (degree + 1)².
    """

    means: Array
    quats: Array
    log_scales: Array
    logit_opacities: Array
    sh: Array


@chex.dataclass(frozen=True, mappable_dataclass=False)
class Gaussians:
    """A scene: parameters, and a mask of the slots that hold a Gaussian.

    Attributes:
      params: N slots of parameters, the differentiable part.
      active: [N] bool; values of inactive slots are ignored, even NaN.
    """

    params: GaussianParams
    active: Array

    @property
    def capacity(self) -> int:
        """Number of slots N, active or not."""
        return self.active.shape[-1]

    @property
    def sh_degree(self) -> int:
        """Static degree of the spherical harmonics."""
        return sh_lib.degree_of(self.params.sh.shape[-2])

    def __repr__(self) -> str:
        try:
            *batch, slots = self.active.shape
            told = [f"batch={tuple(batch)}"] * bool(batch)
            if isinstance(self.active, np.ndarray) or has_values(self.active):
                count = np.count_nonzero(np.asarray(self.active))
                told.append(f"active={count}/{self.active.size}")
            else:
                told.append(f"capacity={slots}")
            told += [f"sh_degree={self.sh_degree}", str(self.params.means.dtype)]
            return f"Gaussians({', '.join(told)})"
        except (AttributeError, InputError, IndexError, TypeError, ValueError):
            # Transformations of JAX put other things than arrays into the leaves.
            return f"Gaussians(params={self.params!r}, active={self.active!r})"


def _unexpected(where: str, expected: str, got, remedy: str) -> InputError:
    return InputError(f"{where}: expected {expected}, got {got}; {remedy}")


def has_values(array) -> bool:
    """Return True for an array of JAX whose values can be read now."""
    return (
        isinstance(array, jax.Array)
        and not isinstance(array, Tracer)
        and not array.is_deleted()
        and array.is_fully_addressable
    )


def check_gaussians(value, argument: str = "gaussians") -> None:
    """Raise `InputError` if an argument is not `Gaussians`; names type and remedy."""
    if isinstance(value, Gaussians):
        return
    remedy = "make them with gsjax.make_gaussians, or read them with gsjax.load"
    if isinstance(value, (list, tuple)):
        remedy = "merge them with gsjax.concatenate, or call this for each of them"
    elif isinstance(value, dict):
        remedy = "call gsjax.make_gaussians(**fields)"
    elif isinstance(value, GaussianParams):
        remedy = "call gsjax.Gaussians(params=params, active=mask)"
    elif isinstance(value, str) or hasattr(value, "__fspath__"):
        remedy = "call gsjax.load(path)"
    raise _unexpected(argument, "Gaussians", type(value).__name__, remedy)


# Contents of an unused slot: a unit quaternion, and an opacity of e^-20.
_EMPTY = {"quats": (1.0, 0.0, 0.0, 0.0), "logit_opacities": -20.0}


def make_gaussians(
    *, means, quats, log_scales, logit_opacities, sh, capacity: int | None = None
) -> Gaussians:
    """Return Gaussians from arrays; traceable, so `jax.grad` may go through it.

    Outside a transformation the arrays are placed on all local devices, where a render
    places its results, unless ``jax.default_device`` names one device.

    Args:
      means: [N, 3] positions in the world.
      quats: [N, 4] rotations, wxyz, any norm above zero.
      log_scales: [N, 3] natural logarithms of the standard deviations.
      logit_opacities: [N] or [N, 1].
      sh: [N, K, 3] coefficients with K = 1, 4, 9, 16 or 25.
      capacity: number of slots, at least N (and 1); default max(N, 1). See
        `capacity_bucket` for sizes that make recompilation rare.

    Raises:
      InputError: if a shape does not match, or the capacity is below N or 1.
    """
    arrays = {
        "means": means,
        "quats": quats,
        "log_scales": log_scales,
        "logit_opacities": logit_opacities,
        "sh": sh,
    }
    arrays = {name: real_floats(name, value) for name, value in arrays.items()}
    opacities = arrays["logit_opacities"]
    if opacities.ndim == 2 and opacities.shape[-1] == 1:
        arrays["logit_opacities"] = opacities[:, 0]
    count = arrays["means"].shape[0] if arrays["means"].ndim else 0
    bases = arrays["sh"].shape[1] if arrays["sh"].ndim == 3 else "K"
    expected = {
        "means": (count, 3),
        "quats": (count, 4),
        "log_scales": (count, 3),
        "logit_opacities": (count,),
        "sh": (count, bases, 3),
    }
    for name, shape in expected.items():
        if arrays[name].shape != shape:
            got = f"{arrays[name].shape}; the first axis of means sets the number"
            raise InputError(f"{name}: expected shape {shape}, got {got} of Gaussians")
    sh_lib.degree_of(arrays["sh"].shape[1])
    slots = max(count, 1) if capacity is None else as_int("capacity", capacity)
    if slots < max(count, 1):
        expected = f"at least {max(count, 1)} for {count} Gaussians"
        raise _unexpected("capacity", expected, capacity, "pass more, or None")
    padded = {
        name: _padded(array, slots - count, _EMPTY.get(name, 0.0))
        for name, array in arrays.items()
    }
    # Under tracing an iota: a mask from the host would be a constant of the program.
    traced = any(isinstance(array, Tracer) for array in arrays.values())
    active = (jnp if traced else np).arange(slots) < count
    gaussians = Gaussians(params=GaussianParams(**padded), active=active)  # pyright: ignore
    return place(gaussians)


def _padded(array: Array | np.ndarray, extra: int, value) -> Array | np.ndarray:
    """Append ``extra`` rows of ``value``."""
    if extra == 0:
        return array
    library = np if isinstance(array, np.ndarray) else jnp
    value = library.asarray(value, array.dtype)
    rows = library.broadcast_to(value, (extra, *array.shape[1:]))
    return library.concatenate([array, rows])


def capacity_bucket(count: int, minimum: int = 1024) -> int:
    """Return the smallest of the sizes 2^k and 1.5 · 2^k that holds ``count``.

    Growing through buckets recompiles once for every factor of 1.33 to 1.5.

    Args:
      count: number of items to hold.
      minimum: the smallest bucket, itself a 2^k or 1.5 · 2^k.

    Raises:
      InputError: if ``minimum`` is not a bucket.
    """
    size = as_int("minimum", minimum)
    if size < 1 or size // (size & -size) not in (1, 3):
        expected = "a bucket, 2^k or 1.5 · 2^k"
        raise _unexpected("minimum", expected, minimum, "pass a power of two")
    while size < count:
        size = size // 3 * 4 if size & (size - 1) else max(2, size * 3 // 2)
    return size


def activate(params: GaussianParams) -> dict[str, Array]:
    """Return the values as used: scales [N, 3], opacities [N], quats [N, 4]."""
    return {
        "scales": exp_log_scale(params.log_scales),
        "opacities": jax.nn.sigmoid(params.logit_opacities),
        "quats": params.quats,
    }


def num_active(gaussians: Gaussians) -> Array:
    """Return the number of active slots, [] int32; traceable."""
    check_gaussians(gaussians)
    return jnp.sum(gaussians.active, dtype=jnp.int32)


def grow(gaussians: Gaussians, capacity: int) -> Gaussians:
    """Return the same Gaussians in more slots; the new ones are inactive.

    Args:
      gaussians: N slots.
      capacity: number of slots of the result, at least N.

    Raises:
      InputError: if ``capacity`` is below N (see `compact`).
    """
    check_gaussians(gaussians)
    extra = as_int("capacity", capacity) - gaussians.capacity
    if extra < 0:
        expected = f"at least the present {gaussians.capacity}"
        remedy = "use compact(gaussians, capacity) to shrink"
        raise _unexpected("capacity", expected, capacity, remedy)
    if extra == 0:
        return gaussians
    return concatenate(gaussians, empty_like(gaussians, extra))


def empty_like(gaussians: Gaussians, capacity: int) -> Gaussians:
    """Return inactive slots with the SH degree and dtype of ``gaussians``."""
    params = {
        name: jnp.broadcast_to(
            jnp.asarray(_EMPTY.get(name, 0.0), array.dtype),
            (capacity, *array.shape[1:]),
        )
        for name, array in gaussians.params.__dict__.items()
    }
    inactive = jnp.zeros(capacity, bool)
    return Gaussians(params=GaussianParams(**params), active=inactive)  # pyright: ignore


def concatenate(first: Gaussians, second: Gaussians) -> Gaussians:
    """Return the slots of both, N and M, in order: N + M slots.

    Raises:
      InputError: if the SH degrees differ.
    """
    check_gaussians(first, "first")
    check_gaussians(second, "second")
    if first.sh_degree != second.sh_degree:
        got = f"{first.sh_degree} and {second.sh_degree}"
        remedy = "change one with with_sh_degree"
        raise _unexpected("concatenate", "equal SH degrees", got, remedy)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)


def select(gaussians: Gaussians, keep: Array) -> Gaussians:
    """Return the same slots; only those that ``keep`` marks stay active.

    Args:
      gaussians: N slots.
      keep: [N] bool.

    Raises:
      InputError: if ``keep`` has another shape or type.
    """
    check_gaussians(gaussians)
    keep = jnp.asarray(keep)
    if keep.shape != gaussians.active.shape or keep.dtype != bool:
        expected, got = f"bool {gaussians.active.shape}", f"{keep.dtype} {keep.shape}"
        raise _unexpected("keep", expected, got, "pass one flag for each slot")
    return gaussians.replace(active=gaussians.active & keep)  # pyright: ignore


def compact(gaussians: Gaussians, capacity: int | None = None) -> Gaussians:
    """Move the active Gaussians to the front, in their order.

    Under jit, active Gaussians that do not fit are lost: compare `num_active` with
    ``capacity``. Outside jit they raise an error.

    Args:
      gaussians: N slots.
      capacity: number of slots of the result; default N.

    Raises:
      InputError: if ``capacity`` is below 1, or outside jit if more are active.
    """
    check_gaussians(gaussians)
    capacity = as_int("capacity", gaussians.capacity if capacity is None else capacity)
    active, least = gaussians.active, 1
    if not isinstance(active, Tracer):
        least = max(1, int(np.sum(np.asarray(active))))
    if capacity < least:
        expected = f"at least {least} for the active Gaussians"
        remedy = "pass a larger number, or deactivate some with select"
        raise _unexpected("capacity", expected, capacity, remedy)
    order = jnp.argsort(~active, stable=True)[:capacity]
    packed = jax.tree.map(lambda a: a[order], gaussians)
    return packed if capacity <= gaussians.capacity else grow(packed, capacity)


def with_sh_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return the same Gaussians at another SH degree: bands are cut, or zeros added.

    Args:
      gaussians: ``sh`` [N, K, 3].
      degree: 0 to 4; K is (degree + 1)² in the result.

    Raises:
      InputError: if ``degree`` is out of range.
    """
    check_gaussians(gaussians)
    degree = as_int("degree", degree)
    if not 0 <= degree <= sh_lib.MAX_DEGREE:
        expected = f"0 to {sh_lib.MAX_DEGREE}"
        raise _unexpected("degree", expected, degree, "pass one of them")
    sh = gaussians.params.sh
    bases = sh_lib.num_bases(degree)
    extra = max(0, bases - sh.shape[1])
    sh = jnp.pad(sh[:, :bases], ((0, 0), (0, extra), (0, 0)))
    params = gaussians.params.replace(sh=sh)  # pyright: ignore
    return gaussians.replace(params=params)  # pyright: ignore
