"""What of its machine this process may use: cores, and the control groups that limit
it, as a container does; and memory in large pages."""

import contextlib
import os
import sys
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


def restart_with_large_pages(root: Path = ROOT) -> None:
    """Start this program anew, with its memory in pages of 2 MB, where it must ask.

    XLA takes the temporaries of a program anew at each call, those of a large picture
    from the system, and that hands them out page by page, of the usual 4 kB slowly.
    Linux has larger ones, in most distributions for who asks ("madvise"), and glibc
    (from 2.35; others do not mind) asks if GLIBC_TUNABLES says so when a process
    starts. So call this first thing in a program that lies in a file, or is a module;
    what is typed, or read from stdin, could not be read again, and goes on as it is. So
    does what has been started by this, and where there is nothing to ask for.
    ``GLIBC_TUNABLES=glibc.malloc.hugetlb=0`` in the environment keeps it from starting
    anything.

    Args:
      root: under which /sys lies.
    """
    name = "glibc.malloc.hugetlb"
    known = os.environ.get("GLIBC_TUNABLES", "")
    choice = text_of(root / "sys/kernel/mm/transparent_hugepage/enabled")
    if "[madvise]" not in choice or name in known or not sys.executable:
        return
    typed = len(sys.orig_argv) < 2 or sys.argv[0] in ("", "-")  # or read from stdin
    if typed or "ipykernel" in sys.modules:
        return
    tunables = f"{known}:{name}=1".lstrip(":")
    command = [sys.executable, *sys.orig_argv[1:]]
    with contextlib.suppress(OSError):  # it is as well without
        os.execve(sys.executable, command, {**os.environ, "GLIBC_TUNABLES": tunables})


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
