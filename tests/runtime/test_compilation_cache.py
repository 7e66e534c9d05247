"""The folder of compiled programs: its size, and truncated files."""

import os
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from gsjax.runtime.compilation_cache import (
    is_complete,
    remove_oldest,
    remove_truncated,
)


def test_the_oldest_are_removed_first(tmp_path):
    for age, name in enumerate(("new", "middle", "old")):
        path = tmp_path / name
        path.write_bytes(bytes(100))
        os.utime(path, (1e9 - age, 1e9 - age))
    remove_oldest(tmp_path, 250)
    assert {path.name for path in tmp_path.iterdir()} == {"new", "middle"}
    remove_oldest(tmp_path, 0)
    assert not list(tmp_path.iterdir())


def compress_zstd(data: bytes) -> bytes:
    zstandard = pytest.importorskip("zstandard", reason="optional dependency of JAX")
    return zstandard.ZstdCompressor().compress(data)


@pytest.mark.parametrize("compress", [compress_zstd, zlib.compress])
def test_truncated_programs_are_incomplete(compress):
    noise = np.random.default_rng(0).bytes(300)
    several_blocks = 600 * noise + bytes(200_000) + noise
    for data in (b"a", noise, bytes(300_000), several_blocks):
        program = compress(data)
        assert is_complete(program)
        ends = {*range(min(40, len(program))), len(program) - 1, len(program) // 2}
        assert not any(is_complete(program[:end]) for end in ends)


def test_only_incomplete_programs_are_removed(tmp_path):
    """Complete ones are checked once; other files and unknown formats stay."""
    data = {"a-cache": zlib.compress(b"complete"), "b-cache": zlib.compress(b"b")[:-1]}
    data |= {"c-cache": bytes(4096), "d-cache": b"LZ4, say", "a-atime": bytes(8)}
    for name, content in data.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "e-cache").mkdir()
    remove_truncated(tmp_path)
    left = {"a-cache", "d-cache", "a-atime", "e-cache"}
    assert {path.name for path in tmp_path.iterdir()} == left
    checked = tmp_path / "a-cache"
    checked.chmod(0o644)
    checked.write_bytes(b"x")
    checked.chmod(0o444)
    remove_truncated(tmp_path)
    assert checked.exists()


START = """
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


def start(home: Path) -> tuple[Path, int]:
    """Compile in a process; return the cache, and the number of programs compiled."""
    env = os.environ | {"XDG_CACHE_HOME": str(home)}
    env |= {"PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(
        [sys.executable, "-c", START], env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    folder, count = done.stdout.split()
    return Path(folder), int(count)


def test_a_truncated_program_is_compiled_and_cached_again(tmp_path):
    folder, first = start(tmp_path)
    programs = list(folder.glob("*-cache"))
    assert len(programs) == first > 0
    for program in programs:
        os.truncate(program, program.stat().st_size // 2)
    assert start(tmp_path)[1] == first
    assert start(tmp_path)[1] == 0
