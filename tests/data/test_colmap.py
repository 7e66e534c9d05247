"""COLMAP models: equal to what pycolmap reads, written and read back, as datasets."""

import shutil
import unicodedata
from dataclasses import replace
from pathlib import Path

import cv2  # before pycolmap: see captures.synthetic_model
import numpy as np
import pytest
from captures import (
    SIZE,
    colmap_dataset,
    dataset_of_views,
    rejects,
    save_photo,
    synthetic_model,
    warned,
    with_names,
)

from gsjax.cameras.distortion import Distortion, distort
from gsjax.data import colmap_binary, colmap_text
from gsjax.data.colmap import find_colmap, load_colmap, read_colmap
from gsjax.data.colmap_model import CAMERA_KINDS, viewmat_of
from gsjax.data.colmap_writer import write_colmap
from gsjax.data.dataset import load_dataset
from gsjax.data.image_files import find_mask
from gsjax.data.photos import load_photo
from gsjax.errors import InputError

pycolmap = pytest.importorskip("pycolmap")
assert cv2 is not None


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory):
    return synthetic_model(tmp_path_factory.mktemp("synthetic"))


def check_equal(model, theirs):
    by_name = {image.name: image for image in theirs.images.values()}
    assert len(model.images) == len(by_name) == 12
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
    ids = sorted(theirs.points3D)
    points = [theirs.points3D[number] for number in ids]
    np.testing.assert_array_equal(model.points.ids, ids)
    np.testing.assert_array_equal(model.points.xyz, [p.xyz for p in points])
    np.testing.assert_array_equal(model.points.colors, [p.color for p in points])
    np.testing.assert_array_equal(model.points.errors, [p.error for p in points])
    lengths = [p.track.length() for p in points]
    np.testing.assert_array_equal(model.points.track_lengths, lengths)
    assert min(lengths) > 1


def test_models_equal_those_of_pycolmap(synthetic, tmp_path):
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


def test_a_larger_model_beside_the_first_gives_a_warning(tmp_path):
    colmap_dataset(tmp_path, dataset_of_views(count=3))
    write_colmap(tmp_path / "sparse/1", dataset_of_views(count=2))
    damaged = tmp_path / "sparse/3"
    damaged.mkdir()
    (damaged / "images.bin").write_bytes(b"\xff" * 9)
    assert len(load_dataset(tmp_path).views) == 3
    write_colmap(tmp_path / "sparse/2", dataset_of_views(count=5))
    with pytest.warns(UserWarning, match=r"this model has 3 images, that of .*2 5"):
        assert len(load_dataset(tmp_path).views) == 3


PARAMETERS = {
    **{"k": 0.03, "k1": 0.04, "k2": -0.02, "k3": 0.01, "k4": 0.005, "k5": 0.02},
    **{"k6": 0.001, "p1": 0.002, "p2": -0.003, "cx": 310.0, "cy": 245.5},
    **{"f": 500.0, "fx": 500.0, "fy": 510.0},
}


@pytest.mark.parametrize("kind", CAMERA_KINDS, ids=lambda kind: kind.name)
def test_camera_models_project_as_those_of_pycolmap(tmp_path, kind):
    number = pycolmap.CameraModelId.__members__.get(kind.name)
    if number is None:
        pytest.skip("unknown to this pycolmap")
    assert int(number) == kind.number
    camera = pycolmap.Camera.create_from_model_id(1, number, 500.0, 640, 480)
    assert len(camera.params) == kind.size
    if kind.lens is not None:
        names = camera.params_info.split(", ")
        camera.params = [PARAMETERS[name] for name in names]
    model = pycolmap.Reconstruction()
    model.add_camera(camera)
    model.write_binary(tmp_path)
    model.write_text(tmp_path)
    for reader, form in ((colmap_binary, "bin"), (colmap_text, "txt")):
        path = tmp_path / f"cameras.{form}"
        if kind.lens is None:
            expected = rf"cameras.{form}: .*{kind.name} is not supported; undistort"
            rejects(expected, reader.read_cameras, path)
            continue
        ours = reader.read_cameras(path)[1]
        x, y = np.random.default_rng(0).uniform(-0.6, 0.6, (2, 50))
        if ours.lens is None:
            assert "PINHOLE" in kind.name
            found = x, y
        else:
            assert ours.lens.model == kind.lens
            found = distort(ours.lens, x, y)
        pixels = np.stack([*found, np.ones(50)]).T @ ours.K.T
        expected = camera.img_from_cam(np.stack([x, y, np.ones(50)], -1))
        np.testing.assert_allclose(pixels[:, :2], expected, atol=1e-9)


def test_zero_coefficients_are_a_pinhole_but_for_a_fisheye(tmp_path):
    equidistant = Distortion("fisheye", (0.0,) * 4)
    lenses = {"SIMPLE_RADIAL": None, "OPENCV": None, "OPENCV_FISHEYE": equidistant}
    for name, lens in lenses.items():
        model = pycolmap.Reconstruction()
        model.add_camera(pycolmap.Camera.create_from_model_name(1, name, 9, 640, 4))
        model.write_binary(tmp_path)
        assert colmap_binary.read_cameras(tmp_path / "cameras.bin")[1].lens == lens


@pytest.mark.parametrize("at", [(0, 0, 0), (5e5, -4.1e6, 120)])
def test_written_models_are_read_back(tmp_path, at):
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


def test_smaller_copies_and_other_folders(tmp_path):
    made = colmap_dataset(tmp_path)
    for factor in (0, -2, 1.5):
        rejects(
            "factor: expected a whole number", load_dataset, tmp_path, factor=factor
        )
    with pytest.raises(InputError, match=r"images_4: no such folder.*has the folders"):
        load_dataset(tmp_path, factor=4)
    for view in made.views:
        save_photo((tmp_path / "images_4" / view.name).with_suffix(".jpg"))
    loaded = load_dataset(tmp_path, factor=4)
    assert loaded.views[0].image == tmp_path / "images_4" / "view_00.jpg"
    assert loaded.views[0].name == "view_00.png"
    assert (loaded.views[0].width, loaded.views[0].height) == SIZE
    by_name = load_dataset(tmp_path, images="images_4")
    assert [v.image for v in by_name.views] == [v.image for v in loaded.views]
    elsewhere = tmp_path / "other"
    shutil.move(tmp_path / "images", elsewhere)
    assert load_dataset(tmp_path, images=elsewhere).views[0].image.parent == elsewhere
    rejects(r"images: no such folder.*images_4.*images=", load_dataset, tmp_path)


def llff_copies(folder, count=5):
    """Scenes of NeRF-LLFF: copies are numbered, whatever the originals are called."""
    names = [f"IMG_{4026 + (7 * n) % 11}.JPG" for n in range(count)]
    colmap_dataset(folder, with_names(dataset_of_views(count), names))
    for index in range(count):
        small = np.full((SIZE[1] // 4, SIZE[0] // 4, 3), index, np.uint8)
        save_photo(folder / f"images_4/image{index:03d}.png", small)
    return sorted(names)


def test_copies_with_other_names_are_matched_by_order(tmp_path):
    names = llff_copies(tmp_path)
    expected = r"images_4: none of the 5 .* order of their names: image000\.png is IMG_"
    views = warned(expected, load_dataset, tmp_path, factor=4).views
    assert [view.name for view in views] == names
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
    for skip_missing in (False, True):
        with pytest.raises(InputError, match=r"5 of 5 .* missing in .*images_4.*image"):
            load_dataset(tmp_path, factor=4, skip_missing=skip_missing)
    save_photo(tmp_path / "images_4/IMG_4026.png")
    rejects(r"4 of 5 .*--skip-missing", load_dataset, tmp_path, factor=4)


def test_masks_are_found_by_name(tmp_path):
    names = [view.name for view in colmap_dataset(tmp_path).views]
    first = save_photo(tmp_path / "masks" / names[0])
    second = save_photo(tmp_path / "masks" / (names[1] + ".png"))
    third = save_photo(tmp_path / "masks" / "view_02.PNG")
    expected = r"masks: 2 of 5 photographs have no mask.*first: view_03\.png, view_04"
    with pytest.warns(UserWarning, match=expected):
        masks = [view.mask for view in load_colmap(tmp_path).views]
    assert masks == [first, second, third, None, None]
    for name in names[3:]:
        save_photo(tmp_path / "masks" / name)
    assert all(view.mask for view in load_colmap(tmp_path).views)


@pytest.mark.parametrize("photo", ["a/1.JPG", "a/1.jpg", "a/1.v2.Jpg"])
@pytest.mark.parametrize("appended", [True, False])
@pytest.mark.parametrize("suffix", [".png", ".PNG", ".Png"])
def test_suffixes_of_masks_have_either_case(tmp_path, photo, appended, suffix):
    stem = photo if appended else photo[: -len(".jpg")]
    for name in ("1.png", "b/1.png", "a/11.png", "a/1.png.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert find_mask(tmp_path, photo) is None
    mask = tmp_path / (stem + suffix)
    mask.touch()
    for name in (photo, photo.lower(), photo[:-4] + ".JPG"):
        assert mask.samefile(find_mask(tmp_path, name) or "")
    exact = tmp_path / (stem + ".png")
    exact.touch()
    assert exact.samefile(find_mask(tmp_path, photo) or ""), "the exact name precedes"


@pytest.mark.parametrize(
    "form", ["/data/{}", "../photos/{}", "C:\\photos\\{}", "a/../../{}", "images/{}"]
)
def test_names_that_leave_the_folder_are_not_followed(tmp_path, form):
    """They are searched in a folder that is passed; ``images/`` is accepted as is."""
    names = [view.name for view in dataset_of_views().views]
    listed = [form.format(name) for name in names]
    write_colmap(tmp_path / "sparse/0", with_names(dataset_of_views(), listed))
    for name in names:
        save_photo(tmp_path / "images" / name)
    save_photo(tmp_path / "masks" / names[0])
    if not form.startswith("images"):
        rejects(r"within the dataset.*pass images=", load_dataset, tmp_path)
    for images in [None, "images"] if form.startswith("images") else ["images"]:
        with pytest.warns(UserWarning, match="4 of 5 photographs have no mask"):
            found = load_dataset(tmp_path, images=images).views
        assert [view.name for view in found] == names
        files = [tmp_path / "images" / name for name in names]
        assert [view.image for view in found] == files
        assert found[0].mask == tmp_path / "masks" / names[0]
    poses = load_dataset(tmp_path, poses_only=True).views
    assert [view.image.name for view in poses] == names


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


def test_missing_files(tmp_path):
    colmap_dataset(tmp_path)
    (tmp_path / "sparse/0/points3D.bin").unlink()
    with pytest.warns(UserWarning, match=r"points3D.*got neither.*has no points"):
        assert load_colmap(tmp_path).points.shape == (0, 3)
    (tmp_path / "sparse/0/images.bin").unlink()
    rejects(r"expected images\.bin or images\.txt, got n", load_colmap, tmp_path)
