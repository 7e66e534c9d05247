"""Times of views: D-NeRF's lists, HyperNeRF's captures, videos, fixed cameras."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import DATA

from gsjax.cameras.camera import look_at
from gsjax.data.dataset import load_dataset
from gsjax.data.splits import split_views
from gsjax.data.times import FrameTimes, require_times, write_times
from gsjax.data.transforms import load_transforms
from gsjax.errors import InputError
from gsjax.synthetic.moving import (
    MovingDemoSettings,
    held_out_moments,
    write_moving_dataset,
)

TINY = MovingDemoSettings(
    cameras=2, times=3, photos=2, held_out=2, width=16, height=12, samples=1, points=9
)


def write_photo(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full((6, 8, 3), 99, np.uint8))


def published_set(folder: Path, times: list, split="train") -> Path:
    """Write a camera list with the keys and the axes of D-NeRF's published files."""
    frames = []
    for index, time in enumerate(times):
        name = f"./{split}/r_{index:03d}"
        write_photo(folder / f"{name}.png")
        matrix = np.eye(4)
        matrix[:3, 3] = index, 0, 4
        frame = {
            "file_path": name,
            "rotation": 0.0314,
            "transform_matrix": matrix.tolist(),
        }
        frames.append(frame if time is None else {**frame, "time": time})
    content = {"camera_angle_x": 0.6911112070083618, "frames": frames}
    path = folder / f"transforms_{split}.json"
    path.write_text(json.dumps(content))
    return path


def test_times_of_a_published_list_are_kept(tmp_path):
    published_set(tmp_path, [0.0, 0.25, 0.5, 0.75])
    published_set(tmp_path, [0.1, 0.9], "test")
    dataset = require_times(load_dataset(tmp_path))
    times = {view.name: view.time for view in dataset.views}
    assert times["train/r_003.png"] == 0.75
    assert times["test/r_001.png"] == 0.9
    train, test = split_views(dataset.views)
    assert (len(train), len(test)) == (4, 2)
    view = dataset.views[-1]
    np.testing.assert_allclose(view.centre, (3, 0, 4))
    np.testing.assert_allclose(view.viewmat[2, :3], (0, 0, -1))  # OpenGL axes
    np.testing.assert_allclose(view.K[0, 0], 4 / np.tan(0.6911112070083618 / 2))


def test_the_demo_writes_the_same_form(tmp_path):
    write_moving_dataset(tmp_path, TINY)
    dataset = load_dataset(tmp_path)
    assert len(dataset.views) == 2 * 3 + 2 + 2
    train, test = split_views(dataset.views)
    moments = held_out_moments(TINY)
    for index, moment in zip(test, moments):
        view = dataset.views[index]
        assert view.time == moment.time
        np.testing.assert_allclose(view.viewmat, moment.viewmat, atol=1e-12)
        others = [dataset.views[i] for i in train]
        assert min(abs(view.time - other.time) for other in others) > 0.2
        centres = np.stack([other.centre for other in others])
        assert np.linalg.norm(centres - view.centre, axis=1).min() > 0.3
    entries = load_transforms(tmp_path / "transforms_test.json")
    assert [entry.time for entry in entries] == [moment.time for moment in moments]
    with pytest.raises(InputError, match="exists"):
        write_moving_dataset(tmp_path, TINY)


def test_other_units_are_mapped_to_0_and_1(tmp_path):
    published_set(tmp_path, [12, 20, 16, 28])
    views = load_dataset(tmp_path).views
    np.testing.assert_allclose([view.time for view in views], [0, 0.5, 0.25, 1])


def bad_times():
    return {
        "2 of 4 views have no time": [0.0, None, 0.5, None],
        "a number, got 'late'": [0.0, "late", 0.5, 1.0],
        "all 3 views are of one time": [0.5, 0.5, 0.5],
        "its views have no times": [None, None],
    }


@pytest.mark.parametrize("message", bad_times())
def test_bad_times_are_told(tmp_path, message):
    published_set(tmp_path, bad_times()[message])
    with pytest.raises(InputError, match=message):
        require_times(load_dataset(tmp_path))


def test_files_of_hypernerf(tmp_path):
    ids = [f"{i:06d}" for i in range(4)]
    rotation = look_at((1, 2, 3), (0, 0, 0))[:3, :3]
    for index, name in enumerate(ids):
        write_photo(tmp_path / "rgb" / "2x" / f"{name}.png")
        camera = {
            "orientation": rotation.tolist(),
            "position": [1.0, 2.0, 3.0 + index],
            "focal_length": 20.0,
            "principal_point": [8.5, 6.0],
            "skew": 0.0,
            "pixel_aspect_ratio": 1.1,
            "radial_distortion": [0.1, 0.02, 0.003],
            "tangential_distortion": [0.001, 0.002],
            "image_size": [16, 12],
        }
        path = tmp_path / "camera" / f"{name}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(camera))
    listed = {"ids": ids, "train_ids": ids[:2], "val_ids": ids[2:3]}
    (tmp_path / "dataset.json").write_text(json.dumps(listed))
    entries = {
        name: {"warp_id": 7 + 2 * i, "camera_id": 0} for i, name in enumerate(ids)
    }
    entries[ids[1]]["time_id"] = 10
    metadata = tmp_path / "metadata.json"
    metadata.write_text(json.dumps(entries))
    np.save(tmp_path / "points.npy", np.ones((5, 3), np.float32))

    dataset = load_dataset(tmp_path)
    assert [view.split for view in dataset.views] == ["train", "train", "test"]
    np.testing.assert_allclose([view.time for view in dataset.views], [0, 0.75, 1])
    view = dataset.views[1]
    np.testing.assert_allclose(view.centre, (1, 2, 4), atol=1e-9)
    np.testing.assert_allclose(view.viewmat[:3, :3], rotation, atol=1e-9)
    np.testing.assert_allclose(view.K, [[20, 0, 8.5], [0, 22, 6], [0, 0, 1]])
    assert view.lens is not None
    assert view.lens.coefficients == (0.1, 0.02, 0.001, 0.002, 0.003)
    assert view.image.parent.name == "2x"
    assert dataset.points.shape == (5, 3)
    with pytest.raises(InputError, match="1x"):
        load_dataset(tmp_path, factor=1)
    del entries[ids[0]]["warp_id"]
    metadata.write_text(json.dumps(entries))
    with pytest.raises(InputError, match="a number time_id, got missing"):
        load_dataset(tmp_path)
    entries[ids[0]]["warp_id"] = 1
    metadata.write_text(json.dumps(entries))
    missing = tmp_path / "rgb" / "2x" / f"{ids[2]}.png"
    missing.unlink()
    with pytest.raises(InputError, match="1 of 3 photographs are missing"):
        load_dataset(tmp_path)
    with pytest.warns(UserWarning, match="left out: 000002"):
        assert len(load_dataset(tmp_path, skip_missing=True).views) == 2
    (tmp_path / "camera" / f"{ids[0]}.json").write_text("{}")
    with pytest.raises(InputError, match="orientation: expected finite numbers"):
        load_dataset(tmp_path)


def fixed_cameras(folder: Path, counts: list[int]) -> None:
    """Write poses of cameras, and a folder of numbered frames for each."""
    rows = []
    for camera, count in enumerate(counts):
        block = np.asarray([[0, 1, 0, camera, 6], [1, 0, 0, 0, 8], [0, 0, -1, 0, 9.0]])
        rows.append([*block.ravel(), 1.0, 9.0])
        for frame in range(count):
            write_photo(folder / f"cam{camera:02d}" / "images" / f"{frame:04d}.png")
    np.save(folder / "poses_bounds.npy", np.asarray(rows))


def test_frames_of_fixed_cameras(tmp_path):
    fixed_cameras(tmp_path, [3, 3, 3])
    dataset = load_dataset(tmp_path)
    assert len(dataset.views) == 9
    assert all(view.time is None for view in dataset.views)
    timed = require_times(dataset)
    assert [view.time for view in timed.views] == [0, 0.5, 1] * 3
    _, test = split_views(timed.views)
    assert {timed.views[i].name.split("/")[0] for i in test} == {"cam00"}
    np.testing.assert_allclose(timed.views[4].centre, (1, 0, 0))


def test_cameras_of_different_lengths_are_told(tmp_path):
    fixed_cameras(tmp_path, [3, 2, 3])
    with pytest.raises(InputError, match=r"cam01/images has 2 and cam00/images has 3"):
        require_times(load_dataset(tmp_path))


def test_seconds_of_a_video(tmp_path):
    """`times.json` has precedence, gives the duration, and must increase."""
    published_set(tmp_path, [0.0, 0.0, 0.0])
    path, seconds = tmp_path / "times.json", [2.0, 3.0, 6.0]
    names = [f"train/r_{i:03d}.png" for i in range(3)]
    write_times(path, FrameTimes(dict(zip(names, seconds))))
    dataset = load_dataset(tmp_path)
    assert dataset.duration == 4.0
    np.testing.assert_allclose([v.time for v in dataset.views], [0, 0.25, 1])
    write_times(path, FrameTimes(dict(zip(names, [2.0, 6.0, 3.0]))))
    with pytest.raises(InputError, match="times must increase"):
        load_dataset(tmp_path)
    write_times(path, FrameTimes(dict(zip(names[:2], seconds))))
    with pytest.raises(InputError, match=f"no time for the photograph {names[2]}"):
        load_dataset(tmp_path)
    path.rename(tmp_path.parent / path.name)  # that of another dataset
    try:
        assert load_dataset(tmp_path).duration is None
    finally:
        (tmp_path.parent / path.name).rename(path)
    path.write_text('{"seconds": {"a.png": "soon"}}')
    with pytest.raises(InputError, match="a time in seconds"):
        load_dataset(tmp_path)


def test_two_frames_of_one_number_are_told(tmp_path):
    fixed_cameras(tmp_path, [2, 2])
    write_photo(tmp_path / "cam00" / "images" / "a0001.png")
    write_photo(tmp_path / "cam01" / "images" / "0002.png")
    with pytest.raises(InputError, match="two frames of number 1"):
        require_times(load_dataset(tmp_path))


def test_a_real_capture_with_times():
    folder = DATA / "captures" / "moving"
    if not folder.exists():
        pytest.skip("captures/moving is absent (../shared/data)")
    dataset = require_times(load_dataset(folder, poses_only=True))
    numbers = [int(Path(view.name).stem) for view in dataset.views]
    times = np.asarray([view.time for view in dataset.views])
    np.testing.assert_allclose(times, np.asarray(numbers) / 79, atol=1e-8)
    still = replace(dataset, views=tuple(replace(v, time=0.3) for v in dataset.views))
    with pytest.raises(InputError, match="of one time"):
        require_times(still)
