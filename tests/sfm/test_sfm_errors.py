"""Failures of structure from motion: exit code, one line, no file left behind."""

import os
import re
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
from corner_room import NAMES, make_room, write_blank

from gsjax.cli.main import main
from gsjax.data.colmap import load_colmap
from gsjax.io import images
from gsjax.sfm.engine import run_cancellable
from gsjax.sfm.output import staging_folder

pytest.importorskip("pycolmap", reason="pycolmap is absent")


def test_unregistered_images_have_a_reason(tmp_path, capsys):
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    make_room(photos)
    for name in NAMES[3:]:
        (photos / name).unlink()
    for name in ("empty 1.jpg", "empty 2.jpg", "empty 3.jpg"):
        write_blank(photos / name)
    write_blank(photos / "noise.jpg", 1)
    assert main(["sfm", str(photos), "-o", str(out)]) == 4
    told = capsys.readouterr()
    lines = told.out.splitlines()
    assert lines[0].startswith("empty 1.jpg  not registered: only 0 features")
    assert re.match(r"noise.jpg  not registered: none of its \d+ features", lines[3])
    assert re.match(r"photo 0.jpg  registered, \d+ points", lines[4])
    assert lines[-1].startswith("3 of 7 images registered")
    assert "gsjax: error: only 3 of 7 images could be registered" in told.err
    assert len(load_colmap(out).views) == 3  # the best model is written nevertheless


def two_photos(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    for seed in range(2):
        write_blank(folder / f"{seed}.jpg", seed)
    return folder


def test_no_model_leaves_nothing(tmp_path, capsys):
    photos = two_photos(tmp_path / "photos")
    assert main(["sfm", str(photos), "-o", str(tmp_path / "out")]) == 4
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.startswith("gsjax: error: no cameras could be found for the 2 images")
    assert [p.name for p in tmp_path.iterdir()] == ["photos"]


def damaged(folder: Path) -> list[str]:
    photos = two_photos(folder / "p")
    data = (photos / "0.jpg").read_bytes()
    (photos / "half.jpg").write_bytes(data[: len(data) // 2])
    (photos / "none.png").write_bytes(b"")
    (photos / "text.jpg").write_text("not an image")
    return [str(photos)]


def huge(folder: Path) -> list[str]:
    """Make a file of a few hundred bytes that declares 2.7 GB of pixels."""
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
    "one photo": (3, one_photo, "expected at least 2 photos (.png, .jpg"),
    "subfolders": (3, in_subfolders, "4 photos lie in subfolders: move them up"),
    "damaged": (3, damaged, "3 of 5 photos cannot be read; repair or remove them: "),
    "half": (3, damaged, "half.jpg: "),
    "empty": (3, damaged, "none.png: "),
    "text": (3, damaged, "text.jpg: "),
    "huge": (3, huge, "huge.png: "),
    "heic": (3, with_file("IMG_1.HEIC"), ".HEIC is not supported; convert"),
    "same name": (3, same_name, "the same name"),
    "image": (3, lambda f: [str(two_photos(f) / "0.jpg")], "single image"),
    "video": (3, junk_video, "video"),
    "no masks": (3, photos_and("--masks", "nowhere"), "no such folder of masks"),
    "other masks": (3, mask_of((9, 9), "b.png"), "no mask for any photo"),
    "mask size": (3, mask_of((320, 240)), "got 240x320; draw the mask"),
    "bad mask": (3, mask_of(None), "0.png: "),
    "max size": (2, photos_and("--max-size", "3"), "--max-size"),
    "frames": (2, photos_and("--frames", "1"), "--frames"),
    "seed": (2, photos_and("--seed", "-1"), "--seed"),
    "matcher": (2, photos_and("--matcher", "best"), "best"),
}


@pytest.mark.parametrize("name", BAD)
def test_an_error_is_one_line_a_code_and_no_file(name, tmp_path, capfd):
    code, make, text = BAD[name]
    args = make(tmp_path)
    assert main(["sfm", *args, "-o", str(tmp_path / "out")]) == code
    lines = capfd.readouterr().err.splitlines()
    assert text in lines[-1]
    assert all(line.startswith("gsjax: ") for line in lines)
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".gsjax*"))


def test_missing_pycolmap_names_the_remedy(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    photos = two_photos(tmp_path / "photos")
    assert main(["sfm", str(photos), "-o", str(tmp_path / "out")]) == 6
    assert "pip install pycolmap" in capsys.readouterr().err


@pytest.mark.skipif(os.name == "nt", reason="signals to oneself are POSIX")
@pytest.mark.parametrize("error", [KeyboardInterrupt, BrokenPipeError])
def test_ctrl_c_and_failing_progress_cancel_colmap(error, request):
    # A shell starts background processes with Ctrl-C ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    cancelled, lines = threading.Event(), []

    def work(token):
        for _ in range(1000):
            if token.is_cancelled:
                cancelled.set()
                return
            time.sleep(0.01)

    def progress(line):
        lines.append(line)
        if error is BrokenPipeError:
            raise error

    if error is KeyboardInterrupt:
        threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(error):
        run_cancellable(work, lambda: "status", progress, interval=0.1)
    assert lines[0] == "status"
    assert lines[-1].startswith("stop" if error is KeyboardInterrupt else "status")
    assert cancelled.wait(1)


def test_staging_is_on_the_disk_of_the_output(tmp_path):
    there, new = tmp_path / "there", tmp_path / "new" / "dataset"
    there.mkdir()
    for output, base in ((there, there), (new, new.parent)):
        with staging_folder(output) as stage:
            assert stage.parent == base
        assert not list(base.iterdir())


def test_importing_the_commands_is_light():
    heavy = "{'cv2', 'pycolmap', 'gsjax.sfm.reconstruction', 'gsjax.runs.views'}"
    code = f"import gsjax.cli.main, sys; assert not {heavy} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True)
