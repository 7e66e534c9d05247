"""Cores that this process may use, and the control groups that limit it."""

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from concurrent.futures import Executor

ROOT = Path("/")

Given = TypeVar("Given")
Made = TypeVar("Made")


def map_concurrently(
    pool: "Executor", work: Callable[[Given], Made], inputs: Iterable[Given]
) -> list[Made]:
    """Return ``work`` of each input; cancel the rest if one raises, or on Ctrl-C."""
    tasks = [pool.submit(work, one) for one in inputs]
    try:
        return [task.result() for task in tasks]
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        raise


def usable_cores(root: Path = ROOT) -> int:
    """Return the number of cores that this process may use.

    These are the cores of its affinity, limited by the CPU time of its control groups
    in whole cores, rounded up.

    Args:
      root: folder that contains /proc and /sys.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    count = len(affinity(0)) if affinity else (os.cpu_count() or 1)
    return max(1, min([count, *_group_limits(root)]))


def _group_limits(root: Path) -> Iterator[int]:
    for version, folder in control_groups("cpu", root):
        if version == 2:
            words = read_system_file(folder / "cpu.max").split()
        else:
            names = ("cpu.cfs_quota_us", "cpu.cfs_period_us")
            words = [read_system_file(folder / name).strip() for name in names]
        # Without a limit the quota is "max" or −1.
        if len(words) == 2 and all(map(str.isdecimal, words)) and int(words[1]):
            quota, period = map(int, words)
            yield -(-quota // period)


def control_groups(kind: str, root: Path = ROOT) -> Iterator[tuple[int, Path]]:
    """Iterate over the control groups of this process and their parents.

    Args:
      kind: controller, as version 1 names it: "cpu" or "memory".
      root: folder that contains /proc and /sys.

    Yields:
      The version, 1 or 2, and the folder, which may not exist.
    """
    for line in read_system_file(root / "proc/self/cgroup").splitlines():
        fields = line.split(":", 2)
        if len(fields) < 3:
            continue
        kinds, path = fields[1:]
        if kinds == "":
            version, top = 2, root / "sys/fs/cgroup"
        elif kind in kinds.split(","):
            version, top = 1, root / "sys/fs/cgroup" / kind
        else:
            continue
        # In a container the path may be that of the host.
        parts = [part for part in path.split("/") if part and part != ".."]
        for depth in range(len(parts) + 1):
            yield version, top.joinpath(*parts[:depth])


def read_system_file(path: Path) -> str:
    """Return the text of a file of the system; "" if it cannot be read."""
    try:
        return path.read_text()
    except (OSError, ValueError):  # ValueError: not text, or not a path
        return ""
