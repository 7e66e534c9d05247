"""Movies are read back: so many frames, about those pictures, at that speed."""

from pathlib import Path

import cv2
import numpy as np
import pytest

import gsjax
from gsjax.io.movies import encode_animation, played_rate, write_movie


def pictures(count=6, width=64, height=48):
    """A disc that moves over a gradient."""
    y, x = np.mgrid[:height, :width].astype(float)
    for index in range(count):
        near = np.hypot(x - 8 - 6 * index, y - height / 2) < 12
        color = np.stack([255 * x / width, 255 * y / height, 0 * x + 80], -1)
        yield np.where(near[..., None], (250, 220, 40), color).astype(np.uint8)


def animation_of(path):
    done, found = cv2.imdecodeanimation(
        np.frombuffer(path.read_bytes(), np.uint8)[None]
    )
    assert done
    return [frame[..., 2::-1] for frame in found.frames], list(found.durations)


def video_of(path):
    capture = cv2.VideoCapture(str(path))
    frames = []
    while (read := capture.read())[0]:
        frames.append(read[1][..., ::-1])
    return frames, capture.get(cv2.CAP_PROP_FPS)


def assert_alike(found, wanted, most):
    assert len(found) == len(wanted)
    for a, b in zip(found, wanted):
        assert a.shape == b.shape
        assert np.abs(a.astype(float) - b).mean() < most


@pytest.mark.parametrize(("suffix", "unit"), [(".gif", 10), (".webp", 1), (".WEBP", 1)])
@pytest.mark.parametrize(("width", "height"), [(64, 48), (33, 21)])
def test_animations(tmp_path, suffix, unit, width, height):
    wanted = list(pictures(6, width, height))
    path = tmp_path / "new" / f"a{suffix}"
    assert write_movie(path, iter(wanted), fps=24) == 6
    found, durations = animation_of(path)
    assert_alike(found, wanted, 6)
    assert abs(sum(durations) - 250) <= unit / 2
    assert max(durations) - min(durations) <= unit
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_name_with_a_colon(tmp_path, monkeypatch):
    """Which FFmpeg takes for an address, where the path is relative."""
    monkeypatch.chdir(tmp_path)
    assert write_movie(Path("2026-11-24T10:30/a.webm"), pictures(4)) == 4
    assert len(video_of(tmp_path / "2026-11-24T10:30" / "a.webm")[0]) == 4


def test_a_gif_is_not_faster_than_browsers_show(tmp_path):
    write_movie(tmp_path / "a.gif", pictures(4), fps=200)
    assert animation_of(tmp_path / "a.gif")[1] == [20] * 4
    assert played_rate(".gif", 200) == 1000 / 20
    assert (played_rate(".gif", 24), played_rate(".webp", 200)) == (24, 200)


@pytest.mark.parametrize(("width", "height"), [(64, 48), (65, 47), (33, 22), (1, 1)])
def test_webm_is_vp9_of_even_size(tmp_path, capfd, width, height):
    wanted = list(pictures(5, width, height))
    path = tmp_path / "a.webm"
    assert write_movie(path, iter(wanted), fps=12.5) == 5
    assert path.read_bytes()[:4] == b"\x1aE\xdf\xa3"  # a Matroska file
    assert b"V_VP9" in path.read_bytes()[:2000]
    found, fps = video_of(path)
    assert fps == 12.5
    even = height + height % 2, width + width % 2, 3
    assert found[0].shape == even
    assert_alike([f[:height, :width] for f in found], wanted, 10)
    assert capfd.readouterr().err == ""
    assert [p.name for p in tmp_path.iterdir()] == ["a.webm"]


@pytest.mark.parametrize("name", ["shots", "shots.png"])
def test_folder_of_pngs(tmp_path, name):
    wanted = list(pictures(3))
    assert write_movie(tmp_path / name, iter(wanted)) == 3
    folder = tmp_path / "shots"
    names = sorted(p.name for p in folder.iterdir())
    assert names == ["frame_0001.png", "frame_0002.png", "frame_0003.png"]
    for file, frame in zip(names, wanted):
        pixels = cv2.imread(str(folder / file))[..., ::-1]
        np.testing.assert_array_equal(pixels, frame)
    with pytest.raises(gsjax.InputError, match="has 3 frames"):
        write_movie(tmp_path / name, iter(wanted))
    assert write_movie(tmp_path / name, iter(wanted[:2]), overwrite=True) == 2
    assert len(list(folder.iterdir())) == 2
    (folder / "notes.txt").touch()
    with pytest.raises(gsjax.InputError, match=r"no frames \(notes.txt\)"):
        write_movie(tmp_path / name, iter(wanted), overwrite=True)
    assert (folder / "notes.txt").exists()


@pytest.mark.parametrize("suffix", [".gif", ".webm"])
def test_existing_files_stay(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"mine")
    with pytest.raises(gsjax.InputError, match="exists; pass --overwrite"):
        write_movie(path, pictures())
    assert path.read_bytes() == b"mine"
    write_movie(path, pictures(), overwrite=True)
    assert len(path.read_bytes()) > 100


@pytest.mark.parametrize("name", ["a.gif", "a.webm", "a.png"])
def test_a_failure_half_way_leaves_nothing(tmp_path, name):
    def failing():
        yield from pictures(2)
        raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        write_movie(tmp_path / name, failing())
    with pytest.raises(gsjax.InputError, match=r"frame 1 is \(8, 8, 3\), the first"):
        write_movie(tmp_path / name, [next(pictures()), np.zeros((8, 8, 3), np.uint8)])
    with pytest.raises(gsjax.InputError, match="uint8 is wanted"):
        write_movie(tmp_path / name, [np.zeros((4, 4, 3))])
    with pytest.raises(gsjax.InputError, match="no frames to write"):
        write_movie(tmp_path / name, [])
    assert not list(tmp_path.iterdir())


def test_a_video_cut_short_is_refused(tmp_path, monkeypatch):
    """As a full disk does it: the encoder says nothing."""

    class Cut:
        def __init__(self, path, *_):
            self.path = path

        def isOpened(self):
            return True

        def write(self, _):
            pass

        def release(self):
            with open(self.path, "wb") as file:
                file.write(b"\x1aE\xdf\xa3")

        fourcc = staticmethod(lambda *_: 0)

    monkeypatch.setattr(cv2, "VideoWriter", Cut)
    with pytest.raises(gsjax.InputError, match="of 6 frames could be written"):
        write_movie(tmp_path / "a.webm", pictures())
    assert not list(tmp_path.iterdir())


def test_names_and_speeds_that_are_refused(tmp_path):
    for name in ("a.mp4", "a.avi"):
        with pytest.raises(gsjax.InputError, match=r"\.gif, \.webp, \.webm, or \.png"):
            write_movie(tmp_path / name, pictures())
    for fps in (0, -3, float("nan")):
        with pytest.raises(gsjax.InputError, match="fps is"):
            write_movie(tmp_path / "a.gif", pictures(), fps=fps)
    (tmp_path / "file").touch()
    with pytest.raises(gsjax.InputError, match="is a file"):
        write_movie(tmp_path / "file", pictures())


def test_one_frame_is_an_animation(tmp_path):
    data = encode_animation(".webp", pictures(1), 10)
    (tmp_path / "a.webp").write_bytes(data)
    assert len(animation_of(tmp_path / "a.webp")[0]) == 1
