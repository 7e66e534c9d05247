"""Cameras from `transforms.json`: known matrices, sizes, names, and rejected files."""

import math

import numpy as np
import pytest
from captures import rejects, to_opengl, write_transforms

from gsjax.cameras.camera import look_at
from gsjax.data.transforms import load_near_transforms, load_transforms
from gsjax.errors import InputError

PIXELS = {"fl_x": 500.0, "fl_y": 510.0, "cx": 310.0, "cy": 245.0, "w": 640, "h": 480}
ANGLE = {"camera_angle_x": 0.6911112070083618}
FOCAL = 0.5 / math.tan(0.5 * ANGLE["camera_angle_x"])  # per px of width
POSE = look_at(eye=(3.0, -2.0, 1.0), target=(0.1, 0.2, 0.3))


def frame(matrix=None, **more):
    matrix = np.eye(4) if matrix is None else np.asarray(matrix, np.float64)
    return {"transform_matrix": matrix.tolist(), **more}


def load_one(folder, *, size=None, frames=None, **content):
    path = write_transforms(folder, frames or [frame()], **content)
    [entry] = load_transforms(path, size=size)
    return entry.camera


def assert_K(camera, fx, fy, cx, cy):
    expected = np.asarray([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    np.testing.assert_allclose(np.asarray(camera.K), expected, rtol=1e-6)


@pytest.mark.parametrize("rows", [3, 4])
@pytest.mark.parametrize("scale", [1.0, 2.5])
@pytest.mark.filterwarnings("ignore:.*scaled")
def test_known_poses(tmp_path, rows, scale):
    matrix = to_opengl(POSE)[:rows]
    matrix[:3, :3] *= scale
    camera = load_one(tmp_path, frames=[frame(matrix)], **PIXELS)
    np.testing.assert_allclose(np.asarray(camera.viewmat), POSE, atol=1e-6)
    path = write_transforms(tmp_path, [frame(matrix)] * 2, **PIXELS)
    if scale != 1:
        with pytest.warns(UserWarning, match=r"2 frames are .*0 \(× 2\.5\)") as caught:
            load_transforms(path)
        assert caught[0].filename == __file__, "the caller's line"


def test_known_points_project_to_known_pixels(tmp_path):
    # At (0, 0, 5) looking down -z with y up, as OpenGL cameras do: a point to the right
    # and above the axis projects right of and *above* the image centre.
    matrix = np.eye(4)
    matrix[2, 3] = 5
    camera = load_one(tmp_path, frames=[frame(matrix)], **PIXELS)
    viewmat, K = (np.asarray(a, np.float64) for a in (camera.viewmat, camera.K))
    point = viewmat @ (0.5, 0.25, 1.0, 1.0)
    np.testing.assert_allclose(point[:3], (0.5, -0.25, 4.0), rtol=1e-6)
    u, v, w = K @ point[:3]
    np.testing.assert_allclose((u / w, v / w), (372.5, 213.125), rtol=1e-6)


def seen_at(viewmat, K, points):
    """Pixels of points, in the precision of the points."""
    viewmat, K = (np.asarray(a, points.dtype) for a in (viewmat, K))
    seen = (points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
    return seen[:, :2] / seen[:, 2:]


@pytest.mark.parametrize("count", [1, 5])
def test_far_cameras_are_translated(tmp_path, count):
    """At 10⁷ units, points keep their pixels to 1e-3 px in float32."""
    far = np.asarray([1e7, -3e6, 0.0])
    rng = np.random.default_rng(0)
    viewmats = [look_at(far + rng.normal(size=3) * 4, far) for _ in range(count)]
    frames = [frame(to_opengl(v)) for v in viewmats]
    entries, origin = load_near_transforms(write_transforms(tmp_path, frames, **PIXELS))
    assert (np.abs(origin - far)[:2] < 100).all()
    assert origin[2] == 0, "axis by axis"
    points = far + rng.normal(size=(50, 3)) / 2
    for viewmat, (_, camera) in zip(viewmats, entries):
        pixels = seen_at(viewmat, camera.K, points)
        found = seen_at(camera.viewmat, camera.K, np.float32(points - origin))
        np.testing.assert_allclose(found, pixels, atol=1e-3)


@pytest.mark.parametrize(
    ("content", "size", "expected"),
    [
        (PIXELS, None, (500, 510, 310, 245)),
        (PIXELS, (320, 120), (250, 127.5, 155, 61.25)),
        ({"fl_x": 500, "w": 640.0, "h": 480.0}, None, (500, 500, 320, 240)),
        (ANGLE | {"w": 800, "h": 600}, None, (800 * FOCAL, 800 * FOCAL, 400, 300)),
        (ANGLE, (400, 200), (400 * FOCAL, 400 * FOCAL, 200, 100)),
        # instant-ngp writes both, and its trainer uses the pixels.
        (ANGLE | PIXELS, None, (500, 510, 310, 245)),
    ],
)
def test_intrinsics(tmp_path, content, size, expected):
    camera = load_one(tmp_path, size=size, **content)
    assert (camera.width, camera.height) == (size or (content["w"], content["h"]))
    assert camera.lens.name == "pinhole"
    assert_K(camera, *expected)


def test_frames_override_the_top_level(tmp_path):
    frames = [frame(), frame(fl_x=100, w=64, h=32, cx=1.5), frame(fl_y=99)]
    frames.append(frame(camera_angle_x=math.pi / 2))
    entries = load_transforms(write_transforms(tmp_path, frames, **PIXELS))
    assert_K(entries[0].camera, 500, 510, 310, 245)
    assert_K(entries[1].camera, 100, 100, 1.5, 245)
    assert (entries[1].camera.width, entries[1].camera.height) == (64, 32)
    assert_K(entries[2].camera, 500, 99, 310, 245)
    assert_K(entries[3].camera, 320, 320, 310, 245)


def test_camera_models(tmp_path):
    lenses = dict.fromkeys(["OPENCV", "opencv", None], "pinhole")
    for model, lens in {**lenses, "ORTHOGRAPHIC": "orthographic"}.items():
        camera = load_one(tmp_path, camera_model=model, k1=0, p2=0.0, **PIXELS)
        assert camera.lens.name == lens


def test_distortion_gives_one_warning(tmp_path):
    frames = [frame(k2=0.1), frame(), frame(distortion_params=[0, 0.2])]
    path = write_transforms(tmp_path, frames, p1=-1e-4, k1=0, **PIXELS)
    expected = r"distortion \(distortion_params, k2, p1\) is ignored"
    with pytest.warns(UserWarning, match=expected) as caught:
        load_transforms(path)
    assert len(caught) == 1


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
    frames = [frame(file_path=path) for path in names]
    entries = load_transforms(write_transforms(tmp_path, frames, **PIXELS))
    found = [entry.name for entry in entries]
    assert found == [*names.values()]
    assert len({name.casefold() for name in found}) == len(found)
    for name in found:
        (tmp_path / f"{name}.png").write_bytes(b"")
    assert len(list(tmp_path.glob("*.png"))) == len(found)
    frames = [frame(file_path="a.png")] * 300
    entries = load_transforms(write_transforms(tmp_path, frames, **PIXELS))
    found = [entry.name for entry in entries]
    assert len(set(found)) == 300
    assert found[:3] == ["a", "a_1", "a_2"]


ORTHOGRAPHIC = {"fl_x": None, "fl_y": None, "camera_model": "ORTHOGRAPHIC"}
EYE = np.eye(4)
RAGGED = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1], [0, 0, 0, 1]]
SHEAR = np.asarray([[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
MOVED = np.asarray([[1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 1, 4], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        (None, "4 rows of 4 numbers, got missing"),
        ("eye", "4 rows of 4 numbers, got 'eye'"),
        ([1, 2, 3, 4], "4 rows of 4 numbers"),
        (np.eye(3).tolist(), "4 rows of 4 numbers"),
        (np.eye(5).tolist(), "4 rows of 4 numbers"),
        (RAGGED, "4 rows of 4 numbers"),
        ([["1", 0, 0, 0], *EYE.tolist()[1:]], "finite numbers"),
        ([[10**400, 0, 0, 0], *EYE.tolist()[1:]], "finite numbers"),
        (np.full((4, 4), np.nan).tolist(), "finite numbers"),
        ([[1e300] * 4] * 4, "finite numbers"),
        (MOVED.T.tolist(), "last row 0 0 0 1, .* transpose"),
        (SHEAR.tolist(), "expected a rotation"),
        (np.diag([1.0, 2.0, 1.0, 1.0]).tolist(), "expected a rotation"),
        (np.diag([0.0, 0.0, 0.0, 1.0]).tolist(), "expected a rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]).tolist(), "reflection"),
    ],
)
def test_bad_matrices(tmp_path, matrix, expected):
    frames = [frame(), {"transform_matrix": matrix}]
    path = write_transforms(tmp_path, frames, **PIXELS)
    place = r"transforms\.json: frames\[1\]: transform_matrix"
    rejects(f"{place}.*{expected}", load_transforms, path)


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({"fl_y": -3}, "focal lengths above 0, got 500, -3"),
        ({"fl_x": "500"}, "fl_x: expected a number, got '500'"),
        ({"fl_x": True}, "fl_x: expected a number, got True"),
        ({"cy": 10**400}, "cy: expected a number, got 1000"),
        ({"fl_x": 1e308, "w": 1, "size": (9, 9)}, r"fl_x: .* got 1e\+308"),
        ({"w": 0}, "image size .* got w 0, h 480"),
        ({"h": 3.5}, "image size .* got w 640, h 3.5"),
        ({"h": None}, "no image size: w is 640.*h is missing"),
        ({"w": None, "h": None}, "no image size.*--size WxH"),
        ({"fl_x": None, "fl_y": None}, "a focal length, fl_x.*got none"),
        ({"fl_x": None, "camera_angle_x": 0}, "camera_angle_x: .*radians.* got 0"),
        ({"fl_x": None, "camera_angle_x": 40.0}, "radians.* got 40"),
        ({**ORTHOGRAPHIC, **ANGLE}, "a focal length, fl_x, got none"),
        ({"camera_model": "OPENCV_FISHEYE"}, "camera_model .* supported: OPENCV, PIN"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model .* cannot be rendered"),
        ({"camera_model": ["OPENCV"]}, "camera_model .* cannot be rendered"),
        ({"is_fisheye": True}, "camera_model .* cannot be rendered"),
        ({"frames": [frame(file_path=7)]}, "file_path: expected text, got 7"),
    ],
)
def test_bad_intrinsics(tmp_path, more, expected):
    with pytest.raises(
        InputError, match=rf"transforms\.json: frames\[0\]: .*{expected}"
    ):
        load_one(tmp_path, **(PIXELS | more))


def test_bad_sizes_and_frames(tmp_path):
    for size in [(0, 4), (4, 4.5), (4,), (4, -1), ("4", 4)]:
        rejects("size: expected", load_one, tmp_path, **PIXELS, size=size)
    for frames in (None, {"0": 1}, [3]):
        path = write_transforms(tmp_path, frames)
        rejects(r"transforms\.json: .*frames.*expected", load_transforms, path)
