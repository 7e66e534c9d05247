"""Bad files: one typed error that names file, place and remedy, quickly and cheaply."""

import json
import os
import re
import shutil
import time
import tracemalloc
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from bad_files import BAD, CAMERAS, IMAGES, POINTS
from captures import dataset_of_views, ply_file
from good_files import READ, STEP, TEXT, WHOLE_ROWS, write_good_files

from gsjax.cli.main import main
from gsjax.data import colmap_binary, colmap_text
from gsjax.data.colmap_writer import write_colmap
from gsjax.errors import InputError
from gsjax.io.point_cloud import read_point_cloud
from gsjax.runs.history import read_metrics

REMEDY = re.compile(
    "pass|export|copy|remove|convert|check|put|train|supported|undistort|choose|repair|"
    "allowed|write|make|rename|keep|estimate|use|flip|replace|transpose|expected|wanted"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Return a folder with a good file of every format."""
    folder = tmp_path_factory.mktemp("good")
    write_good_files(folder)
    return folder


@contextmanager
def replaced(path: Path, data: bytes):
    """Context in which a file holds other bytes."""
    good = path.read_bytes()
    path.write_bytes(data)
    try:
        yield
    finally:
        path.write_bytes(good)


def test_good_files_are_read_and_each_has_bad_ones(folder):
    assert {bad.file for bad in BAD.values()} == set(READ)
    for name, read in READ.items():
        read(folder / name)


def refusal(read, path: Path, most: float = np.inf) -> str:
    """Return the error message; check that it comes quickly and before allocations."""
    tracemalloc.start()
    begun = time.perf_counter()
    try:
        with pytest.raises(InputError) as caught:
            read(path)
    finally:
        taken, peak = time.perf_counter() - begun, tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert taken < 1
    assert peak < most
    message = str(caught.value)
    assert str(path) in message or str(path.parent) in message
    return message


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_rejected(folder, name):
    file, change, expected = BAD[name]
    path = folder / file
    data = change(path.read_bytes())
    with replaced(path, data):
        # The file, its parsed content, and the blocks in which it is parsed.
        message = refusal(READ[file], path, most=2 * len(data) + 3e6)
    assert re.search(expected, message), message
    assert REMEDY.search(message), message


@pytest.mark.parametrize("name", READ)
def test_irregular_files_are_rejected_at_once(folder, tmp_path, name):
    """Folders, pipes, which may never end, and links to themselves."""
    for good in ("photo.png", "config.json"):  # read beside it
        shutil.copy(folder / good, tmp_path)
    path = tmp_path / Path(name).name
    path.unlink(missing_ok=True)
    path.mkdir()
    refusal(READ[name], path)
    path.rmdir()
    if hasattr(os, "mkfifo"):
        os.mkfifo(path)
        refusal(READ[name], path)
        path.unlink()
    if name != "eval.json":  # may be absent
        path.symlink_to(path)
        refusal(READ[name], path)


@pytest.mark.parametrize("name", READ)
def test_every_prefix_is_rejected(folder, name):
    path, whole = folder / name, (folder / name).read_bytes()
    end = len(whole.rstrip(b"\n")) if name.endswith(".json") else len(whole)
    step = WHOLE_ROWS.get(name, end)
    with replaced(path, whole):
        for length in reversed(range(end)):
            os.truncate(path, length)
            if length and length % step == 0:
                assert READ[name](path).capacity == length // step
                continue
            begun = time.perf_counter()
            with pytest.raises((InputError, UserWarning)) as caught:
                READ[name](path)
            assert time.perf_counter() - begun < 1
            assert caught.type is InputError or name in TEXT
            assert str(path) in str(caught.value) or str(path.parent) in str(
                caught.value
            )


def test_a_truncated_log_keeps_its_complete_lines(tmp_path):
    path = tmp_path / "metrics.jsonl"
    record = {"step": 1, "seconds": 0.5, "psnr": None, "gaussians": 5}
    lines = [json.dumps({**record, "step": step}) + "\n" for step in (1, 2, 3)]
    whole = "".join(lines).encode()
    ends = np.cumsum([len(line) - 1 for line in lines]) + (0, 1, 2)
    for length in range(len(whole) + 1):
        path.write_bytes(whole[:length])
        found = [line["step"] for line in read_metrics(path)]
        assert found == [1, 2, 3][: int((ends <= length).sum())]
    for bad in (b"\xff\0\0", b"[" * 200_000, b'{"step": "1"}', b"3"):
        for good, count in ((whole, 4), (b"", 1)):
            path.write_bytes(bad + b"\n" + good)
            with pytest.warns(UserWarning, match=f"1 of {count} lines"):
                assert len(read_metrics(path)) == count - 1


def test_memory_of_good_files(tmp_path, report):
    """At most twice the file, and some blocks of it."""
    count = 60_000
    write_colmap(tmp_path, dataset_of_views(points=2 * count))
    row = "{0} 0.123456 -1.234567 2.345678 1 2 3 0.5 1 0 2 1 3 5 {0} 6 {0} 7 {0} 8\n"
    (tmp_path / "points3D.txt").write_text("".join(map(row.format, range(count))))
    table = np.random.default_rng(0).normal(size=(3, 9 * count))
    (tmp_path / "cloud.ply").write_bytes(ply_file(dict(zip("xyz", table))))
    for name, read in {
        "points3D.bin": colmap_binary.read_points,
        "points3D.txt": colmap_text.read_points,
        "cloud.ply": read_point_cloud,
    }.items():
        path = tmp_path / name
        tracemalloc.start()
        read(path)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        report(name, (peak - 3e6) / path.stat().st_size, 2)
        assert peak < 2 * path.stat().st_size + 3e6, (name, peak)


# A command that reads each of the files.
COMMANDS = {
    "scene.ply": "info scene.ply",
    "scene.spz": "info scene.spz",
    "older.spz": "export older.spz out.ply",
    "scene.splat": "info scene.splat",
    "scene.ksplat": "info scene.ksplat",
    "scene.sog": "info scene.sog",
    "sog/meta.json": "export sog out.ply",
    "sog/quats.webp": "info sog",
    "scene.glb": "export scene.glb out.ply",
    "scene.compressed.ply": "export scene.compressed.ply out.ply",
    "ascii.ply": "export ascii.ply out.ply",
    **dict.fromkeys((CAMERAS, IMAGES, POINTS), "train . -o run"),
    **dict.fromkeys((n for n in READ if n.startswith("text/")), "train text -o run"),
    "transforms.json": "train transforms.json -o run",
    "poses_bounds.npy": "train poses_bounds.npy -o run",
    "photo.png": "train transforms.json -o run",
    STEP: "train . -o . --resume",
    "config.json": "info .",
    "eval.json": "info .",
    "cameras.json": "eval .",
}


@pytest.mark.parametrize("file", COMMANDS)
def test_the_command_line_reports_in_one_line(folder, file, capfd, monkeypatch):
    """The first and the last bad file of each format; the message is the library's."""
    monkeypatch.chdir(folder)
    late = file == "photo.png"  # read after everything else
    path = Path("images/view_00.png" if late else file)
    bad = [bad for bad in BAD.values() if bad.file == file]
    for _, change, expected in bad[:1] + bad[1:][-1:]:
        with replaced(path, change(Path(file).read_bytes())):
            code = main(COMMANDS[file].split())
        output = capfd.readouterr()
        assert (code, output.out) == (3, ""), output
        *before, message = [line for line in output.err.splitlines() if line]
        assert len(before) == 2 * late, before  # views, memory
        assert re.search(f"^gsjax: error: .*(?:{expected})", message), message
        assert not {"out.ply", "run"}.intersection(os.listdir())
