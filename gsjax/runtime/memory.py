"""What memory there is, and refusing what it would not hold before it is taken.

A process that takes more than there is gets killed, without a word and with all that
it held. So what is about to be taken is estimated, and compared.
"""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from gsjax.errors import CapacityError
from gsjax.runtime.machine import ROOT, control_groups, text_of

# Less than that is not worth asking the system for.
_SMALL = 2**28
_unlimited = False


class Estimate(NamedTuple):
    """Bytes by what they are for.

    Attributes:
      parts: by name, in the plural: "photographs".
    """

    parts: dict[str, int]

    @property
    def total(self) -> int:
        """All of it."""
        return sum(self.parts.values())

    def __str__(self) -> str:
        parts = sorted(self.parts.items(), key=lambda part: -part[1])
        told = ", ".join(f"{size_text(size)} {name}" for name, size in parts if size)
        return f"{size_text(self.total)} ({told})"


def size_text(count: int) -> str:
    """Bytes to read, of 10⁹ or 10⁶."""
    if count >= 10**9:
        return f"{count / 1e9:.1f} GB"
    return f"{count / 1e6:.0f} MB"


@contextmanager
def unlimited(really: bool = True) -> Iterator[None]:
    """Within, nothing is refused for want of memory, in any thread of the process."""
    global _unlimited
    before, _unlimited = _unlimited, really or _unlimited
    try:
        yield
    finally:
        _unlimited = before


def require(estimate: Estimate, what: str, remedy: str) -> None:
    """Refuse what the memory would not hold; where there is none to ask, nothing is.

    Args:
      estimate: of what is to be taken beyond what is held already.
      what: is to take it, for the message.
      remedy: what to change, for the message.

    Raises:
      CapacityError: with the numbers.
    """
    if _unlimited or estimate.total < _SMALL:
        return
    free = available()
    if free is not None and estimate.total > free:
        raise CapacityError(
            f"{what} would take about {estimate} of memory, and {size_text(free)} is "
            f"free; {remedy}, or go on all the same with --ignore-memory (in Python: "
            "gsjax.runtime.memory.unlimited())"
        )


def available() -> int | None:
    """Bytes that JAX's device can still give this process; None if nobody says.

    On a CPU the least of what the system says it can give without swapping, and of
    what is left in each control group that the process is in; and what the process
    itself has freed and kept. On other devices what their allocator may still take.
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
    """Bytes that Linux, and the control groups of this process, can still give.

    Args:
      root: under which /proc and /sys lie.
    """
    found = [*_of_meminfo(root / "proc/meminfo"), *_of_groups(root)]
    return max(0, min(found)) if found else None


def _of_meminfo(path: Path) -> Iterator[int]:
    for line in text_of(path).splitlines():
        words = line.split()
        if words[:1] == ["MemAvailable:"] and words[1].isdigit():
            yield int(words[1]) * 1024


def _of_groups(root: Path) -> Iterator[int]:
    """What is left in each control group of the process, of either version."""
    for version, folder in control_groups("memory", root):
        if version == 2:
            names = ("memory.max", "memory.current", "inactive_file")
        else:
            names = (
                "memory.limit_in_bytes",
                "memory.usage_in_bytes",
                "total_inactive_file",
            )
        yield from _of_group(folder, *names)


def _of_group(folder: Path, limit: str, used: str, cache: str) -> Iterator[int]:
    numbers = [text_of(folder / name).strip() for name in (limit, used)]
    if not all(number.isdigit() for number in numbers):  # "max", or not there
        return
    most, taken = map(int, numbers)
    for line in text_of(folder / "memory.stat").splitlines():
        name, _, value = line.partition(" ")
        if name == cache and value.isdigit():
            taken -= int(value)  # files read long ago, dropped when room is needed
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
    """Bytes that were freed in this process and not given back; see `keep_memory`."""
    try:
        mallinfo = ctypes.CDLL(None).mallinfo2
    except (AttributeError, OSError, TypeError):  # older glibc, musl, macOS, Windows
        return 0
    mallinfo.restype = _Mallinfo2
    return int(mallinfo().fordblks)
