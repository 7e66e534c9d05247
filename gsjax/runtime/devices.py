"""How JAX is set up for a program: its devices, and what it keeps of its compiling;
and how work is shared by the devices.

One host device for each core: XLA's CPU backend hardly uses a second core inside the
compositor's loop, so the tiles are spread over several devices instead. And an option
of XLA's, by which that loop is one kernel.

And memory that is kept: XLA allocates the temporaries of a program anew at each call.
From 32 MB on, glibc takes them from the system every time, page by page, which is a
good part of the compositing of a large image.
"""

import ctypes
import hashlib
import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from gsjax.errors import InputError
from gsjax.runtime.compilation_cache import remove_oldest, remove_truncated
from gsjax.runtime.machine import usable_cores
from gsjax.runtime.settings import whole

# Programs are a few hundred kB each; a folder of more than this loses its oldest.
_MAX_KEPT_BYTES = 500_000_000

# What a turn of a loop may touch for XLA's CPU backend to make one kernel of the loop.
KERNEL_BYTES = 131_072
_KERNEL_OPTION = "xla_cpu_small_while_loop_byte_threshold"

# Names and numbers of `mallopt`, from <malloc.h> of glibc.
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4


def platform_name() -> str:
    """Return JAX's default platform, such as "cpu", "gpu" or "tpu"; starts JAX."""
    return jax.default_backend()


def on_cpu() -> bool:
    """Return True if JAX computes on a CPU by default; starts JAX."""
    return platform_name() == "cpu"


def use_all_cores(count: int | None = None, *, queued: bool = True) -> int:
    """Let JAX show ``count`` CPU devices (default: the cores this process may use).

    Those are the cores that it may run on, but no more than the CPU time that its
    control groups give it, as in a container: more devices than that only wait.
    Call it before the first computation: ``import gsjax; gsjax.use_all_cores()``. On
    a GPU or TPU it changes nothing that matters. `RasterConfig.devices` then
    defaults to all of them; images do not depend on it, but for rounding. It also calls
    `keep_memory`, and `make_kernels_of_loops`, which other programs of this process may
    notice.

    Args:
      count: how many.
      queued: whether calls of jitted functions may pile up before a result is waited
        for, as in a training loop that does not look at its loss. XLA's CPU client
        (jax 0.10.2) lets 32 computations wait for a device; whoever starts one more
        blocks a thread for each device, and with as many threads as devices none is
        left to finish one: the process is aborted. So JAX is given twice the threads,
        unless ``NPROC`` in the environment says how many. That costs speed; pass False
        where each result is waited for, or every tenth.

    Returns:
      The number of local devices.

    Raises:
      RuntimeError: if JAX has started already with another number of devices.
      InputError: if ``count`` is not whole, or below 1.
    """
    count = usable_cores() if count is None else whole("count", count)
    if count < 1:
        raise InputError(f"count {count}: at least one device is wanted")
    keep_memory()
    threads = 2 * count if queued and count > 1 else None
    with _threads(threads):
        try:
            jax.config.update("jax_num_cpu_devices", count)
        except RuntimeError as error:
            if not on_cpu() or jax.local_device_count() == count:
                return jax.local_device_count()
            raise RuntimeError(
                "use_all_cores came after JAX had started; call it before the first "
                "computation, right after import gsjax"
            ) from error
        make_kernels_of_loops()
        return jax.local_device_count()  # starts JAX


def make_kernels_of_loops() -> None:
    """Let XLA's CPU backend make one kernel, on one thread, of every loop whose turn
    touches no more than `KERNEL_BYTES`; by default it does so up to 1 kB.

    A picture is then composited by one such loop. XLA reads ``XLA_FLAGS``, to which
    this adds an option, when JAX starts; later it has no effect. They stay as they are
    for good, as JAX keeps compiled programs by them. Flags that set the option already
    (``--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1024`` is the
    default) are left alone, and so is the name of a file of flags.
    """
    flags = os.environ.get("XLA_FLAGS", "").strip()
    if _KERNEL_OPTION not in flags and (flags.startswith("-") or not flags):
        option = f"--xla_backend_extra_options={_KERNEL_OPTION}={KERNEL_BYTES}"
        os.environ["XLA_FLAGS"] = f"{flags} {option}".strip()


@contextmanager
def _threads(count: int | None) -> Iterator[None]:
    """Within, XLA's CPU client is started with so many threads, unless NPROC is set."""
    if count is None or "NPROC" in os.environ:
        yield
        return
    os.environ["NPROC"] = str(count)
    try:
        yield
    finally:
        del os.environ["NPROC"]


def spread(work: Callable[..., Any], count: int, *inputs: Any) -> Any:
    """What ``count`` devices make of the same inputs, each by its number.

    Args:
      work: (number [1] int32, *inputs) → arrays with a leading axis of 1. Traced once;
        derivatives go through.
      count: of local devices, at most.
      *inputs: whole on every device.

    Returns:
      The arrays of all, together along that axis, [count, ...].
    """
    if count == 1:
        return work(jnp.zeros(1, jnp.int32), *inputs)
    by_device, whole = PartitionSpec("devices"), PartitionSpec()
    shared = jax.shard_map(
        work,
        mesh=_mesh(count),
        in_specs=(by_device, *(whole for _ in inputs)),
        out_specs=by_device,
        check_vma=False,
    )
    return shared(jnp.arange(count, dtype=jnp.int32), *inputs)


def shard_rows(values: jax.Array, count: int, fill: float) -> jax.Array:
    """``values`` [n], each of ``count`` devices at work on an equal part.

    What is made of them number by number then is shared, too, up to where something
    takes all of it, as what is given to `spread` is. The same bits as without.

    Args:
      values: with more of ``fill`` at the end where they cannot be parted equally.
      count: of local devices; 1 changes nothing.
      fill: a number of their type.
    """
    if count == 1:
        return values
    values = jnp.pad(values, (0, -len(values) % count), constant_values=fill)
    parts = NamedSharding(_mesh(count), PartitionSpec("devices"))
    return jax.lax.with_sharding_constraint(values, parts)


def replicate(tree: Any) -> Any:
    """``tree`` with its arrays on every local device.

    A render that is shared by devices needs its inputs on each. Where they lie on one,
    they are copied to the others at every call.
    """
    whole = replicated_sharding(jax.local_device_count())
    return tree if whole is None else jax.device_put(tree, whole)


def replicated_sharding(count: int) -> NamedSharding | None:
    """How an array lies that is whole on each of the first ``count`` local devices;
    None for one device, where there is nothing to say."""
    if count == 1:
        return None
    return NamedSharding(_mesh(count), PartitionSpec())


def _mesh(count: int) -> Mesh:
    return Mesh(np.array(jax.local_devices()[:count]), ("devices",))


def keep_memory() -> bool:
    """Let this process keep memory that it frees, up to 2 GB, for its next allocation.

    Where the allocator is that of glibc; elsewhere nothing is changed. A thread's own
    blocks are kept up to 64 MB each. One arena for all threads would keep larger ones
    too, but they then wait for one another, which costs more than it saves. What the
    process holds does not fall below its peak by more than what is above those 2 GB.

    Returns:
      Whether the allocator took it.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # musl, macOS; TypeError: Windows
        return False
    settings = {
        _M_MMAP_MAX: 0,  # from the heap, which is kept, whatever the size
        _M_TRIM_THRESHOLD: 2**31 - 1,
        _M_TOP_PAD: 2**26,
    }
    return all(mallopt(name, value) == 1 for name, value in settings.items())


def keep_programs() -> Path | None:
    """Let JAX keep compiled programs on disk, so that the next process starts at once.

    In a folder of the user's cache (`XDG_CACHE_HOME`, else ``~/.cache``), one for each
    kind of processor: programs are compiled for it. What a kill or a full disk left
    there unfinished is removed. Nothing is changed where JAX has
    a folder already (`JAX_COMPILATION_CACHE_DIR`), or is told to keep nothing
    (`JAX_ENABLE_COMPILATION_CACHE=false`), or none can be made.

    Returns:
      The folder in use, or None.
    """
    chosen = jax.config.jax_compilation_cache_dir  # pyright: ignore
    if chosen or not jax.config.jax_enable_compilation_cache:  # pyright: ignore
        return Path(chosen) if chosen else None
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home) / "gsjax" / f"programs-{_processor()}"
        folder.mkdir(parents=True, exist_ok=True)
        remove_truncated(folder)
        remove_oldest(folder, _MAX_KEPT_BYTES)
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    return folder


def _processor() -> str:
    """What this machine's programs do not run without, as a short name."""
    told = [platform.machine(), platform.processor()]
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = info.read_text(errors="replace").splitlines()
        told += sorted({x for x in lines if x.startswith(("model name", "flags"))})
    return hashlib.sha256("\n".join(told).encode()).hexdigest()[:12]
