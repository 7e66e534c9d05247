"""`transforms.json` as datasets: three dialects, their lenses, splits and points."""

import json
import math

import numpy as np
import pytest
from captures import SIZE, save_photo, scene_of_views, to_opengl

from gsjax.data.dataset import load_dataset
from gsjax.data.photos import load_photo
from gsjax.data.transforms import load_transforms
from gsjax.data.types import Distortion
from gsjax.errors import InputError
from gsjax.io.point_cloud import read_point_cloud

PIXELS = {"fl_x": 40.0, "fl_y": 42.0, "cx": 15.5, "cy": 12.25, "w": 32, "h": 24}


def frames_of(scene, form="images/{}", **more):
    """Frames that list the views, whose names are numbers here."""
    return [
        {
            "file_path": form.format(index),
            "transform_matrix": to_opengl(view.viewmat).tolist(),
            **more,
        }
        for index, view in enumerate(scene.views)
    ]


def put(folder, frames, name="transforms.json", **content):
    path = folder / name
    path.write_text(json.dumps({**content, "frames": frames}))
    return path


def nerfstudio(folder, count=4, **content):
    """A dataset as ns-process-data writes it, with photographs."""
    scene = scene_of_views(count)
    frames = content.pop("frames", frames_of(scene, "images/frame_{}.png"))
    for frame in frames:
        save_photo(folder / frame["file_path"])
    put(folder, frames, **{**PIXELS, "camera_model": "OPENCV", **content})
    return scene


def cloud(path, points, colors, kind="uchar"):
    """An ascii PLY of points, as nerfstudio's sparse_pc.ply."""
    lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    lines += [f"property float {name}" for name in "xyz"]
    if colors is not None:
        lines += [f"property {kind} {name}" for name in ("red", "green", "blue")]
    lines.append("end_header")
    for index, point in enumerate(points):
        color = [] if colors is None else colors[index].tolist()
        lines.append(" ".join(map(str, [*point.tolist(), *color])))
    path.write_text("\n".join(lines) + "\n")


# --- dialects ---


def test_nerfstudio(tmp_path):
    # applied_transform says what was done to poses and points; nothing is undone.
    made = nerfstudio(
        tmp_path,
        k1=0.1, k2=-0.02, p1=0.001, p2=0.002,
        applied_transform=[[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 5]],
        ply_file_path="sparse_pc.ply",
    )  # fmt: skip
    cloud(tmp_path / "sparse_pc.ply", made.points, made.colors)
    scene = load_dataset(tmp_path)
    assert scene.format == "transforms"
    assert [v.name for v in scene.views] == [f"images/frame_{n}.png" for n in range(4)]
    for view, wanted in zip(scene.views, made.views):
        np.testing.assert_allclose(view.viewmat, wanted.viewmat, atol=1e-14)
        np.testing.assert_array_equal(
            view.K, [[40, 0, 15.5], [0, 42, 12.25], [0, 0, 1]]
        )
        assert view.lens == Distortion(
            "radial_tangential", (0.1, -0.02, 0.001, 0.002, 0.0)
        )
        assert view.image.is_file()
        assert view.split is None
    np.testing.assert_allclose(scene.points, made.points, rtol=1e-6)
    np.testing.assert_array_equal(scene.colors, made.colors)


def test_instant_ngp(tmp_path):
    scene = scene_of_views(3)
    frames = frames_of(scene, "./images/{}.jpg", sharpness=30.5)
    for index in range(3):
        save_photo(tmp_path / f"images/{index}.jpg")
    more = {"k1": 0.05, "k2": 0.01, "k3": 0, "k4": 0, "p1": 0, "p2": 0.0}
    more |= {"camera_angle_x": 0.7, "camera_angle_y": 0.5, "is_fisheye": False}
    put(tmp_path, frames, aabb_scale=16, scale=0.33, **PIXELS, **more)
    views = load_dataset(tmp_path).views
    assert [v.name for v in views] == ["images/0.jpg", "images/1.jpg", "images/2.jpg"]
    assert views[0].lens == Distortion("radial_tangential", (0.05, 0.01, 0.0, 0.0, 0.0))
    assert views[0].K[0, 0] == 40


@pytest.mark.parametrize(
    "more", [{"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}]
)
def test_fisheye(tmp_path, more):
    nerfstudio(
        tmp_path, k1=0.1, k2=0.2, k3=0.3, k4=0.4, **{"camera_model": None, **more}
    )
    view = load_dataset(tmp_path).views[0]
    assert view.lens == Distortion("fisheye", (0.1, 0.2, 0.3, 0.4))


def synthetic(folder):
    """NeRF's synthetic scenes: RGBA, no suffixes, no sizes, one list per split."""
    rgba = np.zeros((SIZE[1], SIZE[0], 4), np.uint8)
    rgba[5:9] = (10, 200, 30, 128)
    for split, count in (("train", 3), ("test", 2), ("val", 1)):
        frames = frames_of(scene_of_views(count), f"./{split}/r_{{}}", rotation=0.01)
        for index in range(count):
            save_photo(folder / split / f"r_{index}.png", rgba)
            save_photo(folder / split / f"r_{index}_depth_0001.png")
        put(folder, frames, f"transforms_{split}.json", camera_angle_x=0.69)


def test_nerf_synthetic(tmp_path):
    synthetic(tmp_path)
    scene = load_dataset(tmp_path)
    names = [(view.name, view.split) for view in scene.views]
    assert names == [
        ("test/r_0.png", "test"),
        ("test/r_1.png", "test"),
        ("train/r_0.png", "train"),
        ("train/r_1.png", "train"),
        ("train/r_2.png", "train"),
    ]
    view = scene.views[2]
    assert (view.width, view.height) == SIZE
    focal = 16 / math.tan(0.69 / 2)
    wanted = [[focal, 0, 16], [0, focal, 12], [0, 0, 1]]
    np.testing.assert_allclose(view.K, wanted, rtol=1e-15)
    photo = load_photo(view)
    assert photo.alpha is not None
    assert (photo.alpha[5:9] == 128).all()
    assert (photo.pixels[6, 3] == (10, 200, 30)).all()
    assert photo.alpha[0, 0] == 0


def test_validation_views_stand_in_for_test_views(tmp_path):
    synthetic(tmp_path)
    (tmp_path / "transforms_test.json").unlink()
    splits = {view.name: view.split for view in load_dataset(tmp_path).views}
    assert splits == {f"train/r_{n}.png": "train" for n in range(3)} | {
        "val/r_0.png": "test"
    }


def test_a_list_by_itself(tmp_path):
    synthetic(tmp_path)
    [view] = load_dataset(tmp_path / "transforms_val.json").views
    assert (view.name, view.split) == ("val/r_0.png", None)
    views = load_dataset(tmp_path / "transforms_train.json").views
    assert {view.split for view in views} == {"train"}


# --- parts ---


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
    """One alone is that of both axes, as instant-ngp has it."""
    frames = frames_of(scene_of_views(2), "images/{}.png", **angles)
    if at == "top":
        frames = frames_of(scene_of_views(2), "images/{}.png")
    none = {"fl_x": None, "fl_y": None}
    nerfstudio(tmp_path, frames=frames, **(none | angles if at == "top" else none))
    fx = 16 / math.tan(math.radians(30)) if any("x" in k for k in angles) else None
    fy = 12 / math.tan(math.radians(25)) if any("y" in k for k in angles) else fx
    wanted = [[fx or fy, 0, 15.5], [0, fy, 12.25], [0, 0, 1]]
    for view in load_dataset(tmp_path).views:
        np.testing.assert_allclose(view.K, wanted, rtol=1e-14)
    for _, camera in load_transforms(tmp_path / "transforms.json"):
        np.testing.assert_allclose(camera.K, wanted, rtol=1e-6)


def test_intrinsics_of_frames(tmp_path):
    made = scene_of_views(3)
    frames = frames_of(made, "images/{}.png")
    frames[1] |= {"fl_x": 99.0, "fl_y": 98.0, "w": 64, "h": 48, "cx": 30.0, "cy": 20.0}
    frames[2] |= {"distortion_params": [0.1, 0.2, 0.3, 0, 0.01, 0.02]}
    nerfstudio(tmp_path, frames=frames)
    views = load_dataset(tmp_path).views
    assert views[0].lens is None
    assert (views[1].width, views[1].K[0, 0], views[1].K[1, 2]) == (64, 99, 20)
    assert views[2].lens == Distortion("radial_tangential", (0.1, 0.2, 0.01, 0.02, 0.3))


def test_splits_by_name(tmp_path):
    names = [f"images/frame_{n}.png" for n in range(4)]
    nerfstudio(tmp_path, train_filenames=names[:2], val_filenames=names[2:])
    splits = [view.split for view in load_dataset(tmp_path).views]
    assert splits == ["train", "train", "test", "test"]
    lists = {"train_filenames": names[:2], "val_filenames": names[2:3]}
    nerfstudio(tmp_path, **lists, test_filenames=names[3:])
    views = load_dataset(tmp_path).views
    assert [view.name for view in views] == [names[0], names[1], names[3]]
    assert [view.split for view in views] == ["train", "train", "test"]


@pytest.mark.parametrize("form", ["./{}", "{}", ".\\{}"])
def test_splits_by_names_however_they_are_spelt(tmp_path, form):
    frames = frames_of(scene_of_views(4), "./images/frame_{}.png")
    names = [form.format(f"images/frame_{n}.png") for n in range(4)]
    lists = {"train_filenames": names[:3], "test_filenames": names[3:]}
    nerfstudio(tmp_path, frames=frames, **lists)
    splits = [view.split for view in load_dataset(tmp_path).views]
    assert splits == ["train"] * 3 + ["test"]


def test_frames_in_no_list_and_in_two(tmp_path):
    """As nerfstudio has it, nothing is learnt of the former; the latter are held out,
    where nerfstudio would learn from them too."""
    names = [f"images/frame_{n}.png" for n in range(4)]
    nerfstudio(tmp_path, train_filenames=names[:2], test_filenames=names[3:])
    with pytest.warns(UserWarning, match="1 of 4 frames are in none of its lists, im"):
        views = load_dataset(tmp_path).views
    assert [view.name for view in views] == [names[0], names[1], names[3]]
    for other in ("test_filenames", "val_filenames"):
        nerfstudio(tmp_path, **{"train_filenames": names, other: names[1:2]})
        with pytest.warns(UserWarning, match=f"1 of 4 frames .* with, {names[1]} f"):
            views = load_dataset(tmp_path).views
        assert [view.split for view in views] == ["train", "test", "train", "train"]
    # Without a list to train with, what is in none is trained with.
    nerfstudio(tmp_path, test_filenames=names[:1])
    views = load_dataset(tmp_path).views
    assert [view.split for view in views] == ["test", None, None, None]


def test_a_list_of_frames_that_are_not_there(tmp_path):
    nerfstudio(tmp_path, test_filenames=["images/frame_0.png", "frame_1.png"])
    with pytest.raises(InputError, match=r"1 of 2 names of test_filenames .*'frame_1"):
        load_dataset(tmp_path)


@pytest.mark.parametrize("kept", ["images", "originals"])
def test_sizes_that_are_not_given_are_those_of_the_originals(tmp_path, kept):
    """What is in px is of them, where smaller copies are read."""
    frames = frames_of(scene_of_views(2), "images/{}.png")
    for index in range(2):
        save_photo(tmp_path / f"images_2/{index}.png", np.zeros((12, 16, 3), np.uint8))
        save_photo(tmp_path / f"{kept}/{index}.png")
    pixels = {"fl_x": 40.0, "fl_y": 42.0, "cx": 15.5, "cy": 12.25}
    put(tmp_path, frames, **pixels)
    if kept == "originals":
        with pytest.raises(InputError, match=r"smaller copy is not there; give w and"):
            load_dataset(tmp_path, factor=2)
        put(tmp_path, frames, camera_angle_x=2 * math.atan(0.4))
        copies = load_dataset(tmp_path, factor=2).views[0]
        assert (copies.width, copies.K[0, 0]) == (16, pytest.approx(20))
        return
    for more in ({"factor": 2}, {"images": "images_2"}):
        view = load_dataset(tmp_path, **more).views[0]
        assert (view.width, view.height) == SIZE
        np.testing.assert_allclose(
            load_photo(view).K, [[20, 0, 7.75], [0, 21, 6.125], [0, 0, 1]]
        )


def test_masks_and_smaller_copies(tmp_path):
    made = scene_of_views(2)
    frames = frames_of(made, "images/{}.png")
    frames[1]["mask_path"] = "masks/one.png"
    save_photo(tmp_path / "masks/one.png")
    nerfstudio(tmp_path, frames=frames)
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
    with pytest.raises(InputError, match=r"frames\[1\]: mask_path 'masks/one\.png'"):
        load_dataset(tmp_path)


def test_masks_of_instant_ngp_are_told(tmp_path):
    """No list names them, and black is what is kept there."""
    nerfstudio(tmp_path)
    for index in (1, 3):
        save_photo(tmp_path / f"images/dynamic_mask_frame_{index}.png")
    with pytest.warns(UserWarning, match=r"2 masks of instant-ngp, .*_1\.png first"):
        views = load_dataset(tmp_path).views
    assert [view.mask for view in views] == [None] * 4
    load_dataset(tmp_path, poses_only=True)


def test_photographs_elsewhere(tmp_path):
    folder, elsewhere = tmp_path / "data", tmp_path / "photos"
    nerfstudio(folder)
    (folder / "images").rename(elsewhere)
    for images in (elsewhere, str(elsewhere), "../photos"):
        for view, number in zip(load_dataset(folder, images=images).views, range(4)):
            assert view.image.samefile(elsewhere / f"frame_{number}.png")
            assert view.name == f"frame_{number}.png", "no way out of the dataset"
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
def test_names_that_lead_out_of_the_dataset(tmp_path, form):
    """Never followed; with a folder that is told they are looked for within it."""
    folder, elsewhere = tmp_path / "data", tmp_path / "photos"
    for index in range(3):
        save_photo(elsewhere / "a" / f"{index}.png")
    folder.mkdir()
    frames = frames_of(scene_of_views(3), form)
    put(folder, frames, **PIXELS)
    with pytest.raises(InputError, match=r"frames\[0\]: .* pass images=.*--images"):
        load_dataset(folder)
    with pytest.raises(InputError, match="3 of 3 photographs are missing"):
        load_dataset(folder, images=folder)
    for images in (elsewhere / "a", "../photos/a"):
        views = load_dataset(folder, images=images).views
        assert [view.name for view in views] == ["0.png", "1.png", "2.png"]
        for view in views:
            assert view.image.samefile(elsewhere / "a" / view.name)
    for bad in ("..", "/", "../../x\0"):
        put(folder, [{**frames[0], "file_path": bad}], **PIXELS)
        with pytest.raises(InputError, match="not that of a file within"):
            load_dataset(folder, images=elsewhere)


@pytest.mark.parametrize("more", [{"factor": 2}, {"images": "images_2"}])
@pytest.mark.parametrize("place", ["{}/0.png", "images/{}/0.png"])
def test_folders_within_folders(tmp_path, more, place):
    """Views of the same number are told apart by their folders, whatever is asked."""
    frames = frames_of(scene_of_views(3), "images/cam{}/0.png")
    nerfstudio(tmp_path, frames=frames)
    copies = [tmp_path / "images_2" / place.format(f"cam{n}") for n in range(3)]
    for path in copies:
        save_photo(path)
    save_photo(tmp_path / "images_2/0.png")  # of nobody
    assert [view.image for view in load_dataset(tmp_path, **more).views] == copies
    for path in copies:
        path.unlink()
    with pytest.raises(InputError, match=r"0\.png are one photograph in .*images_2, 0"):
        load_dataset(tmp_path, **more)


def test_missing_photographs(tmp_path):
    nerfstudio(tmp_path)
    (tmp_path / "images/frame_2.png").unlink()
    wanted = r"transforms\.json: 1 of 4 photographs .*: images/frame_2\.png"
    with pytest.raises(InputError, match=wanted):
        load_dataset(tmp_path)
    with pytest.warns(UserWarning, match=wanted):
        assert len(load_dataset(tmp_path, skip_missing=True).views) == 3


def test_scaled_rotations_are_warned_of(tmp_path):
    made = scene_of_views(2)
    frames = frames_of(made, "images/{}.png")
    matrix = to_opengl(made.views[0].viewmat)
    matrix[:3, :3] *= 2
    frames[0]["transform_matrix"] = matrix.tolist()
    nerfstudio(tmp_path, frames=frames)
    with pytest.warns(UserWarning, match=r"1 frames are scaled, the first: 0 \(× 2\)"):
        scene = load_dataset(tmp_path)
    wanted = made.views[0].viewmat
    np.testing.assert_allclose(scene.views[0].viewmat, wanted, atol=1e-14)


@pytest.mark.parametrize(
    ("more", "wanted"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "'EQUIRECTANGULAR' is not supported"),
        ({"ftheta_p0": 0.1}, "ftheta_p0 is 0.1, of a lens that is not supported"),
        ({"latlong": True}, "latlong is True, of a lens that is not supported"),
        ({"equirectangular": 1}, "equirectangular is 1, of a lens"),
        ({"fl_x": None, "fl_y": None}, "no focal length; fl_x, camera_angle_x or x_"),
        ({"fl_x": None, "x_fov": 180}, "x_fov is 180; degrees between 0 and 180"),
        ({"k1": 0.1, "k4": 0.1}, "k4 of a lens that is no fisheye"),
        ({"k1": 0.1, "k6": 0.1}, "k6 of a lens that is no fisheye"),
        ({"is_fisheye": True, "p1": 0.1}, "a fisheye has no p1, p2"),
        ({"k1": "a"}, "k1 is 'a'; a number"),
        ({"fl_x": 0}, "focal lengths 0, 42"),
        ({"fl_x": 1e-30}, "focal lengths 1e-30, 42"),
        ({"cx": -1e20}, "principal point -1e[+]20, "),
        ({"w": 0}, "image size w 0"),
        ({"ply_file_path": 3}, "ply_file_path is 3; text"),
        ({"ply_file_path": "../a.ply"}, "within the dataset's folder"),
        (
            {"ply_file_path": "none.ply"},
            r"ply_file_path 'none\.ply': no such file.*off",
        ),
        ({"test_filenames": "a"}, "test_filenames is 'a'; a list"),
    ],
)
def test_bad_files(tmp_path, more, wanted):
    nerfstudio(tmp_path, **more)
    with pytest.raises(InputError, match=wanted):
        load_dataset(tmp_path)


@pytest.mark.parametrize(
    ("more", "wanted"),
    [
        ({"file_path": None}, r"frames\[1\]: file_path is missing"),
        ({"file_path": 7}, r"frames\[1\]: file_path is 7; text"),
        ({"file_path": "../images/0.png"}, r"frames\[1\]: the name '../images"),
        ({"file_path": "/etc/passwd"}, r"frames\[1\]: the name '/etc/passwd'"),
        ({"file_path": "images/0.png"}, "'images/0.png' is listed more than once"),
        ({"mask_path": "../m.png"}, r"frames\[1\]: the name '../m.png'"),
        ({"distortion_params": [1, 2]}, r"distortion_params is \[1, 2\]"),
        ({"transform_matrix": [[1]]}, r"frames\[1\]: transform_matrix"),
        ({"k1": math.nan}, "k1 is nan"),
    ],
)
def test_bad_frames(tmp_path, more, wanted):
    nerfstudio(tmp_path, frames=frames_of(scene_of_views(3), "images/{}.png"))
    data = json.loads((tmp_path / "transforms.json").read_text())
    data["frames"][1] |= more
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=wanted):
        load_dataset(tmp_path)


def test_every_truncation(tmp_path):
    nerfstudio(tmp_path, count=1)
    path = tmp_path / "transforms.json"
    data = path.read_bytes()
    for length in range(len(data)):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"transforms\.json: "):
            load_dataset(tmp_path)


# --- point clouds ---


def test_point_clouds(tmp_path):
    made = scene_of_views(points=9)
    path = tmp_path / "a.ply"
    cloud(path, made.points, made.colors / 255, "float")
    points, colors = read_point_cloud(path)
    np.testing.assert_allclose(points, made.points, rtol=1e-6)
    np.testing.assert_array_equal(colors, made.colors)
    cloud(path, made.points, None)
    assert (read_point_cloud(path)[1] == 128).all()
    cloud(path, made.points[:0], None)
    assert read_point_cloud(path)[0].shape == (0, 3)
    names = ["x", "y", "z", "nx", "red", "green", "blue", "alpha"]
    kinds = ["f8", "f8", "f8", "f4", "u1", "u1", "u1", "u1"]
    table = np.zeros(9, np.dtype(list(zip(names, kinds))))
    for axis, name in enumerate("xyz"):
        table[name] = made.points[:, axis]
        table[names[4 + axis]] = made.colors[:, axis]
    words = {"f8": "double", "f4": "float", "u1": "uchar"}
    head = ["ply", "format binary_little_endian 1.0", "element vertex 9"]
    head += [f"property {words[k]} {n}" for n, k in zip(names, kinds)] + ["end_header"]
    data = "\n".join(head).encode() + b"\n" + table.tobytes()
    path.write_bytes(data)
    points, colors = read_point_cloud(path)
    np.testing.assert_array_equal(points, made.points)
    np.testing.assert_array_equal(colors, made.colors)
    for length in range(0, len(data), 7):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"a\.ply: "):
            read_point_cloud(path)


@pytest.mark.parametrize(
    "names",
    [
        ("red", "green", "blue"),
        ("diffuse_red", "diffuse_green", "diffuse_blue"),
        ("r", "g", "b"),
    ],
)
@pytest.mark.parametrize("kind", ["uchar", "ushort"])
def test_colours_of_16_bits_and_other_names(tmp_path, names, kind):
    path, made = tmp_path / "a.ply", scene_of_views(points=9)
    wide = kind == "ushort"
    cloud(path, made.points, made.colors.astype(int) * (257 if wide else 1), kind)
    text = path.read_text()
    for old, new in zip(("red", "green", "blue"), names):
        text = text.replace(f"{kind} {old}", f"{kind} {new}")
    path.write_text(text)
    np.testing.assert_array_equal(read_point_cloud(path)[1], made.colors)


def test_bad_point_clouds(tmp_path):
    path = tmp_path / "a.ply"
    made = scene_of_views(points=9)
    cloud(path, made.points, made.colors.astype(float), "float")
    with pytest.raises(InputError, match=r"colours are floating-point, and up to 2"):
        read_point_cloud(path)
    for colors, told in (([-1, 2, 3], "-1 to 3"), ([0, 70000, 1], "0 to 70000")):
        cloud(path, made.points[:1], np.asarray([colors]), "int")
        with pytest.raises(InputError, match=f"colours are from {told}; 0 to 255"):
            read_point_cloud(path)
    cloud(path, np.asarray([[0, 1, 2], [0, np.nan, 1]]), None)
    with pytest.raises(InputError, match=r"1 of 2 points have .*the first: \[1\]"):
        read_point_cloud(path)
    path.write_text(path.read_text().replace("float y", "float why"))
    with pytest.raises(InputError, match=r"has x, why, z; scalar x, y, z"):
        read_point_cloud(path)
    with pytest.raises(InputError, match="not a regular file"):
        read_point_cloud(tmp_path)
