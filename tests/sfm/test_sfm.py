"""Structure from motion: known cameras, written datasets, masks, videos."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import DATA
from corner_room import (
    COUNT,
    FOCAL,
    HEIGHT,
    NAMES,
    WIDTH,
    corner_view,
    exif,
    make_room,
    make_video,
    read,
    viewmat_at,
    write_photo,
)
from PIL import Image

from gsjax import InputError
from gsjax.cli.main import main
from gsjax.data.dataset import load_dataset
from gsjax.data.times import require_times
from gsjax.data.video import sharpest_frames, sharpness
from gsjax.sfm.mapping import deregister_implausible
from gsjax.sfm.reconstruction import SfmSettings, run_sfm

pycolmap = pytest.importorskip("pycolmap", reason="pycolmap is absent")


def centre_errors(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return distances after the best similarity (Umeyama 1991), relative to spread."""
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
    """The dataset that the command makes of the room."""
    out = tmp_path_factory.mktemp("solved") / "new" / "dataset"
    assert main(["sfm", str(room), "-o", str(out)]) == 0
    return out


def test_cameras_match_the_known_ones(solved):
    views = load_dataset(solved).views
    assert [view.name for view in views] == NAMES
    wanted = [viewmat_at(i / (COUNT - 1)) for i in range(COUNT)]
    wanted = np.stack([-m[:3, :3].T @ m[:3, 3] for m in wanted])
    found = np.stack([view.centre for view in views])
    assert centre_errors(found, wanted).max() < 0.01
    assert len(load_dataset(solved).points) > 300
    for view in views:
        assert view.lens is not None
        assert view.lens.model == "opencv"
        np.testing.assert_allclose(view.K[[0, 1], [0, 1]], FOCAL, rtol=0.02)


def test_dataset_is_valid_for_colmap_upright_and_reported(solved, room):
    names = {p.relative_to(solved).as_posix() for p in solved.rglob("*")}
    assert {"images", "sparse/0", "sfm.json"} < names
    assert "masks" not in names
    model = pycolmap.Reconstruction(solved / "sparse" / "0")
    kinds = {camera.model_name for camera in model.cameras.values()}
    assert kinds == {"SIMPLE_RADIAL"}
    assert model.num_cameras() == 1  # shared with the rotated photograph
    model.update_point_3d_errors()  # with the written cameras and features
    assert model.compute_mean_reprojection_error() < 0.7
    camera = next(iter(model.cameras.values()))
    for i, name in enumerate(NAMES):
        pixels = read(solved / "images" / name)
        assert pixels.shape == (camera.height, camera.width, 3)
        assert pixels.shape[0] == HEIGHT
        wanted = cv2.resize(corner_view(i), pixels.shape[1::-1])
        assert np.corrcoef(wanted.ravel(), pixels.ravel())[0, 1] > 0.8
        assert b"Exif" not in (solved / "images" / name).read_bytes()[:100]
    report = json.loads((solved / "sfm.json").read_text())
    assert list(report["registered"]) == NAMES
    assert min(report["registered"].values()) > 50
    assert (report["unregistered"], report["source"]) == ({}, str(room))
    assert report["points"] == len(load_dataset(solved).points)
    assert 0 < report["mean_reprojection_error"] < 0.7
    assert report["mean_track_length"] > 2
    assert report["settings"]["matcher"] == "exhaustive"


def test_heic_and_avif_in_folders_become_a_dataset(tmp_path):
    """With their EXIF used, and none of it in what is written."""
    heif = pytest.importorskip("pillow_heif", reason="needs gsjax[heic]")
    heif.register_heif_opener()
    places = ("a/0.heic", "a/1.avif", "b/deep/2.heic", "b/3.jpg", "4.avif")
    block = exif(1, 32)[4:]
    for i, place in enumerate(places):
        path = tmp_path / "photos" / place
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".jpg":
            write_photo(path, corner_view(i), 1, 32)
        else:
            Image.fromarray(corner_view(i)).save(path, quality=95, exif=block)
    out = tmp_path / "out"
    report = run_sfm(tmp_path / "photos", out)
    names = [str(Path(place).with_suffix(".jpg")) for place in places]
    assert sorted(report.registered) == sorted(names)
    assert report.cameras == 1  # by the same camera and focal length
    dataset = load_dataset(out)
    assert sorted(view.name for view in dataset.views) == sorted(names)
    for view in dataset.views:
        assert b"Maker" not in view.image.read_bytes()
        np.testing.assert_allclose(view.K[0, 0], FOCAL, rtol=0.03)


def test_overwriting_repeats_bits_silently_and_keeps_other_files(
    solved, room, tmp_path, capfd
):
    out = tmp_path / "dataset"
    shutil.copytree(solved, out)
    (out / "mine.ply").write_text("mine")
    (out / "images" / "stale.jpg").write_text("")
    shutil.rmtree(out / "sparse")
    lines = []
    report = run_sfm(room, out, overwrite=True, progress=lines.append)
    assert report.problem is None
    half = replace(report, unregistered=dict.fromkeys("abcde", ""))
    assert half.problem is None
    less = replace(report, unregistered=dict.fromkeys("abcdef", ""))
    less.settings["matcher"] = "sequential"
    assert re.match("only 5 of 11 images .*--matcher exhaustive", less.problem or "")
    assert lines[0] == f"reading {COUNT} photos"
    assert capfd.readouterr() == ("", "")
    for file in sorted((solved / "sparse" / "0").iterdir()):
        again = out / "sparse" / "0" / file.name
        assert again.read_bytes() == file.read_bytes(), file.name
    assert (out / "mine.ply").read_text() == "mine"
    assert sorted(p.name for p in (out / "images").iterdir()) == NAMES
    assert not list(tmp_path.glob(".gsjax*"))


def test_foreign_or_source_files_are_never_replaced(solved, room, tmp_path, capsys):
    out = tmp_path / "dataset"
    shutil.copytree(solved, out)
    before = (out / "sfm.json").read_bytes()
    args = ["sfm", str(room), "-o", str(out)]
    assert main(args) == 3
    assert "images: exists; pass --overwrite" in capsys.readouterr().err
    assert (out / "sfm.json").read_bytes() == before
    (out / "masks").mkdir()
    for more in (["--masks", str(out / "masks")], []):
        source = room if more else out / "images"
        told = ["sfm", str(source), "-o", str(out), "--overwrite", *more]
        assert main(told) == 3
        assert "lies where the dataset would be written" in capsys.readouterr().err
    (out / "sfm.json").unlink()
    assert main([*args, "--overwrite"]) == 3
    assert "was not made by gsjax sfm" in capsys.readouterr().err
    assert not list(tmp_path.glob(".gsjax*"))


def test_interrupted_run_changes_nothing(solved, room, tmp_path, monkeypatch, capsys):
    photos, out = tmp_path / "photos", tmp_path / "out"

    def interrupt(*_, **__):
        assert list(out.glob(".gsjax*")), "work is on the disk of the output"
        raise KeyboardInterrupt

    photos.mkdir()
    for name in NAMES[:3]:
        shutil.copy(room / name, photos)
    shutil.copytree(solved, out)
    before = sorted((p, p.stat().st_mtime_ns) for p in tmp_path.rglob("*"))
    args = ["sfm", str(photos), "-o", str(out), "--overwrite"]
    for step in ("extract_features", "write_dataset"):
        with monkeypatch.context() as patch:
            patch.setattr(f"gsjax.sfm.reconstruction.{step}", interrupt)
            assert main(args) == 130
        after = sorted((p, p.stat().st_mtime_ns) for p in tmp_path.rglob("*"))
        assert [p for p, _ in after] == [p for p, _ in before]
        assert after[1:] == before[1:]
    assert capsys.readouterr().err.splitlines()[-1] == "gsjax: error: interrupted"


def test_implausible_cameras_are_deregistered(solved):
    model = pycolmap.Reconstruction(solved / "sparse" / "0")
    deregister_implausible(model, pycolmap.IncrementalMapperOptions())
    assert model.num_reg_images() == COUNT
    points, image = model.num_points3D(), next(iter(model.images.values()))
    image.camera.focal_length = -5e5
    gone = {i.name for i in model.images.values() if i.camera_id == image.camera_id}
    deregister_implausible(model, pycolmap.IncrementalMapperOptions())
    assert {i.name for i in model.images.values()} == set(NAMES) - gone
    assert model.num_points3D() < points


@pytest.mark.skipif(not (DATA / "kermit").is_dir(), reason="../shared/data/kermit")
def test_kermit_agrees_with_bundler(tmp_path, capsys):
    args = ["sfm", str(DATA / "kermit"), "-o", str(tmp_path), "--max-size", "400"]
    assert main(args) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[-1].startswith("11 of 11 images registered")
    views = load_dataset(tmp_path).views
    focals, rotations, centres, middles = bundler(DATA / "kermit" / "bundle.out", 11)
    both = focals > 0  # Bundler did not register two of them
    assert both.sum() == 9
    # Bundler estimates a focal length for each photo (637 to 729 px) although EXIF has
    # one for all. It trades off against distance, so distances are rescaled first.
    ours = np.array([view.K[0, 0] for view in views])[both]
    distance = (ours * 640 / 400 / focals[both])[:, None]
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
    """Return focal lengths, rotations and centres (OpenCV axes), and the median of the
    points that each camera sees."""
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


def test_cameras_are_shared_by_size_and_focal_length(tmp_path):
    photos, sizes = tmp_path / "photos", (1.0, 1.0, 0.75, 1.0)
    photos.mkdir()
    for i, scale in enumerate(sizes):
        write_photo(photos / f"{i}.jpg", corner_view(i, scale), 1, 32 if i < 3 else 28)
    report = run_sfm(photos, tmp_path / "auto")
    assert len(report.registered) == 4
    assert report.cameras == 3
    with pytest.raises(InputError, match="--camera auto"):
        run_sfm(photos, tmp_path / "single", SfmSettings(camera="single"))


def test_masks_and_a_camera_per_image(room, tmp_path, capsys):
    masks, out = tmp_path / "masks", tmp_path / "out"
    masks.mkdir()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 3] = 0
    for i, name in enumerate(NAMES[:-1]):  # the last photo has none
        called = f"{name}.png" if i % 2 else Path(name).with_suffix(".png").name
        cv2.imwrite(str(masks / called), mask)
    args = ["sfm", str(room), "-o", str(out), "--masks", str(masks), "--undistort"]
    assert main([*args, "--camera", "per-image"]) == 0
    assert f"{COUNT - 1} of {COUNT} photos have a mask" in capsys.readouterr().err
    with pytest.warns(UserWarning, match=f"1 of {COUNT}"):
        views = load_dataset(out).views
    assert [view.mask is not None for view in views] == [True] * (COUNT - 1) + [False]
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    assert model.num_cameras() == COUNT
    assert {c.model_name for c in model.cameras.values()} == {"PINHOLE"}
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


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    """A relative path with a colon, which FFmpeg would take for an address."""
    path = tmp_path_factory.mktemp("video") / "10:30.avi"
    make_video(path)
    return path


def test_the_sharpest_frames_are_chosen(video, monkeypatch):
    monkeypatch.chdir(video.parent)
    relative = Path(video.name)
    assert [f.number for f in sharpest_frames(relative, 6)] == [3, 8, 13, 18, 23, 28]
    frames = list(sharpest_frames(video, 3, max_size=64))
    assert all(f.pixels.shape == (48, 64, 3) for f in frames)
    assert len({f.number // 10 for f in frames}) == 3
    assert all(f.number % 5 == 3 for f in frames)
    assert [f.number for f in sharpest_frames(video, 1000)] == list(range(30))
    sharp = corner_view()
    assert sharpness(sharp) > 3 * sharpness(cv2.GaussianBlur(sharp, (0, 0), 2))


def test_a_video_of_something_that_moves(video, tmp_path, capsys):
    """Frames keep their times, and a mask hides nothing from training."""
    out, masks = tmp_path / "out", tmp_path / "masks"
    number = [frame.number for frame in sharpest_frames(video, 5)][2]
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, : WIDTH // 4] = 0
    masks.mkdir()
    cv2.imwrite(str(masks / f"frame_{number:06d}.png"), mask)
    words = ["--frames", "5", "--moving", "--masks", str(masks)]
    assert main(["sfm", str(video), "-o", str(out), *words]) == 0
    told = capsys.readouterr().out
    assert "the masks of 1 of 5 frames and geometric verification" in told
    report = json.loads((out / "sfm.json").read_text())
    dataset = require_times(load_dataset(out))
    assert len(report["registered"]) == len(dataset.views) == 5
    assert report["settings"]["matcher"] == "sequential"
    assert not (out / "masks").exists()
    numbers = np.asarray([int(view.name[-10:-4]) for view in dataset.views])
    times = np.asarray([view.time for view in dataset.views])
    np.testing.assert_allclose(times, (numbers - numbers[0]) / np.ptp(numbers))
    rate = cv2.VideoCapture(str(video)).get(cv2.CAP_PROP_FPS)
    assert dataset.duration is not None
    np.testing.assert_allclose(dataset.duration * rate, np.ptp(numbers), rtol=1e-6)
    assert main(["sfm", str(masks), "-o", str(tmp_path / "no"), "--moving"]) == 2
    assert "photographs have no times" in capsys.readouterr().err


def test_truncated_video(video, tmp_path, monkeypatch):
    monkeypatch.setattr("gsjax.data.video._count", lambda _: 60)
    with pytest.warns(UserWarning, match="30 of 60 frames"):
        assert len(list(sharpest_frames(video, 6))) == 3
    monkeypatch.setattr("gsjax.sfm.reconstruction.sharpest_frames", lambda *_: iter(()))
    with pytest.raises(InputError, match="only 0 frames"):
        run_sfm(video, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
