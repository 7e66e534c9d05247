"""Files: read or refused by name, written complete or not at all."""

import os
from pathlib import Path

import pytest

from gsjax.errors import InputError
from gsjax.runtime.files import (
    make_folder,
    read_bytes,
    read_json,
    replacing,
    write_file,
    write_json,
)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_failed_write_leaves_nothing(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_bytes(b"old")
    for name in ("none/a.png", "folder", "file/a.png", "a" * 300):
        with pytest.raises(InputError, match=r"cannot be written: .*; check perm"):
            write_file(tmp_path / name, b"new")
    with pytest.raises(InputError, match="file/b: cannot be made a folder: Not a dir"):
        make_folder(tmp_path / "file" / "b")
    assert names(tmp_path) == ["file", "folder"]
    assert (tmp_path / "file").read_bytes() == b"old"


def test_what_a_link_leads_to_is_written(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to("there/file")
    for data in (b"first", b"second"):
        write_file(tmp_path / "link", data)
        assert (tmp_path / "there/file").read_bytes() == data
        assert (tmp_path / "link").is_symlink()
    assert names(tmp_path / "there") == ["file"]


@pytest.mark.parametrize(
    "error", [OSError(28, "No space"), KeyboardInterrupt(), KeyError()], ids=repr
)
def test_what_is_interrupted_keeps_the_old_file_and_no_other(tmp_path, error):
    path = tmp_path / "a"
    path.write_bytes(b"old")

    def interrupted():
        with replacing(path) as file:
            file.write(b"half")
            file.flush()
            assert path.read_bytes() == b"old"
            raise error

    with pytest.raises(InputError if isinstance(error, OSError) else type(error)):
        interrupted()
    assert names(tmp_path) == ["a"]
    assert path.read_bytes() == b"old"
    write_file(path, b"new")
    assert path.read_bytes() == b"new"
    assert names(tmp_path) == ["a"]


def test_what_cannot_be_read(tmp_path, monkeypatch):
    path = tmp_path / "a"
    with pytest.raises(InputError, match=r"a: cannot be read: No such file"):
        read_bytes(path)
    with pytest.raises(InputError, match=r"not a regular file .*; pass b"):
        read_bytes(tmp_path, "b")
    if hasattr(os, "mkfifo"):
        os.mkfifo(path)
        with pytest.raises(InputError, match="a: not a regular file"):
            read_bytes(path)
        path.unlink()
    path.write_bytes(b"[1]")
    with pytest.raises(InputError, match=r"expected an object at the top, got \[1\]; pass c"):
        read_json(path, "c")

    def full(_):
        raise MemoryError

    monkeypatch.setattr(Path, "read_bytes", full)
    with pytest.raises(InputError, match="a: cannot be read: larger than the memory"):
        read_bytes(path)


@pytest.mark.parametrize("name", [b"caf\xc3\xa9", b"caf\xe9"])
def test_names_of_files_go_through_json(tmp_path, name):
    """Also those that are not UTF-8; those that are can be read in it."""
    path, data = tmp_path / "a.json", {"dataset": os.fsdecode(name)}
    write_json(path, data)
    assert os.fsencode(read_json(path)["dataset"]) == name
    assert ("café" in path.read_text(encoding="utf-8")) == (name == b"caf\xc3\xa9")
