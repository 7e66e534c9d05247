"""Set-up of the process for rendering on CPUs; does not import JAX.

XLA hardly uses a second core inside the compositor's loop, so tiles are shared by one
host device per core, and the loop should be one kernel. Both can only be chosen before
JAX starts its backend. `import gsjax` does so; see `prepare_process`.
"""

import contextlib
import ctypes
import hashlib
import os
import platform
import sys
import warnings
from importlib.util import find_spec
from pathlib import Path

from gsjax.runtime.compilation_cache import remove_oldest, remove_truncated
from gsjax.runtime.machine import ROOT, read_system_file, usable_cores

# Memory that one iteration of a loop may touch for XLA to compile the loop as a kernel.
KERNEL_BYTES = 131_072
_KERNEL_OPTION = "xla_cpu_small_while_loop_byte_threshold"
_DEVICES_OPTION = "xla_force_host_platform_device_count"

# Compiled programs are a few hundred kB each.
_MAX_CACHE_BYTES = 500_000_000

# Parameters of `mallopt`, from <malloc.h> of glibc.
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX = -1, -2, -4

# Environment variables that `prepare_process` set, until JAX has read them.
_temporary: set[str] = set()
_hint: str | None = None


def prepare_process() -> None:
    """Set up JAX for rendering on CPUs, as far as the user has not; done on import.

    - One CPU device per usable core, unless ``JAX_NUM_CPU_DEVICES``,
      ``jax_num_cpu_devices`` or XLA's own option says how many; with two threads per
      device, unless ``NPROC`` says how many (see `gsjax.use_all_cores`).
    - Loops compiled as kernels (`compile_loops_as_kernels`), freed memory kept
      (`keep_memory`) and compiled programs cached on disk (`keep_programs`).

    Nothing changes where ``GSJAX_AUTO_SETUP=0``, where ``JAX_PLATFORMS`` excludes CPUs,
    or where JAX has a plugin for an accelerator (unless ``JAX_PLATFORMS=cpu``). If JAX
    has started already, the first render warns, once. Apart from ``XLA_FLAGS``,
    environment variables are restored when JAX has started.
    """
    global _hint
    platforms = os.environ.get("JAX_PLATFORMS", "")
    if os.environ.get("GSJAX_AUTO_SETUP") == "0" or "cpu" not in (platforms or "cpu"):
        return
    if platforms != "cpu" and (find_spec("jax_plugins") or find_spec("libtpu")):
        _hint = "JAX has a plugin for an accelerator; set JAX_PLATFORMS=cpu"
        return
    jax = sys.modules.get("jax")
    flags, cores = os.environ.get("XLA_FLAGS", ""), usable_cores()
    count = None if cores == 1 or _DEVICES_OPTION in flags else cores
    if jax is None:
        keep_programs()
        if count and set_temporarily("JAX_NUM_CPU_DEVICES", count):
            set_temporarily("NPROC", 2 * count)
    else:
        chosen = jax.config.jax_num_cpu_devices
        if _has_started(jax):
            if _KERNEL_OPTION not in flags or (count and chosen < 0):
                _hint = "JAX had started; import gsjax before the first computation"
            return
        keep_programs()
        if count and chosen < 0:
            jax.config.update("jax_num_cpu_devices", count)
            set_temporarily("NPROC", 2 * count)
    compile_loops_as_kernels()
    keep_memory()


def _has_started(jax) -> bool:
    """Return True if JAX refuses another number of CPU devices, as after its start."""
    chosen = jax.config.jax_num_cpu_devices
    try:
        jax.config.update("jax_num_cpu_devices", max(chosen, 0) + 1)
    except RuntimeError:
        return True
    jax.config.update("jax_num_cpu_devices", chosen)
    return False


def set_temporarily(name: str, value: object) -> bool:
    """Set an environment variable until JAX has started; False if the user set it."""
    if name in os.environ:
        return False
    os.environ[name] = str(value)
    _temporary.add(name)
    return True


def restore_environment() -> None:
    """Remove the environment variables that only JAX's start needs."""
    while _temporary:
        os.environ.pop(_temporary.pop(), None)


def warn_if_unprepared() -> None:
    """Warn once if JAX runs on CPUs without what `prepare_process` would have set.

    For the first render, when JAX has started.
    """
    global _hint
    if _hint is not None:
        hint, _hint = _hint, None
        warnings.warn(
            f"gsjax renders at a fraction of its speed on this CPU: {hint}, or set "
            "GSJAX_AUTO_SETUP=0 to silence this warning",
            stacklevel=2,
        )


def compile_loops_as_kernels() -> None:
    """Let XLA's CPU backend compile a loop as one single-threaded kernel if an
    iteration touches at most `KERNEL_BYTES`; XLA's default is 1 kB.

    An image is then composited by one such loop. Adds an option to ``XLA_FLAGS``, which
    XLA reads when JAX starts and which are part of the key of cached programs, so they
    stay. A value set already is kept, as is ``XLA_FLAGS`` that names a file.
    """
    flags = os.environ.get("XLA_FLAGS", "").strip()
    if _KERNEL_OPTION not in flags and (flags.startswith("-") or not flags):
        option = f"--xla_backend_extra_options={_KERNEL_OPTION}={KERNEL_BYTES}"
        os.environ["XLA_FLAGS"] = f"{flags} {option}".strip()


def keep_memory() -> bool:
    """Let this process keep up to 2 GB of freed memory for its next allocation.

    XLA allocates the temporaries of a program anew at each call. From 32 MB on, glibc
    would request them from the system every time, page by page. Applies to glibc only.
    Threads keep blocks of up to 64 MB each.

    Returns:
      Whether the allocator accepted the settings.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # musl, macOS; TypeError: Windows
        return False
    settings = {
        _M_MMAP_MAX: 0,  # allocate on the heap, which is kept, whatever the size
        _M_TRIM_THRESHOLD: 2**31 - 1,
        _M_TOP_PAD: 2**26,
    }
    return all(mallopt(name, value) == 1 for name, value in settings.items())


def keep_programs() -> Path | None:
    """Cache compiled programs on disk, so that later processes start quickly.

    The folder is in the user's cache (``XDG_CACHE_HOME``, else ``~/.cache``), one per
    kind of processor, and is trimmed to 500 MB. Truncated programs are removed. Nothing
    changes if JAX has a folder already (``JAX_COMPILATION_CACHE_DIR``), if its cache is
    switched off (``JAX_ENABLE_COMPILATION_CACHE=false``), or if the folder cannot be
    created. Programs that compile in less than a second are not cached.

    Returns:
      The folder in use, or None.
    """
    jax = sys.modules.get("jax")
    if jax is not None:
        chosen = jax.config.jax_compilation_cache_dir
        enabled = jax.config.jax_enable_compilation_cache
    else:
        chosen = os.environ.get("JAX_COMPILATION_CACHE_DIR")
        enabled = os.environ.get("JAX_ENABLE_COMPILATION_CACHE", "1").lower() in (
            *("y", "yes", "t", "true", "on", "1"),
        )
    if chosen or not enabled:
        return Path(chosen) if chosen else None
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home) / "gsjax" / f"programs-{_processor()}"
        folder.mkdir(parents=True, exist_ok=True)
        remove_truncated(folder)
        remove_oldest(folder, _MAX_CACHE_BYTES)
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        return None
    if jax is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
    else:
        set_temporarily("JAX_COMPILATION_CACHE_DIR", folder)
    return folder


def _processor() -> str:
    """Return a short name of the processor; programs may fail on another one."""
    parts = [platform.machine()]
    try:
        with open("/proc/cpuinfo", errors="replace") as file:
            for line in file:
                if not line.strip():
                    break  # the first core stands for all
                if line.startswith(("model name", "flags", "Features")):
                    parts.append(line)
    except OSError:
        parts.append(platform.processor())
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


def restart_with_large_pages(root: Path = ROOT) -> None:
    """Restart this program with its memory in pages of 2 MB, if it has to ask for them.

    Page faults of 4 kB pages slow down large temporaries. In most distributions Linux
    gives large pages to processes that ask ("madvise"), and glibc (from 2.35) asks if
    ``GLIBC_TUNABLES`` says so when a process starts. Call this first in a program that
    is a file or module; interactive sessions and programs read from stdin are not
    restarted. ``GLIBC_TUNABLES=glibc.malloc.hugetlb=0`` switches it off.

    Args:
      root: folder that contains /sys.
    """
    name = "glibc.malloc.hugetlb"
    known = os.environ.get("GLIBC_TUNABLES", "")
    choice = read_system_file(root / "sys/kernel/mm/transparent_hugepage/enabled")
    if "[madvise]" not in choice or name in known or not sys.executable:
        return
    interactive = len(sys.orig_argv) < 2 or sys.argv[0] in ("", "-")
    if interactive or "ipykernel" in sys.modules:
        return
    restore_environment()  # the new process sets up itself
    tunables = f"{known}:{name}=1".lstrip(":")
    command = [sys.executable, *sys.orig_argv[1:]]
    with contextlib.suppress(OSError):  # without large pages, then
        os.execve(sys.executable, command, {**os.environ, "GLIBC_TUNABLES": tunables})
