"""Fixed-size work done at the size a view needs instead of at the capacity."""

from collections.abc import Callable
from typing import TypeVar

import jax.numpy as jnp
from jax import lax

from gsjax.raster.types import Array
from gsjax.raster.vmap_branching import min_in_batch

T = TypeVar("T")
_LEAST = 128  # smaller sizes are not worth their compilation


def run_at_bucket(
    wanted: Array,
    full: int,
    num_size_buckets: int,
    run: Callable[[int], T],
    step: int = 4,
) -> T:
    """``run(size)`` with the smallest of full, full / step, … that holds ``wanted``.

    Every size is compiled and one is run (`lax.switch`; under `jax.vmap` the largest
    that any of the batch wants). What ``run`` returns must have the same shapes for
    every size.

    Args:
      wanted: [] count, int or float.
      full: the capacity, taken where nothing smaller is enough.
      num_size_buckets: number of sizes, at most; fewer where they would be below 128.
      run: what to do at a size.
      step: ratio of one size to the next.
    """
    sizes = [full]
    while len(sizes) < num_size_buckets and sizes[-1] >= _LEAST * step:
        sizes.append(-(-sizes[-1] // step))
    if len(sizes) == 1:
        return run(full)
    fits = [(wanted <= size).astype(jnp.int32) for size in sizes[1:]]
    index = min_in_batch(sum(fits, start=jnp.int32(0)))
    return lax.switch(index, [lambda size=size: run(size) for size in sizes])
