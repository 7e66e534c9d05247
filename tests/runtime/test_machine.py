"""Cores that a process may use, as Linux reports them."""

import os

import pytest
from conftest import write_files

from gsjax.runtime.machine import usable_cores


@pytest.fixture(autouse=True)
def _sixteen_cores(monkeypatch):
    monkeypatch.setattr(
        os, "sched_getaffinity", lambda _: set(range(16)), raising=False
    )


def test_the_smallest_quota_counts(tmp_path, monkeypatch):
    root, groups = tmp_path, tmp_path / "sys/fs/cgroup"
    assert usable_cores(root) == 16
    # Version 2: quotas of parent groups bind as well; a fraction is rounded up.
    write_files(root, {"proc/self/cgroup": "0::/a/b\n"})
    write_files(groups, {"a/b/cpu.max": "max 100000\n", "cpu.max": "9999999 100000\n"})
    assert usable_cores(root) == 16
    write_files(groups, {"a/cpu.max": "650000 100000\n"})
    assert usable_cores(root) == 7
    write_files(groups, {"a/b/cpu.max": "1000 100000\n"})
    assert usable_cores(root) == 1
    # Version 1, in a container whose path is that of the host.
    write_files(root, {"proc/self/cgroup": "4:cpu,cpuacct:/x\n3:memory:/a\n"})
    quota, period = "cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us"
    write_files(groups, {quota: "-1\n", period: "100000\n"})
    assert usable_cores(root) == 16
    write_files(groups, {quota: "300000\n"})
    assert usable_cores(root) == 3
    # Both versions, each with some controllers.
    write_files(root, {"proc/self/cgroup": "4:cpu,cpuacct:/x\n0::/a\n"})
    assert usable_cores(root) == 3
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {5}, raising=False)
    assert usable_cores(root) == 1


@pytest.mark.parametrize(
    "odd", ["", "max", "7", "100000 0", "-1 5", "a b", "1 2 3", "1.5 1", "\0"]
)
def test_malformed_files_limit_nothing(tmp_path, odd):
    write_files(tmp_path, {"proc/self/cgroup": f"{odd}\n0::/\n0::/\0\n"})
    file = tmp_path / "sys/fs/cgroup/cpu.max"
    write_files(tmp_path, {"sys/fs/cgroup/cpu.max": odd})
    assert usable_cores(tmp_path) == 16
    file.write_bytes(b"\xff\xfe 1 \x80")
    assert usable_cores(tmp_path) == 16
    file.unlink()
    file.mkdir()
    assert usable_cores(tmp_path) == 16
