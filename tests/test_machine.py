"""The cores that a process may use, by what Linux says of it."""

import os

import pytest
from conftest import write_files

from gsjax.machine import usable_cores


@pytest.fixture(autouse=True)
def sixteen(monkeypatch):
    monkeypatch.setattr(
        os, "sched_getaffinity", lambda _: set(range(16)), raising=False
    )


def test_the_least_of_all_quotas_counts(tmp_path):
    root, groups = tmp_path, tmp_path / "sys/fs/cgroup"
    assert usable_cores(root) == 16
    # Version 2: that of a group above binds as well; a part of a core is one more.
    write_files(root, {"proc/self/cgroup": "0::/a/b\n"})
    write_files(groups, {"a/b/cpu.max": "max 100000\n", "cpu.max": "9999999 100000\n"})
    assert usable_cores(root) == 16
    write_files(groups, {"a/cpu.max": "650000 100000\n"})
    assert usable_cores(root) == 7
    write_files(groups, {"a/b/cpu.max": "100000 50000\n"})
    assert usable_cores(root) == 2
    write_files(groups, {"a/b/cpu.max": "1000 100000\n"})
    assert usable_cores(root) == 1
    # Version 1, in a container, whose path is that outside.
    write_files(root, {"proc/self/cgroup": "4:cpu,cpuacct:/x\n3:memory:/a\n"})
    quota, period = "cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us"
    write_files(groups, {quota: "-1\n", period: "100000\n"})
    assert usable_cores(root) == 16
    write_files(groups, {quota: "300000\n"})
    assert usable_cores(root) == 3
    # Both, as where the controllers are shared out among the versions.
    write_files(root, {"proc/self/cgroup": "4:cpu,cpuacct:/x\n0::/a\n"})
    assert usable_cores(root) == 3


def test_there_is_no_quota_above_the_affinity(tmp_path, monkeypatch):
    write_files(tmp_path, {"proc/self/cgroup": "0::/\n"})
    write_files(tmp_path, {"sys/fs/cgroup/cpu.max": "400000 100000\n"})
    assert usable_cores(tmp_path) == 4
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {5}, raising=False)
    assert usable_cores(tmp_path) == 1


@pytest.mark.parametrize(
    "odd", ["", "max", "7", "100000 0", "-1 5", "a b", "1 2 3", "1.5 1", "\0"]
)
def test_odd_files_limit_nothing(tmp_path, odd):
    write_files(tmp_path, {"proc/self/cgroup": f"{odd}\n0::/\n0::/\0\n"})
    write_files(tmp_path, {"sys/fs/cgroup/cpu.max": odd})
    assert usable_cores(tmp_path) == 16
    (tmp_path / "sys/fs/cgroup/cpu.max").write_bytes(b"\xff\xfe 1 \x80")
    assert usable_cores(tmp_path) == 16
    (tmp_path / "sys/fs/cgroup/cpu.max").unlink()
    (tmp_path / "sys/fs/cgroup/cpu.max").mkdir()
    assert usable_cores(tmp_path) == 16
