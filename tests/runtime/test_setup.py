"""What `import gsjax` and `gsjax.use_all_cores` set up, and what they leave alone."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from conftest import write_files

from gsjax import InputError
from gsjax.runtime import setup
from gsjax.runtime.devices import use_all_cores
from gsjax.runtime.machine import usable_cores

NAMES = ("GSJAX_AUTO_SETUP", "JAX_COMPILATION_CACHE_DIR", "JAX_NUM_CPU_DEVICES")
NAMES += ("NPROC", "XLA_FLAGS")
CORES = usable_cores()
needs_cores = pytest.mark.skipif(CORES < 2, reason="needs two cores")


def python(code: str, home: Path, **environment: str) -> str:
    """Return what code prints in a process without settings of ours."""
    env = {name: value for name, value in os.environ.items() if name not in NAMES}
    env |= {"XDG_CACHE_HOME": str(home), "PYTHONPATH": str(Path(__file__).parents[2])}
    env |= {"JAX_PLATFORMS": "cpu", **environment}
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=env,
        timeout=150,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


REPORT = """
import json, os, warnings
from gsjax.runtime import devices, loops
with warnings.catch_warnings(record=True) as caught:
    count = [devices.local_device_count() for _ in range(2)][0]
left = {name for name in ("NPROC", "JAX_NUM_CPU_DEVICES") if name in os.environ}
print(json.dumps({
    "devices": count, "kernels": loops.large_loops_are_kernels(), "left": sorted(left),
    "warnings": len(caught), "cache": jax.config.jax_compilation_cache_dir is not None,
}))
"""
PREPARED = {"devices": CORES, "kernels": True, "left": [], "warnings": 0, "cache": True}
PLAIN = {"devices": 1, "kernels": False, "left": [], "warnings": 0, "cache": False}


@needs_cores
@pytest.mark.parametrize(
    ("before", "environment", "expected"),
    [
        ("import jax, gsjax", {}, PREPARED),
        ("import gsjax, jax; jax.numpy.ones(3)", {}, PREPARED),
        ("import jax; jax.numpy.ones(3); import gsjax", {}, {**PLAIN, "warnings": 1}),
        ("import gsjax, jax", {"GSJAX_AUTO_SETUP": "0"}, PLAIN),
        (
            "import jax; jax.config.update('jax_num_cpu_devices', 1); import gsjax",
            {"JAX_ENABLE_COMPILATION_CACHE": "false"},
            {**PREPARED, "devices": 1, "cache": False},
        ),
    ],
    ids=["jax first", "gsjax first", "too late", "off", "user's choice"],
)
def test_import_prepares_the_process(before, environment, expected, tmp_path):
    assert (
        json.loads(python(f"{before}\n{REPORT}", tmp_path, **environment)) == expected
    )


@pytest.mark.parametrize("count", [0, -1, 1.5, "2"])
def test_invalid_counts(count):
    with pytest.raises(InputError, match="count"):
        use_all_cores(count)


QUEUE = """
import jax, jax.numpy as jnp, numpy as np, gsjax
from gsjax.runtime.devices import map_over_devices
gsjax.use_all_cores(2)
def work(index, x):
    return jnp.sin(x + index)[None]
step = jax.jit(lambda x: map_over_devices(work, 2, x).sum(0))
x = step(jnp.ones(2000))
for _ in range(500):
    x = step(x)
print(jnp.isfinite(x).all())
"""


def test_calls_may_queue_up(tmp_path):
    """XLA would abort with as many threads as devices."""
    assert python(QUEUE, tmp_path).strip() == "True"


def test_memory_is_kept(tmp_path):
    """Repeated calls touch no new pages; otherwise none would do without."""
    code = """
import resource
import jax, jax.numpy as jnp
from gsjax.runtime.setup import keep_memory
kept = keep_memory()
f = jax.jit(lambda x: x + 1)
x = jnp.ones(10_000_000)  # 40 MB
faults = []
for _ in range(14 if kept else 0):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    f(x).block_until_ready()
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(faults)
"""
    faults = json.loads(python(code, tmp_path))
    if not faults:
        pytest.skip("the allocator is not glibc's")
    assert faults[0] > 2**13
    assert sum(count < 100 for count in faults[1:]) >= 3, faults


@pytest.fixture
def no_cache():
    """JAX without a folder of compiled programs."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.mark.usefixtures("no_cache")
def test_folder_of_compiled_programs(tmp_path, monkeypatch):
    """In the user's cache, unless one is chosen or none can be created."""
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert setup.keep_programs() is None
    assert jax.config.jax_compilation_cache_dir is None
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = setup.keep_programs()
    assert folder is not None
    assert folder.is_dir()
    assert folder.parent == tmp_path / "gsjax"
    assert jax.config.jax_compilation_cache_dir == str(folder)
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "chosen"))
    assert setup.keep_programs() == tmp_path / "chosen"


PAGES = "sys/kernel/mm/transparent_hugepage/enabled"


@pytest.mark.parametrize(
    ("choice", "known", "expected"),
    [
        ("always [madvise] never\n", None, "glibc.malloc.hugetlb=1"),
        ("always [madvise] never\n", "a.b=2", "a.b=2:glibc.malloc.hugetlb=1"),
        ("always [madvise] never\n", "glibc.malloc.hugetlb=0", None),
        ("[always] madvise never\n", None, None),
        (None, None, None),
    ],
)
def test_restart_with_large_pages(choice, known, expected, tmp_path, monkeypatch):
    write_files(tmp_path, {PAGES: choice} if choice else {})
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    if known is not None:
        monkeypatch.setenv("GLIBC_TUNABLES", known)
    monkeypatch.setattr(sys, "orig_argv", ["python", "-X", "utf8", "x.py", "a b"])
    monkeypatch.setattr(sys, "argv", ["x.py", "a b"])
    started = []
    monkeypatch.setattr(os, "execve", lambda *arguments: started.append(arguments))
    setup.restart_with_large_pages(tmp_path)
    for interactive in ("", "-"):
        monkeypatch.setattr(sys, "argv", [interactive])
        setup.restart_with_large_pages(tmp_path)
    if expected is None:
        assert not started
        return
    command = [sys.executable, "-X", "utf8", "x.py", "a b"]
    environment = {**os.environ, "GLIBC_TUNABLES": expected}
    assert started == [(sys.executable, command, environment)]


@pytest.mark.skipif(os.name == "nt", reason="Windows does not replace a process")
def test_a_restarted_program_keeps_its_process_arguments_and_input(tmp_path):
    write_files(tmp_path, {PAGES: "always [madvise] never\n"})
    program = (
        "import os, pathlib, sys\n"
        "from gsjax.runtime.setup import restart_with_large_pages\n"
        "print(os.getpid(), flush=True)\n"
        "restart_with_large_pages(pathlib.Path(sys.argv[1]))\n"
        "print(sys.argv[2:], os.environ['GLIBC_TUNABLES'], sys.stdin.read())"
    )
    command = [sys.executable, "-c", program, str(tmp_path), "a b", ""]
    environment = {k: v for k, v in os.environ.items() if k != "GLIBC_TUNABLES"}
    output = subprocess.check_output(
        command, env=environment, input="read once", text=True
    )
    first, second, rest = output.splitlines()
    assert first == second
    assert rest == "['a b', ''] glibc.malloc.hugetlb=1 read once"
