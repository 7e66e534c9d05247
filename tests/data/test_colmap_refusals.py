"""COLMAP's files read strictly: truncated, damaged, or with values that cannot be."""

import contextlib
import re
import shutil
import struct
import time

import numpy as np
import pytest
from captures import save_photo, scene_of_views, synthetic_model
from hypothesis import given, settings
from hypothesis import strategies as st

from gsjax.data import colmap_binary
from gsjax.data.colmap import load_colmap, read_colmap
from gsjax.data.colmap_writer import write_colmap
from gsjax.errors import InputError

READERS = {
    "cameras": colmap_binary.read_cameras,
    "images": colmap_binary.read_images,
    "points3D": colmap_binary.read_points,
}


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory):
    return synthetic_model(tmp_path_factory.mktemp("synthetic"))


@pytest.mark.parametrize("name", READERS)
def test_every_truncation(synthetic, tmp_path, name):
    data = (synthetic / "bin" / f"{name}.bin").read_bytes()
    path = tmp_path / f"{name}.bin"
    READERS[name](synthetic / "bin" / f"{name}.bin")
    step = 1 if len(data) < 3000 else 7
    for length in [*range(0, len(data), step), len(data) - 1]:
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=rf"{name}\.bin: .*(truncat|damage)"):
            READERS[name](path)
    path.write_bytes(data + b"\0")
    with pytest.raises(InputError, match=r"1 bytes follow the last of"):
        READERS[name](path)


@pytest.mark.parametrize("count", [2**63, 2**64 - 1, 10**12, 10**6])
@pytest.mark.parametrize("name", READERS)
def test_huge_counts(synthetic, tmp_path, name, count):
    data = (synthetic / "bin" / f"{name}.bin").read_bytes()
    path = tmp_path / f"{name}.bin"
    path.write_bytes(struct.pack("<Q", count) + data[8:])
    start = time.perf_counter()
    with pytest.raises(
        InputError, match=rf"{name}\.bin: byte 0: the count says {count}"
    ):
        READERS[name](path)
    assert time.perf_counter() - start < 0.2


def test_huge_inner_counts(tmp_path):
    scene = scene_of_views(2, points=2)
    write_colmap(tmp_path, scene)
    for name, at in (("images", -8), ("points3D", -8), ("points3D", 8 + 43)):
        data = bytearray((tmp_path / f"{name}.bin").read_bytes())
        at = at % len(data)
        data[at : at + 8] = struct.pack("<Q", 2**64 - 1)
        path = tmp_path / "x" / f"{name}.bin"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data)
        with pytest.raises(InputError, match="truncated or damaged"):
            READERS[name](path)


@settings(max_examples=150, deadline=None)
@given(
    st.sampled_from(sorted(READERS)),
    st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255)), max_size=4),
)
def test_damaged_bytes(name, changes):
    folder = damaged_folder()
    data = bytearray((folder / f"{name}.bin").read_bytes())
    for at, value in changes:
        data[at % len(data)] = value
    path = folder / "x.bin"
    path.write_bytes(data)
    with contextlib.suppress(InputError):
        READERS[name](path)


_folders: list = []


def damaged_folder():
    if not _folders:
        pytest.fail("the fixture has not run")
    return _folders[0]


@pytest.fixture(autouse=True, scope="module")
def _made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("damaged")
    write_colmap(folder, scene_of_views(3, points=6))
    _folders.append(folder)
    yield
    _folders.clear()


CAMERA = "1 PINHOLE 640 480 500 510 320 240"
IMAGE = "1 1 0 0 0 0 0 3 1 a.png"
POINT = "7 1 2 3 255 0 9 0.5 1 0 2 5"


def write_text(folder, cameras=CAMERA, images=IMAGE, points=POINT):
    folder.mkdir(exist_ok=True, parents=True)
    contents = {"cameras": cameras, "images": images, "points3D": points}
    for name, text in contents.items():
        if text is not None:
            ends = "\n" * (2 if name == "images" else 1)  # a line of 2D points
            (folder / f"{name}.txt").write_text(text + ends)
    return folder


def test_text_by_hand(tmp_path):
    images = f"# IMAGE_ID\n\n{IMAGE}\n\n2 0 0 0 2 0 0 3 1 sub/a b.png\n1 2 -1 3 4 7\n"
    model = read_colmap(write_text(tmp_path, images=images))
    assert [image.name for image in model.images] == ["a.png", "sub/a b.png"]
    np.testing.assert_array_equal(model.images[1].quat, (0, 0, 0, 1))
    np.testing.assert_array_equal(model.points.xyz, [[1, 2, 3]])
    assert model.points.track_lengths.tolist() == [2]


@pytest.mark.parametrize(
    ("more", "wanted"),
    [
        ({"cameras": "1 PINHOLE 640 480 500"}, r"cameras\.txt: line 1: found 1 param"),
        ({"cameras": "1 PINHOLE 640"}, "line 1: found 3 values, CAMERA_ID"),
        ({"cameras": "-1 PINHOLE 640 480 1 1 1 1"}, "camera id is '-1'; a whole"),
        ({"cameras": "x PINHOLE 640 480 1 1 1 1"}, "camera id is 'x'"),
        ({"cameras": "1 PINHOLE 640 4_8 1 1 1 1"}, "height is '4_8'"),
        ({"cameras": "1 PINHOLE 640 0 500 500 1 1"}, "image size 640 × 0"),
        ({"cameras": "1 PINHOLE 99999999 9 9 9 9 9"}, "image size 99999999 × 9"),
        ({"cameras": "1 PINHOLE 640 480 0 500 1 1"}, "focal lengths 0, 500"),
        ({"cameras": "1 PINHOLE 640 480 1e-300 5 1 1"}, "1: focal lengths 1e-300, 5"),
        ({"cameras": "1 PINHOLE 640 480 5 1e29 1 1"}, "1: focal lengths 5, 1e[+]29"),
        (
            {"cameras": "1 PINHOLE 640 480 5 5 1 -1e29"},
            "1: principal point 1, -1e[+]29",
        ),
        ({"cameras": "1 PINHOLE 640 480 nan 500 1 1"}, "finite numbers are wanted"),
        ({"cameras": "1 PINHOLE 640 480 a 500 1 1"}, "could not convert"),
        ({"cameras": "1 PINHULE 640 480 a 500 1 1"}, "'PINHULE' is unknown"),
        ({"cameras": f"{CAMERA}\n{CAMERA}"}, "line 2: the id 1 is that of another cam"),
        ({"cameras": ""}, "is of camera 1, which the 0 cameras"),
        ({"images": ""}, "the model has no image"),
        ({"images": IMAGE.replace("1 a", "2 a")}, "'a.png' is of camera 2, which"),
        ({"images": "1 1 0 0 0 0 0 3 1"}, "line 1: found 9 values, IMAGE_ID"),
        ({"images": "1 0 0 0 0 0 0 3 1 a.png"}, "quaternion of 'a.png' is zero"),
        ({"images": "1 nan 0 0 0 0 0 3 1 a.png"}, "pose .*finite numbers"),
        ({"images": "1 1 0 0 0 0 inf 3 1 a.png"}, "pose .*finite numbers"),
        ({"images": "1 1 0 0 0 0 1e300 3 1 a.png"}, "pose .*finite numbers"),
        ({"images": f"{IMAGE}\n1 2"}, "line 2: 2 values, the last '2'; X Y POINT3D_ID"),
        ({"images": f"{IMAGE}\n\n{IMAGE}\n"}, "line 3: the id 1 is that of another im"),
        ({"images": IMAGE + "x" * 1100}, "a name of more than 1024 bytes"),
        ({"points": "7 1 2 3 255 0 9"}, "line 1: found 7 values, POINT3D_ID"),
        ({"points": "7 1 2 3 256 0 9 0.5"}, "colour .*whole numbers from 0 to 255"),
        ({"points": "7 1 2 3 1.5 0 9 0.5"}, "colour"),
        ({"points": "7 1 2 3 nan 0 9 0.5"}, "colour"),
        ({"points": "7 1 2 nan 0 0 9 0.5"}, "1 of 1 points have .*: point \\[7\\]"),
        ({"points": f"{POINT} 3"}, "the track has 5 values"),
        ({"points": f"{POINT}\n{POINT}"}, r"1 points have an id .*: \[7\]"),
    ],
)
def test_bad_values(tmp_path, more, wanted):
    with pytest.raises(InputError, match=wanted):
        read_colmap(write_text(tmp_path, **more))


def test_bad_values_in_binary(tmp_path):
    scene = scene_of_views(2, points=3)
    write_colmap(tmp_path, scene)
    good = {p.stem: p.read_bytes() for p in tmp_path.glob("*.bin")}
    nan, zero = struct.pack("<d", np.nan), bytes(8)
    image = 4 + 7 * 8 + 4 + len("view_00.png") + 1 + 8
    cases = [
        ("cameras", 8 + 4, struct.pack("<i", 99), "camera 0 .byte 8.*model 99 is unk"),
        ("cameras", 8 + 4, struct.pack("<i", 7), "FOV is not supported"),
        ("cameras", 8 + 8, zero, "image size 0 × 24"),
        ("cameras", 8 + 24, nan, "finite numbers are wanted"),
        ("cameras", 8 + 24, struct.pack("<d", -1), "focal lengths -1, 42"),
        ("cameras", 8 + 56, good["cameras"][8:12], "camera 1 .byte 64.: the id 1"),
        ("images", 8 + 4, nan, r"image 0 \(byte 8\): pose .* of 'view_00.png'"),
        ("images", 8 + 4, 4 * zero, "quaternion of 'view_00.png' is zero"),
        ("images", 8 + 60, struct.pack("<I", 9), "is of camera 9, which the 2"),
        ("images", 8 + image, struct.pack("<I", 1), "image 1 .*the id 1 is that"),
        ("images", 8 + 64, b"\xff\xfe", r"its name b'\\xff\\xfe.* is not UTF-8"),
        ("points3D", 8 + 8, nan, r"1 of 3 points have .*point \[1\]"),
        ("points3D", 8 + 51, struct.pack("<Q", 1), r"1 points have an id .*\[1\]"),
    ]
    for name, at, value, wanted in cases:
        for stem, data in good.items():
            (tmp_path / f"{stem}.bin").write_bytes(data)
        data = bytearray(good[name])
        data[at : at + len(value)] = value
        (tmp_path / f"{name}.bin").write_bytes(data)
        with pytest.raises(InputError, match=wanted):
            read_colmap(tmp_path)


def test_unending_names(tmp_path):
    write_colmap(tmp_path, scene_of_views(2))
    data = (tmp_path / "images.bin").read_bytes()
    at = data.index(b"view_00.png\0")
    path = tmp_path / "x.bin"
    path.write_bytes(data[:at] + b"x" * 5000 + data[at:])
    with pytest.raises(InputError, match="has no end within 1024 bytes"):
        colmap_binary.read_images(path)


@pytest.mark.parametrize(
    "name", ["../a.png", "/etc/passwd", "a/../../b.png", "C:\\a.png", "..\\a.png", "."]
)
def test_names_that_leave_the_folder(tmp_path, name):
    folder = write_text(tmp_path / "sparse/0", images=IMAGE.replace("a.png", name))
    (tmp_path / "images").mkdir()
    save_photo(tmp_path / "a.png")
    wanted = rf"{re.escape(str(folder))}: the name .* within the dataset's folder"
    for skip_missing in (False, True):
        with pytest.raises(InputError, match=wanted):
            load_colmap(tmp_path, skip_missing=skip_missing)


def test_truncated_text_is_warned_of(synthetic, tmp_path):
    for name in ("images", "points3D"):
        shutil.copytree(synthetic / "txt", tmp_path, dirs_exist_ok=True)
        lines = (tmp_path / f"{name}.txt").read_text().splitlines(keepends=True)
        (tmp_path / f"{name}.txt").write_text("".join(lines[:-4]))
        with pytest.warns(UserWarning, match=rf"{name}\.txt: a comment says \d+ "):
            read_colmap(tmp_path)


def test_binary_in_a_text_file(tmp_path):
    write_text(tmp_path)
    (tmp_path / "cameras.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"cameras\.txt: after line 0: not UTF-8"):
        read_colmap(tmp_path)


def test_many_points_are_read_fast(tmp_path):
    count = 200_000
    kinds = [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8")]
    table = np.zeros(count, np.dtype([*kinds, ("n", "<u8"), ("track", "<u4", 6)]))
    rng = np.random.default_rng(0)
    table["id"], table["n"] = rng.permutation(count), 3
    table["xyz"] = rng.normal(size=(count, 3))
    path = tmp_path / "points3D.bin"
    path.write_bytes(struct.pack("<Q", count) + table.tobytes())
    start = time.perf_counter()
    points = colmap_binary.read_points(path)
    assert time.perf_counter() - start < 3
    order = np.argsort(table["id"])
    np.testing.assert_array_equal(points.xyz, table["xyz"][order])
    assert (points.track_lengths == 3).all()
