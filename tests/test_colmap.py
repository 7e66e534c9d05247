"""COLMAP models: equal to what pycolmap reads, and strict where that is not."""

import contextlib
import re
import shutil
import struct
import time
from dataclasses import replace

import cv2  # before pycolmap, whose zlib otherwise breaks the PNG encoder of OpenCV
import numpy as np
import pytest
from captures import SIZE, save_photo, scene_of_views
from hypothesis import given, settings
from hypothesis import strategies as st

from gsjax.errors import InputError
from gsjax.scene import colmap_binary, colmap_text
from gsjax.scene.colmap import find_colmap, load_colmap, read_colmap
from gsjax.scene.colmap_model import CAMERA_KINDS, quat_of, viewmat_of
from gsjax.scene.colmap_writer import write_colmap
from gsjax.scene.types import Lens
from gsjax.scene.undistort import distort

pycolmap = pytest.importorskip("pycolmap")
assert cv2 is not None

READERS = {
    "cameras": colmap_binary.read_cameras,
    "images": colmap_binary.read_images,
    "points3D": colmap_binary.read_points,
}


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory):
    """A model of pycolmap's making with tracks, 2D points, several cameras."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 2, 2
    options.num_frames_per_rig, options.num_points3D = 3, 15
    options.num_points2D_without_point3D = 3
    pycolmap.set_random_seed(1)
    model = pycolmap.synthesize_dataset(options)
    folder = tmp_path_factory.mktemp("synthetic")
    for form in ("bin", "txt"):
        (folder / form).mkdir()
    model.write_binary(folder / "bin")
    model.write_text(folder / "txt")
    return folder


def dataset(folder, scene=None, place="sparse/0"):
    """A dataset with photographs, of our own making."""
    scene = scene_of_views() if scene is None else scene
    write_colmap(folder / place, scene)
    for view in scene.views:
        save_photo(folder / "images" / view.name)
    return scene


def check_equal(model, theirs):
    by_name = {image.name: image for image in theirs.images.values()}
    assert len(model.images) == len(by_name) == 12
    for image in model.images:
        other = by_name[image.name]
        pose = other.cam_from_world()
        np.testing.assert_array_equal(image.quat, pose.rotation.quat[[3, 0, 1, 2]])
        np.testing.assert_array_equal(image.translation, pose.translation)
        viewmat = viewmat_of(image.quat, image.translation)
        # Equal to the last bit where the compiler of theirs fused nothing.
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


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_equal_to_pycolmap(synthetic, form):
    theirs = pycolmap.Reconstruction(synthetic / form)
    check_equal(read_colmap(synthetic / form), theirs)


def test_binary_goes_before_text(synthetic, tmp_path):
    for form in ("bin", "txt"):
        shutil.copytree(synthetic / form, tmp_path, dirs_exist_ok=True)
    for path in tmp_path.glob("*.txt"):
        path.write_text("nonsense")
    check_equal(read_colmap(tmp_path), pycolmap.Reconstruction(synthetic / "bin"))


# --- lenses ---

PARAMETERS = {
    **{"k": 0.03, "k1": 0.04, "k2": -0.02, "k3": 0.01, "k4": 0.005, "k5": 0.02},
    **{"k6": 0.001, "p1": 0.002, "p2": -0.003, "cx": 310.0, "cy": 245.5},
    **{"f": 500.0, "fx": 500.0, "fy": 510.0},
}


@pytest.mark.parametrize("kind", CAMERA_KINDS, ids=lambda kind: kind.name)
def test_camera_models(tmp_path, kind):
    number = pycolmap.CameraModelId.__members__.get(kind.name)
    if number is None:
        pytest.skip("unknown to this pycolmap")
    assert int(number) == kind.number
    camera = pycolmap.Camera.create_from_model_id(1, number, 500.0, 640, 480)
    assert len(camera.params) == kind.size
    names = camera.params_info.split(", ")
    if kind.lens is not None:
        camera.params = [PARAMETERS[name] for name in names]
    model = pycolmap.Reconstruction()
    model.add_camera(camera)
    model.write_binary(tmp_path)
    model.write_text(tmp_path)
    for reader, form in ((colmap_binary, "bin"), (colmap_text, "txt")):
        path = tmp_path / f"cameras.{form}"
        if kind.lens is None:
            wanted = rf"cameras.{form}: .*{kind.name} is not supported; undistort .*"
            with pytest.raises(InputError, match=wanted + "image_undistorter.*gsjax"):
                reader.read_cameras(path)
            continue
        ours = reader.read_cameras(path)[1]
        x, y = np.random.default_rng(0).uniform(-0.6, 0.6, (2, 50))
        if ours.lens is None:
            assert "PINHOLE" in kind.name
            found = x, y
        else:
            assert ours.lens.kind == kind.lens
            found = distort(ours.lens, x, y)
        pixels = np.stack([*found, np.ones(50)]).T @ ours.K.T
        wanted = camera.img_from_cam(np.stack([x, y, np.ones(50)], -1))
        np.testing.assert_allclose(pixels[:, :2], wanted, atol=1e-9)


def test_no_distortion_is_no_lens(tmp_path):
    cameras = []
    for number, name in enumerate(("SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"), 1):
        cameras.append(pycolmap.Camera.create_from_model_name(number, name, 9, 640, 4))
    model = pycolmap.Reconstruction()
    for camera in cameras:
        model.add_camera(camera)
    model.write_binary(tmp_path)
    found = colmap_binary.read_cameras(tmp_path / "cameras.bin")
    assert found[1].lens is None
    assert found[2].lens is None
    assert found[3].lens == Lens("fisheye", (0.0,) * 4)  # equidistant: no pinhole


# --- poses ---


def test_quaternions_there_and_back():
    rng = np.random.default_rng(0)
    quats = [*rng.normal(size=(50, 4)), *np.eye(4), (1, 1e-9, 0, 0), (1e-9, 0, 1, 0)]
    for quat in quats:
        quat = np.asarray(quat) / np.linalg.norm(quat)
        rotation = viewmat_of(quat, np.zeros(3))[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(rotation) > 0
        found = quat_of(rotation)
        again = viewmat_of(found, np.zeros(3))[:3, :3]
        np.testing.assert_allclose(again, rotation, atol=1e-14)
        assert abs(found @ quat) > 1 - 1e-14


# --- the writer ---


@pytest.mark.parametrize("at", [(0, 0, 0), (5e5, -4.1e6, 120)])
def test_written_and_read(tmp_path, at):
    scene = scene_of_views(at=np.asarray(at))
    lenses = [None, Lens("radial_tangential", (0.1, 0.0, 0.0, 0.02))]
    lenses += [Lens("radial_tangential", (0.1, 0.0, 0.0, 0.02, 0.3))]
    lenses += [Lens("fisheye", (0.1, 0.0, 0.0, 0.02)), None]
    views = tuple(replace(v, lens=lens) for v, lens in zip(scene.views, lenses))
    scene = replace(scene, views=views)
    write_colmap(tmp_path / "a" / "b", scene)
    model = read_colmap(tmp_path / "a" / "b")
    np.testing.assert_array_equal(model.points.xyz, scene.points)
    np.testing.assert_array_equal(model.points.colors, scene.colors)
    for view, image in zip(views, model.images):
        camera = model.cameras[image.camera]
        np.testing.assert_array_equal(camera.K, view.K)
        assert (camera.width, camera.height) == SIZE
        assert (camera.lens is None) == (view.lens is None)
        if view.lens is not None and camera.lens is not None:
            assert camera.lens.kind == view.lens.kind
            given = view.lens.coefficients
            assert camera.lens.coefficients[: len(given)] == given
        found = viewmat_of(image.quat, image.translation)
        scale = max(1.0, np.abs(view.viewmat).max())
        np.testing.assert_allclose(found, view.viewmat, atol=2e-15 * scale)
    theirs = pycolmap.Reconstruction(tmp_path / "a" / "b")
    assert (theirs.num_images(), theirs.num_points3D()) == (5, 40)
    assert theirs.num_cameras() == 4  # the first is the last
    with pytest.raises(InputError, match=r"cameras\.bin.*exists"):
        write_colmap(tmp_path / "a" / "b", scene)
    write_colmap(tmp_path / "a" / "b", scene, overwrite=True)


def test_equal_cameras_become_one(tmp_path):
    write_colmap(tmp_path, scene_of_views(6))
    assert len(read_colmap(tmp_path).cameras) == 2


# --- datasets ---


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "."])
def test_places(tmp_path, place):
    scene = dataset(tmp_path, place=place)
    loaded = load_colmap(tmp_path)
    assert find_colmap(tmp_path) == loaded.source == tmp_path / place
    assert loaded.format == "colmap"
    for ours, view in zip(loaded.views, scene.views):
        assert ours.name == view.name
        assert ours.image == tmp_path / "images" / view.name
        np.testing.assert_allclose(ours.viewmat, view.viewmat, atol=1e-14)
    np.testing.assert_array_equal(loaded.points, scene.points)


def test_smaller_copies(tmp_path):
    scene = dataset(tmp_path)
    with pytest.raises(InputError, match=r"images_4: no such folder.*has the folders"):
        load_colmap(tmp_path, factor=4)
    for view in scene.views:
        save_photo((tmp_path / "images_4" / view.name).with_suffix(".jpg"))
    loaded = load_colmap(tmp_path, factor=4)
    assert loaded.views[0].image == tmp_path / "images_4" / "view_00.jpg"
    assert loaded.views[0].name == "view_00.png"
    assert (loaded.views[0].width, loaded.views[0].height) == SIZE
    by_name = load_colmap(tmp_path, images="images_4")
    assert [v.image for v in by_name.views] == [v.image for v in loaded.views]
    for factor in (0, -2, 1.5):
        with pytest.raises(InputError, match=r"factor .*whole number"):
            load_colmap(tmp_path, factor=factor)
    elsewhere = tmp_path / "other"
    shutil.move(tmp_path / "images", elsewhere)
    assert load_colmap(tmp_path, images=elsewhere).views[0].image.parent == elsewhere
    with pytest.raises(InputError, match=r"images: no such folder.*images_4.*images="):
        load_colmap(tmp_path)


def test_masks(tmp_path):
    scene = dataset(tmp_path)
    names = [view.name for view in scene.views]
    first = save_photo(tmp_path / "masks" / names[0])
    second = save_photo(tmp_path / "masks" / (names[1] + ".png"))
    masks = [view.mask for view in load_colmap(tmp_path).views]
    assert masks == [first, second, None, None, None]


def test_missing_photographs(tmp_path):
    scene = dataset(tmp_path)
    for index in (1, 3):
        (tmp_path / "images" / scene.views[index].name).unlink()
    wanted = r"2 of 5 photographs are missing .*: view_01\.png, view_03\.png"
    with pytest.raises(InputError, match=wanted + ".*--skip-missing"):
        load_colmap(tmp_path)
    with pytest.warns(UserWarning, match=wanted):
        loaded = load_colmap(tmp_path, skip_missing=True)
    names = [view.name for view in loaded.views]
    assert names == ["view_00.png", "view_02.png", "view_04.png"]
    for path in (tmp_path / "images").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="5 of 5 photographs are missing"):
        load_colmap(tmp_path, skip_missing=True)


def test_missing_files(tmp_path):
    dataset(tmp_path)
    (tmp_path / "sparse/0/points3D.bin").unlink()
    with pytest.warns(UserWarning, match=r"neither points3D.*has no points"):
        assert load_colmap(tmp_path).points.shape == (0, 3)
    (tmp_path / "sparse/0/images.bin").unlink()
    with pytest.raises(InputError, match=r"neither images\.bin nor images\.txt"):
        load_colmap(tmp_path)


# --- what is refused ---


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


def write_text(folder, cameras=CAMERA, images=IMAGE + "\n", points=POINT):
    folder.mkdir(exist_ok=True, parents=True)
    contents = {"cameras": cameras, "images": images, "points3D": points}
    for name, text in contents.items():
        if text is not None:
            (folder / f"{name}.txt").write_text(text + "\n")
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
        ({"images": f"{IMAGE}\n1 2"}, "line 2: 2 values; X Y POINT3D_ID"),
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
