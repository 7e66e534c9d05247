"""Failures of structure from motion: exit code, one line, no file left behind."""

import io
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
from PIL import Image

from gsjax.cli.main import main
from gsjax.data.colmap import load_colmap
from gsjax.io import images
from gsjax.sfm.engine import run_cancellable

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
    folder.mkdir()
    for seed in range(2):
        write_blank(folder / f"{seed}.jpg", seed)
    return folder


def encoded(form: str, mode: str) -> bytes:
    stream = io.BytesIO()
    Image.new(mode, (64, 48)).save(stream, form)
    return stream.getvalue()


NOISE = np.random.default_rng(0).integers(0, 256, (90, 90, 3), np.uint8)
JPEG = cv2.imencode(".jpg", NOISE)[1].tobytes()
PNG = images.encode_png(NOISE)
CMYK = encoded("JPEG", "CMYK")
HEIC = encoded("AVIF", "RGB").replace(b"avif", b"heic")
TALL = images.encode_png(np.full((320, 240, 3), 255, np.uint8))
DAMAGED = {
    "p/half.jpg": JPEG[: len(JPEG) // 2],
    "p/none.png": b"",
    "p/text.jpg": b"not an image",
    # A small file that declares 2.7 GB of pixels.
    "p/huge.png": PNG[:16] + struct.pack(">II", 30_000, 30_000) + PNG[24:],
}
HIDDEN = dict.fromkeys(("deep/a/0.jpg", "deep/.b/1.jpg", "deep/masks/0.jpg"), JPEG)
TWINS = dict.fromkeys(("p/a.bmp", "p/a.tif"), b"")
# Exit code, arguments, files besides the two photographs of folder p, part of the line.
BAD = {
    "missing": (3, "none", {}, "no such folder"),
    "one photo": (3, "one", {"one/a.jpg": JPEG}, "at least 2 photos (.png, .jpg"),
    "hidden folders": (3, "deep", HIDDEN, "at least 2 photos (.png, .jpg"),
    "damaged": (3, "p", DAMAGED, "4 of 6 photos cannot be read; repair or remove th"),
    **{name: (3, "p", {name: data}, f"{name}: ") for name, data in DAMAGED.items()},
    "heic": (3, "p", {"p/a.HEIC": HEIC[:99]}, "damaged (box meta declares 235 bytes)"),
    "raw": (3, "p", {"p/a.CR2": b"x"}, ".CR2 is a raw format; develop"),
    "cmyk": (3, "p", {"p/a.jpg": CMYK}, "got CMYK, the inks of a printer; convert it"),
    "same name": (3, "p", TWINS, "the same name"),
    "image": (3, "p/0.jpg", {}, "single image"),
    "video": (3, "a.mp4", {"a.mp4": b"junk" * 99}, "video"),
    "no masks": (3, "p --masks nowhere", {}, "no such folder of masks"),
    "other masks": (3, "p --masks m", {"m/b.png": PNG}, "no mask for any photo"),
    "mask size": (3, "p --masks m", {"m/0.png": TALL}, "got 240x320; draw the mask"),
    "bad mask": (3, "p --masks m", {"m/0.png": b""}, "0.png: "),
    "no model": (4, "p", {}, "no cameras could be found for the 2 images"),
    "max size": (2, "p --max-size 3", {}, "--max-size"),
    "frames": (2, "p --frames 1", {}, "--frames"),
    "seed": (2, "p --seed -1", {}, "--seed"),
    "matcher": (2, "p --matcher best", {}, "best"),
}


@pytest.mark.parametrize("name", BAD)
def test_an_error_is_one_line_a_code_and_no_file(name, tmp_path, capfd, monkeypatch):
    code, words, files, text = BAD[name]
    monkeypatch.chdir(tmp_path)
    two_photos(Path("p"))
    for file, data in files.items():
        Path(file).parent.mkdir(exist_ok=True, parents=True)
        Path(file).write_bytes(data)
    before = sorted(Path().iterdir())
    assert main(["sfm", *words.split(), "-o", "out"]) == code
    lines = capfd.readouterr().err.splitlines()
    assert text in lines[-1]
    assert all(line.startswith("gsjax: ") for line in lines)
    assert sorted(Path().iterdir()) == before


def test_missing_pycolmap_names_the_remedy(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    photos = two_photos(tmp_path / "photos")
    assert main(["sfm", str(photos), "-o", str(tmp_path / "out")]) == 6
    assert "pip install pycolmap" in capsys.readouterr().err


@pytest.mark.skipif(os.name == "nt", reason="signals to oneself are POSIX")
@pytest.mark.parametrize("error", [KeyboardInterrupt, BrokenPipeError])
def test_ctrl_c_and_failing_progress_cancel_colmap(error):
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


def test_importing_the_commands_is_light():
    heavy = "{'cv2', 'pycolmap', 'gsjax.sfm.reconstruction', 'gsjax.runs.views'}"
    code = f"import gsjax.cli.main, sys; assert not {heavy} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True)
