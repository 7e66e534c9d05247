"""LLFF's poses_bounds.npy: axes, sizes, and rejected files."""

import warnings

import numpy as np
import pytest
from captures import SIZE, llff_dataset, rejects, save_photo

from gsjax.data.dataset import load_dataset
from gsjax.data.llff import read_poses


def test_known_poses(tmp_path):
    made = llff_dataset(tmp_path)
    # macOS puts a hidden file beside each one that it copies to a foreign disk.
    (tmp_path / "images/._IMG_9.JPG").write_bytes(b"\0\5\x16\7")
    (tmp_path / "images/notes.txt").write_text("not a photograph")
    dataset = load_dataset(tmp_path)
    assert dataset.format == "llff"
    assert [v.name for v in dataset.views] == [f"IMG_{n}.JPG" for n in (6, 7, 8, 9)]
    for view, given in zip(dataset.views, made.views):
        np.testing.assert_allclose(view.viewmat, given.viewmat, atol=1e-14)
        assert np.linalg.det(view.viewmat) > 0.999
        assert (view.width, view.height) == SIZE
        np.testing.assert_array_equal(view.K, [[40, 0, 16], [0, 40, 12], [0, 0, 1]])
    assert dataset.points.shape == (0, 3)
    np.testing.assert_array_equal(dataset.origin, 0)
    assert len(load_dataset(tmp_path / "poses_bounds.npy").views) == 4


def test_a_camera_at_the_origin(tmp_path):
    # Down, right, back = −y, x, z: OpenGL's camera at the origin, looking along −z.
    row = [0, 1, 0, 0, 24, -1, 0, 0, 0, 32, 0, 0, 1, 0, 40, 1, 2]
    np.save(tmp_path / "poses_bounds.npy", np.asarray([row], np.float64))
    save_photo(tmp_path / "images" / "a.png")
    [view] = load_dataset(tmp_path).views
    np.testing.assert_allclose(view.viewmat, np.diag([1, -1, -1, 1]), atol=1e-15)


def test_smaller_copies(tmp_path):
    llff_dataset(tmp_path, size=(4 * SIZE[0], 4 * SIZE[1]), focal=160.0)
    for index in range(4):
        save_photo(tmp_path / "images_4" / f"image{index:03d}.png")
    dataset = load_dataset(tmp_path, factor=4)
    assert dataset.views[0].name == "image000.png"
    assert (dataset.views[0].width, dataset.views[0].K[0, 0]) == (128, 160)
    rejects(r"images_8: no such folder.* factor=4 ", load_dataset, tmp_path, factor=8)
    for name in ("images_16", "images_old", "images_8", "images_1"):
        (tmp_path / name).mkdir()
    (tmp_path / "images").rename(tmp_path / "originals")
    expected = r"images: no such folder.*pass factor=4 \(--factor 4\), as images_4 is"
    rejects(expected, load_dataset, tmp_path)


def change(index, value):
    def edit(rows):
        rows[index] = value
        return rows

    return edit


def mirror(rows):
    rows[:, [0, 5, 10]] *= -1
    return rows


@pytest.mark.parametrize(
    ("edit", "expected"),
    [
        (change((2, 3), np.nan), "row 2: expected finite numbers"),
        (change((2, 3), 1e35), "row 2: expected finite numbers"),
        (change((2, 4), 0), "row 2: .* got 0, 32"),
        (change((2, 9), 3.5), "row 2: .* got 24, 3.5"),
        (change((2, 14), -1), "row 2: .*focal lengths .* got -1, -1"),
        (change((2, 14), 1e20), "row 2: .*focal lengths .* got 1e[+]20"),
        (change((2, 0), 9.0), "row 2: expected a rotation"),
        (mirror, "row 0: .*reflection"),
        (lambda rows: rows[:3], "expected 3 photographs in .*images, .* got 4"),
        (lambda rows: rows[:, :15], r"\[4, 15\]"),
    ],
)
def test_bad_values(tmp_path, edit, expected):
    llff_dataset(tmp_path)
    path = tmp_path / "poses_bounds.npy"
    np.save(path, edit(np.load(path)))
    rejects(rf"poses_bounds\.npy: .*{expected}", load_dataset, tmp_path)


def test_no_rows(tmp_path):
    np.save(tmp_path / "poses_bounds.npy", np.zeros((0, 17)))
    (tmp_path / "images").mkdir()
    rejects("expected at least 1 view, got none", load_dataset, tmp_path)


@pytest.mark.parametrize("dtype", ["<f8", ">f8", "<f4"])
@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
def test_forms_of_the_file(tmp_path, dtype, order, version):
    table = np.random.default_rng(0).normal(size=(5, 17)).astype("<f4").astype(dtype)
    path = tmp_path / "a.npy"
    with path.open("wb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of versions that old NumPy does not read
        array = np.asarray(table, order=order)
        np.lib.format.write_array(file, array, version=version)
    found = read_poses(path)
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, np.load(path))
    path.write_bytes(path.read_bytes() + b"\0")
    rejects("header", read_poses, path)
