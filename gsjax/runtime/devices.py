"""Which devices JAX has, and how work and arrays are shared among them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from gsjax.errors import InputError
from gsjax.runtime import setup
from gsjax.runtime.machine import usable_cores
from gsjax.runtime.settings import as_int


def platform_name() -> str:
    """Return JAX's default platform, such as "cpu", "gpu" or "tpu"; starts JAX."""
    name = jax.default_backend()
    setup.restore_environment()
    return name


def on_cpu() -> bool:
    """Return True if JAX computes on a CPU by default; starts JAX."""
    return platform_name() == "cpu"


def local_device_count() -> int:
    """Return the number of local devices; warn once if a CPU is used badly."""
    if on_cpu():
        setup.warn_if_unprepared()
    return jax.local_device_count()


def use_all_cores(count: int | None = None, *, queued: bool = True) -> int:
    """Choose the number of CPU devices that share a render, by default one per core.

    ``import gsjax`` does this already if JAX has not started (see
    `gsjax.runtime.setup.prepare_process`). Call this function to choose the number, to
    pass ``queued=False``, or to make sure: it raises if it comes too late. Call it
    before the first computation. It has no effect on a GPU or TPU.

    Args:
      count: number of devices; None for the cores that this process may use, limited by
        its affinity and by the CPU time of its control groups, as in a container.
      queued: whether calls of jitted functions may queue up before a result is waited
        for, as in a training loop that does not read its loss. XLA's CPU client
        (jax 0.10.2) blocks a thread per device if more than 32 computations wait for a
        device; with no more threads than devices the process is then aborted. So there
        are two threads per device, unless ``NPROC`` in the environment says how many.
        That costs speed; pass False if you wait for every result, or every tenth.

    Returns:
      The number of local devices.

    Raises:
      RuntimeError: if JAX has started with another number of devices.
      InputError: if ``count`` is not a positive integer.
    """
    count = usable_cores() if count is None else as_int("count", count)
    if count < 1:
        raise InputError(f"use_all_cores: expected count ≥ 1, got {count}")
    setup.restore_environment()
    setup.keep_memory()
    if queued and count > 1:
        setup.set_temporarily("NPROC", 2 * count)
    try:
        jax.config.update("jax_num_cpu_devices", count)
        setup.compile_loops_as_kernels()
    except RuntimeError as error:
        if on_cpu() and jax.local_device_count() != count:
            raise RuntimeError(
                "use_all_cores: JAX has started already; call it before the first "
                "computation, right after import gsjax"
            ) from error
    on_cpu()  # starts JAX with these settings
    return jax.local_device_count()


def map_over_devices(work: Callable[..., Any], count: int, *inputs: Any) -> Any:
    """Call ``work`` on each of ``count`` devices, with the same inputs.

    Args:
      work: (device index [1] int32, *inputs) → arrays with a leading axis of 1. Traced
        once; differentiable.
      count: at most the number of local devices.
      *inputs: replicated on every device.

    Returns:
      The arrays of all devices, concatenated along the leading axis: [count, ...].
    """
    if count == 1:
        return work(jnp.zeros(1, jnp.int32), *inputs)
    sharded, replicated = PartitionSpec("devices"), PartitionSpec()
    mapped = jax.shard_map(
        work,
        mesh=_mesh(count),
        in_specs=(sharded, *(replicated for _ in inputs)),
        out_specs=sharded,
        check_vma=False,
    )
    return mapped(jnp.arange(count, dtype=jnp.int32), *inputs)


def shard_rows(values: jax.Array, count: int, fill: float) -> jax.Array:
    """Shard ``values`` [n] over ``count`` devices; the numbers do not change.

    Elementwise work on them is then shared too, up to the first operation that needs
    all of them, such as `map_over_devices`.

    Args:
      values: padded at the end to a multiple of ``count``.
      count: number of local devices; 1 changes nothing.
      fill: value of the padding.
    """
    if count == 1:
        return values
    values = jnp.pad(values, (0, -len(values) % count), constant_values=fill)
    parts = NamedSharding(_mesh(count), PartitionSpec("devices"))
    return jax.lax.with_sharding_constraint(values, parts)


def replicate(tree: Any) -> Any:
    """Place the arrays of a pytree on every local device.

    A render that is shared by devices needs its inputs on each. Inputs on one device
    are copied to the others at every call.
    """
    sharding = replicated_sharding(jax.local_device_count())
    return tree if sharding is None else jax.device_put(tree, sharding)


def place(tree: Any) -> Any:
    """Place the arrays of a pytree, NumPy's too, where results of a render are.

    That is on every local device, so a loop that feeds results back compiles once.
    Tracers stay as they are, and ``jax_default_device`` is respected.
    """
    traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))
    sharding = replicated_sharding(jax.local_device_count())
    chosen = jax.config.jax_default_device is not None  # pyright: ignore
    if traced or chosen or sharding is None:
        return jax.tree.map(_put_numpy, tree)
    return jax.device_put(tree, sharding)


def _put_numpy(leaf: Any) -> Any:
    return jax.device_put(leaf) if isinstance(leaf, np.ndarray) else leaf


def replicated_sharding(count: int) -> NamedSharding | None:
    """Return the sharding of arrays on each of ``count`` devices; None for one."""
    return None if count == 1 else NamedSharding(_mesh(count), PartitionSpec())


def _mesh(count: int) -> Mesh:
    return Mesh(np.array(jax.local_devices()[:count]), ("devices",))
