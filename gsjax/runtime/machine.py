"""What of its machine this process may use: cores, and the control groups that limit
it, as a container does; and memory in large pages."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from pathlib import Path
from typing import TypeVar

ROOT = Path("/")


Given = TypeVar("Given")
Made = TypeVar("Made")


def all_of(
    pool: Executor, work: Callable[[Given], Made], inputs: Iterable[Given]
) -> list[Made]:
    """What ``work`` makes of each, side by side; what has not begun is given up where
    one fails, or on Ctrl-C."""
    tasks = [pool.submit(work, one) for one in inputs]
    try:
        return [task.result() for task in tasks]
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        raise


def usable_cores(root: Path = ROOT) -> int:
    """Cores that this process may use: those it may run on, at most the CPU time that
    its control groups give it, in whole cores, rounded up.

    Args:
      root: under which /proc and /sys lie.
    """
    affinity = getattr(os, "sched_getaffinity", None)
    count = len(affinity(0)) if affinity else (os.cpu_count() or 1)
    return max(1, min([count, *_of_groups(root)]))


def _of_groups(root: Path) -> Iterator[int]:
    for version, folder in control_groups("cpu", root):
        if version == 2:
            words = text_of(folder / "cpu.max").split()
        else:
            names = ("cpu.cfs_quota_us", "cpu.cfs_period_us")
            words = [text_of(folder / name).strip() for name in names]
        # Without a limit the quota is "max", or −1.
        if len(words) == 2 and all(map(str.isdecimal, words)) and int(words[1]):
            quota, period = map(int, words)
            yield -(-quota // period)


def control_groups(kind: str, root: Path = ROOT) -> Iterator[tuple[int, Path]]:
    """The control groups of this process, and those above, whose limits bind as well.

    Args:
      kind: of what they limit, as version 1 names it: "cpu", "memory".
      root: under which /proc and /sys lie.

    Yields:
      The version, 1 or 2, and the folder; which need not be there.
    """
    for line in text_of(root / "proc/self/cgroup").splitlines():
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
        # In a container the path may be that outside.
        parts = [part for part in path.split("/") if part and part != ".."]
        for depth in range(len(parts) + 1):
            yield version, top.joinpath(*parts[:depth])


def text_of(path: Path) -> str:
    """What a file of the system says; "" where it cannot be read."""
    try:
        return path.read_text()
    except (OSError, ValueError):  # ValueError: not text, or not a path
        return ""
