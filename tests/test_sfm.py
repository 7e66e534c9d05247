"""Structure from motion: cameras that are known, datasets, videos, masks and errors.

The photographs are made here: of the corner of a room, three planes of random texture,
by casting rays. So centres and focal length are known exactly.
"""

import json
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import DATA

from gsjax import InputError, cli, look_at
from gsjax.scene.colmap import load_colmap
from gsjax.scene.sfm import SfmSettings, run_sfm
from gsjax.scene.sfm_colmap import _watched, exif_camera, extract
from gsjax.scene.sfm_photos import Workshop, prepare_photos
from gsjax.scene.video import sharpest_frames, sharpness

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is absent")

WIDTH, HEIGHT, FOCAL, COUNT = 320, 240, 297.0, 6
NAMES = [f"photo {i}.jpg" for i in range(COUNT)]  # with a space
TURNED = 2  # this one is stored turned, with an EXIF orientation


def viewmat_at(turn: float) -> np.ndarray:
    """A camera in the corner x, y, z > 0, on an arc around it; ``turn`` in 0 … 1."""
    angle = 0.45 + 0.6 * turn
    eye = np.array([3.2 * np.cos(angle), 1.5 + 0.5 * turn, 3.2 * np.sin(angle)])
    return np.asarray(look_at(eye, (0.5, 0.6, 0.5)), np.float64)


def corner_view(viewmat: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """[H, W, 3] uint8 of the room's corner: the nearest of three planes, by rays."""
    width, height = round(WIDTH * scale), round(HEIGHT * scale)
    y, x = np.mgrid[:height, :width] + 0.5
    focal = FOCAL * scale
    rays = np.stack([(x - width / 2) / focal, (y - height / 2) / focal, x * 0 + 1], -1)
    rays = rays @ viewmat[:3, :3]
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    with np.errstate(divide="ignore"):
        depths = np.where(rays < -1e-9, -eye / rays, np.inf)
    plane = depths.argmin(-1)
    points = eye + rays * depths.min(-1)[..., None]
    picture = np.zeros((height, width, 3), np.uint8)
    for axis in range(3):
        a, b = (points[..., k].astype(np.float32) * 120 for k in range(3) if k != axis)
        wrap = cv2.BORDER_WRAP
        seen = cv2.remap(texture(axis), a, b, cv2.INTER_LINEAR, borderMode=wrap)
        picture[plane == axis] = seen[plane == axis]
    return picture


def texture(seed: int) -> np.ndarray:
    """Blobs of several sizes, which is what SIFT looks for."""
    rng = np.random.default_rng(seed)
    total = np.zeros((512, 512, 3))
    for size in (64, 128, 256):
        noise = rng.normal(0, 1, (size, size, 3)).astype(np.float32)
        total += cv2.resize(noise, (512, 512), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 45 * total, 0, 255).astype(np.uint8)


def exif(orientation: int, focal_35mm: int) -> bytes:
    """EXIF with an orientation, a camera, and a focal length for 35 mm film."""

    def ifd(entries, at):
        head, tail = struct.pack("<H", len(entries)), b""
        after = at + 2 + 12 * len(entries) + 4
        for tag, kind, count, value in entries:
            if len(value) > 4:
                where = struct.pack("<I", after + len(tail))
                tail += value + b"\0" * (len(value) % 2)
                value = where
            head += struct.pack("<HHI", tag, kind, count) + value.ljust(4, b"\0")
        return head + b"\0" * 4 + tail

    short = struct.Struct("<H").pack
    main = [
        (0x010F, 2, 6, b"Maker\0"),
        (0x0110, 2, 6, b"Model\0"),
        (0x0112, 3, 1, short(orientation)),
        (0x8769, 4, 1, struct.pack("<I", 8)),
    ]
    start = 8 + len(ifd(main, 8))
    main[-1] = (0x8769, 4, 1, struct.pack("<I", start))
    lens = [
        (0x920A, 5, 1, struct.pack("<II", 60, 10)),
        (0xA405, 3, 1, short(focal_35mm)),
    ]
    body = b"II*\0" + struct.pack("<I", 8) + ifd(main, 8) + ifd(lens, start)
    body = b"Exif\0\0" + body
    return b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body


def write_photo(path: Path, upright: np.ndarray, orientation=1, focal_35mm=0) -> None:
    """A JPEG of RGB pixels; of orientation 6 it is stored turned to the left."""
    stored = np.rot90(upright, 1) if orientation == 6 else upright
    quality = [cv2.IMWRITE_JPEG_QUALITY, 97]
    data = cv2.imencode(".jpg", np.ascontiguousarray(stored[..., ::-1]), quality)[1]
    data = data.tobytes()
    if focal_35mm or orientation != 1:
        data = data[:2] + exif(orientation, focal_35mm) + data[2:]
    path.write_bytes(data)


def blank(path: Path, seed: int | None = None) -> None:
    """A photo of nothing, or of noise that no other has."""
    pixels = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    if seed is not None:
        pixels = texture(100 + seed)[:HEIGHT, :WIDTH]
    write_photo(path, pixels)


def read(path: Path) -> np.ndarray:
    pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    return pixels[..., ::-1] if pixels.ndim == 3 else pixels


def alike(a: np.ndarray, b: np.ndarray) -> float:
    """Correlation of two pictures."""
    assert min(a.std(), b.std()) > 20, "neither is empty"
    return np.corrcoef(a.ravel(), b.ravel())[0, 1]


def views_of(dataset: Path):
    return sorted(load_colmap(dataset).views, key=lambda view: view.name)


def centre_errors(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Distances after the best similarity (Umeyama 1991), of the wanted's spread."""
    a, b = found - found.mean(0), wanted - wanted.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (s * sign.diagonal()).sum() / (a**2).sum()
    spread = np.sqrt((b**2).sum(1).mean())
    return np.linalg.norm(scale * a @ (u @ sign @ vt).T - b, axis=1) / spread


def leftovers(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if path.name.startswith(".gsjax")]


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """A folder of photographs with EXIF, one stored turned, and a file that is none."""
    folder = tmp_path_factory.mktemp("room")
    for i, name in enumerate(NAMES):
        pixels = corner_view(viewmat_at(i / (COUNT - 1)))
        write_photo(folder / name, pixels, 6 if i == TURNED else 1, 32)
    (folder / "notes.txt").write_text("not a photo")
    (folder / "._photo 0.jpg").write_text("of another system")
    return folder


@pytest.fixture(scope="module")
def solved(room, tmp_path_factory) -> Path:
    """The dataset that the command makes of it."""
    out = tmp_path_factory.mktemp("solved") / "new" / "dataset"
    assert cli.main(["sfm", str(room), "-o", str(out)]) == 0
    return out


# --- what comes out ---


def test_cameras_are_where_they_were(solved):
    views = views_of(solved)
    assert [view.name for view in views] == NAMES
    wanted = [viewmat_at(i / (COUNT - 1)) for i in range(COUNT)]
    wanted = np.stack([-m[:3, :3].T @ m[:3, 3] for m in wanted])
    found = np.stack([view.centre for view in views])
    assert centre_errors(found, wanted).max() < 0.01
    assert len(load_colmap(solved).points) > 300
    for view in views:
        assert view.lens is None
        np.testing.assert_allclose(view.K[[0, 1], [0, 1]], FOCAL, rtol=0.02)


def test_the_dataset_is_one_for_other_tools_too(solved):
    names = {p.relative_to(solved).as_posix() for p in solved.rglob("*")}
    assert {"images", "sparse/0", "sfm.json"} < names
    assert "masks" not in names
    model = pycolmap.Reconstruction(solved / "sparse" / "0")
    assert {camera.model_name for camera in model.cameras.values()} == {"PINHOLE"}
    assert model.num_cameras() == 1  # the turned photo is of the same camera
    model.update_point_3d_errors()  # with the written cameras and features
    assert model.compute_mean_reprojection_error() < 0.7
    camera = next(iter(model.cameras.values()))
    for i, name in enumerate(NAMES):
        pixels = read(solved / "images" / name)
        assert pixels.shape == (camera.height, camera.width, 3)
        assert pixels.shape[0] > 0.97 * HEIGHT
        wanted = corner_view(viewmat_at(i / (COUNT - 1)))
        assert alike(cv2.resize(wanted, pixels.shape[1::-1]), pixels) > 0.8, "upright"
        assert b"Exif" not in (solved / "images" / name).read_bytes()[:100]


def test_report(solved, room):
    report = json.loads((solved / "sfm.json").read_text())
    assert list(report["registered"]) == NAMES
    assert min(report["registered"].values()) > 50
    assert report["unregistered"] == {}
    assert report["source"] == str(room)
    assert report["points"] == len(load_colmap(solved).points)
    assert 0 < report["mean_reprojection_error"] < 0.7
    assert report["mean_track_length"] > 2
    assert report["settings"]["matcher"] == "exhaustive"
    phases = {"photos", "features", "matching", "mapping"}
    assert phases <= report["seconds"].keys()


def test_same_again_to_the_bit_and_silently(solved, room, tmp_path, capfd):
    seen = []
    report = run_sfm(room, tmp_path / "again", tell=seen.append)
    assert report.problem is None
    assert seen[0] == f"reading {COUNT} photos"
    assert capfd.readouterr() == ("", "")
    for file in sorted((solved / "sparse" / "0").iterdir()):
        again = tmp_path / "again" / "sparse" / "0" / file.name
        assert again.read_bytes() == file.read_bytes(), file.name
    assert not leftovers(tmp_path)


@pytest.mark.skipif(not (DATA / "kermit").is_dir(), reason="../shared/data/kermit")
def test_kermit_agrees_with_bundler(tmp_path, capsys):
    assert cli.main(["sfm", str(DATA / "kermit"), "-o", str(tmp_path)]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[-1].startswith("11 of 11 images registered")
    views = views_of(tmp_path)
    focals, rotations, centres, middles = bundler(DATA / "kermit" / "bundle.out", 11)
    both = focals > 0  # Bundler did not place two of them
    assert both.sum() == 9
    # Bundler has a focal length for each photo, 637 to 729 px, though EXIF says that
    # all are of one: it goes with the distance, and is made the same before comparing.
    ours = np.array([view.K[0, 0] for view in views])[both]
    distance = (ours / focals[both])[:, None]
    wanted = middles[both] + (centres[both] - middles[both]) * distance
    found = np.stack([view.centre for view in views])[both]
    errors = centre_errors(found, wanted)
    assert np.sqrt((errors**2).mean()) < 0.02
    assert errors.max() < 0.04
    seen = np.stack([view.viewmat[:3, :3] for view in views])[both]
    u, _, vt = np.linalg.svd(np.einsum("nki,nkj->ij", rotations[both], seen))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt  # between the two worlds
    cosines = (np.einsum("nij,nij->n", seen, rotations[both] @ turn) - 1) / 2
    assert np.degrees(np.arccos(cosines)).max() < 1


def bundler(path: Path, count: int):
    """Focal lengths, rotations and centres in OpenCV's axes, and middles of what the
    cameras see."""
    lines = path.read_text().splitlines()[2:]
    cameras = np.array(" ".join(lines[: 5 * count]).split(), float).reshape(count, 15)
    rotations = cameras[:, 3:12].reshape(count, 3, 3)
    centres = -np.einsum("nji,nj->ni", rotations, cameras[:, 12:])
    seen: list[list] = [[] for _ in range(count)]
    points = lines[5 * count :]
    for place, track in zip(points[::3], points[2::3]):
        for camera in track.split()[1::4]:
            seen[int(camera)].append(np.array(place.split(), float))
    middles = [np.median(points, 0) if points else np.zeros(3) for points in seen]
    return cameras[:, 0], np.diag([1, -1, -1]) @ rotations, centres, np.stack(middles)


# --- photographs ---


def test_photos_are_upright_small_and_know_their_focal_length(room, tmp_path):
    work = Workshop(tmp_path)
    work.photos.mkdir()
    paths = [room / NAMES[TURNED], room / NAMES[0]]
    made = prepare_photos(paths, None, work, max_size=160)
    for photo, path, i in zip(made, paths, (TURNED, 0)):
        assert (photo.shot.width, photo.shot.height) == (160, 120)
        pixels = read(work.photos / photo.shot.file)
        wanted = cv2.resize(
            corner_view(viewmat_at(i / (COUNT - 1))),
            (160, 120),
            interpolation=cv2.INTER_AREA,
        )
        assert alike(pixels, wanted) > 0.95
        assert photo.name == path.name
        assert photo.shot.focal == pytest.approx(32 / 35 * 160, rel=0.05)
    assert made[0].shot.camera == made[1].shot.camera
    assert exif_camera(room / NAMES[0])[0].startswith("Maker-Model")
    blank(tmp_path / "plain.jpg")
    assert exif_camera(tmp_path / "plain.jpg") == ("", None)


def test_cameras_are_shared_as_asked(tmp_path):
    photos, sizes = tmp_path / "photos", (1.0, 1.0, 0.75, 1.0)
    photos.mkdir()
    for i, scale in enumerate(sizes):
        pixels = corner_view(viewmat_at(i / 5), scale)
        write_photo(photos / f"{i}.jpg", pixels, 1, 32 if i < 3 else 28)
    for settings, wanted in ((SfmSettings(), 3), (SfmSettings(camera="per-image"), 4)):
        report = run_sfm(photos, tmp_path / settings.camera, settings)
        assert len(report.registered) == 4
        assert report.cameras == wanted
    with pytest.raises(InputError, match="--camera auto"):
        run_sfm(photos, tmp_path / "single", SfmSettings(camera="single"))


def test_masks(room, tmp_path):
    masks, out = tmp_path / "masks", tmp_path / "out"
    masks.mkdir()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 3] = 0
    for i, name in enumerate(NAMES[:-1]):  # the last photo has none
        called = f"{name}.png" if i % 2 else Path(name).with_suffix(".png").name
        cv2.imwrite(str(masks / called), mask)
    args = ["sfm", str(room), "-o", str(out), "--masks", str(masks)]
    assert cli.main(args) == 0
    views = views_of(out)
    assert [view.mask is not None for view in views] == [True] * (COUNT - 1) + [False]
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    for view in views[:-1]:
        assert view.mask is not None
        written = read(view.mask)
        assert written.shape == (view.height, view.width)
        assert set(np.unique(written)) == {0, 255}
        assert 0.6 < (written > 0).mean() < 0.75
        image = model.find_image_with_name(view.name)
        left = np.array([p.xy[0] for p in image.points2D])
        assert len(left) > 100
        assert left.min() > 0.32 * WIDTH
    image = model.find_image_with_name(NAMES[-1])
    assert min(p.xy[0] for p in image.points2D) < 0.2 * WIDTH


def test_the_focal_length_of_exif_is_where_colmap_begins(room, tmp_path):
    work = Workshop(tmp_path)
    work.photos.mkdir()
    blank(tmp_path / "plain.jpg", seed=1)
    paths = [room / NAMES[0], tmp_path / "plain.jpg", room / NAMES[1]]
    shots = [p.shot for p in prepare_photos(paths, None, work, max_size=0)]
    extract(tmp_path / "database.db", work.photos, None, shots, print)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        images = sorted(database.read_all_images(), key=lambda image: image.name)
        cameras = [database.read_camera(image.camera_id) for image in images]
    assert [image.name for image in images] == [shot.file for shot in shots]
    assert [c.has_prior_focal_length for c in cameras] == [True, False, True]
    assert cameras[0].camera_id == cameras[2].camera_id
    assert cameras[0].focal_length == pytest.approx(32 / 35 * WIDTH, rel=0.05)


# --- video ---


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    """Thirty frames on the arc, all but every fifth blurred."""
    path = tmp_path_factory.mktemp("video") / "walk.avi"
    code = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), code, 10, (WIDTH, HEIGHT))
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no MJPG")
    for i in range(30):
        pixels = corner_view(viewmat_at(i / 29))[..., ::-1]
        writer.write(pixels if i % 5 == 3 else cv2.GaussianBlur(pixels, (0, 0), 3))
    writer.release()
    return path


def test_the_sharpest_frames_are_chosen(video):
    assert [f.number for f in sharpest_frames(video, 6)] == [3, 8, 13, 18, 23, 28]
    frames = list(sharpest_frames(video, 3, max_size=64))
    assert all(f.pixels.shape == (48, 64, 3) for f in frames)
    assert len({f.number // 10 for f in frames}) == 3
    assert all(f.number % 5 == 3 for f in frames)
    assert [f.number for f in sharpest_frames(video, 1000)] == list(range(30))
    sharp = corner_view(viewmat_at(0))
    assert sharpness(sharp) > 3 * sharpness(cv2.GaussianBlur(sharp, (0, 0), 2))


def test_video_to_dataset(video, tmp_path):
    out = tmp_path / "out"
    assert cli.main(["sfm", str(video), "-o", str(out), "--frames", "6"]) == 0
    report = json.loads((out / "sfm.json").read_text())
    assert list(report["registered"]) == [f"frame_{i:06d}.jpg" for i in range(3, 30, 5)]
    assert report["settings"]["matcher"] == "sequential"
    assert len(load_colmap(out).views) == 6


# --- what goes wrong ---


def test_what_is_not_registered_has_a_reason(room, tmp_path, capsys):
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    for name in NAMES[:3]:
        shutil.copy(room / name, photos)
    blank(photos / "empty.jpg")
    blank(photos / "noise.jpg", seed=1)
    assert cli.main(["sfm", str(photos), "-o", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("empty.jpg  not registered: only 0 features")
    assert re.match(r"noise.jpg  not registered: none of its \d+ features", lines[1])
    assert re.match(r"photo 0.jpg  registered, \d+ points", lines[2])
    assert lines[-1].startswith("3 of 5 images registered")

    for seed in range(2, 4):  # and now they are fewer than half
        blank(photos / f"noise {seed}.jpg", seed)
    assert cli.main(["sfm", str(photos), "-o", str(out), "--overwrite"]) == 4
    told = capsys.readouterr()
    assert "gsjax: error: only 3 of 7 images could be registered" in told.err
    assert "overlap" in told.err
    assert len(told.out.splitlines()) == 8
    assert len(load_colmap(out).views) == 3, "the best model is written all the same"


def test_no_model_leaves_nothing(tmp_path, capsys):
    photos = tmp_path / "photos"
    photos.mkdir()
    for seed in range(3):
        blank(photos / f"{seed}.jpg", seed)
    assert cli.main(["sfm", str(photos), "-o", str(tmp_path / "out")]) == 4
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.startswith("gsjax: error: no cameras could be found for the 3 images")
    assert [p.name for p in tmp_path.iterdir()] == ["photos"]


def test_only_our_own_is_replaced(solved, room, tmp_path, capsys):
    out = tmp_path / "dataset"
    shutil.copytree(solved, out)
    (out / "mine.ply").write_text("mine")
    before = (out / "sfm.json").read_bytes()
    args = ["sfm", str(room), "-o", str(out)]
    assert cli.main(args) == 3
    assert "images: exists; pass --overwrite" in capsys.readouterr().err
    assert (out / "sfm.json").read_bytes() == before
    (out / "images" / "stale.jpg").write_text("")
    assert cli.main([*args, "--overwrite"]) == 0
    assert (out / "mine.ply").read_text() == "mine"
    assert sorted(p.name for p in (out / "images").iterdir()) == NAMES
    (out / "sfm.json").unlink()
    capsys.readouterr()
    assert cli.main([*args, "--overwrite"]) == 3
    assert "was not made by gsjax sfm" in capsys.readouterr().err
    inside = ["sfm", str(out / "images"), "-o", str(out), "--overwrite"]
    assert cli.main(inside) == 3
    assert "lies where the dataset would be written" in capsys.readouterr().err
    assert not leftovers(tmp_path)


def two_photos(folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    for seed in range(2):
        blank(folder / f"{seed}.jpg", seed)
    return folder


def damaged(folder: Path) -> list[str]:
    photos = two_photos(folder / "p")
    data = (photos / "0.jpg").read_bytes()
    (photos / "half.jpg").write_bytes(data[: len(data) // 2])
    (photos / "none.png").write_bytes(b"")
    (photos / "text.jpg").write_text("not an image")
    return [str(photos)]


def with_file(name: str, content: bytes = b"x"):
    def make(folder: Path) -> list[str]:
        photos = two_photos(folder / "p")
        (photos / name).write_bytes(content)
        return [str(photos)]

    return make


def same_name(folder: Path) -> list[str]:
    photos = two_photos(folder / "p")
    for suffix in (".bmp", ".tif"):
        cv2.imwrite(str(photos / f"a{suffix}"), np.zeros((9, 9), np.uint8))
    return [str(photos)]


def one_photo(folder: Path) -> list[str]:
    (two_photos(folder / "p") / "1.jpg").unlink()
    return [str(folder / "p")]


def junk_video(folder: Path) -> list[str]:
    (folder / "a.mp4").write_bytes(b"junk" * 99)
    return [str(folder / "a.mp4")]


def mask_of(shape: tuple[int, int] | None, name: str = "0.png"):
    def make(folder: Path) -> list[str]:
        photos, masks = two_photos(folder / "p"), folder / "m"
        masks.mkdir()
        (masks / name).write_bytes(b"")
        if shape is not None:
            cv2.imwrite(str(masks / name), np.full(shape, 255, np.uint8))
        return [str(photos), "--masks", str(masks)]

    return make


def photos_and(*more: str):
    return lambda folder: [str(two_photos(folder / "p")), *more]


BAD = {
    "missing": (3, lambda f: [str(f / "none")], "no such folder"),
    "one photo": (3, one_photo, "1 photos"),
    "damaged": (3, damaged, "half.jpg, none.png, text.jpg: cannot be read"),
    "heic": (3, with_file("IMG_1.HEIC"), ".HEIC photos are not read here; convert"),
    "same name": (3, same_name, "the same name"),
    "image": (3, lambda f: [str(two_photos(f) / "0.jpg")], "is a single image"),
    "video": (3, junk_video, "nor a video that OpenCV reads"),
    "no masks": (3, photos_and("--masks", "nowhere"), "no such folder of masks"),
    "other masks": (3, mask_of((9, 9), "b.png"), "no mask for any photo"),
    "mask size": (3, mask_of((320, 240)), "the mask is 240x320"),
    "bad mask": (3, mask_of(None), "this mask cannot be read"),
    "max size": (2, photos_and("--max-size", "3"), "--max-size 3"),
    "frames": (2, photos_and("--frames", "1"), "--frames 1"),
    "seed": (2, photos_and("--seed", "-1"), "--seed"),
    "matcher": (2, photos_and("--matcher", "best"), "best"),
}


@pytest.mark.parametrize("name", BAD)
def test_an_error_is_one_line_a_code_and_no_file(name, tmp_path, capfd):
    code, make, text = BAD[name]
    args = make(tmp_path)
    assert cli.main(["sfm", *args, "-o", str(tmp_path / "out")]) == code
    lines = capfd.readouterr().err.splitlines()
    assert text in lines[-1]
    assert all(line.startswith("gsjax: ") for line in lines)
    assert not (tmp_path / "out").exists()
    assert not leftovers(tmp_path)


def test_without_pycolmap_the_remedy_is_named(room, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert cli.main(["sfm", str(room), "-o", str(tmp_path / "out")]) == 6
    assert "pip install pycolmap" in capsys.readouterr().err


def test_interrupted_leaves_what_was_there(solved, room, tmp_path, monkeypatch, capsys):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("gsjax.scene.sfm.write_dataset", interrupt)
    assert cli.main(["sfm", str(room), "-o", str(tmp_path / "out")]) == 130
    assert list(tmp_path.iterdir()) == []
    shutil.copytree(solved, tmp_path / "out")
    before = sorted((p, p.stat().st_mtime_ns) for p in (tmp_path / "out").rglob("*"))
    args = ["sfm", str(room), "-o", str(tmp_path / "out"), "--overwrite"]
    assert cli.main(args) == 130
    after = sorted((p, p.stat().st_mtime_ns) for p in (tmp_path / "out").rglob("*"))
    assert after == before
    assert not leftovers(tmp_path)
    assert capsys.readouterr().err.splitlines()[-1] == "gsjax: error: interrupted"


@pytest.mark.skipif(os.name == "nt", reason="signals to oneself are POSIX")
def test_ctrl_c_cancels_colmap():
    cancelled = threading.Event()

    def work(token):
        for _ in range(1000):
            if token.is_cancelled:
                cancelled.set()
                return
            time.sleep(0.01)

    timer = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        _watched(work, lambda: "", print)
    assert cancelled.wait(1)


def test_importing_the_commands_is_light():
    heavy = "{'cv2', 'pycolmap', 'gsjax.scene.sfm', 'gsjax.views'}"
    code = f"import gsjax.cli, sys; assert not {heavy} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True)
