"""The scene as a pytree: fixed-capacity float arrays with an active mask beside them.

Axis legend: N capacity (slots), K spherical-harmonic bases.

The floats (`GaussianParams`) are exactly what is differentiated; the mask lives
beside them because `jax.grad` refuses a pytree with a boolean leaf. What stands in
an inactive slot never matters, whatever it is: NaN included.
"""

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from gsjax.errors import InputError
from gsjax.math import sh as sh_lib
from gsjax.math.numerics import exp_log_scale, real_floats, to_device
from gsjax.runtime.settings import whole

Array = jax.Array


@chex.dataclass(frozen=True, mappable_dataclass=False)
class GaussianParams:
    """The 14 + 3 (K - 1) numbers of each Gaussian (59 at degree 3), as stored.

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
    """A scene: parameters, and which slots hold a Gaussian.

    Attributes:
      params: N slots; what is differentiated.
      active: [N] bool; what the other slots hold never matters, NaN included.
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


# Contents of an unused slot: a unit quaternion, and an opacity of e^-20.
_EMPTY = {"quats": (1.0, 0.0, 0.0, 0.0), "logit_opacities": -20.0}


def make_gaussians(
    *, means, quats, log_scales, logit_opacities, sh, capacity: int | None = None
) -> Gaussians:
    """Gaussians from arrays; traceable, so that `jax.grad` may go through it.

    Args:
      means: [N, 3] positions in the world.
      quats: [N, 4] rotations, wxyz, any norm above zero.
      log_scales: [N, 3] natural logarithms of the standard deviations.
      logit_opacities: [N] or [N, 1].
      sh: [N, K, 3] coefficients with K = 1, 4, 9, 16 or 25.
      capacity: number of slots, at least N (and 1); default max(N, 1). See
        `capacity_bucket` for sizes that make growing recompile rarely.

    Raises:
      InputError: if a shape is not as above or the capacity is below N or 1.
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
    wanted = {
        "means": (count, 3),
        "quats": (count, 4),
        "log_scales": (count, 3),
        "logit_opacities": (count,),
        "sh": (count, bases, 3),
    }
    for name, shape in wanted.items():
        if arrays[name].shape != shape:
            raise InputError(
                f"{name} has shape {arrays[name].shape}; {shape} is wanted (the first "
                "axis of means sets the number of Gaussians)"
            )
    sh_lib.degree_of(arrays["sh"].shape[1])
    slots = max(count, 1) if capacity is None else whole("capacity", capacity)
    if slots < max(count, 1):
        raise InputError(
            f"capacity {capacity} cannot hold {count} Gaussians; pass at least "
            f"{max(count, 1)}, or None"
        )
    padded = {
        name: _padded(array, slots - count, _EMPTY.get(name, 0.0))
        for name, array in arrays.items()
    }
    # Of what is traced by iota: a mask from the host would be part of the program.
    traced = any(isinstance(array, Tracer) for array in arrays.values())
    active = (jnp if traced else np).arange(slots) < count
    gaussians = Gaussians(params=GaussianParams(**padded), active=active)  # pyright: ignore
    return to_device(gaussians)


def _padded(array: Array | np.ndarray, extra: int, value) -> Array | np.ndarray:
    """With ``extra`` more rows of ``value``."""
    if extra == 0:
        return array
    library = np if isinstance(array, np.ndarray) else jnp
    value = library.asarray(value, array.dtype)
    rows = library.broadcast_to(value, (extra, *array.shape[1:]))
    return library.concatenate([array, rows])


def capacity_bucket(count: int, minimum: int = 1024) -> int:
    """Smallest of the sizes 2^k and 1.5 · 2^k that holds ``count``.

    Growing through buckets recompiles once for every factor of 1.33 to 1.5.

    Args:
      count: what is to be held.
      minimum: the smallest bucket, itself a 2^k or 1.5 · 2^k.

    Raises:
      InputError: if ``minimum`` is none of them.
    """
    size = whole("minimum", minimum)
    if size < 1 or size // (size & -size) not in (1, 3):
        raise InputError(f"minimum {minimum}: a bucket, 2^k or 1.5 · 2^k, is wanted")
    while size < count:
        size = size // 3 * 4 if size & (size - 1) else max(2, size * 3 // 2)
    return size


def activate(params: GaussianParams) -> dict[str, Array]:
    """Values as used: scales [N, 3], opacities [N], quats [N, 4] as stored."""
    return {
        "scales": exp_log_scale(params.log_scales),
        "opacities": jax.nn.sigmoid(params.logit_opacities),
        "quats": params.quats,
    }


def num_active(gaussians: Gaussians) -> Array:
    """Count of active slots, [] int32; traceable."""
    return jnp.sum(gaussians.active, dtype=jnp.int32)


def grow(gaussians: Gaussians, capacity: int) -> Gaussians:
    """The same Gaussians in more slots; the new ones are inactive.

    Args:
      gaussians: N slots.
      capacity: slots afterwards, N or more.

    Raises:
      InputError: if ``capacity`` is below the present one (see `compact`).
    """
    extra = whole("capacity", capacity) - gaussians.capacity
    if extra < 0:
        raise InputError(
            f"capacity {capacity} is below the present {gaussians.capacity}; use "
            "compact(gaussians, capacity) to shrink"
        )
    if extra == 0:
        return gaussians
    return concatenate(gaussians, empty_like(gaussians, extra))


def empty_like(gaussians: Gaussians, capacity: int) -> Gaussians:
    """``capacity`` inactive slots with the SH degree and dtype of ``gaussians``."""
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
    """All slots of both, N and M, in order: N + M slots.

    Raises:
      InputError: if the SH degrees differ.
    """
    if first.sh_degree != second.sh_degree:
        raise InputError(
            f"SH degrees {first.sh_degree} and {second.sh_degree} differ; pad or cut "
            "one with with_sh_degree"
        )
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), first, second)


def select(gaussians: Gaussians, keep: Array) -> Gaussians:
    """The same slots with only those active that were and that ``keep`` marks.

    Args:
      gaussians: N slots.
      keep: [N] bool.

    Raises:
      InputError: if ``keep`` is of another shape or type.
    """
    keep = jnp.asarray(keep)
    if keep.shape != gaussians.active.shape or keep.dtype != bool:
        raise InputError(
            f"keep is {keep.dtype} {keep.shape}; bool {gaussians.active.shape} is "
            "wanted (one for each slot)"
        )
    return gaussians.replace(active=gaussians.active & keep)  # pyright: ignore


def compact(gaussians: Gaussians, capacity: int | None = None) -> Gaussians:
    """Active Gaussians first, in their order; ``capacity`` slots (default: same).

    Under jit an active Gaussian that does not fit would be lost: compare
    `num_active` with ``capacity``. Outside jit that raises.

    Raises:
      InputError: if ``capacity`` is below 1, or outside jit if more are active.
    """
    capacity = whole("capacity", gaussians.capacity if capacity is None else capacity)
    if capacity < 1:
        raise InputError(f"capacity {capacity}: at least 1 slot is wanted")
    active = gaussians.active
    if not isinstance(active, Tracer):
        count = int(np.sum(np.asarray(active)))
        if count > capacity:
            raise InputError(
                f"{count} Gaussians are active, capacity {capacity} cannot hold them"
            )
    order = jnp.argsort(~active, stable=True)[:capacity]
    packed = jax.tree.map(lambda a: a[order], gaussians)
    return packed if capacity <= gaussians.capacity else grow(packed, capacity)


def with_sh_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """The same Gaussians at another degree: bands are cut, or added as zeros.

    Args:
      gaussians: ``sh`` [N, K, 3].
      degree: 0 to 4; K is (degree + 1)² afterwards.

    Raises:
      InputError: if there is no such degree.
    """
    degree = whole("degree", degree)
    if not 0 <= degree <= sh_lib.MAX_DEGREE:
        raise InputError(f"SH degree {degree}: 0 to {sh_lib.MAX_DEGREE} is wanted")
    sh = gaussians.params.sh
    bases = sh_lib.num_bases(degree)
    extra = max(0, bases - sh.shape[1])
    sh = jnp.pad(sh[:, :bases], ((0, 0), (0, extra), (0, 0)))
    params = gaussians.params.replace(sh=sh)  # pyright: ignore
    return gaussians.replace(params=params)  # pyright: ignore
