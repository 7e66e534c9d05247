"""The set-up of a process: devices, memory, the folder of compiled programs."""

import json
import os
import subprocess
import sys
import zlib
from pathlib import Path

import jax
import numpy as np
import pytest
from captures import rejects
from conftest import needs_two_devices, write_files

from gsjax.runtime import compilation_cache as cache
from gsjax.runtime import setup
from gsjax.runtime.devices import shard_rows, use_all_cores
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
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=env, timeout=150, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


REPORT = """
import json, os, pathlib, warnings
from gsjax.runtime import devices, loops
with warnings.catch_warnings(record=True) as caught:
    count = [devices.local_device_count() for _ in range(2)][0]
cache = pathlib.Path(jax.config.jax_compilation_cache_dir or "none/-").parent.name
left = {name for name in ("NPROC", "JAX_NUM_CPU_DEVICES") if name in os.environ}
print(json.dumps({
    "devices": count, "kernels": loops.large_loops_are_kernels(), "left": sorted(left),
    "warnings": len(caught), "cache": cache,
}))
"""
PLAIN = {"devices": 1, "kernels": False, "left": [], "warnings": 0, "cache": "none"}
PREPARED = {**PLAIN, "devices": CORES, "kernels": True, "cache": "gsjax"}


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
            {**PREPARED, "devices": 1, "cache": "none"},
        ),
        (
            "import gsjax, jax",
            {"JAX_COMPILATION_CACHE_DIR": "{home}/mine/programs"},
            {**PREPARED, "cache": "mine"},
        ),
        (
            "import gsjax, jax",
            {"XDG_CACHE_HOME": "/dev/null"},  # no folder can be created there
            {**PREPARED, "cache": "none"},
        ),
    ],
)
def test_import_prepares_the_process(before, environment, expected, tmp_path):
    environment = {k: v.format(home=tmp_path) for k, v in environment.items()}
    found = python(f"{before}\n{REPORT}", tmp_path, **environment)
    assert json.loads(found) == expected


@needs_two_devices
@pytest.mark.parametrize(("size", "expected"), [(4, [0, 1, 2, 3]), (3, [0, 1, 2, -1])])
def test_rows_are_sharded_equally_and_in_order(size, expected):
    for count in (0, -1, 1.5, "2"):
        rejects("count", use_all_cores, count)
    values = np.arange(size, dtype=np.int32)
    parts = jax.jit(lambda x: shard_rows(x, 2, fill=-1))(values)
    np.testing.assert_array_equal(parts, expected)
    assert [part.data.shape for part in parts.addressable_shards] == [(2,), (2,)]


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


def compress_zstd(data: bytes) -> bytes:
    zstandard = pytest.importorskip("zstandard", reason="optional dependency of JAX")
    return zstandard.ZstdCompressor().compress(data)


@pytest.mark.parametrize("compress", [compress_zstd, zlib.compress])
def test_truncated_programs_are_incomplete(compress):
    noise = np.random.default_rng(0).bytes(300)
    several_blocks = 600 * noise + bytes(200_000) + noise
    for data in (b"a", noise, bytes(300_000), several_blocks):
        program = compress(data)
        assert cache.is_complete(program)
        ends = {*range(min(40, len(program))), len(program) - 1, len(program) // 2}
        assert not any(cache.is_complete(program[:end]) for end in ends)


def test_incomplete_and_old_programs_are_removed(tmp_path):
    """Complete ones are checked once; other files and unknown formats stay."""
    data = {"a-cache": zlib.compress(b"complete"), "b-cache": zlib.compress(b"b")[:-1]}
    data |= {"c-cache": bytes(4096), "d-cache": b"LZ4, say", "a-atime": bytes(8)}
    for age, (name, content) in enumerate(data.items()):
        (tmp_path / name).write_bytes(content)
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    (tmp_path / "e-cache").mkdir()
    cache.remove_truncated(tmp_path)
    left = {"a-cache", "d-cache", "a-atime", "e-cache"}
    assert {path.name for path in tmp_path.iterdir()} == left
    checked = tmp_path / "a-cache"
    checked.chmod(0o644)
    checked.write_bytes(b"x")
    os.utime(checked, (1e9, 1e9))
    checked.chmod(0o444)
    cache.remove_truncated(tmp_path)
    cache.remove_oldest(tmp_path, 10)
    left = {"a-cache", "d-cache", "e-cache"}
    assert {path.name for path in tmp_path.iterdir()} == left
    cache.remove_oldest(tmp_path, 0)
    assert [path.name for path in tmp_path.iterdir()] == ["e-cache"]


COMPILE = """
import warnings
warnings.simplefilter("error")  # JAX warns of programs that it cannot read
import jax, jax.numpy as jnp
from gsjax.runtime.setup import keep_programs
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
compiled = []
jax.monitoring.register_event_listener(
    lambda event, **_: compiled.append(event.endswith("compilation_cache/cache_misses"))
)
print(keep_programs())
jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones((3, 3))).block_until_ready()
print(sum(compiled))
"""


def test_a_truncated_program_is_compiled_and_cached_again(tmp_path):
    folder, first = python(COMPILE, tmp_path).split()
    assert Path(folder).parent == tmp_path / "gsjax"
    programs = list(Path(folder).glob("*-cache"))
    assert len(programs) == int(first) > 0
    for program in programs:
        os.truncate(program, program.stat().st_size // 2)
    assert python(COMPILE, tmp_path).split()[1] == first
    assert python(COMPILE, tmp_path).split()[1] == "0"


PAGES = "sys/kernel/mm/transparent_hugepage/enabled"


@pytest.mark.parametrize(
    ("choice", "known", "expected"),
    [
        ("always [madvise] never\n", None, ["glibc.malloc.hugetlb=1"]),
        ("always [madvise] never\n", "a.b=2", ["a.b=2:glibc.malloc.hugetlb=1"]),
        ("always [madvise] never\n", "glibc.malloc.hugetlb=0", []),
        ("[always] madvise never\n", None, []),
        (None, None, []),
    ],
)
def test_restart_with_large_pages(choice, known, expected, tmp_path, monkeypatch):
    write_files(tmp_path, {PAGES: choice} if choice else {})
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    if known is not None:
        monkeypatch.setenv("GLIBC_TUNABLES", known)
    started = []
    monkeypatch.setattr(os, "execve", lambda *given: started.append(given[-1]))
    for program in ("x.py", "", "-"):  # the last two are interactive
        monkeypatch.setattr(sys, "argv", [program])
        setup.restart_with_large_pages(tmp_path)
    assert [environment["GLIBC_TUNABLES"] for environment in started] == expected


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
