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
from bad_files import BAD, CAMERAS, IMAGES, LEAVING, POINTS, swap
from captures import dataset_of_views
from good_files import READ, STEP, TEXT, write_good_files

from gsjax.cli.main import main
from gsjax.data import colmap_binary, colmap_text
from gsjax.data.colmap_writer import write_colmap
from gsjax.data.dataset import load_dataset
from gsjax.errors import InputError
from gsjax.io.point_cloud import read_point_cloud
from gsjax.runs.history import read_metrics

REMEDY = re.compile(
    "pass|export|copy|remove|convert|check|put|train|supported|undistort|choose|repair|"
    "allowed|write|make|rename|keep|estimate|use|flip|replace|transpose|expected|wanted"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with a good file of every format."""
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


def test_good_files_are_read(folder):
    for name, read in READ.items():
        read(folder / name)


# --- damaged files ---


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
    return str(caught.value)


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_rejected(folder, name):
    file, change, expected = BAD[name]
    path = folder / file
    data = change(path.read_bytes())
    with replaced(path, data):
        # The file, its parsed content, and the blocks in which it is parsed.
        message = refusal(READ[file], path, most=2 * len(data) + 3e6)
    assert str(path) in message or str(path.parent) in message
    assert re.search(expected, message), message
    assert REMEDY.search(message), message


def test_every_format_has_bad_files():
    assert {bad.file for bad in BAD.values()} == set(READ)


@pytest.mark.parametrize("name", READ)
def test_irregular_files_are_rejected_at_once(folder, tmp_path, name):
    """Folders, pipes, which may never end, and links to themselves."""
    for good in ("photo.png", "config.json"):  # read beside it
        shutil.copy(folder / good, tmp_path)
    path = tmp_path / Path(name).name
    path.unlink(missing_ok=True)
    path.mkdir()
    messages = [refusal(READ[name], path)]
    path.rmdir()
    if hasattr(os, "mkfifo"):
        os.mkfifo(path)
        messages.append(refusal(READ[name], path))
        path.unlink()
    if name != "eval.json":  # may be absent
        path.symlink_to(path)
        messages.append(refusal(READ[name], path))
    for message in messages:
        assert path.name in message or str(path.parent) in message


# --- truncated files ---


@pytest.mark.parametrize("name", READ)
def test_every_prefix_is_rejected(folder, name):
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
                pytest.fail(f"{length} of {len(whole)} bytes are accepted")
            except InputError as error:
                message = str(error)
            except UserWarning as warning:
                assert name in TEXT
                message = str(warning)
            longest = max(longest, time.perf_counter() - begun)
            assert path.name in message or str(path.parent) in message
    assert longest < 1


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
        path.write_bytes(bad + b"\n" + whole)
        with pytest.warns(UserWarning, match="1 of 4 lines"):
            assert [line["step"] for line in read_metrics(path)] == [1, 2, 3]
        path.write_bytes(bad + b"\n")
        with pytest.warns(UserWarning, match="1 of 1 lines"):
            assert read_metrics(path) == []


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "a/" + "b" * 300])
def test_names_in_a_model_do_not_leave_its_folder(folder, name):
    path = folder / IMAGES
    with replaced(path, swap("view_00.png", name)(path.read_bytes())):
        assert re.search(f"{LEAVING}|of 30. and", refusal(load_dataset, folder))


def test_memory_of_good_files(tmp_path, report):
    """At most twice the file, and some blocks of it."""
    count = 60_000
    dataset = dataset_of_views(points=2 * count)
    write_colmap(tmp_path, dataset)
    rows = [
        f"{i} {x:.6f} {y:.6f} {z:.6f} 1 2 3 0.5 1 0 2 1 3 5 4 {i} 5 {i} 6 {i} 7 {i}\n"
        for i, (x, y, z) in enumerate(dataset.points[:count])
    ]
    (tmp_path / "points3D.txt").write_text("".join(rows))
    table = np.random.default_rng(0).normal(size=(9 * count, 3)).astype("<f4")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {9 * count}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    (tmp_path / "cloud.ply").write_bytes(head.encode() + table.tobytes())
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


# --- the command line ---


TEXTS = [name for name in READ if name.startswith("text/")]
PHOTOS = [name for name in READ if name.startswith("photo.")]
# A command that reads each of the files.
COMMANDS = {
    "scene.ply": ["info", "scene.ply"],
    "scene.spz": ["info", "scene.spz"],
    "ascii.ply": ["export", "ascii.ply", "out.ply"],
    "cloud.ply": ["train", "with_cloud.json", "-o", "run"],
    **{name: ["train", ".", "-o", "run"] for name in (CAMERAS, IMAGES, POINTS)},
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


@pytest.mark.parametrize("file", COMMANDS)
def test_the_command_line_reports_in_one_line(datasets, file, capfd, monkeypatch):
    """The first and the last bad file of each format; the message is the library's."""
    monkeypatch.chdir(datasets)
    bad = [bad for bad in BAD.values() if bad.file == file]
    for _, change, expected in bad[:1] + bad[1:][-1:]:
        with replaced(datasets / file, change((datasets / file).read_bytes())):
            code = main(COMMANDS[file])
        output = capfd.readouterr()
        assert code == 3, output
        assert output.out == ""
        *before, message = [line for line in output.err.splitlines() if line]
        assert message.startswith("gsjax: error: ")
        late = file in (*PHOTOS, "mask.png")  # read after everything else
        assert len(before) == 2 * late, before  # views, memory
        assert re.search(expected, message), message
        assert not (datasets / "out.ply").exists()
        assert not (datasets / "run").exists()
