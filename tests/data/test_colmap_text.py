"""COLMAP's text files: blocks give the same as lines, whatever their length."""

from functools import cache

import numpy as np
import pytest
from captures import rejects

from gsjax.data import colmap_text
from gsjax.errors import InputError
from gsjax.io.numerals import BLOCK


@cache
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


@cache
def one_by_one(count: int):
    """Return the fields of the same points, parsed line by line."""
    lines = random_lines(count)
    rows = sorted((line.split() for line in lines), key=lambda words: int(words[0]))
    table = np.asarray([[float(word) for word in words[1:8]] for words in rows])
    ids = np.asarray([int(words[0]) for words in rows], np.uint64)
    lengths = [(len(words) - 8) // 2 for words in rows]
    return ids, table[:, :3], table[:, 3:6], table[:, 6], lengths


@pytest.mark.parametrize(
    "end", ["\n", "\r\n", "\r", "\n\n \n", "\n# a note, ünïcode\n"]
)
def test_blocks_give_the_same_points_as_lines(tmp_path, end):
    lines = random_lines(9_000)
    path = tmp_path / "points3D.txt"
    text = "".join(["# 3D points", end, *(line + end for line in lines)])
    path.write_bytes(text.encode())
    assert len(text) > 3 * BLOCK
    points = colmap_text.read_points(path)
    for found, expected in zip(points, one_by_one(len(lines)), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_errors_name_the_line_in_any_block(tmp_path):
    lines = random_lines(9_000)
    path = tmp_path / "points3D.txt"
    for at in (0, 4_321, 8_999):
        bad = [*lines[:at], lines[at] + " 5", *lines[at + 1 :]]
        path.write_text("# a\n\n" + "\n".join(bad) + "\n")
        with pytest.raises(
            InputError, match=rf"points3D\.txt: line {at + 3}: expected a track"
        ):
            colmap_text.read_points(path)
        path.write_text("# a\n\n" + "\n".join([*lines[:at], "\uff11" + lines[at], ""]))
        with pytest.raises(
            InputError, match=rf"line {at + 3}: .* as the point id, got '\uff11"
        ):
            colmap_text.read_points(path)


def test_a_track_of_many_photographs(tmp_path):
    path = tmp_path / "points3D.txt"
    path.write_text("7 1 2 3 4 5 6 0.5" + " 1234567 54321" * 60_000 + "\n")
    assert colmap_text.read_points(path).track_lengths.tolist() == [60_000]


def test_lines_of_2d_points_have_any_length(tmp_path):
    path = tmp_path / "images.txt"
    image = "{} 1 0 0 0 0 0 3 1 {}.png\n"
    for count in (0, BLOCK // 8, 100_000):
        line = "1.5 2 -1" + " 3.25 41 17" * count + "\n"
        path.write_text(image.format(1, "a") + line + image.format(2, "b") + "\n")
        images = colmap_text.read_images(path)
        assert [found.name for found in images] == ["a.png", "b.png"]
        path.write_text(image.format(1, "a") + line.replace("\n", " 5\n"))
        expected = f"line 2: .* got {3 * count + 4} values, the last '5'"
        rejects(expected, colmap_text.read_images, path)
