"""The cores that a process may use, and the pages of its memory, by what Linux says."""

import os
import subprocess
import sys

import pytest
from conftest import write_files

from gsjax.runtime.machine import restart_with_large_pages, usable_cores


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


PAGES = "sys/kernel/mm/transparent_hugepage/enabled"


@pytest.mark.parametrize(
    ("choice", "known", "wanted"),
    [
        ("always [madvise] never\n", None, "glibc.malloc.hugetlb=1"),
        ("always [madvise] never\n", "a.b=2", "a.b=2:glibc.malloc.hugetlb=1"),
        ("always [madvise] never\n", "glibc.malloc.hugetlb=0", None),
        ("[always] madvise never\n", None, None),
        ("always madvise [never]\n", None, None),
        (None, None, None),
    ],
)
def test_a_program_starts_anew_where_large_pages_must_be_asked_for(
    choice, known, wanted, tmp_path, monkeypatch
):
    write_files(tmp_path, {PAGES: choice} if choice else {})
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    if known is not None:
        monkeypatch.setenv("GLIBC_TUNABLES", known)
    monkeypatch.setattr(sys, "orig_argv", ["python", "-X", "utf8", "x.py", "a b"])
    monkeypatch.setattr(sys, "argv", ["x.py", "a b"])
    started = []
    monkeypatch.setattr(os, "execve", lambda *all_: started.append(all_))
    restart_with_large_pages(tmp_path)
    if wanted is None:
        assert not started
        return
    ((program, command, environment),) = started
    assert program == sys.executable
    assert command == [sys.executable, "-X", "utf8", "x.py", "a b"]
    assert environment == {**os.environ, "GLIBC_TUNABLES": wanted}
    for typed in ("", "-"):
        monkeypatch.setattr(sys, "argv", [typed])
        restart_with_large_pages(tmp_path)
    assert len(started) == 1


@pytest.mark.skipif(os.name == "nt", reason="a process is not replaced there")
def test_a_program_that_starts_anew_is_the_same(tmp_path):
    write_files(tmp_path, {PAGES: "always [madvise] never\n"})
    program = (
        "import os, pathlib, sys; from gsjax.runtime.machine import restart_with_large_pages;"
        "print(os.getpid(), flush=True);"
        "restart_with_large_pages(pathlib.Path(sys.argv[1]));"
        "print(sys.argv[2:], os.environ['GLIBC_TUNABLES'], sys.stdin.read())"
    )
    command = [sys.executable, "-c", program, str(tmp_path), "a b", ""]
    environment = {k: v for k, v in os.environ.items() if k != "GLIBC_TUNABLES"}
    told = subprocess.check_output(
        command, env=environment, input="read once", text=True
    )
    first, second, rest = told.splitlines()
    assert first == second  # one process
    assert rest == "['a b', ''] glibc.malloc.hugetlb=1 read once"


def test_one_that_cannot_start_anew_goes_on(tmp_path, monkeypatch):
    write_files(tmp_path, {PAGES: "always [madvise] never\n"})
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "none"))
    monkeypatch.setattr(sys, "argv", ["x.py"])
    restart_with_large_pages(tmp_path)
