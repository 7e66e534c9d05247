"""Structure from motion that fails: exit codes, one line, and nothing half done."""

import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from corner_room import (
    NAMES,
    blank,
    leftovers,
    make_room,
)

from gsjax import InputError
from gsjax.cli.main import main
from gsjax.data.colmap import load_colmap
from gsjax.io import images
from gsjax.sfm import engine
from gsjax.sfm.engine import watched
from gsjax.sfm.output import staging
from gsjax.sfm.reconstruction import SfmSettings, run_sfm

pytest.importorskip("pycolmap", reason="pycolmap is absent")


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    return make_room(tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def solved(room, tmp_path_factory) -> Path:
    """The dataset of it."""
    out = tmp_path_factory.mktemp("solved") / "dataset"
    run_sfm(room, out)
    return out


def test_what_is_not_registered_has_a_reason(room, tmp_path, capsys):
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    for name in NAMES[:3]:
        shutil.copy(room / name, photos)
    blank(photos / "empty.jpg")
    blank(photos / "noise.jpg", seed=1)
    assert main.main(["sfm", str(photos), "-o", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("empty.jpg  not registered: only 0 features")
    assert re.match(r"noise.jpg  not registered: none of its \d+ features", lines[1])
    assert re.match(r"photo 0.jpg  registered, \d+ points", lines[2])
    assert lines[-1].startswith("3 of 5 images registered")

    for seed in range(2, 4):  # and now they are fewer than half
        blank(photos / f"noise {seed}.jpg", seed)
    assert main.main(["sfm", str(photos), "-o", str(out), "--overwrite"]) == 4
    told = capsys.readouterr()
    assert "gsjax: error: only 3 of 7 images could be registered" in told.err
    assert "overlap" in told.err
    assert len(told.out.splitlines()) == 8
    assert len(load_colmap(out).views) == 3, "the best model is written all the same"


def test_no_model_leaves_nothing(tmp_path, capsys):
    photos = tmp_path / "photos"
    photos.mkdir()
    for seed in range(3):
        blank(photos / f"{seed}.jpg", seed)
    assert main.main(["sfm", str(photos), "-o", str(tmp_path / "out")]) == 4
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.startswith("gsjax: error: no cameras could be found for the 3 images")
    assert [p.name for p in tmp_path.iterdir()] == ["photos"]


def test_only_our_own_is_replaced(solved, room, tmp_path, capsys):
    out = tmp_path / "dataset"
    shutil.copytree(solved, out)
    (out / "mine.ply").write_text("mine")
    before = (out / "sfm.json").read_bytes()
    args = ["sfm", str(room), "-o", str(out)]
    assert main.main(args) == 3
    assert "images: exists; pass --overwrite" in capsys.readouterr().err
    assert (out / "sfm.json").read_bytes() == before
    (out / "images" / "stale.jpg").write_text("")
    assert main.main([*args, "--overwrite"]) == 0
    assert (out / "mine.ply").read_text() == "mine"
    assert sorted(p.name for p in (out / "images").iterdir()) == NAMES
    (out / "sfm.json").unlink()
    capsys.readouterr()
    assert main.main([*args, "--overwrite"]) == 3
    assert "was not made by gsjax sfm" in capsys.readouterr().err
    inside = ["sfm", str(out / "images"), "-o", str(out), "--overwrite"]
    assert main.main(inside) == 3
    assert "lies where the dataset would be written" in capsys.readouterr().err
    assert not leftovers(tmp_path)


def two_photos(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    for seed in range(2):
        blank(folder / f"{seed}.jpg", seed)
    return folder


def damaged(folder: Path) -> list[str]:
    photos = two_photos(folder / "p")
    data = (photos / "0.jpg").read_bytes()
    (photos / "half.jpg").write_bytes(data[: len(data) // 2])
    (photos / "none.png").write_bytes(b"")
    (photos / "text.jpg").write_text("not an image")
    return [str(photos)]


def huge(folder: Path) -> list[str]:
    """A few kilobytes that ask for 2.7 GB."""
    photos = two_photos(folder / "p")
    data = bytearray(images.encode_png(np.zeros((9, 9, 3), np.uint8)))
    data[16:24] = struct.pack(">II", 30_000, 30_000)
    (photos / "huge.png").write_bytes(data)
    return [str(photos)]


def with_file(name: str, content: bytes = b"x"):
    def make(folder: Path) -> list[str]:
        photos = two_photos(folder / "p")
        (photos / name).write_bytes(content)
        return [str(photos)]

    return make


def same_name(folder: Path) -> list[str]:
    photos = two_photos(folder / "p")
    for suffix in (".bmp", ".tif"):
        cv2.imwrite(str(photos / f"a{suffix}"), np.zeros((9, 9), np.uint8))
    return [str(photos)]


def one_photo(folder: Path) -> list[str]:
    (two_photos(folder / "p") / "1.jpg").unlink()
    return [str(folder / "p")]


def in_subfolders(folder: Path) -> list[str]:
    for name in ("p/a", "p/b/c"):
        (folder / name).mkdir(parents=True)
        two_photos(folder / name)
    return [str(folder / "p")]


def junk_video(folder: Path) -> list[str]:
    (folder / "a.mp4").write_bytes(b"junk" * 99)
    return [str(folder / "a.mp4")]


def mask_of(shape: tuple[int, int] | None, name: str = "0.png"):
    def make(folder: Path) -> list[str]:
        photos, masks = two_photos(folder / "p"), folder / "m"
        masks.mkdir()
        (masks / name).write_bytes(b"")
        if shape is not None:
            cv2.imwrite(str(masks / name), np.full(shape, 255, np.uint8))
        return [str(photos), "--masks", str(masks)]

    return make


def photos_and(*more: str):
    return lambda folder: [str(two_photos(folder / "p")), *more]


BAD = {
    "missing": (3, lambda f: [str(f / "none")], "no such folder"),
    "one photo": (3, one_photo, "1 photo ("),
    "subfolders": (3, in_subfolders, "subfolders are not searched, 4 photos lie there"),
    "damaged": (3, damaged, "3 of 5 photos cannot be read; mend or remove: "),
    "half": (3, damaged, "half.jpg: the image is truncated or damaged"),
    "empty": (3, damaged, "none.png: the file is empty"),
    "text": (3, damaged, "text.jpg: starts with b'not an i'"),
    "huge": (3, huge, "huge.png: declares 30000 × 30000 px"),
    "heic": (3, with_file("IMG_1.HEIC"), ".HEIC photos are not read here; convert"),
    "same name": (3, same_name, "the same name"),
    "image": (3, lambda f: [str(two_photos(f) / "0.jpg")], "is a single image"),
    "video": (3, junk_video, "nor a video that OpenCV reads"),
    "no masks": (3, photos_and("--masks", "nowhere"), "no such folder of masks"),
    "other masks": (3, mask_of((9, 9), "b.png"), "no mask for any photo"),
    "mask size": (3, mask_of((320, 240)), "the mask is 240x320"),
    "bad mask": (3, mask_of(None), "0.png: the file is empty"),
    "max size": (2, photos_and("--max-size", "3"), "--max-size 3"),
    "frames": (2, photos_and("--frames", "1"), "--frames 1"),
    "seed": (2, photos_and("--seed", "-1"), "--seed"),
    "matcher": (2, photos_and("--matcher", "best"), "best"),
}


@pytest.mark.parametrize("name", BAD)
def test_an_error_is_one_line_a_code_and_no_file(name, tmp_path, capfd):
    code, make, text = BAD[name]
    args = make(tmp_path)
    assert main.main(["sfm", *args, "-o", str(tmp_path / "out")]) == code
    lines = capfd.readouterr().err.splitlines()
    assert text in lines[-1]
    assert all(line.startswith("gsjax: ") for line in lines)
    assert not (tmp_path / "out").exists()
    assert not leftovers(tmp_path)


def test_what_is_refused_is_not_begun(tmp_path, capsys):
    photo = two_photos(tmp_path) / "0.jpg"
    assert main.main(["sfm", str(photo), "-o", str(tmp_path / "out")]) == 3
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_without_pycolmap_the_remedy_is_named(room, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert main.main(["sfm", str(room), "-o", str(tmp_path / "out")]) == 6
    assert "pip install pycolmap" in capsys.readouterr().err


def test_interrupted_leaves_what_was_there(solved, room, tmp_path, monkeypatch, capsys):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("gsjax.sfm.reconstruction.extract", interrupt)
        assert main.main(["sfm", str(room), "-o", str(tmp_path / "out")]) == 130
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr("gsjax.sfm.reconstruction.write_dataset", interrupt)
    shutil.copytree(solved, tmp_path / "out")
    before = sorted((p, p.stat().st_mtime_ns) for p in (tmp_path / "out").rglob("*"))
    args = ["sfm", str(room), "-o", str(tmp_path / "out"), "--overwrite"]
    assert main.main(args) == 130
    after = sorted((p, p.stat().st_mtime_ns) for p in (tmp_path / "out").rglob("*"))
    assert after == before
    assert not leftovers(tmp_path)
    assert capsys.readouterr().err.splitlines()[-1] == "gsjax: error: interrupted"


@pytest.mark.skipif(os.name == "nt", reason="signals to oneself are POSIX")
def test_ctrl_c_cancels_colmap(request):
    # A shell starts what it puts in the background with Ctrl-C ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    cancelled = threading.Event()

    def work(token):
        for _ in range(1000):
            if token.is_cancelled:
                cancelled.set()
                return
            time.sleep(0.01)

    timer = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    told = []
    with pytest.raises(KeyboardInterrupt):
        watched(work, lambda: "", told.append)
    assert told[-1].startswith("stopping")
    assert cancelled.wait(1)


def test_progress_that_cannot_be_told_cancels_colmap(monkeypatch):
    monkeypatch.setattr(engine, "_WAIT", 0.01)
    ended = threading.Event()

    def work(token):
        while not token.is_cancelled:
            time.sleep(0.01)
        ended.set()

    def tell(_):
        raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        watched(work, lambda: "a line", tell)
    assert ended.is_set()


def test_masks_that_lie_in_the_dataset_are_not_replaced(solved, room):
    drawn = solved / "masks"
    drawn.mkdir()
    (drawn / "drawn.png").write_bytes(b"by hand")
    settings = SfmSettings(masks=drawn)
    with pytest.raises(InputError, match="lies where the dataset would be written"):
        run_sfm(room, solved, settings, overwrite=True)
    assert (drawn / "drawn.png").read_bytes() == b"by hand"
    shutil.rmtree(drawn)


def test_a_dataset_is_made_on_the_disk_that_it_is_for(tmp_path):
    """A file can be moved to its place there; ``-o`` may be another disk's folder."""
    there, new = tmp_path / "there", tmp_path / "new" / "dataset"
    there.mkdir()
    for output, base in ((there, there), (new, new.parent)):
        with staging(output) as stage:
            assert stage.parent == base
        assert not list(base.iterdir())


def test_importing_the_commands_is_light():
    heavy = "{'cv2', 'pycolmap', 'gsjax.sfm.reconstruction', 'gsjax.runs.views'}"
    code = f"import gsjax.cli.main, sys; assert not {heavy} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True)
