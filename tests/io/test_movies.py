"""Movies decode to their frames and appear complete or not at all; depth pictures."""

import importlib.util
import resource
import sys
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from captures import rejects

import gsjax
from gsjax.io.images import depth_picture
from gsjax.io.movies import encode_animation, played_rate, write_movie

needs_av = pytest.mark.skipif(
    importlib.util.find_spec("av") is None, reason="needs gsjax[movies]"
)


def pictures(count=6, width=64, height=48):
    """A disc that moves over a gradient."""
    y, x = np.mgrid[:height, :width].astype(float)
    for index in range(count):
        near = np.hypot(x - 8 - 6 * index, y - height / 2) < 12
        color = np.stack([255 * x / width, 255 * y / height, 0 * x + 80], -1)
        yield np.where(near[..., None], (250, 220, 40), color).astype(np.uint8)


def animation_of(path):
    done, found = cv2.imreadanimation(str(path))
    assert done
    return [frame[..., 2::-1] for frame in found.frames], list(found.durations)


def video_of(path):
    capture = cv2.VideoCapture(str(path))
    frames = []
    while (read := capture.read())[0]:
        frames.append(read[1][..., ::-1])
    return frames, capture.get(cv2.CAP_PROP_FPS)


def psnr(found, expected) -> float:
    apart = np.asarray(found, float) - np.asarray(expected)
    return float(-10 * np.log10(np.mean(np.square(apart)) / 255**2))


def assert_alike(found, expected, most):
    assert len(found) == len(expected)
    for a, b in zip(found, expected):
        assert a.shape == b.shape
        assert np.abs(a.astype(float) - b).mean() < most


@pytest.mark.parametrize(
    ("suffix", "unit", "width", "height"),
    [(".gif", 10, 64, 48), (".webp", 1, 33, 21), (".WEBP", 1, 64, 48)],
)
def test_animations_round_trip(tmp_path, suffix, unit, width, height):
    expected = list(pictures(6, width, height))
    path = tmp_path / "new" / f"a{suffix}"
    assert write_movie(path, iter(expected), fps=24) == 6
    found, durations = animation_of(path)
    assert_alike(found, expected, 6)
    assert abs(sum(durations) - 250) <= unit / 2
    assert max(durations) - min(durations) <= unit
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_gifs_have_at_most_50_frames_per_second(tmp_path):
    write_movie(tmp_path / "a.gif", pictures(4), fps=200)
    assert animation_of(tmp_path / "a.gif")[1] == [20] * 4
    assert played_rate(".gif", 200) == 1000 / 20
    assert (played_rate(".gif", 24), played_rate(".webp", 200)) == (24, 200)
    (tmp_path / "a.webp").write_bytes(encode_animation(".webp", pictures(1), 10))
    assert len(animation_of(tmp_path / "a.webp")[0]) == 1


@pytest.mark.parametrize(("width", "height"), [(65, 47), (64, 48), (1, 1)])
def test_webm_is_vp9_of_even_size(tmp_path, capfd, width, height):
    expected = list(pictures(5, width, height))
    path = tmp_path / "a.webm"
    assert write_movie(path, iter(expected), fps=12.5) == 5
    assert path.read_bytes()[:4] == b"\x1aE\xdf\xa3"  # a Matroska file
    assert b"V_VP9" in path.read_bytes()[:2000]
    found, fps = video_of(path)
    assert fps == 12.5
    assert found[0].shape == (height + height % 2, width + width % 2, 3)
    assert_alike([f[:height, :width] for f in found], expected, 10)
    assert capfd.readouterr().err == ""
    assert [p.name for p in tmp_path.iterdir()] == ["a.webm"]


@needs_av
@pytest.mark.parametrize(("width", "height"), [(65, 47), (64, 48), (1, 1)])
@pytest.mark.parametrize("fps", [12.5, 24000 / 1001, 0.1])
def test_mp4_is_h264_of_even_size(tmp_path, width, height, fps):
    expected = list(pictures(5, width, height))
    path = tmp_path / "a.mp4"
    assert write_movie(path, iter(expected), fps=fps) == 5
    found, rate = video_of(path)
    np.testing.assert_allclose(rate, fps, rtol=1e-12)
    even = ((0, 0), (0, height % 2), (0, width % 2), (0, 0))
    assert psnr(found, np.pad(expected, even, "edge")) > 28  # chroma of edges
    head = path.read_bytes()
    assert 0 < head.find(b"avc1") < head.find(b"mdat"), "the index comes first"
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


@needs_av
def test_mp4_of_a_smooth_picture_shows_no_loss(tmp_path):
    y, x, time = np.mgrid[:90, :160, :8] / 90
    waves = 0.5 + 0.5 * np.sin([3 * x + 2 * time, 2 * y - time, 2 * x * y - time])
    expected = np.rint(255 * waves.transpose(3, 1, 2, 0)).astype(np.uint8)
    write_movie(tmp_path / "a.mp4", expected)
    assert psnr(video_of(tmp_path / "a.mp4")[0], expected) > 41


@needs_av
def test_mp4_keeps_colours(tmp_path):
    """BT.709, as it is tagged, also for the reader of another library."""
    import av

    values = np.random.default_rng(0).integers(0, 256, (6, 9, 3))
    values[:2] = [[[0, 0, 0]], [[255, 255, 255]]]
    frame = values.astype(np.uint8).repeat(16, 0).repeat(16, 1)
    path = tmp_path / "a.mp4"
    write_movie(path, [frame] * 3)
    with av.open(str(path)) as file:
        (stream,) = file.streams.video
        tags = [stream.colorspace, stream.color_primaries, stream.color_trc]
        assert [*tags, stream.color_range] == [1, 1, 1, 1]
        planes = next(file.decode(video=0)).to_ndarray().astype(float)
    for found in video_of(path)[0]:
        middles = found[8::16, 8::16].astype(int)
        assert np.abs(middles - values).max() <= 3
        assert np.abs(middles - values).mean() <= 1
    red, green, blue = np.moveaxis(frame / 255, -1, 0)  # of ITU-R BT.709
    luma = 16 + 219 * (0.2126 * red + 0.7152 * green + 0.0722 * blue)
    assert np.abs(planes[:96] - luma)[8::16, 8::16].max() <= 1


@pytest.mark.parametrize("name", ["shots", "shots.png"])
def test_folders_of_pngs(tmp_path, name):
    expected = list(pictures(3))
    assert write_movie(tmp_path / name, iter(expected)) == 3
    folder = tmp_path / "shots"
    names = sorted(p.name for p in folder.iterdir())
    assert names == ["frame_0001.png", "frame_0002.png", "frame_0003.png"]
    for file, frame in zip(names, expected):
        pixels = cv2.imread(str(folder / file))[..., ::-1]
        np.testing.assert_array_equal(pixels, frame)
    rejects("holds 3 frames", write_movie, tmp_path / name, iter(expected))
    assert write_movie(tmp_path / name, iter(expected[:2]), overwrite=True) == 2
    assert len(list(folder.iterdir())) == 2
    (folder / "notes.txt").touch()
    with pytest.raises(gsjax.InputError, match=r"other than frames \(notes.txt\)"):
        write_movie(tmp_path / name, iter(expected), overwrite=True)
    assert (folder / "notes.txt").exists()


def test_an_existing_file_is_replaced_only_when_asked(tmp_path, monkeypatch):
    """Also by a relative name that FFmpeg would take for a network address."""
    monkeypatch.chdir(tmp_path)
    path = Path("2026-11-24T10:30/a.webm")
    path.parent.mkdir()
    path.write_bytes(b"mine")
    rejects("exists; pass --overwrite", write_movie, path, pictures())
    assert path.read_bytes() == b"mine"
    write_movie(path, pictures(), overwrite=True)
    assert len(video_of(tmp_path / path)[0]) == 6


@contextmanager
def largest_file(size: int):
    """Context in which no file can be larger, as if the disk were full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@needs_av
def test_an_mp4_that_does_not_fit_is_refused(tmp_path):
    """Whether the frames exceed the space, or the index alone."""
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, (96, 96, 3), np.uint8) for _ in range(8)]
    path = tmp_path / "a.mp4"
    write_movie(path, noise)
    whole = path.read_bytes()
    for size in (4096, len(whole) // 2, len(whole) - 1):
        with (
            largest_file(size),
            pytest.raises(gsjax.InputError, match="cannot be written: File too large"),
        ):
            write_movie(path, noise, overwrite=True)
        assert path.read_bytes() == whole
        assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]
    with largest_file(len(whole)):
        write_movie(path, noise, overwrite=True)
    wide = [np.zeros((2, 17_000, 3), np.uint8)]
    rejects(
        "cannot encode frames of 17000 × 2 px", write_movie, tmp_path / "b.mp4", wide
    )
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_without_av_the_error_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(gsjax.errors.MissingExtraError, match=r"gsjax\[movies\]"):
        write_movie(tmp_path / "a.mp4", failing())
    assert not list(tmp_path.iterdir())


def failing():
    yield from pictures(2)
    raise RuntimeError("no more")


BLACK = np.zeros((8, 8, 3), np.uint8)
REFUSED = [
    (failing, 24, RuntimeError, "no more"),
    (lambda: [next(pictures()), BLACK], 24, ValueError, "frame 1: expected the shape"),
    (lambda: [np.zeros((4, 4, 3))], 24, ValueError, "frame 0: expected uint8"),
    (lambda: [], 24, ValueError, "at least one frame"),
    (pictures, float("nan"), ValueError, "fps: expected"),
    (pictures, 0, ValueError, "fps: expected"),
]


@pytest.mark.parametrize(
    "name",
    ["a.gif", "a.webm", "a.png", pytest.param("a.mp4", marks=needs_av), "a.mov"],
)
def test_refused_frames_leave_nothing(tmp_path, name):
    for frames, fps, error, message in REFUSED:
        if name.endswith("mov"):
            error, message = ValueError, r"expected a suffix of \.mp4, \.webm, \.webp"
        with pytest.raises(error, match=message):
            write_movie(tmp_path / name, frames(), fps=fps)
    assert not list(tmp_path.iterdir())


def test_a_truncated_video_is_refused(tmp_path, monkeypatch):
    """The encoder does not report a full disk."""

    def writer(path, *_):
        Path(path).write_bytes(b"\x1aE\xdf\xa3")
        return Mock()

    monkeypatch.setattr(cv2, "VideoWriter", Mock(side_effect=writer))
    with pytest.raises(gsjax.InputError, match="of 6 frames could be written"):
        write_movie(tmp_path / "a.webm", pictures())
    assert not list(tmp_path.iterdir())


def test_depth_pictures_of_no_depth_and_of_a_plane():
    assert not depth_picture(np.zeros((2, 3))).pixels.any()
    flat = depth_picture(np.full((2, 3), 2.0))
    assert (flat.pixels == 1).all()
    assert (flat.near, flat.far) == (2, 2)
