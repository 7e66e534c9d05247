"""`transforms.json`: cameras, three dialects as datasets, and rejected files."""

import math
import re
import warnings

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
    warned,
    write_transforms,
)

import gsjax
from gsjax.cameras.distortion import Distortion, distortion_of
from gsjax.cameras.lenses import panorama_intrinsics
from gsjax.data.dataset import load_dataset
from gsjax.data.photos import load_photo
from gsjax.data.transforms import CameraEntry, load_transforms, transforms_json
from gsjax.io.point_cloud import read_point_cloud

ANGLE = {"camera_angle_x": 0.6911112070083618}
FOCAL = 0.5 / math.tan(0.5 * ANGLE["camera_angle_x"])  # per px of width
NO_FOCAL = {"fl_x": None, "fl_y": None}


def poses_of(path):
    return load_dataset(path, poses_only=True).views


def frame(**more):
    return {"transform_matrix": np.eye(4).tolist(), **more}


def load_one(folder, *, size=None, **content):
    path = write_transforms(folder, [frame()], **content)
    [entry] = load_transforms(path, size=size)
    return entry.camera


def assert_K(found, fx, fy, cx, cy, rtol=1e-6):
    expected = np.asarray([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    np.testing.assert_allclose(np.asarray(found), expected, rtol=rtol)


@pytest.mark.parametrize("rows", [3, 4])
@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_known_poses(tmp_path, rows, scale):
    """A scale is divided out, with a warning of the caller's line."""
    made = dataset_of_views(2)
    frames = frames_of(made)
    for each in frames:
        matrix = np.asarray(each["transform_matrix"])[:rows]
        matrix[:3, :3] *= scale
        each["transform_matrix"] = matrix.tolist()
    path = write_transforms(tmp_path, frames, **PIXELS)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        entries = load_transforms(path)
        views = poses_of(path)
    for view, (_, camera), given in zip(views, entries, made.views, strict=True):
        np.testing.assert_allclose(view.viewmat, given.viewmat, atol=1e-14)
        np.testing.assert_allclose(camera.viewmat, given.viewmat, atol=1e-6)
    assert len(caught) == 2 * (scale != 1)
    for each in caught:
        expected = r"2 frames are scaled, the first: 0 \(× 2\.5\)"
        assert re.search(expected, str(each.message))
        assert each.filename == __file__


def test_a_camera_on_the_z_axis(tmp_path):
    # It looks down −z with y up, as OpenGL cameras do.
    matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5]]
    path = write_transforms(tmp_path, [{"transform_matrix": matrix}], **PIXELS)
    viewmat = load_transforms(path)[0].camera.viewmat
    expected = [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 5], [0, 0, 0, 1]]
    np.testing.assert_allclose(viewmat, expected, atol=1e-15)


@pytest.mark.parametrize(
    ("content", "size", "expected"),
    [
        (PIXELS, None, (40, 42, 15.5, 12.25)),
        (PIXELS, (16, 6), (20, 10.5, 7.75, 3.0625)),
        ({"fl_x": 500, "w": 640.0, "h": 480.0}, None, (500, 500, 320, 240)),
        (ANGLE, (400, 200), (400 * FOCAL, 400 * FOCAL, 200, 100)),
        # instant-ngp writes both, and its trainer uses the pixels.
        (ANGLE | PIXELS, None, (40, 42, 15.5, 12.25)),
        *(
            (PIXELS | {"camera_model": name, "k1": 0}, None, (40, 42, 15.5, 12.25))
            for name in ("OPENCV", "opencv", "ORTHOGRAPHIC")
        ),
    ],
)
def test_intrinsics(tmp_path, content, size, expected):
    camera = load_one(tmp_path, size=size, **content)
    assert (camera.width, camera.height) == (size or (content["w"], content["h"]))
    orthographic = content.get("camera_model") == "ORTHOGRAPHIC"
    assert camera.lens.name == ("orthographic" if orthographic else "pinhole")
    assert_K(camera.K, *expected)


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
    path = write_transforms(tmp_path, frames, **(PIXELS | NO_FOCAL | top))
    fx = 16 / math.tan(math.radians(30)) if any("x" in k for k in angles) else None
    fy = 12 / math.tan(math.radians(25)) if any("y" in k for k in angles) else fx
    for view, (_, camera) in zip(poses_of(path), load_transforms(path), strict=True):
        assert_K(view.K, fx or fy, fy, 15.5, 12.25, rtol=1e-14)
        assert_K(camera.K, fx or fy, fy, 15.5, 12.25)


def test_frames_override_the_top_level(tmp_path):
    changes = (
        {},
        {"fl_x": 100, "w": 64, "h": 16, "cx": 1.5},
        {"fl_y": 99},
        {"camera_angle_x": math.pi / 2},
        {"distortion_params": [0.1, 0.2, 0.3, 0, 0.01, 0.02]},
    )
    frames = frames_of(dataset_of_views(5))
    frames = [given | change for given, change in zip(frames, changes)]
    path = write_transforms(tmp_path, frames, **PIXELS)
    views, entries = poses_of(path), load_transforms(path)
    wanted = [(40, 42, 15.5), (100, 100, 1.5), (40, 99, 15.5), (16, 16, 15.5)]
    wanted.append(wanted[0])
    for view, (_, camera), expected in zip(views, entries, wanted, strict=True):
        assert_K(view.K, *expected, 12.25, rtol=1e-14)
        assert_K(camera.K, *expected, 12.25)
        assert (view.width, view.height) == (camera.width, camera.height)
    assert (views[1].width, views[1].height) == (64, 16)
    lens = Distortion("opencv", (0.1, 0.2, 0.01, 0.02, 0.3))
    assert [view.lens for view in views] == [None] * 4 + [lens]
    assert [distortion_of(camera) for _, camera in entries[:4]] == [None] * 4
    np.testing.assert_allclose(entries[4].camera.coefficients, lens.coefficients)


@pytest.mark.parametrize(
    ("lens", "coefficients"),
    [
        ("opencv", (0.1, 0.2, 0.01, 0.02, 0.3)),
        ("fisheye", (0.1, 0.02, 0.01, 0.003)),
        ("equirectangular", None),
    ],
)
def test_lenses_are_written_and_read(tmp_path, lens, coefficients):
    K = np.array([[40.0, 0, 23], [0, 41, 13], [0, 0, 1]])
    if coefficients is None:
        K = panorama_intrinsics(48, 24)
    camera = gsjax.make_camera(
        viewmat=np.eye(4),
        K=K,
        width=48,
        height=24,
        lens=lens,
        coefficients=coefficients,
    )
    path = tmp_path / "transforms.json"
    path.write_text(transforms_json([CameraEntry("a", camera)]))
    [(_, found)] = load_transforms(path)
    assert distortion_of(found) == distortion_of(camera)
    np.testing.assert_allclose(found.K, K, rtol=1e-12)


def test_names_are_unique_and_safe(tmp_path):
    names = {
        "./train/r_0": "r_0",
        "images/IMG_1.JPG": "IMG_1",
        "other/img_1.png": "img_1_1",
        "IMG_1_1.png": "IMG_1_1_1",
        "..": "frame_00004",
        "../../etc/passwd": "passwd",
        "C:\\pictures\\a b.png": "a b",
        "/": "frame_00007",
        ".hidden/..": "frame_00008",
        "a\0b<>|\ud800.png": "a_b____",
        "é" * 300 + ".png": "é" * 90,
        None: "frame_00011",
    }
    frames = [frame(file_path=path) for path in [*names, *["b.png"] * 300]]
    entries = load_transforms(write_transforms(tmp_path, frames, **PIXELS))
    found = [entry.name for entry in entries]
    assert found[:12] == [*names.values()]
    assert found[12:15] == ["b", "b_1", "b_2"]
    assert len({name.casefold() for name in found}) == len(found)
    for name in found:
        (tmp_path / f"{name}.png").write_bytes(b"")
    assert len(list(tmp_path.glob("*.png"))) == len(found)


EYE = np.eye(4).tolist()
RAGGED = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1], [0, 0, 0, 1]]
SHEAR = [[1, 0.1, 0, 0], *EYE[1:]]
TRANSPOSED = [*EYE[:3], [2, 3, 4, 1]]
MATRICES = [
    (None, "4 rows of 4 numbers, got missing"),
    ("eye", "4 rows of 4 numbers, got 'eye'"),
    ([1, 2, 3, 4], "4 rows of 4 numbers"),
    ([[1, 2]], "4 rows of 4 numbers"),
    (np.eye(3).tolist(), "4 rows of 4 numbers"),
    (np.eye(5).tolist(), "4 rows of 4 numbers"),
    (RAGGED, "4 rows of 4 numbers"),
    ([["1", 0, 0, 0], *EYE[1:]], "finite numbers"),
    ([[10**400, 0, 0, 0], *EYE[1:]], "finite numbers"),
    ([[math.nan] * 4] * 4, "finite numbers"),
    ([[1e300] * 4] * 4, "finite numbers"),
    (TRANSPOSED, "last row 0 0 0 1, .* transpose"),
    (SHEAR, "expected a rotation"),
    ([[0] * 4] * 3, "expected a rotation"),
    (np.diag([1.0, 2.0, 1.0, 1.0]).tolist(), "expected a rotation"),
    (np.diag([1.0, 1.0, -1.0, 1.0]).tolist(), "reflection"),
]
REFUSED = {
    "both": [
        ({"fl_y": -3}, "focal lengths above 0, got 40, -3"),
        ({"fl_x": 0}, "focal lengths above 0, got 0, 42"),
        ({"fl_x": "500"}, "fl_x: expected a number, got '500'"),
        ({"fl_x": True}, "fl_x: expected a number, got True"),
        ({"cy": 10**400}, "cy: expected a number, got 1000"),
        ({"cx": 1e300}, r"cx: expected a number, got 1e\+300"),
        ({"w": 0}, "image size .* got w 0, h 24"),
        ({"w": 10**9}, r"image size .* got w 1e\+09, h 24"),
        ({"h": 3.5}, "image size .* got w 32, h 3.5"),
        ({"h": None}, "no image size: w is 32.*h is missing"),
        (NO_FOCAL, "a focal length, fl_x, camera_angle_x or x_fov, got none"),
        ({"fl_x": None, "camera_angle_x": 0}, "camera_angle_x: .*radians.* got 0"),
        ({"fl_x": None, "camera_angle_x": 40.0}, "radians.* got 40"),
        ({"fl_x": None, "x_fov": 180}, "x_fov: expected degrees between .* got 180"),
        ({"ftheta_p0": 0.1}, "ftheta_p0 0.1: this lens is not supported"),
        ({"latlong": True}, "latlong True: this lens is not supported"),
        ({"equirectangular": 1}, "equirectangular 1: this lens is not supported"),
        ({"k1": "a"}, "k1: expected a number, got 'a'"),
        ({"k1": math.nan}, "k1: expected a number, got nan"),
        ({"frame": {"file_path": 7}}, "file_path: expected text, got 7"),
        *(
            ({"frame": {"transform_matrix": matrix}}, f"transform_matrix: .*{expected}")
            for matrix, expected in MATRICES
        ),
    ],
    "cameras": [
        ({"w": None, "h": None}, "no image size.*--size WxH"),
        ({**NO_FOCAL, "camera_model": "ORTHOGRAPHIC", **ANGLE}, "length, fl_x, got n"),
        ({"camera_model": "FISHEYE624"}, "camera_model .* supported: PINHOLE, SIM"),
        ({"camera_model": ["OPENCV"]}, "camera_model .* is not supported"),
    ],
    "datasets": [
        ({"camera_model": "ORTHOPHOTO"}, "'ORTHOPHOTO' is not supported"),
        ({"k1": 0.1, "k4": 0.1}, "k4 of a perspective lens"),
        ({"k1": 0.1, "k6": 0.1}, "k6 of a perspective lens"),
        ({"is_fisheye": True, "p1": 0.1}, "a fisheye has no p1, p2"),
        ({"fl_x": 1e-30}, "focal lengths .* got 1e-30, 42"),
        ({"cx": -1e20}, "principal point .* got -1e[+]20, "),
        ({"ply_file_path": 3}, "ply_file_path: expected text, got 3"),
        ({"ply_file_path": "none.ply"}, r"'none\.ply': no such file.*remove ply_file"),
        ({"frame": {"file_path": None}}, "file_path: expected text, got missing"),
        ({"frame": {"distortion_params": [1, 2]}}, r"distortion_params: .* \[1, 2\]"),
    ],
    "whole datasets": [
        ({"frame": {"file_path": "images/1.png"}}, "'images/1.png' is listed more"),
        ({"test_filenames": "a"}, "test_filenames: expected a list, got 'a'"),
        ({"test_filenames": ["images/0.png", "0.png"]}, "1 of 2 names .*'0.png"),
    ],
}


@pytest.mark.parametrize(
    ("of", "more", "expected"),
    [(of, *row) for of, rows in REFUSED.items() for row in rows],
)
def test_bad_values(tmp_path, of, more, expected):
    frames = frames_of(dataset_of_views(3))
    content = PIXELS | more
    frames[0] |= content.pop("frame", {})
    path = write_transforms(tmp_path, frames, **content)
    frame_of = "" if of == "whole datasets" else r"frames\[0\]: .*"
    loaders = {"both": (load_transforms, poses_of), "cameras": (load_transforms,)}
    for load in loaders.get(of, (poses_of,)):
        rejects(rf"transforms\.json: .*{frame_of}{expected}", load, path)


def test_bad_sizes_and_frames(tmp_path):
    expected = r"fl_x: .* got 1e\+308"
    rejects(expected, load_one, tmp_path, fl_x=1e308, w=1, h=480, size=(9, 9))
    for size in [(0, 4), (4, 4.5), (4,), (4, -1), ("4", 4)]:
        rejects("size: expected", load_one, tmp_path, **PIXELS, size=size)
    for frames in (None, {"0": 1}, [3]):
        path = write_transforms(tmp_path, frames)
        rejects(r"transforms\.json: .*frames.*expected", load_transforms, path)


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
        applied_transform=[[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 5]],
        ply_file_path="sparse_pc.ply",
    )
    cloud(tmp_path / "sparse_pc.ply", made.points, made.colors)
    dataset = load_dataset(tmp_path)
    assert dataset.format == "transforms"
    names = [f"images/frame_{n}.png" for n in range(4)]
    assert [view.name for view in dataset.views] == names
    K = [[40, 0, 15.5], [0, 42, 12.25], [0, 0, 1]]
    for view, given in zip(dataset.views, made.views):
        np.testing.assert_allclose(view.viewmat, given.viewmat, atol=1e-14)
        np.testing.assert_array_equal(view.K, K)
        assert view.image.is_file()
        assert (view.lens, view.split) == (None, None)
    np.testing.assert_allclose(dataset.points, made.points, rtol=1e-6)
    np.testing.assert_array_equal(dataset.colors, made.colors)


FOUR = {"k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4}
FISHEYE = ("fisheye", (0.1, 0.2, 0.3, 0.4))


@pytest.mark.parametrize(
    ("more", "lens"),
    [
        ({"k1": 0, "k2": 0, "k3": 0, "k4": 0, "p1": 0, "p2": 0.0}, None),
        ({"k1": 0.05, "k4": 0, "is_fisheye": False}, ("opencv", (0.05, 0, 0, 0, 0))),
        (
            {"k1": 0.1, "k2": -0.02, "k3": 0.3, "p1": 0.001, "p2": 0.002},
            ("opencv", (0.1, -0.02, 0.001, 0.002, 0.3)),
        ),
        ({**FOUR, "is_fisheye": True}, FISHEYE),
        ({**FOUR, "camera_model": "OPENCV_FISHEYE"}, FISHEYE),
    ],
)
def test_instant_ngp(tmp_path, more, lens):
    frames = frames_of(dataset_of_views(2), "./images/{}.jpg", sharpness=30.5)
    write_transforms(tmp_path, frames, aabb_scale=16, scale=0.33, **PIXELS, **more)
    for view, index in zip(load_dataset(tmp_path, poses_only=True).views, range(2)):
        assert view.name == f"images/{index}.jpg"
        assert view.lens == (None if lens is None else Distortion(*lens))


def test_nerf_synthetic(tmp_path):
    """RGBA, no suffixes, no sizes, one list per split."""
    rgba = np.zeros((SIZE[1], SIZE[0], 4), np.uint8)
    rgba[5:9] = (10, 200, 30, 128)
    for split, count in (("train", 3), ("test", 2), ("val", 1)):
        frames = frames_of(dataset_of_views(count), f"./{split}/r_{{}}", rotation=0.01)
        for index in range(count):
            save_photo(tmp_path / split / f"r_{index}.png", rgba)
            save_photo(tmp_path / split / f"r_{index}_depth_0001.png")
        name = f"transforms_{split}.json"
        write_transforms(tmp_path, frames, name, camera_angle_x=0.69)
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


def test_missing_sizes_are_those_of_the_originals(tmp_path):
    """Intrinsics in px refer to the originals if smaller copies are read."""
    frames = frames_of(dataset_of_views(2))
    for index in range(2):
        save_photo(tmp_path / f"images_2/{index}.png", np.zeros((12, 16, 3), np.uint8))
        save_photo(tmp_path / f"images/{index}.png")
    write_transforms(tmp_path, frames, **(PIXELS | {"w": None, "h": None}))
    for more in ({"factor": 2}, {"images": "images_2"}):
        view = load_dataset(tmp_path, **more).views[0]
        assert (view.width, view.height) == SIZE
        expected = [[20, 0, 7.75], [0, 21, 6.125], [0, 0, 1]]
        np.testing.assert_allclose(load_photo(view).K, expected)
    (tmp_path / "images").rename(tmp_path / "originals")
    expected = r"original of the smaller .* give w and"
    rejects(expected, load_dataset, tmp_path, factor=2)
    write_transforms(tmp_path, frames, camera_angle_x=2 * math.atan(0.4))
    copies = load_dataset(tmp_path, factor=2).views[0]
    assert (copies.width, copies.K[0, 0]) == (16, pytest.approx(20))


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
        # Other spellings of the names.
        (([f".\\{n}" for n in NAMES[:3]], NAMES[3:]), "train train train test", None),
        (([f"./{name}" for name in NAMES],), "train train train train", None),
    ],
)
@pytest.mark.filterwarnings("ignore:.*frames are in")
def test_splits_by_lists_of_names(tmp_path, lists, splits, expected):
    keys = [f"{split}_filenames" for split in ("train", "val", "test")]
    frames = frames_of(dataset_of_views(4), "./images/frame_{}.png")
    nerfstudio_dataset(tmp_path, frames=frames, **dict(zip(keys, lists)))
    if expected:
        warned(expected, load_dataset, tmp_path)
    found = {view.name: view.split for view in load_dataset(tmp_path).views}
    assert " ".join(str(found.get(name, "-")) for name in NAMES) == splits


def test_masks(tmp_path):
    """Those of instant-ngp give a warning: no list names them; black means kept."""
    frames = frames_of(dataset_of_views(2), "images/frame_{}.png")
    frames[1]["mask_path"] = "masks/one.png"
    mask = save_photo(tmp_path / "masks/one.png")
    nerfstudio_dataset(tmp_path, frames=frames)
    assert [view.mask for view in load_dataset(tmp_path).views] == [None, mask]
    for index in range(2):
        save_photo(tmp_path / f"images/dynamic_mask_frame_{index}.png")
    expected = r"2 masks of instant-ngp are ignored.*_0\."
    views = warned(expected, load_dataset, tmp_path).views
    assert [view.mask for view in views] == [None, mask]
    load_dataset(tmp_path, poses_only=True)
    mask.unlink()
    rejects(r"frames\[1\]: mask_path 'masks/one\.png'", load_dataset, tmp_path)


@pytest.mark.parametrize("more", [{"factor": 2}, {"images": "images_2"}])
@pytest.mark.parametrize("place", ["{}/0.png", "images/{}/0.png"])
def test_equal_names_in_subfolders(tmp_path, more, place):
    frames = frames_of(dataset_of_views(3), "images/cam{}/0.png")
    nerfstudio_dataset(tmp_path, frames=frames)
    copies = [tmp_path / "images_2" / place.format(f"cam{n}") for n in range(3)]
    for path in copies:
        save_photo(path)
    save_photo(tmp_path / "images_2/0.png")  # belongs to none
    assert [view.image for view in load_dataset(tmp_path, **more).views] == copies
    for path in copies:
        path.unlink()
    expected = r"0\.png are one photograph in .*images_2, 0"
    rejects(expected, load_dataset, tmp_path, **more)


def test_point_clouds(tmp_path):
    made, path = dataset_of_views(points=9), tmp_path / "a.ply"
    cloud(path, made.points, made.colors / 255, "float")
    points, colors = read_point_cloud(path)
    np.testing.assert_allclose(points, made.points, rtol=1e-6)
    np.testing.assert_array_equal(colors, made.colors)
    cloud(path, made.points, None)
    assert (read_point_cloud(path)[1] == 128).all()
    cloud(path, made.points[:0], None)
    assert read_point_cloud(path)[0].shape == (0, 3)
    wide = {"form": "binary_little_endian", **dict.fromkeys("xyz", "double")}
    for rgb in ("red green blue", "diffuse_red diffuse_green diffuse_blue", "r g b"):
        for kind, scale in (("uchar", 1), ("ushort", 257)):
            for more, rtol in (({}, 1e-6), (wide, 0)):
                scaled = made.colors.astype(int) * scale
                cloud(path, made.points, scaled, kind, rgb, **more)
                points, colors = read_point_cloud(path)
                np.testing.assert_allclose(points, made.points, rtol=rtol)
                np.testing.assert_array_equal(colors, made.colors)
    for colors, kind, expected in (
        ([[9.0, 200, 3]], "float", "0 to 200"),
        ([[-1, 2, 3]], "int", "-1 to 3"),
        ([[0, 70000, 1]], "int", "0 to 70000"),
    ):
        cloud(path, made.points[:1], colors, kind)
        rejects(f"a.ply: .*colours.*{expected}", read_point_cloud, path)
