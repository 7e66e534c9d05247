"""Free memory, and rejecting work that would not fit before it is allocated.

A process that takes more memory than there is gets killed without a message.
"""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from gsjax.errors import CapacityError
from gsjax.runtime.machine import ROOT, control_groups, read_system_file

# Less than this is not checked.
_SMALL = 2**28
_unlimited = False


class Estimate(NamedTuple):
    """Bytes by purpose.

    Attributes:
      parts: bytes by name, in the plural: "photographs".
    """

    parts: dict[str, int]

    @property
    def total(self) -> int:
        """Sum of the parts."""
        return sum(self.parts.values())

    def __str__(self) -> str:
        parts = sorted(self.parts.items(), key=lambda part: -part[1])
        told = ", ".join(f"{size_text(size)} {name}" for name, size in parts if size)
        return f"{size_text(self.total)} ({told})"


def size_text(count: int) -> str:
    """Format bytes as GB (10⁹) or MB (10⁶)."""
    if count >= 10**9:
        return f"{count / 1e9:.1f} GB"
    return f"{count / 1e6:.0f} MB"


@contextmanager
def unlimited(enabled: bool = True) -> Iterator[None]:
    """Within, no thread of the process checks memory."""
    global _unlimited
    before, _unlimited = _unlimited, enabled or _unlimited
    try:
        yield
    finally:
        _unlimited = before


def require(estimate: Estimate, what: str, remedy: str) -> None:
    """Check that an allocation fits in free memory; pass if that is unknown.

    Args:
      estimate: memory to be allocated beyond what is in use.
      what: name of what allocates it, for the message.
      remedy: what to change, for the message.

    Raises:
      CapacityError: if it does not fit; with the numbers.
    """
    if _unlimited or estimate.total < _SMALL:
        return
    free = available()
    if free is not None and estimate.total > free:
        raise CapacityError(
            f"{what} would take about {estimate} of memory, and {size_text(free)} is "
            f"free; {remedy}, or pass --ignore-memory to try it all the same (in "
            "Python: gsjax.runtime.memory.unlimited())"
        )


def available() -> int | None:
    """Return the bytes that JAX's device can still allocate; None if unknown.

    On a CPU this is the memory available without swapping, limited by each control
    group of the process, plus what the process has freed and kept.
    """
    import jax

    from gsjax.runtime.devices import on_cpu

    if not on_cpu():
        stats = jax.local_devices()[0].memory_stats() or {}
        if not {"bytes_limit", "bytes_in_use"} <= set(stats):
            return None
        return stats["bytes_limit"] - stats["bytes_in_use"]
    free = system_available()
    return None if free is None else free + _kept()


def system_available(root: Path = ROOT) -> int | None:
    """Return the bytes that Linux and the control groups of this process leave.

    Args:
      root: folder that contains /proc and /sys.
    """
    found = [*_meminfo_available(root / "proc/meminfo"), *_groups_available(root)]
    return max(0, min(found)) if found else None


def _meminfo_available(path: Path) -> Iterator[int]:
    for line in read_system_file(path).splitlines():
        words = line.split()
        if words[:1] == ["MemAvailable:"] and words[1].isdigit():
            yield int(words[1]) * 1024


def _groups_available(root: Path) -> Iterator[int]:
    for version, folder in control_groups("memory", root):
        if version == 2:
            names = ("memory.max", "memory.current", "inactive_file")
        else:
            names = (
                "memory.limit_in_bytes",
                "memory.usage_in_bytes",
                "total_inactive_file",
            )
        yield from _group_available(folder, *names)


def _group_available(folder: Path, limit: str, used: str, cache: str) -> Iterator[int]:
    numbers = [read_system_file(folder / name).strip() for name in (limit, used)]
    if not all(number.isdigit() for number in numbers):  # "max", or missing
        return
    most, taken = map(int, numbers)
    for line in read_system_file(folder / "memory.stat").splitlines():
        name, _, value = line.partition(" ")
        if name == cache and value.isdigit():
            taken -= int(value)  # cached files, dropped on demand
    yield most - max(taken, 0)


class _Mallinfo2(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_size_t)
        for name in (
            *("arena", "ordblks", "smblks", "hblks", "hblkhd"),
            *("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
        )
    ]


def _kept() -> int:
    """Return the bytes that this process freed and kept; see `keep_memory`."""
    try:
        mallinfo = ctypes.CDLL(None).mallinfo2
    except (AttributeError, OSError, TypeError):  # older glibc, musl, macOS, Windows
        return 0
    mallinfo.restype = _Mallinfo2
    return int(mallinfo().fordblks)
