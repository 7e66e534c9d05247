"""Fixed-size work done at the size that a view needs instead of at the capacity."""

from collections.abc import Callable
from typing import TypeVar

import jax.numpy as jnp
from jax import lax

from gsjax.raster.types import Array
from gsjax.raster.vmap_branching import min_in_batch

T = TypeVar("T")
_SMALLEST = 128  # smaller sizes are not worth their compilation


def run_at_bucket(
    needed: Array,
    full: int,
    num_size_buckets: int,
    run: Callable[[int], T],
    step: int = 4,
) -> T:
    """Return ``run(size)`` for the smallest size that holds ``needed``.

    Sizes are full, full / step, full / step², …

    Every size is compiled and one is run by `lax.switch`; under `jax.vmap` the largest
    that any element of the batch needs.

    Args:
      needed: [] count, int or float.
      full: the capacity, used if nothing smaller is enough.
      num_size_buckets: largest number of sizes; sizes below 128 are left out.
      run: the work at a size. It must return the same shapes for every size.
      step: ratio of one size to the next.
    """
    sizes = [full]
    while len(sizes) < num_size_buckets and sizes[-1] >= _SMALLEST * step:
        sizes.append(-(-sizes[-1] // step))
    if len(sizes) == 1:
        return run(full)
    fits = [(needed <= size).astype(jnp.int32) for size in sizes[1:]]
    index = min_in_batch(sum(fits, start=jnp.int32(0)))
    return lax.switch(index, [lambda size=size: run(size) for size in sizes])
