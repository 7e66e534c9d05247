"""Cores and memory that a process may use, as Linux reports them."""

import os

import pytest
from conftest import write_files

from gsjax.runtime import memory
from gsjax.runtime.devices import on_cpu
from gsjax.runtime.machine import usable_cores
from gsjax.runtime.memory import system_available

GROUPS = "sys/fs/cgroup"
# Files that are written one after another, and the limit then. With version 2 of
# control groups those of parents bind as well; version 1 is that of a container, whose
# path is that of the host.
CORES = [
    ({}, 16),
    ({"proc/self/cgroup": "0::/a/b\n", f"{GROUPS}/cpu.max": "9999999 100000\n"}, 16),
    ({f"{GROUPS}/a/b/cpu.max": "max 100000\n"}, 16),
    ({f"{GROUPS}/a/cpu.max": "650000 100000\n"}, 7),  # rounded up
    ({f"{GROUPS}/a/b/cpu.max": "1000 100000\n"}, 1),
    ({"proc/self/cgroup": "4:cpu,cpuacct:/x\n3:memory:/a\n"}, 16),
    ({f"{GROUPS}/cpu/cpu.cfs_period_us": "100000\n"}, 16),
    ({f"{GROUPS}/cpu/cpu.cfs_quota_us": "-1\n"}, 16),
    ({f"{GROUPS}/cpu/cpu.cfs_quota_us": "300000\n"}, 3),
    # Both versions, each with some controllers.
    ({"proc/self/cgroup": "4:cpu,cpuacct:/x\n0::/a\n"}, 3),
]
MEMORY = [
    ({}, None),
    ({"proc/meminfo": "MemTotal: 99 kB\nMemAvailable:  4000 kB\n"}, 4_096_000),
    ({"proc/self/cgroup": "0::/a/b\n", f"{GROUPS}/a/b/memory.max": "max\n"}, 4_096_000),
    ({f"{GROUPS}/a/b/memory.current": "77\n"}, 4_096_000),
    ({f"{GROUPS}/a/memory.max": "3000000\n"}, 4_096_000),  # the use is unknown
    ({f"{GROUPS}/a/memory.current": "1500000\n"}, 1_500_000),
    # Cached files do not count.
    ({f"{GROUPS}/a/memory.stat": "anon 5\ninactive_file 500000\n"}, 2_000_000),
    ({"proc/self/cgroup": "4:cpu:/\n3:hugetlb,memory:/x\n0::/\n"}, 4_096_000),
    ({f"{GROUPS}/memory/memory.limit_in_bytes": "1000000"}, 4_096_000),
    ({f"{GROUPS}/memory/memory.usage_in_bytes": "950000"}, 50_000),
    ({f"{GROUPS}/memory/memory.stat": "total_inactive_file 20000\n"}, 70_000),
    ({f"{GROUPS}/memory/memory.usage_in_bytes": "2000000"}, 0),
]


@pytest.fixture(autouse=True)
def _sixteen_cores(monkeypatch):
    cores = set(range(16))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: cores, raising=False)


@pytest.mark.parametrize(
    ("limit", "rows"), [(usable_cores, CORES), (system_available, MEMORY)]
)
def test_the_smallest_limit_counts(tmp_path, limit, rows):
    for files, expected in rows:
        write_files(tmp_path, files)
        assert limit(tmp_path) == expected, files


@pytest.mark.parametrize(
    "odd", ["", "max", "7", "100000 0", "-1 5", "a b", "1 2 3", "1.5 1", "\0"]
)
def test_malformed_files_limit_nothing(tmp_path, odd, monkeypatch):
    group, file = f"{odd}\n0::/\n0::/\0\n", tmp_path / GROUPS / "cpu.max"
    write_files(tmp_path, {"proc/self/cgroup": group, f"{GROUPS}/cpu.max": odd})
    assert usable_cores(tmp_path) == 16
    file.write_bytes(b"\xff\xfe 1 \x80")
    assert usable_cores(tmp_path) == 16
    file.unlink()
    file.mkdir()
    assert usable_cores(tmp_path) == 16
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {5}, raising=False)
    assert usable_cores(tmp_path) == 1


def test_this_machine_has_memory():
    if on_cpu() and os.path.exists("/proc/meminfo"):
        assert 10**7 < memory.available() < 10**15
