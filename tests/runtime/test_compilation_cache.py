"""The folder of compiled programs: which of them go, and that torn ones do."""

import os
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from gsjax.runtime.compilation_cache import is_complete, remove_oldest, remove_truncated


def test_the_oldest_go_first(tmp_path):
    for age, name in enumerate(("new", "middle", "old")):
        path = tmp_path / name
        path.write_bytes(bytes(100))
        os.utime(path, (1e9 - age, 1e9 - age))
    remove_oldest(tmp_path, 250)
    assert {path.name for path in tmp_path.iterdir()} == {"new", "middle"}
    remove_oldest(tmp_path, 0)
    assert not list(tmp_path.iterdir())


def texts() -> list[bytes]:
    """Of all kinds of blocks: none, raw, repeated, compressed, several."""
    noise = np.random.default_rng(0).bytes(300)
    return [b"", b"a", noise, bytes(300_000), 600 * noise + bytes(200_000) + noise]


def zstd_frames() -> list[bytes]:
    zstandard = pytest.importorskip("zstandard", reason="what JAX compresses by, too")
    frames = []
    for options in ({}, {"write_checksum": True}, {"write_content_size": False}):
        compressor = zstandard.ZstdCompressor(**options)
        frames += [compressor.compress(text) for text in texts()]
        # In several blocks, of a size that is not told.
        streamed = compressor.compressobj()
        frames += [streamed.compress(texts()[-1]) + streamed.flush()]
    return frames


@pytest.mark.parametrize("frames", [zstd_frames, lambda: map(zlib.compress, texts())])
def test_no_beginning_of_a_whole_one_is_whole(frames):
    for frame in frames():
        assert is_complete(frame)
        ends = {*range(min(40, len(frame))), len(frame) - 1, len(frame) // 2}
        ends |= set(range(0, len(frame), 997))
        assert not any(is_complete(frame[:end]) for end in ends)


def test_what_was_never_written_is_not_whole_and_what_is_unknown_may_be():
    assert not is_complete(bytes(4096))
    assert is_complete(b"LZ4 or whatever comes")


def test_each_is_looked_at_once_and_others_are_left_alone(tmp_path):
    whole, torn = tmp_path / "a-cache", tmp_path / "b-cache"
    other = tmp_path / "a-atime"
    whole.write_bytes(zlib.compress(b"whole"))
    torn.write_bytes(zlib.compress(b"torn")[:-1])
    other.write_bytes(bytes(8))
    (tmp_path / "c-cache").mkdir()
    remove_truncated(tmp_path)
    assert whole.exists()
    assert other.exists()
    assert not torn.exists()
    whole.chmod(0o644)
    whole.write_bytes(b"x")
    whole.chmod(0o444)
    remove_truncated(tmp_path)
    assert whole.exists()


START = """
import logging, sys, warnings
warnings.simplefilter("error")  # of a program that cannot be read, too
import jax, jax.numpy as jnp
from gsjax.runtime.devices import keep_programs
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
    """A process that keeps its programs at home: where, and how many it compiled."""
    env = os.environ | {"XDG_CACHE_HOME": str(home)}
    env |= {"PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(
        [sys.executable, "-c", START], env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    folder, count = done.stdout.split()
    return Path(folder), int(count)


def test_what_was_cut_off_is_compiled_once_more_and_kept_again(tmp_path):
    folder, first = start(tmp_path)
    programs = list(folder.glob("*-cache"))
    assert len(programs) == first > 0
    for count, program in enumerate(programs):
        os.truncate(program, program.stat().st_size // 2 * (count % 2))
    assert start(tmp_path)[1] == first
    assert start(tmp_path)[1] == 0
    assert not any(os.stat(p).st_mode & 0o200 for p in folder.glob("*-cache"))
