"""What JAX keeps of its compiling, and where."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from conftest import needs_two_devices

from gsjax import InputError
from gsjax.runtime import devices


@pytest.fixture
def nothing_chosen():
    """JAX without a folder for programs, and afterwards as it was."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    jax.config.update("jax_compilation_cache_dir", before)


@pytest.mark.usefixtures("nothing_chosen")
def test_programs_are_kept_in_the_users_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = devices.keep_programs()
    assert folder is not None
    assert folder.is_dir()
    assert folder.parent == tmp_path / "gsjax"
    assert jax.config.jax_compilation_cache_dir == str(folder)
    assert devices.keep_programs() == folder


@pytest.mark.usefixtures("nothing_chosen")
def test_a_folder_that_was_chosen_stays(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "other"))
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    assert devices.keep_programs() == tmp_path
    assert not (tmp_path / "other").exists()


@pytest.mark.usefixtures("nothing_chosen")
def test_nowhere_to_keep_them(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert devices.keep_programs() is None
    assert jax.config.jax_compilation_cache_dir is None


def test_memory_is_kept():
    """In a process of its own: calls that take no new page, of which else is none."""
    code = """
import resource, sys
import gsjax.runtime.devices, jax, jax.numpy as jnp
if not gsjax.runtime.devices.keep_memory():
    sys.exit("skip")
f = jax.jit(lambda x: jnp.sort(x.reshape(64, -1), axis=0).sum())
x = jnp.arange(10 * 2.0**20)  # 40 MB
faults = []
for _ in range(14):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    f(x).block_until_ready()
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
assert faults[0] > 2**13, faults
assert sum(count < 100 for count in faults[1:]) >= 3, faults
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if done.stderr.strip() == "skip":
        pytest.skip("the allocator is not that of glibc")
    assert done.returncode == 0, done.stderr


QUEUE = """
import jax, jax.numpy as jnp, numpy as np, gsjax
gsjax.use_all_cores(2)
mesh = jax.sharding.Mesh(np.array(jax.local_devices()), ("x",))
spec = jax.sharding.PartitionSpec
share = jax.shard_map(
    lambda shift, x: jnp.sin(x + shift)[None],
    mesh=mesh, in_specs=(spec("x"), spec()), out_specs=spec("x"), check_vma=False,
)
step = jax.jit(lambda x: share(jnp.arange(2.0), x).sum(0))
x = step(jnp.ones(2000))
for _ in range(500):
    x = step(x)
assert jnp.isfinite(x).all()
"""


@pytest.mark.parametrize("count", [0, -1, 1.5, "2"])
def test_no_number_of_devices(count):
    with pytest.raises(InputError, match="count"):
        devices.use_all_cores(count)


def test_calls_may_pile_up():
    """XLA aborts this within a minute where it has as many threads as devices."""
    env = {name: value for name, value in os.environ.items() if name != "NPROC"}
    env |= {"PYTHONPATH": str(Path(__file__).parents[2]), "XLA_FLAGS": ""}
    done = subprocess.run(
        [sys.executable, "-c", QUEUE], env=env, timeout=150, capture_output=True
    )
    assert done.returncode == 0, done.stderr[-2000:]


@needs_two_devices
@pytest.mark.parametrize(("size", "wanted"), [(4, [0, 1, 2, 3]), (3, [0, 1, 2, -1])])
def test_parts_are_equal_and_in_order(size, wanted):
    values = np.arange(size, dtype=np.int32)
    parts = jax.jit(lambda x: devices.shard_rows(x, 2, fill=-1))(values)
    np.testing.assert_array_equal(parts, wanted)
    assert [part.data.shape for part in parts.addressable_shards] == [(2,), (2,)]
    assert devices.shard_rows(values, 1, fill=-1) is values
