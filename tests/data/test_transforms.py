"""Camera lists: known matrices, both forms of intrinsics, and what is refused."""

import json
import math

import numpy as np
import pytest

from gsjax.cameras.camera import look_at
from gsjax.data.transforms import load_near_transforms, load_transforms
from gsjax.errors import InputError

PIXELS = {"fl_x": 500.0, "fl_y": 510.0, "cx": 310.0, "cy": 245.0, "w": 640, "h": 480}
ANGLE = {"camera_angle_x": 0.6911112070083618}


def frame(matrix=None, **more):
    matrix = np.eye(4) if matrix is None else np.asarray(matrix, np.float64)
    return {"transform_matrix": matrix.tolist(), **more}


def put(folder, content):
    path = folder / "transforms.json"
    if not isinstance(content, str | bytes):
        content = json.dumps(content)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def load_one(folder, *, size=None, **content):
    content.setdefault("frames", [frame()])
    [entry] = load_transforms(put(folder, content), size=size)
    return entry.camera


def to_opengl(viewmat):
    """Camera → world in OpenGL axes of an OpenCV world → camera matrix."""
    return np.linalg.inv(viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])


def assert_K(camera, fx, fy, cx, cy):
    wanted = np.asarray([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    np.testing.assert_allclose(np.asarray(camera.K), wanted, rtol=1e-6)


# --- poses ---


def test_identity_is_a_flip_of_y_and_z(tmp_path):
    viewmat = np.asarray(load_one(tmp_path, **PIXELS).viewmat)
    np.testing.assert_array_equal(viewmat, np.diag([1, -1, -1, 1]))


@pytest.mark.parametrize("rows", [3, 4])
def test_known_pose(tmp_path, rows):
    wanted = look_at(eye=(3.0, -2.0, 1.0), target=(0.1, 0.2, 0.3))
    frames = [frame(to_opengl(wanted)[:rows])]
    camera = load_one(tmp_path, frames=frames, **PIXELS)
    np.testing.assert_allclose(np.asarray(camera.viewmat), wanted, atol=1e-6)


def test_known_points_fall_where_they_should(tmp_path):
    # At (0, 0, 5) looking down -z with y up, as OpenGL cameras do at rest: a point to
    # the right and above the axis falls right of and *above* the image centre.
    matrix = np.eye(4)
    matrix[2, 3] = 5
    camera = load_one(tmp_path, frames=[frame(matrix)], **PIXELS)
    viewmat, K = (np.asarray(a, np.float64) for a in (camera.viewmat, camera.K))
    point = viewmat @ (0.5, 0.25, 1.0, 1.0)
    np.testing.assert_allclose(point[:3], (0.5, -0.25, 4.0), rtol=1e-6)
    u, v, w = K @ point[:3]
    np.testing.assert_allclose((u / w, v / w), (372.5, 213.125), rtol=1e-6)


def test_scaled_rotation_is_divided_out(tmp_path):
    wanted = look_at(eye=(3.0, -2.0, 1.0), target=(0.0, 0.0, 0.0))
    matrix = to_opengl(wanted)
    matrix[:3, :3] *= 2.5
    path = put(tmp_path, {"frames": [frame(matrix)] * 2, **PIXELS})
    with pytest.warns(
        UserWarning, match=r"2 frames are scaled, .*0 \(× 2\.5\)"
    ) as told:
        entries = load_transforms(path)
    assert told[0].filename == __file__, "who asked is who is told"
    viewmat = np.asarray(entries[0].camera.viewmat)
    np.testing.assert_allclose(viewmat, wanted, atol=1e-6)


# --- intrinsics ---


def test_intrinsics_in_pixels(tmp_path):
    camera = load_one(tmp_path, **PIXELS)
    assert (camera.width, camera.height) == (640, 480)
    assert camera.model.name == "pinhole"
    assert_K(camera, 500, 510, 310, 245)


def test_defaults_of_intrinsics(tmp_path):
    camera = load_one(tmp_path, fl_x=500, w=640.0, h=480.0, fl_y=None)
    assert_K(camera, 500, 500, 320, 240)


def test_intrinsics_from_angles(tmp_path):
    fx = 0.5 * 800 / math.tan(0.5 * ANGLE["camera_angle_x"])
    camera = load_one(tmp_path, **ANGLE, w=800, h=600)
    assert_K(camera, fx, fx, 400, 300)
    camera = load_one(tmp_path, **ANGLE, camera_angle_y=0.5, w=800, h=600)
    assert_K(camera, fx, 300 / math.tan(0.25), 400, 300)
    # instant-ngp writes both; the pixels are what its trainer uses.
    assert_K(load_one(tmp_path, **ANGLE, **PIXELS), 500, 510, 310, 245)


def test_size_is_wanted_where_the_file_has_none(tmp_path):
    with pytest.raises(InputError, match=r"frames\[0\]: no image size.*--size WxH"):
        load_one(tmp_path, **ANGLE)
    with pytest.raises(InputError, match=r"w is 640.*h is missing"):
        load_one(tmp_path, **ANGLE, w=640, size=(64, 48))
    camera = load_one(tmp_path, **ANGLE, size=(400, 200))
    fx = 200 / math.tan(0.5 * ANGLE["camera_angle_x"])
    assert (camera.width, camera.height) == (400, 200)
    assert_K(camera, fx, fx, 200, 100)


def test_size_rescales(tmp_path):
    camera = load_one(tmp_path, **PIXELS, size=(320, 120))
    assert (camera.width, camera.height) == (320, 120)
    assert_K(camera, 250, 127.5, 155, 61.25)


def test_frames_override_the_file(tmp_path):
    frames = [frame(), frame(fl_x=100, w=64, h=32, cx=1.5), frame(fl_y=99)]
    frames.append(frame(camera_angle_x=math.pi / 2))
    entries = load_transforms(put(tmp_path, {"frames": frames, **PIXELS}))
    assert_K(entries[0].camera, 500, 510, 310, 245)
    assert_K(entries[1].camera, 100, 100, 1.5, 245)
    assert (entries[1].camera.width, entries[1].camera.height) == (64, 32)
    assert_K(entries[2].camera, 500, 99, 310, 245)
    assert_K(entries[3].camera, 320, 320, 310, 245)


@pytest.mark.parametrize("model", ["OPENCV", "PINHOLE", "opencv", None])
def test_pinhole_models(tmp_path, model):
    camera = load_one(tmp_path, camera_model=model, k1=0, p2=0.0, **PIXELS)
    assert camera.model.name == "pinhole"


def test_orthographic(tmp_path):
    camera = load_one(tmp_path, camera_model="ORTHOGRAPHIC", **PIXELS)
    assert camera.model.name == "orthographic"
    with pytest.raises(InputError, match="no focal length; fl_x is wanted"):
        load_one(tmp_path, camera_model="ORTHOGRAPHIC", **ANGLE, w=4, h=4)


@pytest.mark.parametrize(
    "more",
    [
        {"camera_model": "OPENCV_FISHEYE"},
        {"camera_model": "EQUIRECTANGULAR"},
        {"camera_model": ["OPENCV"]},
        {"is_fisheye": True},
    ],
)
def test_other_models_are_refused(tmp_path, more):
    wanted = r"transforms\.json: frames\[0\]: camera_model .*supported: OPENCV, PINHOLE"
    with pytest.raises(InputError, match=wanted):
        load_one(tmp_path, **more, **PIXELS)


def test_distortion_is_warned_of_once(tmp_path):
    frames = [frame(k2=0.1), frame(), frame(distortion_params=[0, 0.2])]
    path = put(tmp_path, {"frames": frames, "p1": -1e-4, "k1": 0, **PIXELS})
    wanted = r"distortion \(distortion_params, k2, p1\) is ignored"
    with pytest.warns(UserWarning, match=wanted) as caught:
        load_transforms(path)
    assert len(caught) == 1


# --- names ---


def test_names_are_unique_and_safe(tmp_path):
    paths = [
        "./train/r_0",
        "images/IMG_1.JPG",
        "other/img_1.png",
        "IMG_1_1.png",
        "..",
        "../../etc/passwd",
        "C:\\pictures\\a b.png",
        "/",
        ".hidden/..",
        "a\0b<>|\ud800.png",
        "é" * 300 + ".png",
        None,
    ]
    frames = [frame(file_path=path) for path in paths] + [frame()]
    entries = load_transforms(put(tmp_path, {"frames": frames, **PIXELS}))
    names = [entry.name for entry in entries]
    assert names == [
        "r_0",
        "IMG_1",
        "img_1_1",
        "IMG_1_1_1",
        "frame_00004",
        "passwd",
        "a b",
        "frame_00007",
        "frame_00008",
        "a_b____",
        "é" * 90,
        "frame_00011",
        "frame_00012",
    ]
    assert len({name.casefold() for name in names}) == len(names)
    for name in names:
        (tmp_path / f"{name}.png").write_bytes(b"")
    assert len(list(tmp_path.glob("*.png"))) == len(names)


def test_many_equal_names(tmp_path):
    frames = [frame(file_path="a.png")] * 300
    names = [
        e.name for e in load_transforms(put(tmp_path, {"frames": frames, **PIXELS}))
    ]
    assert len(set(names)) == 300
    assert names[:3] == ["a", "a_1", "a_2"]


# --- what is refused ---


@pytest.mark.parametrize(
    ("content", "wanted"),
    [
        ("", "not JSON"),
        ("{", "not JSON"),
        (b"\xff\xfe\xff", "not JSON"),
        ("[" * 9_000, "not JSON"),
        ("[1]", r"the top is \[1\]"),
        ({}, "'frames' is missing"),
        ({"frames": []}, r"'frames' is \[\]"),
        ({"frames": {"0": 1}}, "'frames' is {"),
        ({"frames": [3]}, r"frames\[0\] is 3"),
    ],
)
def test_no_camera_list(tmp_path, content, wanted):
    with pytest.raises(InputError, match=rf"transforms\.json: {wanted}"):
        load_transforms(put(tmp_path, content))


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match=r"none\.json: cannot be read: No such file"):
        load_transforms(tmp_path / "none.json")
    with pytest.raises(InputError, match="not a regular file"):
        load_transforms(tmp_path)


SHEAR = np.asarray([[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
MOVED = np.asarray([[1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 1, 4], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("matrix", "wanted"),
    [
        (None, "transform_matrix is missing"),
        ("eye", "transform_matrix is 'eye'"),
        ([], r"transform_matrix is \[\]; 4 rows"),
        ([1, 2, 3, 4], "4 rows of 4 numbers"),
        (np.eye(3).tolist(), "4 rows of 4 numbers"),
        (np.eye(5).tolist(), "4 rows of 4 numbers"),
        ([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1], [0, 0, 0, 1]], "4 rows of 4"),
        ([["1", 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "finite"),
        ([[10**400, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "finite"),
        (np.full((4, 4), np.nan).tolist(), "finite numbers"),
        (np.full((4, 4), np.inf).tolist(), "finite numbers"),
        ([[1e300] * 4] * 4, "finite numbers"),
        (MOVED.T.tolist(), "last row is .* transposed"),
        (SHEAR.tolist(), "no rotation"),
        (np.diag([1.0, 2.0, 1.0, 1.0]).tolist(), "no rotation"),
        (np.diag([0.0, 0.0, 0.0, 1.0]).tolist(), "no rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]).tolist(), "mirrors"),
    ],
)
def test_bad_matrices(tmp_path, matrix, wanted):
    frames = [frame(), {"transform_matrix": matrix}]
    path = put(tmp_path, {"frames": frames, **PIXELS})
    with pytest.raises(InputError, match=rf"transforms\.json: frames\[1\].*{wanted}"):
        load_transforms(path)


@pytest.mark.parametrize(
    ("more", "wanted"),
    [
        ({"fl_x": 0}, "focal lengths 0, 510"),
        ({"fl_y": -3}, "focal lengths 500, -3"),
        ({"fl_x": "500"}, "fl_x is '500'; a number"),
        ({"fl_x": True}, "fl_x is True; a number"),
        ({"cx": math.nan}, "cx is nan; a number"),
        ({"cy": 10**400}, "cy is 1000.*; a number"),
        ({"fl_x": 1e308, "w": 1, "size": (9, 9)}, r"fl_x is 1e\+308; a number"),
        ({"w": 0}, "image size w 0, h 480"),
        ({"h": 3.5}, "image size w 640, h 3.5"),
        ({"fl_x": None, "fl_y": None}, "no focal length"),
        ({"fl_x": None, "camera_angle_x": 0}, "camera_angle_x is 0; radians"),
        ({"fl_x": None, "camera_angle_x": 40.0}, "camera_angle_x is 40; radians"),
    ],
)
def test_bad_intrinsics(tmp_path, more, wanted):
    with pytest.raises(InputError, match=rf"transforms\.json: frames\[0\]: {wanted}"):
        load_one(tmp_path, **(PIXELS | more))


def test_bad_file_path(tmp_path):
    with pytest.raises(InputError, match=r"frames\[0\]: file_path is 7"):
        load_one(tmp_path, frames=[frame(file_path=7)], **PIXELS)


@pytest.mark.parametrize("size", [(0, 4), (4, 4.5), (4,), (4, -1), ("4", 4)])
def test_bad_size(tmp_path, size):
    with pytest.raises(InputError, match=r"size .*is wanted"):
        load_one(tmp_path, **PIXELS, size=size)


def test_what_is_far_out_is_brought_near(tmp_path):
    """Points are seen where they are, to a thousandth of a pixel, at 10⁷ units."""
    far = np.asarray([1e7, -3e6, 0.0])
    rng = np.random.default_rng(0)
    viewmats = [look_at(far + rng.normal(size=3) * 4, far) for _ in range(5)]
    content = {"frames": [frame(to_opengl(v)) for v in viewmats], **PIXELS}
    entries, origin = load_near_transforms(put(tmp_path, content))
    assert (np.abs(origin - far)[:2] < 100).all()
    assert origin[2] == 0, "axis by axis"
    points = far + rng.normal(size=(50, 3)) / 2
    for viewmat, (_, camera) in zip(viewmats, entries):
        pixels = seen_at(viewmat, camera.K, points)
        found = seen_at(camera.viewmat, camera.K, np.float32(points - origin))
        np.testing.assert_allclose(found, pixels, atol=1e-3)
    alone, origin = load_near_transforms(
        put(tmp_path, {"frames": content["frames"][:1], **PIXELS})
    )
    assert origin.any(), "one camera is enough"
    assert np.abs(np.asarray(alone[0].camera.viewmat)[:3, 3]).max() < 100


def seen_at(viewmat, K, points):
    """Pixels of points, in the precision of the points."""
    viewmat, K = (np.asarray(a, points.dtype) for a in (viewmat, K))
    seen = (points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
    return seen[:, :2] / seen[:, 2:]
