"""Bad files: a typed error that names file, place and remedy, soon, and one line."""

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
from bad_files import BAD, CAMERAS, IMAGES, LEAVING, POINTS, swap
from captures import scene_of_views
from good_files import READ, STEP, TEXT, write_good_files

from gsjax.cli.main import main
from gsjax.data import colmap_binary, colmap_text
from gsjax.data.colmap import load_colmap
from gsjax.data.colmap_writer import write_colmap
from gsjax.data.dataset import load_dataset
from gsjax.errors import InputError
from gsjax.io.point_cloud import read_point_cloud
from gsjax.runs.history import read_metrics

REMEDY = re.compile(
    "wanted|pass|export|copy|remove|convert|check|put|train|supported|undistort|choose|"
    "repair|known|allowed|write|exactly|make it|are read|rename|keep|estimate"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """With a good file of every format."""
    folder = tmp_path_factory.mktemp("good")
    write_good_files(folder)
    return folder


@contextmanager
def replaced(path: Path, data: bytes):
    """Within, the file holds other bytes."""
    good = path.read_bytes()
    path.write_bytes(data)
    try:
        yield
    finally:
        path.write_bytes(good)


def test_the_good_files_are_read(folder):
    for name, read in READ.items():
        read(folder / name)


# --- damaged in a way that has a name ---


def refusal(read, path: Path, most: float = np.inf) -> str:
    """The message; that it comes soon, and before memory is taken, is checked."""
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
    return str(caught.value)


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_by_name(folder, name):
    file, change, wanted = BAD[name]
    path = folder / file
    data = change(path.read_bytes())
    with replaced(path, data):
        # What is read, what is made of it, and the pieces in which it is read.
        told = refusal(READ[file], path, most=2 * len(data) + 3e6)
    assert str(path) in told or str(path.parent) in told
    assert re.search(wanted, told), told
    assert REMEDY.search(told), told


def test_there_are_enough_classes():
    assert len(BAD) >= 33
    assert {bad.file for bad in BAD.values()} == set(READ)


@pytest.mark.parametrize("name", READ)
def test_what_is_no_regular_file_is_not_waited_for(folder, tmp_path, name):
    for good in ("photo.png", "config.json"):  # of what is read beside it
        shutil.copy(folder / good, tmp_path)
    path = tmp_path / Path(name).name
    path.unlink(missing_ok=True)
    path.mkdir()
    told = [refusal(READ[name], path)]
    path.rmdir()
    if hasattr(os, "mkfifo"):
        os.mkfifo(path)
        told.append(refusal(READ[name], path))
        path.unlink()
    if name != "eval.json":  # need not be there
        path.symlink_to(path)
        told.append(refusal(READ[name], path))
    for message in told:
        assert path.name in message or str(path.parent) in message


# --- cut short ---


@pytest.mark.parametrize("name", READ)
def test_every_prefix_is_refused(folder, name):
    path, read = folder / name, READ[name]
    whole = path.read_bytes()
    end = len(whole.rstrip(b"\n")) if name.endswith(".json") else len(whole)
    longest = 0.0
    with replaced(path, whole):
        for length in reversed(range(end)):
            os.truncate(path, length)
            begun = time.perf_counter()
            try:
                read(path)
                pytest.fail(f"{length} of {len(whole)} bytes are taken")
            except InputError as error:
                told = str(error)
            except UserWarning as warning:
                assert name in TEXT
                told = str(warning)
            longest = max(longest, time.perf_counter() - begun)
            assert path.name in told or str(path.parent) in told
    assert longest < 1


def test_a_log_cut_short_is_what_was_whole(tmp_path):
    path = tmp_path / "metrics.jsonl"
    record = {"step": 1, "seconds": 0.5, "psnr": None, "gaussians": 5}
    lines = [json.dumps({**record, "step": step}) + "\n" for step in (1, 2, 3)]
    whole = "".join(lines).encode()
    for length in range(len(whole) + 1):
        path.write_bytes(whole[:length])
        found = [line["step"] for line in read_metrics(path)]
        ends = np.cumsum([len(line) - 1 for line in lines]) + (0, 1, 2)
        assert found == [1, 2, 3][: int((ends <= length).sum())]
    for bad in (b"\xff\0\0", b"[" * 200_000, b'{"step": "1"}', b"3"):
        path.write_bytes(bad + b"\n" + whole)
        with pytest.warns(UserWarning, match="1 of 4 lines .* the first: line 1"):
            assert [line["step"] for line in read_metrics(path)] == [1, 2, 3]
        path.write_bytes(bad + b"\n")
        with pytest.warns(UserWarning, match="1 of 1 lines are no records"):
            assert read_metrics(path) == []


# --- names of COLMAP, and of files in general ---


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "a/" + "b" * 300])
def test_names_in_a_model_do_not_leave_its_folder(folder, name):
    path = folder / IMAGES
    change = swap("view_00.png", name)
    with replaced(path, change(path.read_bytes())):
        for read in (load_dataset, load_colmap):
            told = refusal(read, folder)
            assert re.search(f"{LEAVING}|has 30. bytes", told)


def test_memory_of_what_is_good(tmp_path, report):
    """Twice the file, and pieces of it: nothing is held in a wider form as a whole."""
    rng = np.random.default_rng(0)
    count = 60_000
    scene = scene_of_views(points=5 * count)
    write_colmap(tmp_path, scene)
    rows = [
        f"{i} {x:.6f} {y:.6f} {z:.6f} 1 2 3 0.5 1 0 2 1 3 5 4 {i} 5 {i} 6 {i} 7 {i}\n"
        for i, (x, y, z) in enumerate(scene.points[:count])
    ]
    (tmp_path / "points3D.txt").write_text("".join(rows))
    table = rng.normal(size=(9 * count, 3)).astype("<f4").tobytes()
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {9 * count}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    (tmp_path / "cloud.ply").write_bytes(head.encode() + table)
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


# --- on the command line ---


MODEL = [CAMERAS, IMAGES, POINTS]
TEXTS = [name for name in READ if name.startswith("text/")]
PHOTOS = [name for name in READ if name.startswith("photo.")]
# A command that reads each of the files.
COMMANDS = {
    "scene.ply": ["info", "scene.ply"],
    "scene.spz": ["info", "scene.spz"],
    "ascii.ply": ["export", "ascii.ply", "out.ply"],
    "cloud.ply": ["train", "with_cloud.json", "-o", "run"],
    **{name: ["train", ".", "-o", "run"] for name in MODEL},
    **{name: ["train", "text", "-o", "run"] for name in TEXTS},
    "transforms.json": ["train", "transforms.json", "-o", "run"],
    "poses_bounds.npy": ["train", "poses_bounds.npy", "-o", "run"],
    **{name: ["train", f"of_{name}.json", "-o", "run"] for name in PHOTOS},
    "mask.png": ["train", "masked.json", "-o", "run"],
    STEP: ["train", ".", "-o", ".", "--resume"],
    "config.json": ["info", "."],
    "eval.json": ["info", "."],
    "cameras.json": ["eval", "."],
}


@pytest.fixture(scope="module")
def datasets(folder) -> Path:
    """The good files, with datasets that name those which are no dataset."""
    shutil.copy(folder / "photo.png", folder / "a.png")
    frame = {"transform_matrix": np.eye(4).tolist()}
    top = {"w": 8, "h": 6, "fl_x": 8}

    def write(name, photo, **more):
        frames = [{**frame, "file_path": file} for file in ("a.png", photo)]
        frames[1] |= more.pop("frame", {})
        (folder / name).write_text(json.dumps({**top, **more, "frames": frames}))

    for name in PHOTOS:
        shutil.copy(folder / name, folder / f"b_{name}")
        write(f"of_{name}.json", name)
    write("masked.json", "b_photo.png", frame={"mask_path": "mask.png"})
    write("with_cloud.json", "b_photo.png", ply_file_path="cloud.ply")
    shutil.copytree(folder / "images", folder / "text" / "images")
    return folder


@pytest.mark.parametrize("name", BAD)
def test_the_command_line_tells_in_one_line(datasets, name, capfd, monkeypatch):
    monkeypatch.chdir(datasets)
    file, change, wanted = BAD[name]
    with replaced(datasets / file, change((datasets / file).read_bytes())):
        code = main.main(COMMANDS[file])
    said = capfd.readouterr()
    assert code == 3, said
    assert said.out == ""
    *before, told = [line for line in said.err.splitlines() if line]
    assert told.startswith("gsjax: error: ")
    late = file in (*PHOTOS, "mask.png")  # looked at when all else is known
    assert len(before) == 2 * late, before  # views, memory
    assert re.search(wanted, told), told
    assert not (datasets / "out.ply").exists()
    assert not (datasets / "run").exists()
