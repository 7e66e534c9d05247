"""What JAX keeps of its compiling, and where."""

import os
from pathlib import Path

import jax
import pytest

from gsjax import devices


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


def test_the_oldest_go_first(tmp_path):
    for age, name in enumerate(("new", "middle", "old")):
        path = tmp_path / name
        path.write_bytes(bytes(100))
        os.utime(path, (1e9 - age, 1e9 - age))
    devices._drop_oldest(tmp_path, 250)
    assert {path.name for path in Path(tmp_path).iterdir()} == {"new", "middle"}
    devices._drop_oldest(tmp_path, 0)
    assert not list(tmp_path.iterdir())
