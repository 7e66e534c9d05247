"""COLMAP's files parsed strictly: truncated, damaged, or with impossible values.

`tests/stress/test_bad_files.py` has the classes that all formats share.
"""

import contextlib
import shutil
import struct
import time

import numpy as np
import pytest
from captures import dataset_of_views, rejects, synthetic_model, warned
from hypothesis import given, settings
from hypothesis import strategies as st

from gsjax.data import colmap_binary
from gsjax.data.colmap import read_colmap
from gsjax.data.colmap_writer import write_colmap
from gsjax.errors import InputError

READERS = {
    "cameras": colmap_binary.read_cameras,
    "images": colmap_binary.read_images,
    "points3D": colmap_binary.read_points,
}


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory):
    """A model with tracks and 2D points, which our writer does not write."""
    return synthetic_model(tmp_path_factory.mktemp("synthetic"))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("written")
    write_colmap(folder, dataset_of_views(2, points=3))
    return folder


@pytest.mark.parametrize("name", READERS)
def test_truncations_and_huge_counts(synthetic, tmp_path, name):
    data = (synthetic / "bin" / f"{name}.bin").read_bytes()
    path = tmp_path / f"{name}.bin"
    READERS[name](synthetic / "bin" / f"{name}.bin")
    for length in [*range(0, len(data), len(data) // 150 | 1), len(data) - 1]:
        path.write_bytes(data[:length])
        rejects(rf"{name}\.bin: .*(truncat|damage)", READERS[name], path)
    path.write_bytes(data + b"\0")
    rejects(r"1 bytes follow the last of", READERS[name], path)
    for count in (2**63, 2**64 - 1, 10**12, 10**6):
        path.write_bytes(struct.pack("<Q", count) + data[8:])
        begun = time.perf_counter()
        rejects(f"byte 0: the count says {count}", READERS[name], path)
        assert time.perf_counter() - begun < 0.2


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from(sorted(READERS)),
    st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=4),
)
def test_damaged_bytes_raise_nothing_else(written, name, changes):
    data = bytearray((written / f"{name}.bin").read_bytes())
    for at, value in changes:
        data[at % len(data)] = value
    path = written / "x.bin"
    path.write_bytes(data)
    with contextlib.suppress(InputError):
        READERS[name](path)


CAMERA = "1 PINHOLE 640 480 500 510 320 240"
IMAGE = "1 1 0 0 0 0 0 3 1 a.png"
POINT = "7 1 2 3 255 0 9 0.5 1 0 2 5"


def write_text(folder, cameras=CAMERA, images=IMAGE, points=POINT):
    folder.mkdir(exist_ok=True, parents=True)
    contents = {"cameras": cameras, "images": images, "points3D": points}
    for name, text in contents.items():
        ends = "\n" * (2 if name == "images" else 1)  # a line of 2D points
        (folder / f"{name}.txt").write_text(text + ends)
    return folder


def test_text_written_by_hand(tmp_path):
    images = f"# IMAGE_ID\n\n{IMAGE}\n\n2 0 0 0 2 0 0 3 1 sub/a b.png\n1 2 -1 3 4 7\n"
    model = read_colmap(write_text(tmp_path, images=images))
    assert [image.name for image in model.images] == ["a.png", "sub/a b.png"]
    np.testing.assert_array_equal(model.images[1].quat, (0, 0, 0, 1))
    np.testing.assert_array_equal(model.points.xyz, [[1, 2, 3]])
    assert model.points.track_lengths.tolist() == [2]


@pytest.mark.parametrize(
    ("file", "text", "expected"),
    [
        ("cameras", "1 PINHOLE 640", "line 1: expected CAMERA_ID .* got 3 values"),
        ("cameras", "-1 PINHOLE 640 480 1 1 1 1", "whole .* camera id, got '-1'"),
        ("cameras", "1 PINHOLE 99999999 9 9 9 9 9", "got 99999999 × 9"),
        ("cameras", "1 PINHOLE 640 480 1e-300 5 1 1", "got 1e-300, 5"),
        ("cameras", "1 PINHOLE 640 480 5 1e29 1 1", "got 5, 1e[+]29"),
        ("cameras", "1 PINHOLE 640 480 5 5 1 -1e29", "principal .* got 1, -1e[+]29"),
        ("cameras", "1 PINHOLE 640 480 nan 500 1 1", "expected finite parameters"),
        ("cameras", "1 PINHULE 640 480 a 500 1 1", "unknown camera model 'PINHULE'"),
        ("cameras", f"{CAMERA}\n{CAMERA}", "line 2: the id 1 is that of another cam"),
        ("cameras", "", "refers to camera 1, which is not among the 0 cameras"),
        ("images", "", "the model has no image"),
        ("images", IMAGE.replace("1 a", "2 a"), "'a.png' refers to camera 2, which"),
        ("images", f"{IMAGE}\n\n{IMAGE}\n", "line 3: the id 1 is that of another im"),
        ("images", IMAGE + "x" * 1100, "expected a name of at most 1024 bytes"),
        ("points", "7 1 2 3 255 0 9", "line 1: expected POINT3D_ID .* got 7 values"),
        ("points", "7 1 2 3 nan 0 9 0.5", "expected a colour"),
        ("points", "7 1 2 nan 0 0 9 0.5", "1 of 1 points have .*: point \\[7\\]"),
        ("points", f"{POINT}\n{POINT}", r"1 points have the id .*: \[7\]"),
    ],
)
def test_bad_text(tmp_path, file, text, expected):
    rejects(expected, read_colmap, write_text(tmp_path, **{file: text}))


@pytest.mark.parametrize("name", ["images", "points3D"])
def test_truncated_text_gives_a_warning(synthetic, tmp_path, name):
    shutil.copytree(synthetic / "txt", tmp_path, dirs_exist_ok=True)
    lines = (tmp_path / f"{name}.txt").read_text().splitlines(keepends=True)
    (tmp_path / f"{name}.txt").write_text("".join(lines[:-4]))
    warned(rf"{name}\.txt: a comment says \d+ ", read_colmap, tmp_path)
