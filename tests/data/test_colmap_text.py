"""COLMAP's points as text, block by block: what one line at a time would give."""

import numpy as np
import pytest
from captures import scene_of_views

from gsjax.data import colmap_binary, colmap_text
from gsjax.data.colmap_writer import write_colmap
from gsjax.errors import InputError
from gsjax.io.numerals import BLOCK


def random_lines(count: int) -> list[str]:
    """Points with unsorted ids, some beyond what float64 holds, and short tracks."""
    rng = np.random.default_rng(0)
    ids = rng.permutation(count).astype(object)
    ids[: count // 10] += 2**64 - count
    lines = []
    for identity, xyz, rgb in zip(
        ids, rng.normal(size=(count, 3)), rng.integers(0, 256, (count, 3))
    ):
        track = rng.integers(0, 2**32, 2 * rng.integers(10))
        values = (identity, *map(float, xyz), *rgb, float(rng.uniform()), *track)
        lines.append(" ".join(map(str, values)))
    return lines


def one_by_one(lines: list[str]):
    rows = sorted((line.split() for line in lines), key=lambda words: int(words[0]))
    table = np.asarray([[float(word) for word in words[1:8]] for words in rows])
    ids = np.asarray([int(words[0]) for words in rows], np.uint64)
    lengths = [(len(words) - 8) // 2 for words in rows]
    return ids, table[:, :3], table[:, 3:6], table[:, 6], lengths


@pytest.mark.parametrize(
    "end", ["\n", "\r\n", "\r", "\n\n \n", "\n# a note, ünïcode\n"]
)
def test_the_same_points_as_line_by_line(tmp_path, end):
    lines = random_lines(9_000)
    path = tmp_path / "points3D.txt"
    text = "".join(["# 3D points", end, *(line + end for line in lines)])
    path.write_bytes(text.encode())
    assert len(text) > 3 * BLOCK
    points = colmap_text.read_points(path)
    for found, wanted in zip(points, one_by_one(lines), strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_the_line_is_named_in_any_block(tmp_path):
    lines = random_lines(9_000)
    path = tmp_path / "points3D.txt"
    for at in (0, 4_321, 8_999):
        bad = [*lines[:at], lines[at] + " 5", *lines[at + 1 :]]
        path.write_text("# a\n\n" + "\n".join(bad) + "\n")
        with pytest.raises(
            InputError, match=rf"points3D\.txt: line {at + 3}: the track"
        ):
            colmap_text.read_points(path)
        path.write_text("# a\n\n" + "\n".join([*lines[:at], "\uff11" + lines[at], ""]))
        with pytest.raises(
            InputError, match=rf"line {at + 3}: the point id is '\uff11"
        ):
            colmap_text.read_points(path)


def test_a_track_through_many_photographs(tmp_path):
    path = tmp_path / "points3D.txt"
    path.write_text("7 1 2 3 4 5 6 0.5" + " 1234567 54321" * 60_000 + "\n")
    assert colmap_text.read_points(path).track_lengths.tolist() == [60_000]


def test_many_2d_points(tmp_path):
    """Of any length: they are passed in pieces, within words too."""
    path = tmp_path / "images.txt"
    image = "{} 1 0 0 0 0 0 3 1 {}.png\n"
    for count in (BLOCK // 8, BLOCK // 8 + 1, 200_000):
        line = "1.5 2 -1" + " 3.25 41 17" * count + "\n"
        path.write_text(image.format(1, "a") + line + image.format(2, "b") + "\n")
        images = colmap_text.read_images(path)
        assert [found.name for found in images] == ["a.png", "b.png"]
        path.write_text(image.format(1, "a") + line.replace("\n", " 5\n"))
        wanted = f"line 2: {3 * count + 4} values, the last '5'"
        with pytest.raises(InputError, match=wanted):
            colmap_text.read_images(path)


def test_sorting_takes_no_copy_of_all(tmp_path):
    """Nor changes what is read: points of a binary file in another order."""
    scene = scene_of_views(points=50)
    write_colmap(tmp_path, scene)
    path = tmp_path / "points3D.bin"
    data = path.read_bytes()
    records = [data[8 + 51 * i :][:51] for i in range(50)]
    wanted = colmap_binary.read_points(path)
    path.write_bytes(data[:8] + b"".join(reversed(records)))
    for found, field in zip(colmap_binary.read_points(path), wanted, strict=True):
        np.testing.assert_array_equal(found, field)
