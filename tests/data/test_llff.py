"""LLFF's poses_bounds.npy: axes, sizes, and what is refused."""

import struct
import time
import warnings

import numpy as np
import pytest
from captures import SIZE, save_photo, scene_of_views

from gsjax.data.dataset import load_dataset
from gsjax.data.llff import load_llff, read_poses
from gsjax.errors import InputError


def rows_of(scene, size=SIZE, focal=40.0):
    """[N, 17] of the views of a scene, by the definition of the format."""
    rows = []
    for view in scene.views:
        right, down, forward = view.viewmat[:3, :3]
        matrix = np.zeros((3, 5))
        matrix[:, :3] = np.stack([down, right, -forward], -1)
        matrix[:, 3] = view.centre
        matrix[:, 4] = size[1], size[0], focal
        rows.append([*matrix.ravel(), 1.5, 20.0])
    return np.asarray(rows)


def dataset(folder, count=4, **more):
    scene = scene_of_views(count)
    np.save(folder / "poses_bounds.npy", rows_of(scene, **more))
    for index in range(count):
        save_photo(folder / "images" / f"IMG_{9 - index}.JPG")
    return scene


def test_known_poses(tmp_path):
    made = dataset(tmp_path)
    scene = load_dataset(tmp_path)
    assert scene.format == "llff"
    assert [v.name for v in scene.views] == [f"IMG_{n}.JPG" for n in (6, 7, 8, 9)]
    for view, wanted in zip(scene.views, made.views):
        np.testing.assert_allclose(view.viewmat, wanted.viewmat, atol=1e-14)
        assert np.linalg.det(view.viewmat) > 0.999
        assert (view.width, view.height) == SIZE
        np.testing.assert_array_equal(view.K, [[40, 0, 16], [0, 40, 12], [0, 0, 1]])
    assert scene.points.shape == (0, 3)
    np.testing.assert_array_equal(scene.origin, 0)


def test_what_is_hidden_is_no_photograph(tmp_path):
    """macOS puts a file beside each one that it copies to a disk of another kind."""
    dataset(tmp_path)
    for index in range(4):
        (tmp_path / "images" / f"._IMG_{9 - index}.JPG").write_bytes(b"\0\5\x16\7")
    assert len(load_dataset(tmp_path).views) == 4


def test_a_camera_at_rest(tmp_path):
    # Down, right, back = −y, x, z: OpenGL's camera at the origin, looking along −z.
    row = [0, 1, 0, 0, 24, -1, 0, 0, 0, 32, 0, 0, 1, 0, 40, 1, 2]
    np.save(tmp_path / "poses_bounds.npy", np.asarray([row], np.float64))
    save_photo(tmp_path / "images" / "a.png")
    [view] = load_dataset(tmp_path).views
    np.testing.assert_allclose(view.viewmat, np.diag([1, -1, -1, 1]), atol=1e-15)


def test_smaller_copies(tmp_path):
    dataset(tmp_path, size=(4 * SIZE[0], 4 * SIZE[1]), focal=160.0)
    for index in range(4):
        save_photo(tmp_path / "images_4" / f"image{index:03d}.png")
    scene = load_dataset(tmp_path, factor=4)
    assert scene.views[0].name == "image000.png"
    assert (scene.views[0].width, scene.views[0].K[0, 0]) == (128, 160)
    with pytest.raises(InputError, match=r"images_8: no such folder.* factor=4 "):
        load_dataset(tmp_path, factor=8)


def test_a_factor_that_is_there_is_offered(tmp_path):
    dataset(tmp_path)
    for name in ("images_16", "images_old", "images_8", "images_1"):
        (tmp_path / name).mkdir()
    (tmp_path / "images").rename(tmp_path / "images_4")
    wanted = (
        r"images: no such folder.*pass factor=4 \(--factor 4\), as images_4 is there"
    )
    with pytest.raises(InputError, match=wanted):
        load_dataset(tmp_path)
    assert len(load_dataset(tmp_path, factor=4).views) == 4


def test_number_of_photographs(tmp_path):
    dataset(tmp_path)
    (tmp_path / "images" / "notes.txt").write_text("not a photograph")
    load_dataset(tmp_path / "poses_bounds.npy")
    save_photo(tmp_path / "images" / "more.png")
    with pytest.raises(InputError, match=r"4 rows, but .*images has 5 photographs"):
        load_dataset(tmp_path)


@pytest.mark.parametrize(
    ("column", "value", "wanted"),
    [
        (3, np.nan, "row 2: values that are no finite numbers"),
        (3, 1e35, "row 2: values that are no finite numbers"),
        (4, 0, "row 2: height 0, width 32"),
        (9, 3.5, "width 3.5"),
        (14, -1, "row 2: focal lengths -1, -1"),
        (14, 1e20, "row 2: focal lengths 1e[+]20"),
        (0, 9.0, "row 2: the 3 × 3 part .* is no rotation"),
    ],
)
def test_bad_values(tmp_path, column, value, wanted):
    dataset(tmp_path)
    rows = np.load(tmp_path / "poses_bounds.npy")
    rows[2, column] = value
    np.save(tmp_path / "poses_bounds.npy", rows)
    with pytest.raises(InputError, match=rf"poses_bounds\.npy: .*{wanted}"):
        load_dataset(tmp_path)


def test_mirrored(tmp_path):
    dataset(tmp_path)
    rows = np.load(tmp_path / "poses_bounds.npy")
    rows[:, [0, 5, 10]] *= -1
    np.save(tmp_path / "poses_bounds.npy", rows)
    with pytest.raises(InputError, match=r"row 0: .*mirrors"):
        load_dataset(tmp_path)


# --- the file ---


@pytest.mark.parametrize("dtype", ["<f8", ">f8", "<f4"])
@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
def test_forms(tmp_path, dtype, order, version):
    table = np.random.default_rng(0).normal(size=(5, 17)).astype("<f4").astype(dtype)
    path = tmp_path / "a.npy"
    with path.open("wb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of versions that old NumPy does not read
        array = np.asarray(table, order=order)
        np.lib.format.write_array(file, array, version=version)
    found = read_poses(path)
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, np.load(path))


def test_every_truncation(tmp_path):
    dataset(tmp_path)
    path = tmp_path / "poses_bounds.npy"
    data = path.read_bytes()
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"poses_bounds\.npy: "):
            read_poses(path)
    path.write_bytes(data + b"\0")
    with pytest.raises(InputError, match="545 bytes follow the header"):
        read_poses(path)


def npy(header: str, body: bytes = bytes(17 * 8)) -> bytes:
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header.encode() + body


@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f8', 'fortran_order': False, 'shape': (999999999, 17), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (2, 17), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1, 15), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (17,), }",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1, 17), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 17), }",
        "{'descr': '<f8', 'shape': (1, 17), }",
        "(" * 3000,
        "",
    ],
)
def test_bad_headers(tmp_path, header):
    path = tmp_path / "poses_bounds.npy"
    path.write_bytes(npy(header))
    start = time.perf_counter()
    with pytest.raises(InputError, match=r"poses_bounds\.npy: .*(header|truncated)"):
        read_poses(path)
    assert time.perf_counter() - start < 0.2


def test_other_files(tmp_path):
    path = tmp_path / "poses_bounds.npy"
    with pytest.raises(InputError, match="cannot be read: No such file"):
        load_llff(path)
    path.write_bytes(b"PK\3\4 a zip")
    with pytest.raises(InputError, match=r"which is no \.npy file"):
        load_llff(path)
    np.save(path, np.zeros((0, 17)))
    (tmp_path / "images").mkdir()
    with pytest.raises(InputError, match="no view is left"):
        load_dataset(tmp_path)
