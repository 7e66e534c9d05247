"""Files are written completely or not at all, with errors that name them."""

import os
from pathlib import Path

import pytest
from captures import rejects

from gsjax.errors import InputError
from gsjax.runtime import files


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_failed_write_leaves_nothing(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_bytes(b"old")
    for name in ("none/a.png", "folder", "file/a.png", "a" * 300):
        message = "cannot be written: .*; check perm"
        rejects(message, files.write_file, tmp_path / name, b"new")
    rejects("b: cannot be created: Not a dir", files.make_folder, tmp_path / "file/b")
    assert names(tmp_path) == ["file", "folder"]
    assert (tmp_path / "file").read_bytes() == b"old"


def test_the_target_of_a_link_is_replaced(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to("there/file")
    for data in (b"first", b"second"):
        files.write_file(tmp_path / "link", data)
        assert (tmp_path / "there/file").read_bytes() == data
        assert (tmp_path / "link").is_symlink()
    assert names(tmp_path / "there") == ["file"]


@pytest.mark.parametrize(
    "error", [OSError(28, "No space"), KeyboardInterrupt(), KeyError()], ids=repr
)
def test_an_interrupted_write_keeps_the_old_file(tmp_path, error):
    path = tmp_path / "a"
    path.write_bytes(b"old")

    def interrupted():
        with files.replacing(path) as file:
            file.write(b"half")
            file.flush()
            assert path.read_bytes() == b"old"
            raise error

    with pytest.raises(InputError if isinstance(error, OSError) else type(error)):
        interrupted()
    assert names(tmp_path) == ["a"]
    assert path.read_bytes() == b"old"


def test_a_file_larger_than_memory(tmp_path, monkeypatch):
    def full(_):
        raise MemoryError

    monkeypatch.setattr(Path, "read_bytes", full)
    (tmp_path / "a").touch()
    rejects("a: cannot be read: larger than memory", files.read_bytes, tmp_path / "a")


@pytest.mark.parametrize("name", [b"caf\xc3\xa9", b"caf\xe9"])
def test_file_names_round_trip_through_json(tmp_path, name):
    """Also those that are not UTF-8; UTF-8 is stored as such."""
    path, data = tmp_path / "a.json", {"dataset": os.fsdecode(name)}
    files.write_json(path, data)
    assert os.fsencode(files.read_json(path)["dataset"]) == name
    assert ("café" in path.read_text(encoding="utf-8")) == (name == b"caf\xc3\xa9")
