"""`transforms.json` as datasets: three dialects, their lenses, splits and points."""

import math

import numpy as np
import pytest
from captures import (
    PIXELS,
    SIZE,
    dataset_of_views,
    frames_of,
    nerfstudio_dataset,
    ply_file,
    rejects,
    save_photo,
    to_opengl,
    warned,
    write_transforms,
)

from gsjax.cameras.distortion import Distortion
from gsjax.data.dataset import load_dataset
from gsjax.data.photos import load_photo
from gsjax.data.transforms import load_transforms
from gsjax.errors import InputError
from gsjax.io.point_cloud import read_point_cloud


def cloud(path, xyz, colors, kind="uchar", rgb="red green blue", form="ascii", **types):
    """Write points as a PLY, by default as nerfstudio's sparse_pc.ply."""
    table = dict(zip("xyz", np.transpose(xyz)))
    colored = {} if colors is None else dict(zip(rgb.split(), np.transpose(colors)))
    types |= dict.fromkeys(colored, kind)
    path.write_bytes(ply_file(table | colored, types=types, kind=form))


def test_nerfstudio(tmp_path):
    # applied_transform was applied to poses and points already.
    made = nerfstudio_dataset(
        tmp_path,
        k1=0.1, k2=-0.02, p1=0.001, p2=0.002,
        applied_transform=[[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 5]],
        ply_file_path="sparse_pc.ply",
    )  # fmt: skip
    cloud(tmp_path / "sparse_pc.ply", made.points, made.colors)
    dataset = load_dataset(tmp_path)
    assert dataset.format == "transforms"
    names = [f"images/frame_{n}.png" for n in range(4)]
    assert [view.name for view in dataset.views] == names
    K = [[40, 0, 15.5], [0, 42, 12.25], [0, 0, 1]]
    radial = Distortion("opencv", (0.1, -0.02, 0.001, 0.002, 0.0))
    for view, given in zip(dataset.views, made.views):
        np.testing.assert_allclose(view.viewmat, given.viewmat, atol=1e-14)
        np.testing.assert_array_equal(view.K, K)
        assert view.lens == radial
        assert view.image.is_file()
        assert view.split is None
    np.testing.assert_allclose(dataset.points, made.points, rtol=1e-6)
    np.testing.assert_array_equal(dataset.colors, made.colors)


def test_instant_ngp(tmp_path):
    frames = frames_of(dataset_of_views(3), "./images/{}.jpg", sharpness=30.5)
    for index in range(3):
        save_photo(tmp_path / f"images/{index}.jpg")
    more = {"k1": 0.05, "k2": 0.01, "k3": 0, "k4": 0, "p1": 0, "p2": 0.0}
    more |= {"camera_angle_x": 0.7, "camera_angle_y": 0.5, "is_fisheye": False}
    write_transforms(tmp_path, frames, aabb_scale=16, scale=0.33, **PIXELS, **more)
    views = load_dataset(tmp_path).views
    assert [v.name for v in views] == ["images/0.jpg", "images/1.jpg", "images/2.jpg"]
    assert views[0].lens == Distortion("opencv", (0.05, 0.01, 0, 0, 0))
    assert views[0].K[0, 0] == 40


@pytest.mark.parametrize(
    "more", [{"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}]
)
def test_fisheye(tmp_path, more):
    coefficients = dict(zip(("k1", "k2", "k3", "k4"), (0.1, 0.2, 0.3, 0.4)))
    nerfstudio_dataset(tmp_path, **{"camera_model": None, **coefficients, **more})
    view = load_dataset(tmp_path).views[0]
    assert view.lens == Distortion("fisheye", (0.1, 0.2, 0.3, 0.4))


def synthetic(folder):
    """NeRF's synthetic scenes: RGBA, no suffixes, no sizes, one list per split."""
    rgba = np.zeros((SIZE[1], SIZE[0], 4), np.uint8)
    rgba[5:9] = (10, 200, 30, 128)
    for split, count in (("train", 3), ("test", 2), ("val", 1)):
        frames = frames_of(dataset_of_views(count), f"./{split}/r_{{}}", rotation=0.01)
        for index in range(count):
            save_photo(folder / split / f"r_{index}.png", rgba)
            save_photo(folder / split / f"r_{index}_depth_0001.png")
        write_transforms(
            folder, frames, f"transforms_{split}.json", camera_angle_x=0.69
        )


def test_nerf_synthetic(tmp_path):
    synthetic(tmp_path)
    dataset = load_dataset(tmp_path)
    test = {f"test/r_{n}.png": "test" for n in range(2)}
    train = {f"train/r_{n}.png": "train" for n in range(3)}
    assert {view.name: view.split for view in dataset.views} == test | train
    view = dataset.views[2]
    assert (view.width, view.height) == SIZE
    focal = 16 / math.tan(0.69 / 2)
    expected = [[focal, 0, 16], [0, focal, 12], [0, 0, 1]]
    np.testing.assert_allclose(view.K, expected, rtol=1e-15)
    photo = load_photo(view)
    assert photo.alpha is not None
    assert (photo.alpha[5:9] == 128).all()
    assert (photo.pixels[6, 3] == (10, 200, 30)).all()
    assert photo.alpha[0, 0] == 0
    # A list by itself; validation views replace missing test views.
    [view] = load_dataset(tmp_path / "transforms_val.json").views
    assert (view.name, view.split) == ("val/r_0.png", None)
    views = load_dataset(tmp_path / "transforms_train.json").views
    assert {view.split for view in views} == {"train"}
    (tmp_path / "transforms_test.json").unlink()
    splits = {view.name: view.split for view in load_dataset(tmp_path).views}
    assert splits == train | {"val/r_0.png": "test"}


@pytest.mark.parametrize("at", ["top", "frame"])
@pytest.mark.parametrize(
    "angles",
    [
        {"x_fov": 60.0},
        {"y_fov": 50.0},
        {"x_fov": 60.0, "y_fov": 50.0},
        {"camera_angle_x": math.radians(60), "camera_angle_y": math.radians(50)},
        {"camera_angle_y": math.radians(50)},
        {"fl_y": 12 / math.tan(math.radians(25))},
    ],
    ids=" ".join,
)
def test_angles_of_view(tmp_path, angles, at):
    """A single one holds for both axes, as in instant-ngp."""
    inner, top = ({}, angles) if at == "top" else (angles, {})
    frames = frames_of(dataset_of_views(2), **inner)
    nerfstudio_dataset(tmp_path, frames=frames, **({"fl_x": None, "fl_y": None} | top))
    fx = 16 / math.tan(math.radians(30)) if any("x" in k for k in angles) else None
    fy = 12 / math.tan(math.radians(25)) if any("y" in k for k in angles) else fx
    expected = [[fx or fy, 0, 15.5], [0, fy, 12.25], [0, 0, 1]]
    for view in load_dataset(tmp_path).views:
        np.testing.assert_allclose(view.K, expected, rtol=1e-14)
    for _, camera in load_transforms(tmp_path / "transforms.json"):
        np.testing.assert_allclose(camera.K, expected, rtol=1e-6)


def test_intrinsics_of_frames(tmp_path):
    frames = frames_of(dataset_of_views(3))
    frames[1] |= {"fl_x": 99.0, "fl_y": 98.0, "w": 64, "h": 48, "cx": 30.0, "cy": 20.0}
    frames[2] |= {"distortion_params": [0.1, 0.2, 0.3, 0, 0.01, 0.02]}
    nerfstudio_dataset(tmp_path, frames=frames)
    views = load_dataset(tmp_path).views
    assert views[0].lens is None
    assert (views[1].width, views[1].K[0, 0], views[1].K[1, 2]) == (64, 99, 20)
    expected = Distortion("opencv", (0.1, 0.2, 0.01, 0.02, 0.3))
    assert views[2].lens == expected


def test_scaled_rotations_give_a_warning(tmp_path):
    made = dataset_of_views(3)
    frames = frames_of(made)
    matrix = to_opengl(made.views[0].viewmat) * [2, 2, 2, 1]
    frames[0]["transform_matrix"] = matrix.tolist()
    nerfstudio_dataset(tmp_path, frames=frames)
    expected = r"1 frames are scaled, the first: 0 \(× 2\)"
    view = warned(expected, load_dataset, tmp_path).views[0]
    np.testing.assert_allclose(view.viewmat, made.views[0].viewmat, atol=1e-14)


@pytest.mark.parametrize("kept", ["images", "originals"])
def test_missing_sizes_are_those_of_the_originals(tmp_path, kept):
    """Intrinsics in px refer to the originals if smaller copies are read."""
    frames = frames_of(dataset_of_views(2))
    for index in range(2):
        save_photo(tmp_path / f"images_2/{index}.png", np.zeros((12, 16, 3), np.uint8))
        save_photo(tmp_path / f"{kept}/{index}.png")
    pixels = {"fl_x": 40.0, "fl_y": 42.0, "cx": 15.5, "cy": 12.25}
    write_transforms(tmp_path, frames, **pixels)
    if kept == "originals":
        with pytest.raises(InputError, match=r"original of the smaller .* give w and"):
            load_dataset(tmp_path, factor=2)
        write_transforms(tmp_path, frames, camera_angle_x=2 * math.atan(0.4))
        copies = load_dataset(tmp_path, factor=2).views[0]
        assert (copies.width, copies.K[0, 0]) == (16, pytest.approx(20))
        return
    for more in ({"factor": 2}, {"images": "images_2"}):
        view = load_dataset(tmp_path, **more).views[0]
        assert (view.width, view.height) == SIZE
        expected = [[20, 0, 7.75], [0, 21, 6.125], [0, 0, 1]]
        np.testing.assert_allclose(load_photo(view).K, expected)


NAMES = [f"images/frame_{n}.png" for n in range(4)]


@pytest.mark.parametrize(
    ("lists", "splits", "expected"),
    [
        ((NAMES[:2], NAMES[2:], None), "train train test test", None),
        ((NAMES[:2], NAMES[2:3], NAMES[3:]), "train train - test", None),
        # In no list: unused if there is a training list.
        ((NAMES[:2], None, NAMES[3:]), "train train - test", "1 of 4 .* in no list"),
        ((None, None, NAMES[:1]), "test None None None", None),
        # In both lists: held out.
        ((NAMES, None, NAMES[1:2]), "train test train train", "1 of 4 .* training and"),
        ((NAMES, NAMES[1:2], None), "train test train train", "1 of 4 .* training and"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*frames are in")
def test_splits_by_lists_of_names(tmp_path, lists, splits, expected):
    keys = [f"{split}_filenames" for split in ("train", "val", "test")]
    nerfstudio_dataset(tmp_path, **dict(zip(keys, lists)))
    if expected:
        warned(expected, load_dataset, tmp_path)
    found = {view.name: view.split for view in load_dataset(tmp_path).views}
    assert " ".join(str(found.get(name, "-")) for name in NAMES) == splits


@pytest.mark.parametrize("form", ["./{}", "{}", ".\\{}"])
def test_spellings_of_names_in_lists(tmp_path, form):
    frames = frames_of(dataset_of_views(4), "./images/frame_{}.png")
    names = [form.format(name) for name in NAMES]
    lists = {"train_filenames": names[:3], "test_filenames": names[3:]}
    nerfstudio_dataset(tmp_path, frames=frames, **lists)
    splits = [view.split for view in load_dataset(tmp_path).views]
    assert splits == ["train"] * 3 + ["test"]


def test_masks_and_smaller_copies(tmp_path):
    frames = frames_of(dataset_of_views(2))
    frames[1]["mask_path"] = "masks/one.png"
    save_photo(tmp_path / "masks/one.png")
    nerfstudio_dataset(tmp_path, frames=frames)
    views = load_dataset(tmp_path).views
    assert [view.mask for view in views] == [None, tmp_path / "masks/one.png"]
    with pytest.raises(InputError, match=r"images_2: no such folder.*the factor out"):
        load_dataset(tmp_path, factor=2)
    for index in range(2):
        save_photo(tmp_path / f"images_2/{index}.png", np.zeros((12, 16, 3), np.uint8))
    view = load_dataset(tmp_path, factor=2).views[0]
    assert view.image == tmp_path / "images_2/0.png"
    assert (view.width, load_photo(view).K[0, 0]) == (32, 20)
    (tmp_path / "masks/one.png").unlink()
    rejects(r"frames\[1\]: mask_path 'masks/one\.png'", load_dataset, tmp_path)


def test_masks_of_instant_ngp_give_a_warning(tmp_path):
    """No list names them, and black means kept."""
    nerfstudio_dataset(tmp_path)
    for index in (1, 3):
        save_photo(tmp_path / f"images/dynamic_mask_frame_{index}.png")
    with pytest.warns(UserWarning, match=r"2 masks of instant-ngp are ignored.*_1\."):
        views = load_dataset(tmp_path).views
    assert [view.mask for view in views] == [None] * 4
    load_dataset(tmp_path, poses_only=True)


def test_photographs_elsewhere(tmp_path):
    folder, elsewhere = tmp_path / "data", tmp_path / "photos"
    nerfstudio_dataset(folder)
    (folder / "images").rename(elsewhere)
    for images in (elsewhere, str(elsewhere), "../photos"):
        for view, number in zip(load_dataset(folder, images=images).views, range(4)):
            assert view.image.samefile(elsewhere / f"frame_{number}.png")
            assert view.name == f"frame_{number}.png"
    missing = tmp_path / "none"
    with pytest.raises(InputError, match=f"{missing}: no such folder"):
        load_dataset(folder, images=missing, skip_missing=True)
    elsewhere.rename(folder / "moved")
    views = load_dataset(folder, images=folder / "moved").views
    assert views[0].name == "moved/frame_0.png"


@pytest.mark.parametrize(
    "form",
    [
        "../photos/a/{}.png",
        "/data/photos/a/{}.png",
        "C:\\photos\\a\\{}.png",
        "a/../../{}",
    ],
)
def test_names_that_leave_the_dataset_are_not_followed(tmp_path, form):
    """With ``images`` they are searched within that folder."""
    folder, elsewhere = tmp_path / "data", tmp_path / "photos"
    for index in range(3):
        save_photo(elsewhere / "a" / f"{index}.png")
    frames = frames_of(dataset_of_views(3), form)
    write_transforms(folder, frames, **PIXELS)
    rejects(r"frames\[0\]: .* pass images=.*--images", load_dataset, folder)
    rejects("3 of 3 photographs are missing", load_dataset, folder, images=folder)
    for images in (elsewhere / "a", "../photos/a"):
        views = load_dataset(folder, images=images).views
        assert [view.name for view in views] == ["0.png", "1.png", "2.png"]
        for view in views:
            assert view.image.samefile(elsewhere / "a" / view.name)
    for bad in ("..", "/", "../../x\0"):
        write_transforms(folder, [{**frames[0], "file_path": bad}], **PIXELS)
        with pytest.raises(InputError, match="expected the name of a file within"):
            load_dataset(folder, images=elsewhere)


@pytest.mark.parametrize("more", [{"factor": 2}, {"images": "images_2"}])
@pytest.mark.parametrize("place", ["{}/0.png", "images/{}/0.png"])
def test_equal_names_in_subfolders(tmp_path, more, place):
    nerfstudio_dataset(
        tmp_path, frames=frames_of(dataset_of_views(3), "images/cam{}/0.png")
    )
    copies = [tmp_path / "images_2" / place.format(f"cam{n}") for n in range(3)]
    for path in copies:
        save_photo(path)
    save_photo(tmp_path / "images_2/0.png")  # belongs to none
    assert [view.image for view in load_dataset(tmp_path, **more).views] == copies
    for path in copies:
        path.unlink()
    with pytest.raises(InputError, match=r"0\.png are one photograph in .*images_2, 0"):
        load_dataset(tmp_path, **more)


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "'EQUIRECTANGULAR' is not supported"),
        ({"ftheta_p0": 0.1}, "ftheta_p0 0.1: this lens is not supported"),
        ({"latlong": True}, "latlong True: this lens is not supported"),
        ({"equirectangular": 1}, "equirectangular 1: this lens is not supported"),
        ({"fl_x": None, "fl_y": None}, "a focal length, fl_x, camera_angle_x or x_fov"),
        ({"fl_x": None, "x_fov": 180}, "x_fov: expected degrees between .* got 180"),
        ({"k1": 0.1, "k4": 0.1}, "k4 of a perspective lens"),
        ({"k1": 0.1, "k6": 0.1}, "k6 of a perspective lens"),
        ({"is_fisheye": True, "p1": 0.1}, "a fisheye has no p1, p2"),
        ({"k1": "a"}, "k1: expected a number, got 'a'"),
        ({"fl_x": 1e-30}, "focal lengths .* got 1e-30, 42"),
        ({"cx": -1e20}, "principal point .* got -1e[+]20, "),
        ({"ply_file_path": 3}, "ply_file_path: expected text, got 3"),
        ({"ply_file_path": "../a.ply"}, "within the dataset's folder"),
        ({"ply_file_path": "none.ply"}, r"'none\.ply': no such file.*remove ply_file"),
        ({"test_filenames": "a"}, "test_filenames: expected a list, got 'a'"),
        (
            {"test_filenames": [NAMES[0], "frame_1.png"]},
            "test_filenames: 1 of 2 names .*'frame_1",
        ),
    ],
)
def test_bad_top_level(tmp_path, more, expected):
    nerfstudio_dataset(tmp_path, **more)
    rejects(expected, load_dataset, tmp_path)


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({"file_path": None}, r"frames\[1\]: file_path: expected text, got missing"),
        ({"file_path": "images/0.png"}, "'images/0.png' is listed more than once"),
        ({"distortion_params": [1, 2]}, r"distortion_params: .* got \[1, 2\]"),
        ({"k1": math.nan}, "k1: expected a number, got nan"),
    ],
)
def test_bad_frames(tmp_path, more, expected):
    frames = frames_of(dataset_of_views(3))
    nerfstudio_dataset(tmp_path, frames=frames)
    frames[1] |= more
    write_transforms(tmp_path, frames, **PIXELS)
    rejects(expected, load_dataset, tmp_path)


def test_point_clouds(tmp_path):
    made = dataset_of_views(points=9)
    path = tmp_path / "a.ply"
    cloud(path, made.points, made.colors / 255, "float")
    points, colors = read_point_cloud(path)
    np.testing.assert_allclose(points, made.points, rtol=1e-6)
    np.testing.assert_array_equal(colors, made.colors)
    cloud(path, made.points, None)
    assert (read_point_cloud(path)[1] == 128).all()
    cloud(path, made.points[:0], None)
    assert read_point_cloud(path)[0].shape == (0, 3)
    wide = {"form": "binary_little_endian", **dict.fromkeys("xyz", "double")}
    cloud(path, made.points, made.colors, **wide)
    points, colors = read_point_cloud(path)
    np.testing.assert_array_equal(points, made.points)
    np.testing.assert_array_equal(colors, made.colors)
    data = path.read_bytes()
    for length in range(0, len(data), 17):
        path.write_bytes(data[:length])
        rejects(r"a\.ply: ", read_point_cloud, path)


@pytest.mark.parametrize(
    "names", ["red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b"]
)
@pytest.mark.parametrize("kind", ["uchar", "ushort"])
def test_colours_of_16_bits_and_other_names(tmp_path, names, kind):
    path, made = tmp_path / "a.ply", dataset_of_views(points=9)
    scale = 257 if kind == "ushort" else 1
    cloud(path, made.points, made.colors.astype(int) * scale, kind, names)
    np.testing.assert_array_equal(read_point_cloud(path)[1], made.colors)


POINT = np.asarray([[0.0, 1, 2]])


@pytest.mark.parametrize(
    ("colors", "kind", "expected"),
    [
        ([[9.0, 200, 3]], "float", "0 to 200"),
        ([[-1, 2, 3]], "int", "-1 to 3"),
        ([[0, 70000, 1]], "int", "0 to 70000"),
    ],
)
def test_bad_colours(tmp_path, colors, kind, expected):
    cloud(tmp_path / "a.ply", POINT, np.asarray(colors), kind)
    rejects(f"a.ply: .*colours.*{expected}", read_point_cloud, tmp_path / "a.ply")
