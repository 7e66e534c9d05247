"""Structure from motion: cameras that are known, datasets, photos, masks, videos."""

import json
import os
import re
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import save_photo
from conftest import DATA
from corner_room import (
    COUNT,
    FOCAL,
    HEIGHT,
    NAMES,
    TURNED,
    WIDTH,
    alike,
    blank,
    corner_view,
    leftovers,
    make_room,
    make_video,
    read,
    texture,
    viewmat_at,
    write_photo,
)

from gsjax import InputError
from gsjax.cli.main import main
from gsjax.data.colmap import load_colmap
from gsjax.data.photos import load_photo
from gsjax.data.video import sharpest_frames, sharpness
from gsjax.sfm import engine
from gsjax.sfm.mapping import _leave_out_impossible, exif_camera, extract
from gsjax.sfm.photos import Workshop, find_photos, prepare_photos
from gsjax.sfm.reconstruction import SfmSettings, run_sfm

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is absent")


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


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    return make_room(tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def solved(room, tmp_path_factory) -> Path:
    """The dataset that the command makes of it."""
    out = tmp_path_factory.mktemp("solved") / "new" / "dataset"
    assert main.main(["sfm", str(room), "-o", str(out)]) == 0
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


def test_same_again_to_the_bit_and_silently(solved, room, tmp_path, capfd, monkeypatch):
    """Also where progress is looked for all the time."""
    monkeypatch.setattr(engine, "_WAIT", 0.001)
    seen = []
    report = run_sfm(room, tmp_path / "again", tell=seen.append)
    assert report.problem is None
    assert seen[0] == f"reading {COUNT} photos"
    pairs = COUNT * (COUNT - 1) // 2
    found = [re.fullmatch(rf"matching pairs (\d+)/{pairs}", line) for line in seen]
    assert 0 < max(int(match[1]) for match in found if match) <= pairs
    assert capfd.readouterr() == ("", "")
    for file in sorted((solved / "sparse" / "0").iterdir()):
        again = tmp_path / "again" / "sparse" / "0" / file.name
        assert again.read_bytes() == file.read_bytes(), file.name
    assert not leftovers(tmp_path)


@pytest.mark.skipif(not (DATA / "kermit").is_dir(), reason="../shared/data/kermit")
def test_kermit_agrees_with_bundler(tmp_path, capsys):
    assert main.main(["sfm", str(DATA / "kermit"), "-o", str(tmp_path)]) == 0
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


def test_masks(room, tmp_path, capsys):
    masks, out = tmp_path / "masks", tmp_path / "out"
    masks.mkdir()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 3] = 0
    for i, name in enumerate(NAMES[:-1]):  # the last photo has none
        called = f"{name}.png" if i % 2 else Path(name).with_suffix(".png").name
        cv2.imwrite(str(masks / called), mask)
    args = ["sfm", str(room), "-o", str(out), "--masks", str(masks)]
    assert main.main(args) == 0
    assert f"{COUNT - 1} of {COUNT} photos have a mask" in capsys.readouterr().err
    with pytest.warns(UserWarning, match=f"masks: 1 of {COUNT} photographs have no"):
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


RED = (255, 0, 0)  # which is nowhere in the room


def transparent(pixels: np.ndarray, left: int, top=0, size=HEIGHT) -> np.ndarray:
    """RGBA in which a square is red, and not seen."""
    rgba = np.dstack([pixels, np.full(pixels.shape[:2], 255, np.uint8)])
    rgba[top : top + size, left : left + size] = (*RED, 127)
    return rgba


def grown(hidden: np.ndarray) -> np.ndarray:
    return cv2.dilate(hidden.astype(np.uint8), np.ones((5, 5))) > 0


def png_turned(path: Path, orientation: int) -> None:
    """Give a PNG an orientation in EXIF."""
    body = b"eXIf" + b"II*\0" + struct.pack("<IHHHII", 8, 1, 0x112, 3, 1, orientation)
    body += bytes(4)
    chunk = struct.pack(">I", len(body) - 4) + body
    chunk += struct.pack(">I", zlib.crc32(body))
    data = path.read_bytes()
    path.write_bytes(data[:33] + chunk + data[33:])


@pytest.mark.parametrize("orientation", range(1, 9))
def test_transparency_is_turned_as_the_colours_are(tmp_path, orientation):
    work = Workshop(tmp_path)
    for folder in work.photos, work.masks:
        folder.mkdir()
    path = tmp_path / "a.png"
    save_photo(path, transparent(corner_view(viewmat_at(0)), 20, 30, 90))
    png_turned(path, orientation)
    (made,) = prepare_photos([path], None, work, 0)
    pixels = read(work.photos / made.shot.file)
    if int(cv2.__version__.split(".")[0]) >= 5:  # older ones turn no PNG
        assert (pixels.shape[0] > pixels.shape[1]) == (orientation > 4)
    red = (pixels == RED).all(-1)
    assert red.sum() == 90 * 90
    np.testing.assert_array_equal(read(work.mask(made.shot.file)) == 0, grown(red))


@pytest.mark.parametrize("suffix", [".png", ".tiff", ".webp"])
def test_what_is_transparent_is_nowhere_to_be_seen(tmp_path, suffix):
    """No colour of it is in a pixel that counts, however much the photo is shrunk."""
    seen = []
    for name, hidden in (("a", RED), ("b", (0, 0, 255))):
        work = Workshop(tmp_path / name)
        work.folder.mkdir()
        for folder in work.photos, work.masks:
            folder.mkdir()
        rgba = transparent(corner_view(viewmat_at(0)), 21, 33, 90)
        rgba[rgba[..., 3] < 128, :3] = hidden
        encoding = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == ".webp" else []
        path = work.folder / f"photo{suffix}"
        cv2.imwrite(str(path), rgba[..., [2, 1, 0, 3]], encoding)
        (made,) = prepare_photos([path], None, work, 150)
        assert made.mask
        mask = read(work.mask(made.shot.file))
        pixels = read(work.photos / made.shot.file)
        assert 0.05 < (mask == 0).mean() < 0.2
        seen.append(np.where(mask[..., None] > 0, pixels, 0))
    np.testing.assert_array_equal(*seen)


def test_masks_and_transparency_both_count(tmp_path):
    work, masks = Workshop(tmp_path), tmp_path / "drawn"
    for folder in work.photos, work.masks, masks:
        folder.mkdir()
    plain = corner_view(viewmat_at(0))
    opaque = np.dstack([plain, np.full(plain.shape[:2], 128, np.uint8)])
    paths = [
        save_photo(tmp_path / "both.png", transparent(plain, 0, 0, 50)),
        save_photo(tmp_path / "alpha.png", transparent(plain, 0, 0, 50)),
        save_photo(tmp_path / "opaque.png", opaque),
        save_photo(tmp_path / "deep.png", opaque.astype(np.uint16) * 257),
    ]
    drawn = np.full((HEIGHT, WIDTH), 255, np.uint8)
    drawn[:, -60:] = 0
    cv2.imwrite(str(masks / "both.png"), (drawn > 0).astype(np.uint16))
    made = prepare_photos(paths, masks, work, 0)
    assert [photo.mask for photo in made] == [True, True, False, False]
    both, alpha, *others = (read(work.mask(photo.shot.file)) for photo in made)
    np.testing.assert_array_equal(both, np.minimum(alpha, drawn))
    assert (alpha == 0).sum() == 52 * 52
    assert all((mask == 255).all() for mask in others), "which COLMAP wants of each"


def test_transparent_photos_to_dataset(tmp_path, capsys):
    """What is hidden, the same in each photo, gives no features and is not learnt."""
    photos, out = tmp_path / "photos", tmp_path / "out"
    for i in range(4):
        pixels = corner_view(viewmat_at(i / (COUNT - 1)))
        rgba = transparent(pixels, 0, 0, 110)
        rgba[:110, :110, :3] = texture(7)[:110, :110]
        save_photo(photos / f"{i}.png", rgba)
    assert main.main(["sfm", str(photos), "-o", str(out)]) == 0
    assert "4 of 4 photos have a mask or are" in capsys.readouterr().err
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    views = views_of(out)
    assert len(views) == 4
    for view in views:
        photo = load_photo(view)
        assert photo.alpha is None
        assert photo.valid is not None
        assert not photo.valid[:105, :105].any()
        assert photo.valid[120:].all()
        assert photo.valid[:, 120:].all()
        image = model.find_image_with_name(view.name)
        places = np.array([point.xy for point in image.points2D])
        assert len(places) > 100
        assert (places.max(1) > 105).all()


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


PHONE = (b"Apple", b"iPhone 12")  # COLMAP has a table of sensors, and this one's


@pytest.mark.parametrize(
    ("focal_35mm", "focal_mm", "known"),
    [
        (0, (42, 10), True),
        (0, (0, 0), False),
        (0, (5, 0), False),
        (0, (1, 10**5), False),
        (65535, (42, 10), False),
        (1, (42, 10), False),
    ],
)
def test_a_focal_length_that_none_has_is_not_known(
    tmp_path, focal_35mm, focal_mm, known
):
    """COLMAP would place no photograph, or look for ever."""
    pixels, lens = corner_view(viewmat_at(0)), {"focal_mm": focal_mm, "camera": PHONE}
    write_photo(tmp_path / "a.jpg", pixels, 1, focal_35mm, **lens)
    camera, focal = exif_camera(tmp_path / "a.jpg")
    assert camera.startswith("Apple-iPhone 12")
    assert (focal is not None) == known
    if focal is not None:
        assert WIDTH / 2 < focal < 2 * WIDTH


def test_a_camera_that_there_cannot_be_is_not_placed(solved):
    model = pycolmap.Reconstruction(solved / "sparse" / "0")
    _leave_out_impossible(model, pycolmap.IncrementalMapperOptions())
    assert model.num_reg_images() == COUNT
    points, image = model.num_points3D(), next(iter(model.images.values()))
    image.camera.focal_length_x = -5e5
    gone = {i.name for i in model.images.values() if i.camera_id == image.camera_id}
    _leave_out_impossible(model, pycolmap.IncrementalMapperOptions())
    assert {i.name for i in model.images.values()} == set(NAMES) - gone
    assert model.num_points3D() < points
    assert all(i.num_points3D and i.has_pose for i in model.images.values())


# --- video ---


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("video") / "walk.avi"
    make_video(path)
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
    assert main.main(["sfm", str(video), "-o", str(out), "--frames", "6"]) == 0
    report = json.loads((out / "sfm.json").read_text())
    assert list(report["registered"]) == [f"frame_{i:06d}.jpg" for i in range(3, 30, 5)]
    assert report["settings"]["matcher"] == "sequential"
    assert len(load_colmap(out).views) == 6


def test_a_video_with_a_colon_in_its_name(video, tmp_path, monkeypatch):
    """Which FFmpeg takes for an address, where the path is relative."""
    monkeypatch.chdir(tmp_path)
    os.link(video, "10:30.avi")
    assert len(list(sharpest_frames(Path("10:30.avi"), 6))) == 6


def test_a_video_that_ends_early_is_told(video, monkeypatch):
    monkeypatch.setattr("gsjax.data.video._count", lambda _: 60)
    with pytest.warns(UserWarning, match="breaks off after 30 of 60 frames"):
        assert len(list(sharpest_frames(video, 6))) == 3
    monkeypatch.setattr("gsjax.data.video._count", lambda _: 31)
    assert len(list(sharpest_frames(video, 31))) == 30


def test_photos_follow_one_another_as_people_count(tmp_path):
    """Neighbours by name are matched: frame 9 stands beside frame 10."""
    names = [f"frame{i}.jpg" for i in range(8, 13)]
    for name in sorted(names):
        (tmp_path / name).write_bytes(b"")
    assert [path.name for path in find_photos(tmp_path)] == names


def test_names_are_utf_8(tmp_path):
    for name in (b"one.png", b"caf\xe9.png"):
        (tmp_path / os.fsdecode(name)).write_bytes(b"")
    with pytest.raises(InputError, match=r"'caf\\udce9.png' is not UTF-8; rename"):
        find_photos(tmp_path)


def test_a_video_that_breaks_off(video, tmp_path, monkeypatch):
    monkeypatch.setattr("gsjax.sfm.reconstruction.sharpest_frames", lambda *_: iter(()))
    with pytest.raises(InputError, match="only 0 frames"):
        run_sfm(video, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
