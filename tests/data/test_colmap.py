"""COLMAP models: files parsed strictly, equal to pycolmap's, and as datasets.

`tests/stress/test_bad_files.py` has the refusals that all formats share.
"""

import contextlib
import shutil
import struct
import time
import unicodedata
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import (
    SIZE,
    colmap_dataset,
    dataset_of_views,
    rejects,
    save_photo,
    warned,
    with_names,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from gsjax.cameras.distortion import Distortion, project_points
from gsjax.data import colmap_binary, colmap_text
from gsjax.data.colmap import find_colmap, load_colmap, read_colmap
from gsjax.data.colmap_model import CAMERA_KINDS, viewmat_of
from gsjax.data.colmap_writer import write_colmap
from gsjax.data.dataset import load_dataset
from gsjax.data.photos import load_photo
from gsjax.errors import InputError
from gsjax.io.numerals import BLOCK

READERS = {
    "cameras": colmap_binary.read_cameras,
    "images": colmap_binary.read_images,
    "points3D": colmap_binary.read_points,
}


@pytest.fixture(scope="module")
def pycolmap():
    assert cv2 is not None  # if loaded after pycolmap, it would encode no PNG
    return pytest.importorskip("pycolmap")


@pytest.fixture(scope="module")
def synthetic(pycolmap, tmp_path_factory):
    """A model by pycolmap in ``bin`` and ``txt``, with tracks and 2D points."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 2, 2
    options.num_frames_per_rig, options.num_points3D = 3, 15
    options.num_points2D_without_point3D = 3
    pycolmap.set_random_seed(1)
    model = pycolmap.synthesize_dataset(options)
    folder = tmp_path_factory.mktemp("synthetic")
    for form, write in (("bin", model.write_binary), ("txt", model.write_text)):
        (folder / form).mkdir()
        write(folder / form)
    return folder


def check_equal(model, theirs):
    assert len(model.images) == len(theirs.images) == 12
    by_name = {image.name: image for image in theirs.images.values()}
    for image in model.images:
        other = by_name[image.name]
        pose = other.cam_from_world()
        np.testing.assert_array_equal(image.quat, pose.rotation.quat[[3, 0, 1, 2]])
        np.testing.assert_array_equal(image.translation, pose.translation)
        viewmat = viewmat_of(image.quat, image.translation)
        np.testing.assert_allclose(viewmat[:3], pose.matrix(), atol=1e-15)
        assert image.camera == other.camera_id
    assert set(model.cameras) == set(theirs.cameras)
    for number, camera in model.cameras.items():
        other = theirs.cameras[number]
        assert (camera.width, camera.height) == (other.width, other.height)
        np.testing.assert_array_equal(camera.K, other.calibration_matrix())
    columns = zip(
        *(
            (number, point.xyz, point.color, point.error, point.track.length())
            for number, point in sorted(theirs.points3D.items())
        )
    )
    for ours, expected in zip(model.points, columns, strict=True):
        np.testing.assert_array_equal(ours, expected)
    assert min(model.points.track_lengths) > 1


def test_models_equal_those_of_pycolmap(pycolmap, synthetic, tmp_path):
    """In binary and text, also behind a byte order mark, and .bin precedes .txt."""
    theirs = pycolmap.Reconstruction(synthetic / "bin")
    for form in ("bin", "txt"):
        check_equal(read_colmap(synthetic / form), theirs)
    shutil.copytree(synthetic / "txt", tmp_path, dirs_exist_ok=True)
    for path in tmp_path.glob("*.txt"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    check_equal(read_colmap(tmp_path), theirs)
    shutil.copytree(synthetic / "bin", tmp_path, dirs_exist_ok=True)
    for path in tmp_path.glob("*.txt"):
        path.write_text("nonsense")
    check_equal(read_colmap(tmp_path), theirs)


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
def test_damaged_bytes_raise_nothing_else(synthetic, name, changes):
    data = bytearray((synthetic / "bin" / f"{name}.bin").read_bytes())
    for at, value in changes:
        data[at % len(data)] = value
    path = synthetic / "x.bin"
    path.write_bytes(data)
    with contextlib.suppress(InputError):
        READERS[name](path)


CAMERA = "1 PINHOLE 640 480 500 510 320 240"
IMAGE = "1 1 0 0 0 0 0 3 1 a.png"
POINT = "7 1 2 3 255 0 9 0.5 1 0 2 5"


def write_text(folder, cameras=CAMERA, images=IMAGE, points=POINT):
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


COUNT = 9_000


@cache
def random_points() -> tuple[list[str], list[np.ndarray]]:
    """Return lines of points, and the columns that they were made from, sorted by id.

    The ids are not in order, and some are beyond what float64 holds.
    """
    rng = np.random.default_rng(0)
    ids = rng.permutation(COUNT).astype(object)
    ids[: COUNT // 10] += 2**64 - COUNT
    xyz, rgb = rng.normal(size=(COUNT, 3)), rng.integers(0, 256, (COUNT, 3))
    errors, lengths = rng.uniform(size=COUNT), rng.integers(0, 10, COUNT)
    lines = []
    for row in zip(ids, xyz.tolist(), rgb, errors.tolist(), lengths):
        track = rng.integers(0, 2**32, 2 * row[4])
        lines.append(" ".join(map(str, (row[0], *row[1], *row[2], row[3], *track))))
    order = np.argsort(ids)
    columns = (ids.astype(np.uint64), xyz, rgb, errors, lengths)
    return lines, [column[order] for column in columns]


@pytest.mark.parametrize(
    "end", ["\n", "\r\n", "\r", "\n\n \n", "\n# a note, ünïcode\n"]
)
def test_points_in_many_blocks(tmp_path, end):
    lines, columns = random_points()
    path = tmp_path / "points3D.txt"
    text = "".join(["# 3D points", end, *(line + end for line in lines)])
    path.write_bytes(text.encode())
    assert len(text) > 3 * BLOCK
    points = colmap_text.read_points(path)
    for found, expected in zip(points, columns, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_errors_name_the_line_in_any_block(tmp_path):
    lines, _ = random_points()
    path = tmp_path / "points3D.txt"
    for at in (0, COUNT // 2, COUNT - 1):
        where = rf"points3D\.txt: line {at + 3}: "
        for bad, expected in (
            (lines[at] + " 5", "expected a track"),
            ("\uff11" + lines[at], ".* as the point id, got '\uff11"),
        ):
            text = "\n".join([*lines[:at], bad, *lines[at + 1 :]])
            path.write_text(f"# a\n\n{text}\n")
            rejects(where + expected, colmap_text.read_points, path)


def test_lines_have_any_length(tmp_path):
    """The track of a point in many photographs, and the 2D points of a photograph."""
    path = tmp_path / "points3D.txt"
    path.write_text("7 1 2 3 4 5 6 0.5" + " 1234567 54321" * 60_000 + "\n")
    assert colmap_text.read_points(path).track_lengths.tolist() == [60_000]
    path = tmp_path / "images.txt"
    image = "{} 1 0 0 0 0 0 3 1 {}.png\n"
    for count in (0, BLOCK // 8, 100_000):
        line = "1.5 2 -1" + " 3.25 41 17" * count + "\n"
        path.write_text(image.format(1, "a") + line + image.format(2, "b") + "\n")
        images = colmap_text.read_images(path)
        assert [found.name for found in images] == ["a.png", "b.png"]
        path.write_text(image.format(1, "a") + line.replace("\n", " 5\n"))
        expected = f"line 2: .* got {3 * count + 4} values, the last '5'"
        rejects(expected, colmap_text.read_images, path)


def test_a_larger_model_beside_the_first_gives_a_warning(tmp_path):
    colmap_dataset(tmp_path, dataset_of_views(count=3))
    write_colmap(tmp_path / "sparse/1", dataset_of_views(count=2))
    damaged = tmp_path / "sparse/3"
    damaged.mkdir()
    (damaged / "images.bin").write_bytes(b"\xff" * 9)
    assert len(load_dataset(tmp_path).views) == 3
    write_colmap(tmp_path / "sparse/2", dataset_of_views(count=5))
    expected = r"this model has 3 images, that of .*2 5"
    assert len(warned(expected, load_dataset, tmp_path).views) == 3


def test_missing_files(tmp_path):
    colmap_dataset(tmp_path)
    (tmp_path / "sparse/0/points3D.bin").unlink()
    dataset = warned(r"points3D.*neither.*has no points", load_colmap, tmp_path)
    assert dataset.points.shape == (0, 3)
    (tmp_path / "sparse/0/images.bin").unlink()
    rejects(r"expected images\.bin or images\.txt, got n", load_colmap, tmp_path)


PARAMETERS = {
    **{"k": 0.03, "k1": 0.04, "k2": -0.02, "k3": 0.01, "k4": 0.005, "k5": 0.02},
    **{"k6": 0.001, "p1": 0.002, "p2": -0.003, "cx": 310.0, "cy": 245.5},
    **{"f": 500.0, "fx": 500.0, "fy": 510.0, "k0": 0.01, "omega": 0.4},
    **{"sx1": 0.002, "sy1": -0.001, "p0": 0.002, "s0": 0.001, "s1": -0.002},
    **{"s2": 0.003, "s3": 0.001, "alpha": 0.55, "beta": 1.1},
}


@pytest.mark.parametrize("distorted", [False, True])
@pytest.mark.parametrize("kind", CAMERA_KINDS, ids=lambda kind: kind.name)
def test_camera_models_project_as_those_of_pycolmap(
    pycolmap, tmp_path, kind, distorted
):
    """With zero coefficients OpenCV's perspective lenses are pinholes."""
    number = pycolmap.CameraModelId.__members__.get(kind.name)
    if number is None:
        pytest.skip("unknown to this pycolmap")
    assert int(number) == kind.number
    camera = pycolmap.Camera.create_from_model_id(1, number, 500.0, 640, 480)
    assert len(camera.params) == kind.size
    if distorted and kind.focals:
        names = camera.params_info.split(", ")
        camera.params = [PARAMETERS[name] for name in names]
    model = pycolmap.Reconstruction()
    model.add_camera(camera)
    model.write_binary(tmp_path)
    model.write_text(tmp_path)
    for reader, form in ((colmap_binary, "bin"), (colmap_text, "txt")):
        path = tmp_path / f"cameras.{form}"
        ours = reader.read_cameras(path)[1]
        x, y = np.random.default_rng(0).uniform(-0.6, 0.6, (2, 50))
        zero = not distorted and kind.lens == "opencv"
        assert (ours.lens is None) == ("PINHOLE" in kind.name or zero)
        assert ours.lens is None or ours.lens.model == kind.lens
        points = np.stack([x, y, np.ones(50)], -1)
        pixels, _, seen = project_points(ours.lens, ours.K, points)
        assert seen.all()
        np.testing.assert_allclose(pixels, camera.img_from_cam(points), atol=1e-9)


@pytest.mark.parametrize("at", [(0, 0, 0), (5e5, -4.1e6, 120)])
def test_written_models_are_read_back(pycolmap, tmp_path, at):
    dataset = dataset_of_views(at=np.asarray(at))
    radial = (0.1, 0.0, 0.0, 0.02)
    lenses = [None, Distortion("opencv", radial)]
    lenses += [Distortion("opencv", (*radial, 0.3))]
    lenses += [Distortion("fisheye", radial), None]
    views = tuple(replace(v, lens=lens) for v, lens in zip(dataset.views, lenses))
    # Half a turn about each axis, where quaternions change sign.
    turns = [np.eye(3), *(np.diag(d) for d in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1]))]
    for view, turn in zip(views[1:], turns):
        view.viewmat[:3, :3] = turn
    dataset = replace(dataset, views=views)
    write_colmap(tmp_path / "a" / "b", dataset)
    model = read_colmap(tmp_path / "a" / "b")
    np.testing.assert_array_equal(model.points.xyz, dataset.points)
    np.testing.assert_array_equal(model.points.colors, dataset.colors)
    for view, image in zip(views, model.images):
        camera = model.cameras[image.camera]
        np.testing.assert_array_equal(camera.K, view.K)
        assert (camera.width, camera.height) == SIZE
        assert (camera.lens is None) == (view.lens is None)
        if view.lens is not None and camera.lens is not None:
            assert camera.lens.model == view.lens.model
            given = view.lens.coefficients
            assert camera.lens.coefficients[: len(given)] == given
        found = viewmat_of(image.quat, image.translation)
        scale = max(1.0, np.abs(view.viewmat).max())
        np.testing.assert_allclose(found, view.viewmat, atol=2e-15 * scale)
    theirs = pycolmap.Reconstruction(tmp_path / "a" / "b")
    assert (theirs.num_images(), theirs.num_points3D()) == (5, 40)
    assert theirs.num_cameras() == 4  # the first equals the last
    rejects(r"cameras\.bin.*exists", write_colmap, tmp_path / "a" / "b", dataset)
    write_colmap(tmp_path / "a" / "b", dataset, overwrite=True)


@pytest.mark.parametrize("place", ["sparse/0", "sparse", ".", "colmap/sparse/0"])
def test_models_are_found_in_several_places(tmp_path, place):
    made = colmap_dataset(tmp_path, place=place)
    loaded = load_colmap(tmp_path)
    assert find_colmap(tmp_path) == loaded.source == tmp_path / place
    assert loaded.format == "colmap"
    for ours, view in zip(loaded.views, made.views):
        assert ours.name == view.name
        assert ours.image == tmp_path / "images" / view.name
        np.testing.assert_allclose(ours.viewmat, view.viewmat, atol=1e-14)
    np.testing.assert_array_equal(loaded.points, made.points)


def test_copies_with_other_names_are_matched_by_order(tmp_path):
    """As of NeRF-LLFF: numbered, whatever the originals are called."""
    names = [f"IMG_{4026 + (7 * n) % 11}.JPG" for n in range(5)]
    colmap_dataset(tmp_path, with_names(dataset_of_views(), names))
    for index in range(5):
        small = np.full((SIZE[1] // 4, SIZE[0] // 4, 3), index, np.uint8)
        save_photo(tmp_path / f"images_4/image{index:03d}.png", small)
    expected = r"images_4: none of the 5 .* order of their names: image000\.png is IMG_"
    views = warned(expected, load_dataset, tmp_path, factor=4).views
    assert [view.name for view in views] == sorted(names)
    for index, view in enumerate(views):
        assert view.image == tmp_path / f"images_4/image{index:03d}.png"
        photo = load_photo(view)
        assert (photo.pixels == index).all()
        np.testing.assert_allclose(photo.K[:2], view.K[:2] / 4)
    # The order is that of all photographs, of which the model may have few.
    save_photo(tmp_path / "images/IMG_4000.JPG")
    save_photo(tmp_path / "images_4/image005.png")
    views = warned("image001", load_dataset, tmp_path, factor=4).views
    assert views[0].image == tmp_path / "images_4/image001.png"
    # Not if the numbers differ, nor if one copy has a listed name.
    (tmp_path / "images_4/image000.png").unlink()
    expected = r"5 of 5 .* missing in .*images_4.*image"
    for skip in (False, True):
        rejects(expected, load_dataset, tmp_path, factor=4, skip_missing=skip)
    save_photo(tmp_path / "images_4/IMG_4026.png")
    rejects(r"4 of 5 .*--skip-missing", load_dataset, tmp_path, factor=4)


def test_masks_are_found_by_name(tmp_path):
    """The suffixes of both have either case; an exact name precedes.

    Listed names may begin with the folder of the photographs.
    """
    ends, others = (".JPG", ".jpg", ".v2.Jpg"), (".jpg", ".JPG", "")
    masks = {}
    for end, other, suffix in product(ends, others, (".png", ".PNG", ".Png")):
        stem = f"a/{len(masks)}"
        masks[stem + end] = tmp_path / "masks" / (stem + end[:-4] + other + suffix)
    names = [*masks, "b/1.jpg", "b/2.jpg"]
    files = [save_photo(tmp_path / "images" / name) for name in names]
    listed = [f"images/{name}" for name in names]
    write_colmap(tmp_path / "sparse", with_names(dataset_of_views(29), listed))
    others = ("1.png", "c/1.png", "b/11.png", "b/1.png.txt")
    for path in (*masks.values(), *(tmp_path / "masks" / name for name in others)):
        path.parent.mkdir(exist_ok=True, parents=True)
        path.touch()
    expected = r"masks: 2 of 29 photographs have no mask.*first: b/1\.jpg, b/2\.jpg"
    for options in ({}, {"images": "images"}):
        views = warned(expected, load_dataset, tmp_path, **options).views
        for view in views:
            assert view.image == files[names.index(view.name)]
            mask = masks.get(view.name)
            assert view.mask is mask is None or mask.samefile(view.mask)
        assert len(views) == 29
    for name in names:
        save_photo(tmp_path / "masks" / f"{name}.png")
    for view in load_dataset(tmp_path).views:
        assert view.mask.samefile(tmp_path / "masks" / f"{view.name}.png")


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_letters_may_be_composed_or_not(tmp_path, form):
    other = {"NFC": "NFD", "NFD": "NFC"}[form]
    names = [unicodedata.normalize(form, name) for name in ("für/ä.png", "é.png")]
    write_colmap(tmp_path / "sparse/0", with_names(dataset_of_views(2), names))
    for name in names:
        folder, name = name.rpartition("/")[::2]
        name = unicodedata.normalize(other, name)
        save_photo(tmp_path / "images" / folder / name)
        save_photo(tmp_path / "masks" / folder / name)
    for view, name in zip(load_colmap(tmp_path).views, names):
        assert view.name == name
        assert view.image.is_file()
        assert (view.mask or Path("none")).is_file()


def test_missing_photographs(tmp_path):
    made = colmap_dataset(tmp_path)
    for index in (1, 3):
        (tmp_path / "images" / made.views[index].name).unlink()
    expected = r"2 of 5 photographs are missing .*: view_01\.png, view_03\.png"
    rejects(expected + ".*--skip-missing", load_dataset, tmp_path)
    loaded = warned(expected, load_dataset, tmp_path, skip_missing=True)
    names = [view.name for view in loaded.views]
    assert names == ["view_00.png", "view_02.png", "view_04.png"]
    for path in (tmp_path / "images").iterdir():
        path.unlink()
    save_photo(tmp_path / "images/other.png")
    for skip_missing in (False, True):
        expected = r"5 of 5 photographs are missing .* has other\.png\), .*--images"
        with pytest.raises(InputError, match=expected) as caught:
            load_dataset(tmp_path, skip_missing=skip_missing)
        assert "skip" not in str(caught.value), "that would leave none"
